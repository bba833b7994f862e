"""ArduPilot DataFlash (`.bin`) through pymavlink's reader: the board's sensors and the autopilot's own attitude.

The first IMU is taken, and all receivers, magnetometers and barometers. Logged rates and forces are those of a moment, so
that a sample's mean is that of its two ends (trapezoid); after a gap it is the value of its own end. What moves faster than
half the logging rate is aliased: nothing brings it back.

A fix is true as long before it was logged as the autopilot's own filter supposes. Its deviations are those of the receiver
(GPA, UBX3), or come from its dilution of precision; those of magnetometer and barometer are those of the autopilot's filter.
The logs have no check sums: records that leave their neighbours by more than a second, or hold impossible values, are left out.

The board's clock may be wrong by far. Where it disagrees with the receiver's by more than `CLOCK_TOLERANCE`, all times are scaled
to the receiver's seconds.
"""

import contextlib
import io
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drivers.can.aiding import AidingArray
from drivers.logs.imu_log import ImuLog, make_log, steady
from nav.aiding import AIDING, Kind, aiding_rows
from nav.errors import HilError
from nav.increments import FloatArray, IntArray
from nav.rotation import quaternion_from_euler

CLOCK_TOLERANCE = 1e-3
"""A crystal is a hundred times better."""
CLOCK_SPAN_S = 20.0
"""Fixes over less than this say nothing of the clock."""
MILLIGAUSS = 1e-7
"""T."""
RANGE_ERROR_M = 2.5
"""Error of a range to a satellite: times the dilution of precision it is that of a fix whose receiver does not state one."""
SPEED_ERROR_MS = 0.5
_ATTITUDES = ("ATT", "XKF1", "NKF1", "EKF1", "AHR2")
"""Where the autopilot's attitude is, by preference: the one that it flies by, its filters, its stand-by."""
_SENSORS = {
    "GPS": ("GPS", "GPS2"),
    "MAG": ("MAG", "MAG2", "MAG3"),
    "BARO": ("BARO", "BAR2", "BAR3"),
    "accuracy": ("GPA", "GPA2", "UBX3"),
}
"""Messages of each sensor; the place is the number of a sensor whose message does not say it."""
_HEAD = 3
"""Bytes that every message begins with."""
_LONGEST_US = 1e15
_DELAY_MS = (("EKF_POS_DELAY", "EK2_GPS_DELAY", "GPS_DELAY_MS", "GPS1_DELAY_MS"), 200.0)
_MAG_NOISE = (("EK3_MAG_M_NSE", "EK2_MAG_M_NSE", "EKF_MAG_NOISE"), 0.05)  # Gs
_BARO_NOISE = (("EK3_ALT_M_NSE", "EK2_ALT_M_NSE", "EKF_ALT_NOISE"), 2.0)  # m

Undulation = Callable[[float, float], float]
_Columns = Mapping[str, FloatArray]
_Measured = tuple[AidingArray, FloatArray]
"""Rows and their arrivals on the board's clock, us."""


def read_dataflash(path: Path, undulation: Undulation) -> ImuLog:
    """The first IMU of a DataFlash log, all that aids it, and the autopilot's attitude.

    Parameters
    ----------
    path : Path
        The log.
    undulation : callable
        Height of mean sea level above the ellipsoid, m, at a latitude and longitude, rad: the logs have heights above the sea.

    Raises
    ------
    HilError
        The file cannot be read or is no DataFlash log, or it lacks inertial samples or an attitude.
    """
    messages, parameters = _read(path)
    try:
        return _log(messages, parameters, undulation)
    except KeyError as error:
        raise HilError(f"log {path}: a message lacks its column {error}") from error
    except HilError as error:
        raise HilError(f"log {path}: {error}") from error


