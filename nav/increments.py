"""The samples that flow down the spine: what a head or a board delivers, as batches of increments.

A batch is a set of equally long arrays, one row a sample. `ImuIncrements` is what the navigator takes from any board;
`HeadIncrements` is what a dual-DTG head delivers before :mod:`nav.instruments.head` turns it into `ImuIncrements`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from nav.kernel import kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@kernel
def first_bad(time: FloatArray, step: FloatArray, dtheta: FloatArray, dvel: FloatArray) -> int:
    """Row of the first sample that holds a value that is not finite; -1 when there is none."""
    for k in range(time.shape[0]):
        total = time[k] + step[k]
        for i in range(3):
            total += dtheta[k, i] + dvel[k, i]
        if not math.isfinite(total):
            return k
    return -1


class Validity(IntFlag):
    """What is wrong with a sample; 0 is a good one."""

    GOOD = 0
    INTERPOLATED = 1
    """Made up by the gap policy between two received samples."""
    BRIDGED = 2
    """Made up over a gap longer than the policy interpolates: attitude and velocity are no longer trusted."""
    SENSOR = 4
    """An instrument that the solution needs has failed, by its own test or by ours, or is saturated."""
    SPARE = 8
    """An instrument has failed that the solution does not need: there is none to spare any more."""


@dataclass(frozen=True, slots=True)
class ImuIncrements:
    """Increments of one IMU in body axes (Forward-Right-Down).

    Attributes
    ----------
    time : (n,) float
        Device time at the end of each step, s.
    step : (n,) float
        Length of each step, s.
    dtheta : (n, 3) float
        Angle increments: integral of ``w_ib_b`` over the step, rad.
    dvel : (n, 3) float
        Velocity increments: integral of ``f_b`` over the step, m/s.
    validity : (n,) int
        `Validity` of each sample.
    sequence : (n,) int
        Sample counter of the device, unwrapped.
    """

    time: FloatArray
    step: FloatArray
    dtheta: FloatArray
    dvel: FloatArray
    validity: IntArray
    sequence: IntArray

    def __len__(self) -> int:
        return len(self.time)

    def first_bad(self) -> int:
        """Row of the first sample that holds a value that is not finite; -1 when there is none."""
        return int(first_bad(self.time, self.step, self.dtheta, self.dvel))

    def rows(self, start: int, stop: int) -> "ImuIncrements":
        """The samples `start` to `stop` as views."""
        return ImuIncrements(
            self.time[start:stop],
            self.step[start:stop],
            self.dtheta[start:stop],
            self.dvel[start:stop],
            self.validity[start:stop],
            self.sequence[start:stop],
        )

    def fill(self, source: "ImuIncrements") -> None:
        """Take the values of as many samples."""
        self.time[:], self.step[:] = source.time, source.step
        self.dtheta[:], self.dvel[:] = source.dtheta, source.dvel
        self.validity[:], self.sequence[:] = source.validity, source.sequence

    @staticmethod
    def empty(n: int) -> "ImuIncrements":
        """Room for `n` samples."""
        return ImuIncrements(
            np.zeros(n), np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n, np.int64), np.zeros(n, np.int64)
        )


def joined(parts: Sequence[ImuIncrements]) -> ImuIncrements:
    """Batches one after the other, as a new one."""
    return ImuIncrements(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ImuIncrements.__dataclass_fields__)
    )


@dataclass(frozen=True, slots=True)
class HeadIncrements:
    """Raw increments of a head with two DTGs and three pendulum accelerometers, in head axes.

    Gyro 1 spins along z and senses x and y; gyro 2 spins along x and senses y and z.

    Attributes
    ----------
    time, step, validity, sequence
        As in `ImuIncrements`.
    dtheta : (n, 4) float
        Angle increments of the axes g1x, g1y, g2y, g2z, rad.
    rotor : (n, 4) float
        Rotor tilt angles of the same axes at the end of the step, rad; NaN where the wire does not carry them.
    dvel : (n, 3) float
        Velocity increments along x, y, z, m/s.
    status : (n,) int
        What the head says of itself: bit 0 fault of gyro 1, 1 of gyro 2, 2..4 of the x, y, z accelerometer; others as its
        driver documents.
    spin : (n, 2) float
        Rotor speeds of both gyros as last said, Hz; NaN before.
    temperature : (n, 3) float
        Of gyro 1, gyro 2 and the accelerometers as last said, degrees Celsius; NaN before.
    """

    time: FloatArray
    step: FloatArray
    dtheta: FloatArray
    rotor: FloatArray
    dvel: FloatArray
    validity: IntArray
    sequence: IntArray
    status: IntArray
    spin: FloatArray
    temperature: FloatArray

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, start: int, stop: int) -> "HeadIncrements":
        """The samples `start` to `stop` as views."""
        return HeadIncrements(
            self.time[start:stop],
            self.step[start:stop],
            self.dtheta[start:stop],
            self.rotor[start:stop],
            self.dvel[start:stop],
            self.validity[start:stop],
            self.sequence[start:stop],
            self.status[start:stop],
            self.spin[start:stop],
            self.temperature[start:stop],
        )

    @staticmethod
    def empty(n: int) -> "HeadIncrements":
        """Room for `n` samples."""
        return HeadIncrements(
            np.zeros(n),
            np.zeros(n),
            np.zeros((n, 4)),
            np.zeros((n, 4)),
            np.zeros((n, 3)),
            np.zeros(n, np.int64),
            np.zeros(n, np.int64),
            np.zeros(n, np.int64),
            np.full((n, 2), np.nan),
            np.full((n, 3), np.nan),
        )
