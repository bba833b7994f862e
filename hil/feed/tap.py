"""What a feed takes of the ring of solutions, and the gate that makes simulated time wait for the autopilots."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.ring import Ring, Shared
from nav.increments import FloatArray, IntArray
from nav.kernel import kernel
from nav.state import NAV_STATE, Mode

Rows = NDArray[Any]
_NAVIGATE = int(Mode.NAVIGATE)
_OPEN = 1 << 62
_POLL_S = 0.0005
_SPAN_ROWS = 1024
"""Most solutions of a span of simulated time."""
_EARLY = 1e-6
"""Times are sums of steps: a span is over so much before its end, s."""


class Gate:
    """How far each feed has read the ring; the loop waits for the slowest. Survives being passed to a spawned process."""

    def __init__(self, feeds: int, shared: Shared | None = None) -> None:
        self._shared = Shared(8 * feeds) if shared is None else shared
        self._read = np.frombuffer(self._shared.memory, np.int64, feeds)

    def __reduce__(self) -> Any:
        return Gate, (len(self._read), self._shared)

    def set(self, feed: int, number: int) -> None:
        """Feed `feed` needs no record before `number`."""
        self._read[feed] = number

    def open(self, feed: int) -> None:
        """Nobody waits for feed `feed` any more."""
        self._read[feed] = _OPEN

    def wait(self, ring: Ring, ahead: int, cancelled: Callable[[], bool]) -> None:
        """Wait until no feed is more than `ahead` records behind, or cancelled."""
        while ring.count - int(self._read.min()) > ahead and not cancelled():
            time.sleep(_POLL_S)


class Tap:
    """The navigated solutions of a ring, one span after another.

    Time never goes back: where the sensor's clock begins anew, it goes on from where it was.

    Parameters
    ----------
    ring : Ring
        Of `NAV_STATE`.
    gate : Gate, optional
        Simulated time: every solution counts, and the loop waits for us.
    feed : int
        Our number there.

    Attributes
    ----------
    lost : int
        Solutions that were overwritten before they were read.
    """

    def __init__(self, ring: Ring, gate: Gate | None = None, feed: int = 0) -> None:
        self._ring, self._gate, self._feed = ring, gate, feed
        self._rows = np.zeros(ring.capacity if gate is None else _SPAN_ROWS, NAV_STATE)
        self._number = 0
        self._index, self._times = np.zeros(len(self._rows), np.int64), np.zeros(len(self._rows))
        self._last = -math.inf
        self._step = 1e-3
        self._shift = 0.0
        self.lost = 0

    def skip(self) -> None:
        """In real time pass over what is there already, but for the newest."""
        if self._gate is None:
            self._number = max(self._ring.count - 1, self._number)

    def take(self, span_s: float) -> Rows | None:
        """The solutions of the next `span_s` (n,), at least one; None when they are not there yet.

        In real time all that are there, as soon as they cover the span.
        """
        if self._gate is None:
            return self._take(span_s, len(self._rows))
        likely = min(int(span_s / self._step) + 2, len(self._rows))
        taken = self._take(span_s, likely)
        if taken is None and self._ring.count - self._number >= likely:
            taken = self._take(span_s, len(self._rows))
        if taken is None:
            self._gate.set(self._feed, self._ring.count)  # all has been looked at
        return taken

    def _take(self, span_s: float, most: int) -> Rows | None:
        copied, first = self._ring.pull(self._rows[:most], self._number)
        self.lost += first - self._number
        self._number = first
        rows, index, times = self._rows[:copied], self._index, self._times
        there, shift, broken = _go_on(rows["time"], rows["mode"], self._last, self._step, self._shift, index, times)
        if there == 0:
            self._pass(copied)
            return None
        begin = self._last if self._last > -math.inf else times[0] - self._step
        count = int(times[:there].searchsorted(begin + span_s - _EARLY)) + 1
        if count > there and not broken and copied < len(self._rows):
            return None
        self._shift = shift  # not before: what is looked at again is not yet shifted
        if self._gate is None or count > there:
            count = there
        taken: Rows = rows[index[:count]]
        taken["time"] = times[:count]
        self._step = float(times[count - 1]) - (float(times[count - 2]) if count > 1 else float(begin))
        self._last = float(times[count - 1])
        self._pass(int(index[count - 1]) + 1)
        return taken

    def _pass(self, used: int) -> None:
        self._number += used
        if self._gate is not None:
            self._gate.set(self._feed, self._number)


@kernel
def _go_on(
    times: FloatArray,
    modes: NDArray[np.int32],
    last: float,
    step: float,
    shift: float,
    index: IntArray,
    out: FloatArray,
) -> tuple[int, float, bool]:
    """Fill `index` with the places of rows that are navigated and new, `out` with their times as they go on behind `last`.

    How many, the new shift, and whether the clock begins anew behind them. What a silent sensor's loop tells again is not new.
    """
    n, newest = 0, last
    for i in range(times.shape[0]):
        if modes[i] < _NAVIGATE:
            continue
        time = times[i] + shift
        if time < newest:
            if n > 0:
                return n, shift, True
            shift += newest + step - time
            time = newest + step
        if time > newest:
            index[n], out[n] = i, time
            newest = time
            n += 1
    return n, shift, False


def mean_row(rows: Rows, rates: str) -> Any:
    """One record: the newest of `rows` (n,), its rate and specific force the means over all.

    `rates` is ``"compensated"`` for rates with the navigator's gyro bias in them.
    """
    row = rows[-1].copy()
    if len(rows) > 1:
        row["w_ib_b"], row["f_b"] = rows["w_ib_b"].mean(axis=0), rows["f_b"].mean(axis=0)
    if rates == "compensated":
        row["w_ib_b"] += row["gyro_bias"]
    return row
