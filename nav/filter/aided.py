"""An aided navigator: a strapdown core and an error-state filter, fed with increments and with measurements of any age.

The core takes every sample; the filter follows in intervals of `Settings.predict_s`. A measurement belongs to the first
sample that ends at its time or later: there the interval ends early, and the model takes the solution back by what is
missing of a sample. What it says of the errors is taken off the core and added to the parameters at once.

At the end of each interval everything is remembered, for `Settings.buffer_s`, with the samples since. A measurement that
comes late makes the navigator go back to the last memory before its time and take samples and measurements again, in the
order of their times. So the state never depends on when a measurement came, nor on how samples were batched: to the last
bit. (What was answered before it came stays answered.) A measurement older than the buffer is refused; one that is early
waits.
"""

import math
from bisect import bisect_right, insort
from collections import deque
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nav.checks import read_array
from nav.errors import HilError
from nav.filter.correction import Correction, Judged, Restart, Table
from nav.filter.health import ChannelHealth
from nav.filter.interval import add_one, gather
from nav.filter.record import Recorder
from nav.filter.rows import Row, checked
from nav.filter.settings import Settings
from nav.filter.states import Tuning
from nav.increments import FloatArray, ImuIncrements
from nav.step import POLE
from nav.strapdown import Answers, Strapdown

__all__ = ["AidedNavigator", "Answers", "Judged", "Restart", "Settings"]

_NOTHING = np.zeros(3)
_ROOM = 4096
"""Samples that there is room for at the start."""


class _Memory(NamedTuple):
    number: int
    time: float
    core: tuple[Any, ...]
    own: tuple[FloatArray, ...]
    table: Table


