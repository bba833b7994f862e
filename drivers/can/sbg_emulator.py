"""The other end of :mod:`drivers.can.sbg`: increments to the frames that an SBG unit sends, rounded as it rounds them."""

from typing import Literal

import numpy as np

from drivers.can.emulation import EndRates, axes, check_period, put, rounded, stamp, ticks_of
from drivers.can.frames import FrameArray, frames
from drivers.can.sbg import HEALTHY, TICK_S, VECTORS, sbg_database
from nav.increments import ImuIncrements

ACCELS_IN_RANGE, GYROS_IN_RANGE = 0x0100, 0x0200
"""Status bits that go out while an axis is held at the end of its range."""


class SbgEmulator:
    """Frames of one unit; satisfies `drivers.BoardEmulator`.

    Parameters
    ----------
    period_us : int
        Sample period.
    messages : {"rates", "deltas"}
        IMU_ACCEL and IMU_GYRO with the values at the sample's time, or IMU_DELTA_VEL and IMU_DELTA_ANGLE with the means.

    Raises
    ------
    HilError
        The unit has no such period.
    """

    frames_per_sample = 3

    def __init__(self, period_us: int, messages: Literal["rates", "deltas"] = "rates") -> None:
        check_period("an SBG unit", period_us, least_us=1000, grid_us=1000)
        database = sbg_database()
        self._info = database["SBG_ECAN_MSG_IMU_INFO"]
        names = ("IMU_ACCEL", "IMU_GYRO") if messages == "rates" else ("IMU_DELTA_VEL", "IMU_DELTA_ANGLE")
        self._vectors = [(database[f"SBG_ECAN_MSG_{name}"], VECTORS[name][1]) for name in names]
        self._ends = EndRates() if messages == "rates" else None

    def slow(self) -> FrameArray:
        """Nothing: all that the unit says comes with each sample."""
        return frames(0)

    def samples(self, imu: ImuIncrements) -> FrameArray:
        """Frames of n samples in the order of their identifiers, stamped with the board's time; the calls follow one another."""
        n = len(imu)
        values = np.hstack([imu.dtheta, imu.dvel]) / imu.step[:, None] if self._ends is None else self._ends.rates(imu)
        turn, turns_fit = rounded(values[:, :3], 1e-3)
        push, pushes_fit = rounded(values[:, 3:], 1e-2)
        status = HEALTHY - np.where(pushes_fit, 0, ACCELS_IN_RANGE) - np.where(turns_fit, 0, GYROS_IN_RANGE)
        info = {"TIME_STAMP": ticks_of(imu.time, TICK_S), "STATUS": status, "TEMPERATURE": np.full(n, 3500)}
        batch = frames(3 * n)
        put(self._info, info, batch[0::3])
        for k, ((codec, signal), vector) in enumerate(zip(self._vectors, (push, turn), strict=True)):
            put(codec, axes(vector, [f"{signal}_{axis}" for axis in "XYZ"]), batch[k + 1 :: 3])
        stamp(batch, imu.time, 3)
        return batch