def _log(messages: Mapping[str, _Columns], parameters: Mapping[str, float], undulation: Undulation) -> ImuLog:
    imu = _of(messages, ("IMU",)).get(0, {})
    attitudes = (_of(messages, (name,)) for name in _ATTITUDES)
    attitude = next((found[min(found)] for found in attitudes if found and len(found[min(found)]["us"]) > 1), {})
    if len(imu.get("us", ())) < 2 or not attitude:
        raise HilError("it has no IMU with samples, or no attitude of the autopilot (ATT)")
    measured: list[_Measured] = []
    fixes, accuracies = _of(messages, _SENSORS["GPS"]), _of(messages, _SENSORS["accuracy"])
    for source, columns in fixes.items():
        measured.append(_fixes(columns, accuracies.get(source, {}), source, parameters, undulation))
    for source, columns in _of(messages, _SENSORS["MAG"]).items():
        flux = _stack(columns, "MagX", "MagY", "MagZ") * MILLIGAUSS
        sigma = [_parameter(parameters, _MAG_NOISE) * 1e3 * MILLIGAUSS] * 3
        measured.append((aiding_rows(columns["us"] * 1e-6, Kind.MAGNETIC, flux, sigma, source), columns["us"]))
    for source, columns in _of(messages, _SENSORS["BARO"]).items():
        sigma = [_parameter(parameters, _BARO_NOISE)]
        rows = aiding_rows(columns["us"] * 1e-6, Kind.BARO, _stack(columns, "Alt"), sigma, source)
        measured.append((rows, columns["us"]))
    slope, origin = _clock_slope(fixes.get(0, {})), float(imu["us"][0])

    def true_us(us: FloatArray) -> IntArray:
        return np.rint(origin + (us - origin) * slope).astype(np.int64)

    for rows, _ in measured:
        rows["time"] = (origin + (rows["time"] * 1e6 - origin) * slope) * 1e-6
    time_us, rate, force = _samples(imu)
    return make_log(
        true_us(time_us),
        rate,
        force,
        true_us(attitude["us"]),
        quaternion_from_euler(*np.radians([attitude["Yaw"], attitude["Pitch"], attitude["Roll"]])),
        [(rows, true_us(arrivals)) for rows, arrivals in measured],
        parameters.get("COMPASS_DEC"),
    )


class _Formats(dict[int, Any]):
    """Formats of messages by number, but for damaged ones: one shorter than its head holds the reader in its place for ever."""

    def __setitem__(self, number: int, form: Any) -> None:
        if form.len >= _HEAD:
            super().__setitem__(number, form)


def _read(path: Path) -> tuple[dict[str, _Columns], dict[str, float]]:
    """Columns of each message that is wanted, by its name, and the parameters."""
    from pymavlink.DFReader import DFReader_binary

    class Reader(DFReader_binary):  # type: ignore[misc]
        def init_arrays_fast(self, progress_callback: Any = None) -> None:  # the one in C prints past our ears
            self.formats: dict[int, Any] = _Formats(self.formats)
            self.init_arrays(progress_callback)

    wanted = {"IMU", "PARM", *_ATTITUDES, *(name for names in _SENSORS.values() for name in names)}
    found: dict[str, dict[str, list[float]]] = {}
    parameters: dict[str, float] = {}
    said = io.StringIO()  # the reader prints what it does not understand, also to standard output
    reader = Reader.__new__(Reader)
    try:
        path.open("rb").close()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            reader.__init__(str(path))  # type: ignore[misc]
            while (message := reader.recv_match(type=wanted)) is not None:
                fields = message.to_dict()
                name = fields.pop("mavpackettype")
                if name == "PARM":
                    parameters[str(fields["Name"])] = float(fields["Value"])
                    continue
                columns = found.setdefault(name, {})
                for key, value in fields.items():
                    columns.setdefault(key, []).append(float(value) if isinstance(value, int | float) else math.nan)
    except OSError as error:
        raise HilError(f"log {path}: {error.strerror or error}") from error
    except Exception as error:  # the reader raises whatever the bytes provoke
        if not found:
            raise HilError(f"log {path}: not a readable DataFlash log: {error}") from error
    finally:
        reader.__dict__.clear()  # it holds the file and messages that hold it
    if not found:
        raise HilError(f"log {path}: not a readable DataFlash log: it holds no messages of sensors")
    return {
        name: {key: np.array(values) for key, values in columns.items()} for name, columns in found.items()
    }, parameters


def _of(messages: Mapping[str, _Columns], names: tuple[str, ...]) -> dict[int, _Columns]:
    """Columns by the number of the sensor, with the board's time as ``us``."""
    split: dict[int, _Columns] = {}
    for place, name in enumerate(names):
        columns = messages.get(name)
        if columns is None or len({len(values) for values in columns.values()}) != 1:
            continue
        instance = next((columns[key] for key in ("I", "Instance", "C") if key in columns), None)
        if name in _ATTITUDES and instance is None:
            instance = np.zeros(len(next(iter(columns.values()))))
        if instance is None:
            instance = np.full(len(next(iter(columns.values()))), float(place if name not in {"GPA", "UBX3"} else 0))
        us = _board_us(columns)
        for number in np.unique(instance[np.isfinite(instance)]).astype(int).tolist():
            rows = (instance == number) & (np.abs(us) < _LONGEST_US)
            for values in columns.values():
                rows &= np.isfinite(values) | np.isnan(values).all()  # what is not a number at all is a text
            rows[rows] = steady(us[rows].astype(np.int64))
            if rows.any() and number not in split:
                split[number] = {**{key: values[rows] for key, values in columns.items()}, "us": us[rows]}
    return split


