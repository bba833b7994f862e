"""PX4 ULog (`.ulg`): the IMU of a flight board and the autopilot's own attitude, through pyulog (extra ``logs``)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nav.errors import HilError
from nav.increments import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class ImuLog:
    """The IMU in a log, as a board would have sent it.

    Attributes
    ----------
    time_us : (n,) int
        Device time at the end of each sample, us.
    counter : (n,) int
        Sample counter: jumps where the log has gaps.
    period_us : int
        Nominal period: the median.
    rate : (n, 3) float
        Body rate, rad/s.
    force : (n, 3) float
        Specific force, m/s^2.
    attitude_us : (m,) int
        Times of the log's own attitude.
    attitude : (m, 4) float
        Its q_nb.
    """

    time_us: IntArray
    counter: IntArray
    period_us: int
    rate: FloatArray
    force: FloatArray
    attitude_us: IntArray
    attitude: FloatArray

    @property
    def step_us(self) -> IntArray:
        """Length of each sample, us: the time since the one before, the nominal period after a gap."""
        steps = np.diff(self.time_us, prepend=self.time_us[0] - self.period_us)
        jumps = np.diff(self.counter, prepend=self.counter[0] - 1) != 1
        return np.where(jumps, self.period_us, steps)


def read_ulog(path: Path) -> ImuLog:
    """The first IMU (`sensor_combined`) and `vehicle_attitude` of a ULog.

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
        log = ULog(str(path), ["sensor_combined", "vehicle_attitude"])
    except OSError as error:
        raise HilError(f"log {path}: {error.strerror}") from error
    except Exception as error:  # pyulog raises whatever the bytes provoke
        raise HilError(f"log {path}: not a readable ULog: {error}") from error
    topics: dict[str, Any] = {topic.name: topic.data for topic in reversed(log.data_list)}
    for name in ("sensor_combined", "vehicle_attitude"):
        if name not in topics or len(topics[name]["timestamp"]) < 2:
            raise HilError(f"log {path}: it has no topic {name} with samples")
    imu, attitude = topics["sensor_combined"], topics["vehicle_attitude"]
    time_us = imu["timestamp"].astype(np.int64)
    order = np.concatenate(([True], np.diff(time_us) > 0))
    rate = np.stack([imu[f"gyro_rad[{i}]"] for i in range(3)], axis=1).astype(float)
    force = np.stack([imu[f"accelerometer_m_s2[{i}]"] for i in range(3)], axis=1).astype(float)
    good = order & np.isfinite(rate).all(1) & np.isfinite(force).all(1)
    time_us, rate, force = time_us[good], rate[good], force[good]
    period_us = int(np.median(np.diff(time_us)))
    missing = np.maximum(np.rint(np.diff(time_us) / period_us).astype(np.int64), 1)
    return ImuLog(
        time_us=time_us,
        counter=np.concatenate(([0], np.cumsum(missing))),
        period_us=period_us,
        rate=rate,
        force=force,
        attitude_us=attitude["timestamp"].astype(np.int64),
        attitude=np.stack([attitude[f"q[{i}]"] for i in range(4)], axis=1).astype(float),
    )
