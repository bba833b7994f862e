"""Rows of `NAV_STATE` as the navigator fills them: one buffer, its fields handed to kernels, nothing made per sample."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nav.cut import Cut
from nav.increments import FloatArray, ImuIncrements, IntArray
from nav.kernel import kernel
from nav.state import NAV_STATE
from nav.strapdown import Answers

StateArray = NDArray[Any]


@kernel
def fill_rows(
    rows: StateArray,
    start: int,
    stop: int,
    what: tuple[int, int, float],
    position: FloatArray,
    velocity: FloatArray,
    attitude: FloatArray,
    bias: FloatArray,
    sigmas: NDArray[np.float32],
    ratios: NDArray[np.float32],
) -> None:
    """`Solutions.fill`; `start` and `stop` are those of the buffer."""
    for k in range(start, stop):
        i, row = min(k - start, position.shape[0] - 1), rows[k]
        row.mode, row.health, row.progress = what
        row.lat, row.lon, row.height = position[i, 0], position[i, 1], position[i, 2]
        for j in range(3):
            row.vel_n[j], row.gyro_bias[j] = velocity[i, j], bias[j]
        for j in range(4):
            row.q_nb[j] = attitude[i, j]
        for j in range(sigmas.shape[0]):
            row.sigma[j] = sigmas[j]
        for j in range(ratios.shape[0]):
            row.test_ratio[j] = ratios[j]


@kernel
def add_to_rows(
    rows: StateArray, time: FloatArray, step: FloatArray, dtheta: FloatArray, dvel: FloatArray, sequence: IntArray
) -> None:
    """`Solutions.add_samples`, to the rows from the second on."""
    for i in range(time.shape[0]):
        row = rows[i + 1]
        row.time, row.sequence = time[i], sequence[i]
        t = step[i] if step[i] > 0.0 else 1.0
        for j in range(3):
            row.w_ib_b[j] = dtheta[i, j] / t - row.gyro_bias[j]
            row.f_b[j] = dvel[i, j] / t


class Solutions:
    """Room for the rows of a batch; row 0 of the buffer is the last one of the batch before."""

    def __init__(self) -> None:
        self._room(256)

    @property
    def last(self) -> StateArray:
        """(1,) The last row that was kept; to be changed in place."""
        return self._rows[:1]

    @property
    def buffer(self) -> StateArray:
        """(2 or more,) rows; the first is `last`, the next that of the first sample."""
        return self._rows

    def room(self, n: int) -> StateArray:
        """(n,) rows to be filled; valid until there is more to fill."""
        if n + 1 > len(self._rows):
            before = self._rows[0].copy()
            self._room(2 * n + 1)
            self._rows[0] = before
        return self._views[n]

    def answers(self, n: int) -> Answers:
        """Room for the place, velocity and attitude of `n` samples; valid until there is more to fill."""
        self.room(n)
        return self._answers[n]

    def fill(
        self,
        start: int,
        stop: int,
        what: tuple[int, int, float],
        answers: Answers,
        gyro_bias: FloatArray,
        worth: tuple[NDArray[np.float32], NDArray[np.float32]],
    ) -> None:
        """Fill the rows `start` to `stop` but for what comes from the samples alone.

        Parameters
        ----------
        start, stop : int
            Of `room`.
        what : tuple
            Mode, health, progress.
        answers : Answers
            Beyond its rows the last one is repeated.
        gyro_bias : (3,) float
            rad/s.
        worth : tuple of (9,), (len(Ratio),) float32
            Sigmas and test ratios.
        """
        fill_rows(self._rows, start + 1, stop + 1, what, *answers, gyro_bias, *worth)

    def add_samples(self, imu: ImuIncrements) -> None:
        """Time, number, rate and force of every row, from samples from which the bias is not taken off yet."""
        add_to_rows(self._rows, imu.time, imu.step, imu.dtheta, imu.dvel, imu.sequence)

    def keep_last(self, n: int) -> None:
        """The last of `n` rows is what `last` gives."""
        self._rows[0] = self._rows[n]

    def _room(self, n: int) -> None:
        self._rows = np.zeros(n, NAV_STATE)
        rows, scratch = self._rows, (np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4)))
        self._views = Cut[StateArray](lambda m: rows[1 : m + 1])
        self._answers = Cut(lambda m: Answers(*(array[:m] for array in scratch)))
