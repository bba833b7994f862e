"""A clock against the host's, from pairs of its time and the arrival: offset, drift, a bound, and steps.

A message can arrive late but not early. Over the time t of the device, arrival minus t lies on or above a line,

    arrival - t = offset + slope t + smallest delay + delay,   delay >= 0,   drift of the device = -slope,

so the line sought is the highest one below all points: of those the one that is highest at their mean time, an edge of their
lower convex hull (Moon, Skelly and Towsley 1999, "Estimation and removal of clock skew from network delay measurements"). The
smallest delay of the transport is in the offset: no fit of one direction can tell the two apart.

Of each cell of time only the earliest arrival is kept, `WINDOW` of these. Their heights above the line are delays of cells. Twice
the lower quartile of those of n cells, times `WINDOW` / n, is the bound of the line at the newest sample: where delays near the
smallest one are as frequent as others, the error of the line goes with 1 / n as this bound does. Where the newest second lies
above the line as a whole, the bound is as wide as that.

A sample that is early moves the line at once. A line that the newest cells contradict is given up for them: the drift has
changed, or, from `STEP_S` on, one of the clocks has stepped. A step towards earlier arrivals is seen within a cell; one towards
later arrivals looks like a queue for `SETTLED` cells.
"""

import math

import numpy as np

from nav.increments import FloatArray
from nav.kernel import kernel

CELL_S = 0.25
"""Length of a cell for a sensor, s."""
WINDOW = 128
"""Cells that the fit remembers."""
SETTLED = 16
"""Cells from which on the drift is fitted; before, it is that of the last fit or zero."""
SPOKEN = 4
"""Cells from which on a bound is stated, and that must all be late for it to widen."""
DRIFT = 200e-6
"""Largest relative drift that the bound allows for while the drift is not fitted."""
STEP_S = 1e-3
"""A change of the offset from here on is a step."""
NEAR_S = 100e-6
"""A contradiction of less than this and four times the quartile of the delays is left to the sliding window."""
RESOLUTION_S = 1e-6
"""Smallest bound: what the stamps resolve."""


@kernel
def _envelope(time: FloatArray, value: FloatArray, hull: FloatArray) -> tuple[float, float]:
    """The line below all points that is highest at their mean time: its value at the last one, and its slope."""
    size, mean = 0, 0.0
    for i in range(len(time)):
        mean += time[i] / len(time)
        while size > 1 and (
            (value[int(hull[size - 1])] - value[int(hull[size - 2])]) * (time[i] - time[int(hull[size - 1])])
            >= (value[i] - value[int(hull[size - 1])]) * (time[int(hull[size - 1])] - time[int(hull[size - 2])])
        ):
            size -= 1
        hull[size] = i
        size += 1
    edge = 1
    while edge < size - 1 and time[int(hull[edge])] < mean:
        edge += 1
    a, b = int(hull[edge - 1]), int(hull[edge])
    slope = (value[b] - value[a]) / (time[b] - time[a])
    return value[a] + slope * (time[len(time) - 1] - time[a]), slope


