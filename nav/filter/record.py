"""What a smoother needs of a filter that has run: for each interval its solutions, sums and accepted measurements.

Covariances are kept at one of `STRIDE` interval ends only. From there the filter can be run again to the same bits, so the
record holds tens of numbers for each interval and not thousands. An interval ends in an *epoch*. A start and a restart
are epochs with no interval before them: the errors before tell nothing of those behind.
"""

from typing import NamedTuple

import numpy as np

from nav.filter.error_state import ErrorState
from nav.filter.states import STATES
from nav.increments import FloatArray

STRIDE = 256
"""Epochs from one kept covariance to the next."""

EPOCH = np.dtype(
    [
        ("time", "<f8"),  # s
        ("before", "<f8", 10),  # lat, lon, height, vel_n, q_nb when the measurements come
        ("after", "<f8", 10),  # and when they have been taken
        ("sums", "<f8", 7),  # of the interval, as `ErrorState.predict`
        ("estimates", "<f8", STATES),  # of the parameters, after
        ("first_row", "<i8"),  # of the measurements
    ]
)
"""End of an interval."""


class Mark(NamedTuple):
    """The filter at an epoch, before its measurements.

    Attributes
    ----------
    epoch : int
    begin : bool
        Nothing stands before it: a start, or a restart.
    u, d, turn, transition
        As of `ErrorState`.
    """

    epoch: int
    begin: bool
    u: FloatArray
    d: FloatArray
    turn: FloatArray
    transition: FloatArray


class Recorder:
    """See the module. It is given to one `nav.filter.aided.AidedNavigator`, which fills it.

    Attributes
    ----------
    marks : list of Mark
    runs : list of int
        Epochs of the starts; times rise from one to the next.
    filter : ErrorState
        The recorded one.
    """

    def __init__(self) -> None:
        self._epochs, self._count = np.zeros(1024, EPOCH), 0
        self._rows, self._taken = np.zeros((1024, 0)), 0
        self.marks: list[Mark] = []
        self.runs: list[int] = []

    @property
    def epochs(self) -> np.ndarray:
        """(n,) `EPOCH`."""
        return self._epochs[: self._count]

    @property
    def rows(self) -> FloatArray:
        """(m, used + 3): H of the used states, residual, variance, and 1 in the first row of a measurement."""
        return self._rows[: self._taken]

    def start(self, time: float, state: ErrorState, solution: FloatArray) -> None:
        """The navigator has been started with `solution` (10,) at `time`, s."""
        if not self.runs:
            self.filter = state
            self._rows = np.zeros((1024, len(state.used) + 3))
        self.runs.append(self._count)
        self._begin(time, solution)

    def restart(self, solution: FloatArray) -> None:
        """The filter has been started again, with `solution` (10,)."""
        self._begin(float(self.epochs["time"][-1]), solution)

    def predict(self, time: float, solution: FloatArray, sums: FloatArray) -> None:
        """The filter has been carried to `time`, s, where the navigator says `solution` (10,); `sums` as of the filter."""
        self._add(time, solution)
        self._epochs["sums"][self._count - 1] = sums
        if self._count - 1 - self.marks[-1].epoch >= STRIDE:
            self._mark(begin=False)

    def absorb(self, h: FloatArray, residual: FloatArray, variance: FloatArray, count: int) -> None:
        """A measurement is taken; arguments as of `ErrorState.absorb`."""
        used = self.filter.used
        for k in range(count):
            if self._taken == len(self._rows):
                self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
            row = self._rows[self._taken]
            row[:-3] = h[k][used]
            row[-3], row[-2], row[-1] = residual[k], variance[k], k == 0
            self._taken += 1

    def end(self, solution: FloatArray, estimates: FloatArray) -> None:
        """The measurements of the epoch have been taken."""
        self._epochs["after"][self._count - 1] = solution
        self._epochs["estimates"][self._count - 1] = estimates

    def recall(self, time: float) -> None:
        """Forget what came after `time`, s, the end of an interval of the present run."""
        run = self.runs[-1]
        kept = run + int(np.searchsorted(self.epochs["time"][run:], time, side="right"))
        if kept < self._count:
            self._taken = int(self._epochs["first_row"][kept])
            self._count = kept
        while self.marks[-1].epoch >= kept:
            self.marks.pop()

    def _begin(self, time: float, solution: FloatArray) -> None:
        self._add(time, solution)
        self._mark(begin=True)

    def _add(self, time: float, solution: FloatArray) -> None:
        if self._count == len(self._epochs):
            self._epochs = np.concatenate([self._epochs, np.zeros_like(self._epochs)])
        row = self._epochs[self._count]
        row["time"], row["before"], row["first_row"] = time, solution, self._taken
        self._count += 1

    def _mark(self, *, begin: bool) -> None:
        f = self.filter
        held = f.u.copy(), f.d.copy(), f.turn.copy(), f.transition.copy()
        self.marks.append(Mark(self._count - 1, begin, *held))
