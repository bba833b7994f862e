"""PX4 ULog (`.ulg`) through pyulog (extra ``logs``): the board's sensors and the autopilot's own attitude.

Inertial samples are `sensor_combined`, whose rates and forces are means over the sample. What aids is satellite fixes,
magnetometer and barometer, each at the time at which it was true: its time stamp less the delay that the autopilot's own filter
takes for it. Standard deviations are those that the receiver states; the others are those of the autopilot's filter.
"""

import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drivers.can.aiding import AidingArray
from drivers.logs.imu_log import ImuLog, make_log
from nav.aiding import Kind, aiding_rows
from nav.errors import HilError
from nav.increments import FloatArray, IntArray

GAUSS = 1e-4
"""T."""
_NEVER = 0x7FFFFFFF
"""Relative time stamp of a sensor that has not spoken."""
_REPEATED_US = 1000
"""A measurement that is repeated with the next inertial sample has the same time but for rounding."""
_DEFAULTS = {
    "EKF2_GPS_DELAY": 110.0,  # ms
    "EKF2_MAG_DELAY": 0.0,
    "EKF2_BARO_DELAY": 0.0,
    "EKF2_MAG_NOISE": 0.05,  # Gs
    "EKF2_BARO_NOISE": 3.5,  # m
    "EKF2_GPS_V_NOISE": 0.3,  # m/s
    "EKF2_MAG_DECL": 0.0,  # deg
}
"""What PX4 takes where the log does not say."""
_TOPICS = (
    *("sensor_combined", "vehicle_attitude", "vehicle_gps_position", "sensor_gps"),
    *("vehicle_magnetometer", "vehicle_air_data"),
)
_Data = Mapping[str, Any]
_Measured = tuple[AidingArray, IntArray]


def read_ulog(path: Path) -> ImuLog:
    """The first IMU of a ULog, all that aids it, and `vehicle_attitude`.

    Raises
    ------
    HilError
        pyulog is missing, the file cannot be read or is no ULog, or it lacks `sensor_combined` or `vehicle_attitude`.
    """
    try:
        from pyulog import ULog
    except ImportError as error:
        raise HilError("reading ULog needs pyulog: pip install 'dtg-hil[logs]'") from error
    try:
        with _Torn(io.FileIO(path)) as file:
            log = ULog(file, list(_TOPICS))
    except OSError as error:
        raise HilError(f"log {path}: {error.strerror}") from error
    except Exception as error:  # pyulog raises whatever the bytes provoke
        raise HilError(f"log {path}: not a readable ULog: {error}") from error
    topics = {(topic.name, topic.multi_id): topic.data for topic in log.data_list}
    said = {name: _stated(log.initial_parameters.get(name), value) for name, value in _DEFAULTS.items()}
    try:
        for name in ("sensor_combined", "vehicle_attitude"):
            if (name, 0) not in topics or len(topics[name, 0]["timestamp"]) < 2:
                raise HilError(f"it has no topic {name} with samples")
        imu, attitude = topics["sensor_combined", 0], topics["vehicle_attitude", 0]
        return make_log(
            _times(imu),
            _columns(imu, "gyro_rad", 3),
            _columns(imu, "accelerometer_m_s2", 3),
            _times(attitude),
            _columns(attitude, "q", 4),
            list(_measured(topics, said)),
            math.radians(said["EKF2_MAG_DECL"]),
        )
    except KeyError as error:
        raise HilError(f"log {path}: a topic lacks its column {error}") from error
    except HilError as error:
        raise HilError(f"log {path}: {error}") from error


class _Torn(io.BufferedReader):
    """A file that may end within a message, which pyulog would go back over whole, past its start, and read again for ever."""

    _lacked = 0

    def read(self, size: int | None = -1) -> bytes:
        """What is there of `size` bytes."""
        found = super().read(size)
        self._lacked = max((size or 0) - len(found), 0)
        return found

    def seek(self, offset: int, whence: int = 0) -> int:
        """Go back over what was read, when asked to go back over what the last read asked for."""
        back, self._lacked = offset + self._lacked if whence == io.SEEK_CUR else offset, 0
        return super().seek(back, whence)