@kernel
def _quartile(
    time: FloatArray, value: FloatArray, level: float, slope: float, touching: int, work: FloatArray
) -> float:
    """Lower quartile of what lies above a line that touches `touching` of the points."""
    n = len(time)
    for i in range(n):
        work[i] = value[i] - level - slope * (time[i] - time[n - 1])
    work[:n].sort()
    quartile: float = work[min(touching - 1 + max(1, n // 4), n - 1)]
    return quartile


@kernel
def _least(time: FloatArray, value: FloatArray, level: float, slope: float, newest: int) -> float:
    """The least that any of the newest points lies above a line."""
    n, least = len(time), np.inf
    for i in range(max(0, n - newest), n):
        least = min(least, value[i] - level - slope * (time[i] - time[n - 1]))
    return least


@kernel
def _fit(time: FloatArray, value: FloatArray, prior: float, work: FloatArray) -> tuple[float, float, float, float]:
    """Level at the last cell, slope, bound, and how far the newest `SETTLED` cells contradict the line beyond their noise.

    A contradiction is positive where all of them lie above the line, negative where the line has come down to the newest one
    and the others stay behind.
    """
    n = len(time)
    if n < SETTLED:
        level = np.inf
        for i in range(n):
            level = min(level, value[i] - prior * (time[i] - time[n - 1]))
        bound = 2.0 * _quartile(time, value, level, prior, 1, work) * WINDOW / n + DRIFT * (time[n - 1] - time[0])
        return level, prior, bound + RESOLUTION_S if n >= SPOKEN else np.inf, 0.0
    level, slope = _envelope(time, value, work)
    bound = 2.0 * _quartile(time, value, level, slope, 2, work) * WINDOW / n
    bound = RESOLUTION_S + max(bound, _least(time, value, level, slope, SPOKEN))
    if n == SETTLED:
        return level, slope, bound, 0.0
    short_time, short_value = time[n - SETTLED :], value[n - SETTLED :]
    short, short_slope = _envelope(short_time, short_value, work)
    near = NEAR_S + 4.0 * _quartile(short_time, short_value, short, short_slope, 2, work)
    raised = _least(time, value, level, slope, SETTLED)
    if raised > near:
        return level, slope, bound, raised
    behind = short - level - (short_slope - slope) * (time[n - 1] - short_time.mean())
    if behind > near and value[n - 1] - level <= near:
        return level, slope, bound, -behind
    return level, slope, bound, 0.0


class ClockFit:
    """The host's time of another clock's; plain numbers a sample, a kernel a cell, nothing allocated for a sample.

    Parameters
    ----------
    cell_s : float
        Length of a cell, s: the earliest arrival of each counts. A few samples long at least.
    """

    def __init__(self, cell_s: float = CELL_S) -> None:
        self._cell_s = cell_s
        self._cells, self._work = np.zeros((2, 2 * WINDOW)), np.zeros(WINDOW)
        self.steps = 0
        """Steps of either clock, of `STEP_S` or more."""
        self.step_s = 0.0
        """The last one: host less device grew by this, s."""
        self.reset()
        _fit(self._cells[0, :1], self._cells[1, :1], 0.0, self._work)  # loads the kernel before the first sample

    def reset(self) -> None:
        """Forget all but the count of steps: the device was restarted."""
        self._base_ns = 0
        self._origin, self._last = math.inf, 0.0
        self._first = self._end = self._cell = 0
        self._low = self._low_at = math.inf
        self._level = self._at = self._slope = 0.0
        self._lowered, self._bound = 0.0, math.inf

    def update(self, device_s: float, arrival_ns: int) -> float:
        """Take a sample's time on its own clock and its arrival; its age on arrival beyond the fastest one, s.

        Time that goes back starts the fit anew, as `reset` does.
        """
        if device_s < self._origin + self._last:
            self.reset()
            self._base_ns, self._origin = arrival_ns, device_s
        at = device_s - self._origin
        value = (arrival_ns - self._base_ns) * 1e-9 - at
        cell = int(at / self._cell_s)
        if cell != self._cell:
            self._close()
            self._cell = cell
        self._last = at
        age = value - self._level - self._slope * (at - self._at)
        if value < self._low:
            self._low, self._low_at = value, at
        if age < 0.0:
            self._level += age
            self._lowered -= age
            age = 0.0
        return age

    def host_ns(self, device_s: float) -> int:
        """Host clock (ns) when the device showed `device_s`, late by the smallest delay; there must have been a sample."""
        at = device_s - self._origin
        return self._base_ns + round((at + self._level + self._slope * (at - self._at)) * 1e9)

    @property
    def bound_s(self) -> float:
        """How far `host_ns` of the newest sample may be off, s; infinite while that is not known."""
        return self._bound + self._lowered

    @property
    def drift(self) -> float:
        """How much faster the device's clock goes than the host's, relative; zero while it is not known."""
        return -self._slope / (1.0 + self._slope)

    def _close(self) -> None:
        """Take the cell that is over into the fit."""
        known = self._end - self._first >= SETTLED
        wander = DRIFT * (self._low_at - self._at)  # of the line in a gap
        if self._lowered > (self._bound + NEAR_S + wander if known else STEP_S):
            if known and self._lowered > STEP_S + wander:
                self._count(-self._lowered)
            self._first = self._end  # what was before says nothing of the offset
        self._append()
        contradiction = self._refit()
        if contradiction:
            if contradiction > STEP_S:
                self._count(contradiction)
            self._first = self._end - SETTLED
            self._refit()
        self._low, self._lowered = math.inf, 0.0

    def _append(self) -> None:
        if self._end == self._cells.shape[1]:
            kept = self._end - self._first
            self._cells[:, :kept] = self._cells[:, self._first :]
            self._first, self._end = 0, kept
        self._cells[0, self._end], self._cells[1, self._end] = self._low_at, self._low
        self._end += 1
        self._first = max(self._first, self._end - WINDOW)
        while self._cells[0, self._first] < self._low_at - WINDOW * self._cell_s:
            self._first += 1

    def _refit(self) -> float:
        here = slice(self._first, self._end)
        time, value = self._cells[0, here], self._cells[1, here]
        self._level, self._slope, self._bound, contradiction = _fit(time, value, self._slope, self._work)
        self._at = float(time[-1])
        return contradiction

    def _count(self, step_s: float) -> None:
        self.steps += 1
        self.step_s = step_s