def _board_us(columns: _Columns) -> FloatArray:
    """Time on the board's clock: of old fixes it is T, their TimeMS is that of the receiver."""
    if "TimeUS" in columns:
        return columns["TimeUS"]
    return columns["T" if "T" in columns and "Week" in columns else "TimeMS"] * 1e3


def _stack(columns: _Columns, *names: str) -> FloatArray:
    return np.stack([columns[name] for name in names], axis=1)


def _parameter(parameters: Mapping[str, float], choice: tuple[tuple[str, ...], float]) -> float:
    """The first of the parameters that the log has and that is positive, or the default."""
    names, default = choice
    return next((parameters[name] for name in names if parameters.get(name, 0.0) > 0.0), default)


def _samples(imu: _Columns) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, us, and means over the samples of rate and force: the trapezoid, but after a gap the value at the end."""
    rate, force = _stack(imu, "GyrX", "GyrY", "GyrZ"), _stack(imu, "AccX", "AccY", "AccZ")
    steps = np.diff(imu["us"])
    joined = np.flatnonzero(steps < 1.5 * np.median(steps)) + 1
    for values in (rate, force):
        values[joined] = 0.5 * (values[joined] + values[joined - 1])
    return imu["us"], rate, force


def _clock_slope(fixes: _Columns) -> float:
    """The receiver's seconds in one of the board's; 1 where they agree or where the fixes do not tell."""
    if "Week" in fixes:
        there = (fixes["Week"] * 604800e3 + fixes["TimeMS"]) * 1e-3
    elif "GWk" in fixes:
        there = (fixes["GWk"] * 604800e3 + fixes["GMS"]) * 1e-3
    else:
        return 1.0
    good = fixes["Status"] >= 3
    here, there = fixes["us"][good] * 1e-6, there[good]
    if len(here) < 20 or here[-1] - here[0] < CLOCK_SPAN_S:
        return 1.0
    half = len(here) // 2
    slope = float(np.median((there[half:] - there[:-half]) / (here[half:] - here[:-half])))
    offset = there - slope * here
    settled = float(np.median(np.abs(offset - np.median(offset)))) < 0.1
    return slope if settled and 0.5 < slope < 2.0 and abs(slope - 1.0) > CLOCK_TOLERANCE else 1.0


def _fixes(
    fixes: _Columns, accuracy: _Columns, source: int, parameters: Mapping[str, float], undulation: Undulation
) -> _Measured:
    """Fixes in three dimensions, with the deviations that the receiver states nearest in time."""
    good = (fixes["Status"] >= 3) & (np.abs(fixes["Lat"]) <= 90.0) & (np.abs(fixes["Lng"]) <= 180.0)
    fixes = {key: values[good] for key, values in fixes.items()}
    n, us = len(fixes["us"]), fixes["us"]
    if n == 0:
        return np.zeros(0, AIDING), us
    lat, lon = np.radians(fixes["Lat"]), np.radians(fixes["Lng"])
    height = fixes["Alt"] + [undulation(*place) for place in zip(lat.tolist(), lon.tolist(), strict=True)]
    course = np.radians(fixes["GCrs"])
    velocity = fixes["Spd"] * np.cos(course), fixes["Spd"] * np.sin(course), fixes.get("VZ", np.zeros(n))
    coarse = fixes["HDop"] * RANGE_ERROR_M
    sigma = np.stack([coarse, coarse, 1.5 * coarse, *[np.full(n, SPEED_ERROR_MS)] * 3], axis=1)
    h, v, s = (_stated(accuracy, name, us) for name in ("HAcc", "VAcc", "SAcc"))
    known = (h > 0.0) & (v > 0.0) & (s > 0.0)
    sigma[known] = np.stack([h, h, v, s, s, s], axis=1)[known]
    at = us * 1e-6 - _parameter(parameters, _DELAY_MS) * 1e-3
    return aiding_rows(at, Kind.GNSS, np.stack([lat, lon, height, *velocity], axis=1), sigma, source), us


def _stated(accuracy: _Columns, name: str, us: FloatArray) -> FloatArray:
    """What the receiver states nearest to the times `us`; 0 where there is nothing within a second."""
    values = accuracy.get(name, accuracy.get(name[0].lower() + name[1:]))  # UBX3 writes hAcc
    if values is None:
        return np.zeros(len(us))
    times = accuracy["us"]
    right = np.searchsorted(times, us).clip(0, len(times) - 1)
    left = (right - 1).clip(0)
    nearest = np.where(us - times[left] < times[right] - us, left, right)
    return np.where(np.abs(us - times[nearest]) < 1e6, values[nearest], 0.0)