def _stated(value: object, default: float) -> float:
    """A parameter of the log, the default where it is no number."""
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else default


def _times(data: _Data) -> IntArray:
    times: IntArray = data["timestamp"].astype(np.int64)
    return times


def _columns(data: _Data, name: str, count: int) -> FloatArray:
    return np.stack([data[f"{name}[{i}]"] for i in range(count)], axis=1).astype(float)


def _measured(topics: Mapping[tuple[str, int], _Data], said: Mapping[str, float]) -> list[_Measured]:
    found = []
    names = {name for name, _ in topics}
    fixes = "vehicle_gps_position" if "vehicle_gps_position" in names else "sensor_gps"
    for (name, source), data in topics.items():
        if name == fixes:
            found.append(_fixes(data, source, said))
        elif name == "vehicle_magnetometer":
            found.append(_magnetic(data, _times(data), source, said))
        elif name == "vehicle_air_data":
            found.append(_pressure(data, _times(data), source, said))
    imu = topics["sensor_combined", 0]
    if "magnetometer_ga[0]" in imu:  # old logs: with the inertial samples, repeated until there is a new one
        found.append(_magnetic(*_spoken(imu, "magnetometer"), 0, said))
    if "baro_alt_meter" in imu:
        found.append(_pressure(*_spoken(imu, "baro"), 0, said))
    return found


def _spoken(imu: _Data, sensor: str) -> tuple[_Data, IntArray]:
    """The samples that bring something new of a sensor, and its times."""
    relative = imu[f"{sensor}_timestamp_relative"].astype(np.int64)
    times = _times(imu) + relative
    fresh = (relative != _NEVER) & (np.diff(np.maximum.accumulate(times), prepend=-_REPEATED_US) >= _REPEATED_US)
    return {name: values[fresh] for name, values in imu.items()}, times[fresh]


def _at(times: IntArray, delay_ms: float) -> FloatArray:
    return np.asarray(times * 1e-6 - delay_ms * 1e-3, float)


def _fixes(data: _Data, source: int, said: Mapping[str, float]) -> _Measured:
    if "latitude_deg" in data:
        place = [np.radians(data["latitude_deg"]), np.radians(data["longitude_deg"]), data["altitude_ellipsoid_m"]]
    else:
        place = [np.radians(data["lat"] * 1e-7), np.radians(data["lon"] * 1e-7), data["alt_ellipsoid"] * 1e-3]
    velocity = [data[f"vel_{axis}_m_s"] for axis in "ned"]
    speed_sigma = np.maximum(data["s_variance_m_s"], said["EKF2_GPS_V_NOISE"])
    sigmas = np.stack([data["eph"], data["eph"], data["epv"], *[speed_sigma] * 3], axis=1)
    good = data["fix_type"] >= 3
    times = _times(data)[good]
    rows = aiding_rows(
        _at(times, said["EKF2_GPS_DELAY"]), Kind.GNSS, np.stack([*place, *velocity], axis=1)[good], sigmas[good], source
    )
    return rows, times


def _magnetic(data: _Data, times: IntArray, source: int, said: Mapping[str, float]) -> _Measured:
    sigma = [said["EKF2_MAG_NOISE"] * GAUSS] * 3
    flux = _columns(data, "magnetometer_ga", 3) * GAUSS
    good = flux.any(axis=1)
    at = _at(times, said["EKF2_MAG_DELAY"])
    return aiding_rows(at[good], Kind.MAGNETIC, flux[good], sigma, source), _heard(data, times)[good]


def _pressure(data: _Data, times: IntArray, source: int, said: Mapping[str, float]) -> _Measured:
    at, sigma = _at(times, said["EKF2_BARO_DELAY"]), [said["EKF2_BARO_NOISE"]]
    return aiding_rows(at, Kind.BARO, data["baro_alt_meter"][:, None], sigma, source), _heard(data, times)


def _heard(data: _Data, times: IntArray) -> IntArray:
    """When a measurement reached the autopilot: with the record that it stands in."""
    return np.maximum(times, _times(data))