class AidedNavigator:
    """See the module.

    Parameters
    ----------
    core : Strapdown
        Its mechanization; it belongs to this object from now on.
    tuning : Tuning
        What the sensors are worth and what is estimated (:func:`nav.filter.states.tuning`).
    settings : Settings
    recorder : Recorder, optional
        Notes what :mod:`nav.filter.smoother` needs.

    Attributes
    ----------
    estimates : (STATES,) float
        The parameters as estimated (biases, scale factors...); the first nine are 0.
    time : float
        End of the newest sample, s.
    too_late : int
        Measurements refused because they were older than the buffer.
    """

    def __init__(
        self, core: Strapdown, tuning: Tuning, settings: Settings | None = None, recorder: Recorder | None = None
    ) -> None:
        self.settings = settings or Settings()
        self._core = core
        self._correction = Correction(core, tuning, self.settings, recorder)
        self._filter, self.estimates = self._correction.filter, self._correction.estimates
        self._sums, self._before = np.zeros(7), np.zeros(10)
        self._last, self._one = np.zeros(6), np.zeros(6)
        self._samples = ImuIncrements.empty(_ROOM)
        self._rows: list[Row] = []
        self._memories: deque[_Memory] = deque()
        self._room(256)
        self.time, self.too_late = -math.inf, 0

    def start(
        self,
        time: float,
        lat: float,
        lon: float,
        height: float,
        vel_n: FloatArray,
        q_nb: FloatArray,
        sigma: FloatArray,
        gyro_bias: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        """Begin at `time`, s, from a solution (rad, m, m/s) with independent errors, `sigma` (9,): m, m/s, rad.

        The parameters begin at what the settings say and the gyros' bias at `gyro_bias` (3,), rad/s; so they do after a
        restart. What came before is forgotten.

        Raises
        ------
        HilError
            `sigma` is not finite or negative, or `gyro_bias` is not finite.
        """
        given, bias = np.asarray(sigma, float), read_array("filter: gyro_bias of the start", gyro_bias, 3)
        if given.shape != (9,) or not (np.isfinite(given) & (given >= 0.0)).all() or not np.isfinite(bias).all():
            raise HilError("filter: sigma of the start must be nine numbers, finite and not negative, gyro_bias finite")
        self._core.start(lat, lon, height, vel_n, q_nb)
        self._correction.start(time, given, bias)
        self._sums[:] = 0.0
        self._before[:] = self._core.solution
        self.time, self._number, self._count, self._first, self._next = time, 0, 0, 0, 0
        self._rows.clear()
        self._memories.clear()
        self._remember()

    def process(self, imu: ImuIncrements) -> Answers:
        """Take samples; the solution at each, valid until the next call.

        Raises
        ------
        HilError
            Not started, an increment is not finite, or time goes back.
        """
        n, bad = len(imu), imu.first_bad()
        if bad >= 0:
            raise HilError(f"increment {int(imu.sequence[bad])} is not a number: mend the driver or the file")
        self._check_started()
        if n and (imu.time[0] < self.time or (np.diff(imu.time) < 0.0).any()):
            raise HilError(f"filter: time goes back, after {self.time:g} s: start anew")
        self._append(imu)
        out = self._answers(n)
        self._run(out)
        return out

    def push(
        self, time: float, step: float, x: float, y: float, z: float, vx: float, vy: float, vz: float
    ) -> FloatArray:
        """Take one sample, to the same bits as `process` and many times faster.

        Parameters
        ----------
        time, step : float
            End and length of the step, s.
        x, y, z, vx, vy, vz : float
            Increments as measured, rad, m/s, b.

        Returns
        -------
        (10,) float
            lat, lon, height, vel_n, q_nb: the core's own array, to be read only.

        Raises
        ------
        HilError
            As `process`.
        """
        if not math.isfinite(time + step + x + y + z + vx + vy + vz):
            raise HilError(f"increment at {time:g} s is not a number: mend the driver or the file")
        if not time >= self.time or not self._memories:
            self._check_started()
            raise HilError(f"filter: time goes back, after {self.time:g} s: start anew")
        row = self._count - self._first
        if row == len(self._samples):
            row = self._make_way(1)
        s = self._samples
        kept = s.time, s.step, s.dtheta, s.dvel
        how = self.settings.predict_s, self._until(), self.estimates, self._sums, self._last, self._one
        ended, *corrected = add_one(kept, row, time, step, x, y, z, vx, vy, vz, *how)
        if self._core.push(step, *corrected) == POLE:
            self._core.hand_over("wander")
            self._core.push(step, *corrected)
        self._count += 1
        self._number += 1
        self.time = time
        if ended:
            self._end()
        return self._core.solution

    def aid(self, rows: NDArray[Any]) -> None:
        """Take measurements, `nav.aiding.AIDING`, in any order.

        Raises
        ------
        HilError
            A value or a sigma that is used is no number, the kind is unknown, or there is no magnetic field to compare with.
        """
        self._check_started()
        late = math.inf
        for row in [checked(entry, self.settings) for entry in np.atleast_1d(rows)]:
            if row.time <= self._memories[0].time:
                self.too_late += 1
                continue
            insort(self._rows, row, key=attrgetter("key"))
            late = min(late, row.time)
        if late <= self.time:
            self._recall(late)
            self._run(self._answers(self._count - self._number))

    @property
    def solution(self) -> FloatArray:
        """(10,): lat, lon, height, vel_n (3), q_nb (4) at `time`."""
        return self._core.solution.copy()

    @property
    def covariance(self) -> FloatArray:
        """P of the states in `used`, as of the last end of an interval: `predict_s` ago at most."""
        return self._filter.covariance

    @property
    def sigma(self) -> FloatArray:
        """(STATES,): one sigma of each state (:mod:`nav.filter.states`); 0 of one that is not used."""
        return self._filter.sigma

    @property
    def used(self) -> NDArray[np.int64]:
        """Places of the states that are used, the rows of `covariance`."""
        return self._filter.used

    @property
    def health(self) -> list[ChannelHealth]:
        """Of every source heard so far."""
        return self._correction.health()

    def judged(self) -> list[Judged]:
        """Measurements judged since the last call; those that are taken again by a late one come again."""
        judged, self._correction.judged = self._correction.judged, []
        return judged

    def restarts(self) -> list[Restart]:
        """Restarts since the last call."""
        restarts, self._correction.restarts = self._correction.restarts, []
        return restarts

    def _check_started(self) -> None:
        if not self._memories:
            raise HilError("filter: no start yet: call start")

    def _append(self, imu: ImuIncrements) -> None:
        row, n = self._count - self._first, len(imu)
        if row + n > len(self._samples):
            row = self._make_way(n)
        self._samples.rows(row, row + n).fill(imu)
        self._count += n

    def _make_way(self, n: int) -> int:
        """Room for `n` more samples by forgetting those before the oldest memory; the row of the first."""
        oldest, old = self._memories[0].number - self._first, self._samples
        kept = self._count - self._memories[0].number
        if 2 * (kept + n) > len(old):
            self._samples = ImuIncrements.empty(2 * (kept + n))
        self._samples.rows(0, kept).fill(old.rows(oldest, oldest + kept))
        self._first += oldest
        return kept

    def _until(self) -> float:
        """Time of the next measurement that waits."""
        return self._rows[self._next].time if self._next < len(self._rows) else math.inf

    def _run(self, out: Answers) -> None:
        """Take all samples that are not taken yet; `out` begins at the first of them."""
        base = self._number
        while self._number < self._count:
            first, stop = self._number - self._first, self._count - self._first
            data = self._samples.time, self._samples.step, self._samples.dtheta, self._samples.dvel
            room = self._sums, self._last, self._turned, self._pushed
            n, ended = gather(*data, first, stop, self.settings.predict_s, self._until(), self.estimates, *room)
            here, begin = slice(first, first + n), self._number - base
            there = tuple(array[begin : begin + n] for array in out)
            self._core.advance(self._samples.step[here], self._turned[:n], self._pushed[:n], _NOTHING, *there)
            self._number += n
            self.time = float(self._samples.time[first + n - 1])
            if ended:
                self._end()
                solution = self._core.solution
                there[0][-1], there[1][-1], there[2][-1] = solution[0:3], solution[3:6], solution[6:10]

    def _end(self) -> None:
        """End an interval: predict, take what is due, remember."""
        self._correction.predict(self.time, self._before, self._sums, self._last)
        while self._until() <= self.time:
            self._correction.take(self._rows[self._next])
            self._next += 1
        self._correction.end()
        self._before[:] = self._core.solution
        self._sums[:] = 0.0
        self._remember()

    def _own(self) -> tuple[FloatArray, ...]:
        return *self._correction.own(), self._before, self._last

    def _remember(self) -> None:
        table = {key: row.copy() for key, row in self._correction.table.items()}
        own = tuple(array.copy() for array in self._own())
        self._memories.append(_Memory(self._number, self.time, self._core.memory(), own, table))
        old = len(self._memories)
        while len(self._memories) > 1 and self._memories[1].time <= self.time - self.settings.buffer_s:
            self._memories.popleft()
        if len(self._memories) < old:
            done = bisect_right(self._rows, self._memories[0].time, key=attrgetter("time"))
            del self._rows[:done]
            self._next -= done

    def _recall(self, time: float) -> None:
        """Go back to the last memory before `time`."""
        while self._memories[-1].time >= time:
            self._memories.pop()
        memory = self._memories[-1]
        self._number, self.time = memory.number, memory.time
        self._core.recall(memory.core)
        for array, then in zip(self._own(), memory.own, strict=True):
            array[:] = then
        self._correction.recall(memory.time, memory.table)
        self._sums[:] = 0.0
        self._next = bisect_right(self._rows, self.time, key=attrgetter("time"))

    def _room(self, n: int) -> None:
        self._out = Answers(np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4)))
        self._turned, self._pushed = np.empty((n, 3)), np.empty((n, 3))

    def _answers(self, n: int) -> Answers:
        if n > len(self._turned):
            self._room(2 * n)
        return Answers(*(array[:n] for array in self._out))
