"""Samples that are held back until measurements of their time can no longer come."""

import math

import numpy as np

from nav.increments import FloatArray, ImuIncrements
from nav.rotation import conjugate, product, quaternion_from_rotation_vector

LATE_S = 2.0
"""How late a measurement may come, s."""


class Held:
    """A queue of samples; `rows` are those held, oldest first, valid until the next call."""

    def __init__(self) -> None:
        self._room, self._count = ImuIncrements.empty(256), 0

    @property
    def rows(self) -> ImuIncrements:
        """All of them."""
        return self._room.rows(0, self._count)

    def add(self, imu: ImuIncrements) -> None:
        """Hold more."""
        n, before = self._count + len(imu), self.rows
        if n > len(self._room):
            self._room = ImuIncrements.empty(2 * n)
            self._room.rows(0, self._count).fill(before)
        self._room.rows(self._count, n).fill(imu)
        self._count = n

    def drop(self, n: int) -> None:
        """Hold the oldest `n` no longer."""
        self._room.rows(0, self._count - n).fill(self._room.rows(n, self._count))
        self._count -= n


def turn_between(imu: ImuIncrements, before: float, after: float) -> FloatArray:
    """Quaternion from the body axes at `after` to those at `before`, s, in steady turns within each sample.

    `after` may be the earlier of the two; what the samples do not cover does not turn.
    """
    first, last = min(before, after), max(before, after)
    q = np.array([1.0, 0.0, 0.0, 0.0])
    begin = int(np.searchsorted(imu.time, first, "right"))
    for k in range(begin, len(imu)):
        starts, ends = float(imu.time[k] - imu.step[k]), float(imu.time[k])
        if starts >= last:
            break
        if imu.step[k] > 0.0:
            share = max(0.0, min(ends, last) - max(starts, first)) / float(imu.step[k])
            q = product(q, quaternion_from_rotation_vector(share * imu.dtheta[k]))
    return q if math.copysign(1.0, after - before) > 0.0 else conjugate(q)
