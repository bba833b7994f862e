"""The order of a board's samples, by its clock and, where it has one, its counter.

The next sample or a later one is taken, and what is missing is counted as lost: by the counter, whose turns the clock
resolves, or by the clock alone. The same sample again is a duplicate. One that fits neither counter nor clock is set
aside: when the next one continues it, the board started anew; else it was damage that its check did not show, or
another board on the wire, and counts as `crc_errors`.
"""

from drivers import Counters

NEAR = 8
"""Most samples that may be missing behind one that was set aside for it to count as continued."""

LONGEST_NS = 3_600_000_000_000
"""No gap is longer: a leap of the clock beyond it is damage, or a board that started anew."""


class Timeline:
    """Time and number of each sample; int ns.

    Parameters
    ----------
    counters : Counters
        Where the outcome is counted.
    clock_ns : int
        Time after which the board's clock begins again at zero.
    turn : int
        Number of samples after which its counter does; 0 for a board without one.
    """

    def __init__(self, counters: Counters, clock_ns: int, turn: int) -> None:
        self._counters = counters
        self._clock, self._turn = clock_ns, turn
        self._last: tuple[int, int] | None = None
        self._aside: tuple[int, int] | None = None
        self.period_ns = 0
        """Between the last two samples that followed each other; 0 while unknown."""
        self.time_ns = 0
        """Of the newest sample, unwrapped."""
        self.sequence = 0
        """Number of the newest sample, unwrapped."""

    def place(self, time_ns: int, counter: int, said_ns: int = 0) -> int:
        """The step in ns of a sample that ended at `time_ns` and covers `said_ns` (0: not said); 0: do not use it."""
        here = (time_ns, counter)
        if self._last is None:
            self._last, self.time_ns, self.sequence = here, time_ns, counter
            return said_ns
        elapsed = self._elapsed(time_ns, self._last[0])
        if elapsed == 0 and (not self._turn or counter == self._last[1]):
            self._counters.duplicated += 1
            return 0
        steps = self._steps(elapsed, counter, said_ns) if 0 < elapsed <= LONGEST_NS else 0
        if steps <= 0:
            return self._set_aside(here, said_ns)
        if self._aside is not None:
            self._counters.crc_errors += 1
            self._aside = None
        self._last = here
        self.time_ns += elapsed
        self.sequence += steps
        self._counters.lost += steps - 1
        if steps == 1 or not self.period_ns:
            self.period_ns = said_ns or elapsed // steps
        return said_ns or (elapsed if steps == 1 else self.period_ns)

    def _elapsed(self, time_ns: int, since: int) -> int:
        half = self._clock // 2
        return (time_ns - since + half) % self._clock - half

    def _steps(self, elapsed: int, counter: int, said_ns: int) -> int:
        """How many samples on; 0 when counter and clock disagree."""
        assert self._last is not None
        period = said_ns or self.period_ns
        by_clock = round(elapsed / period) if period else 0
        if not self._turn:
            return max(1, by_clock)
        steps = (counter - self._last[1]) % self._turn
        if not period:
            return steps
        steps += self._turn * round((by_clock - steps) / self._turn)
        return steps if abs(steps - by_clock) <= 1 + by_clock // 64 else 0

    def _set_aside(self, here: tuple[int, int], said_ns: int) -> int:
        if self._aside is not None and self._continues(here, self._aside):
            self._counters.restarts += 1
            self._last, self._aside = here, None
            self.time_ns = here[0]
            self.sequence += 2  # any jump: the navigator sees that time does not go on
            return said_ns or self.period_ns
        self._counters.crc_errors += self._aside is not None
        self._aside = here
        return 0

    def _continues(self, here: tuple[int, int], before: tuple[int, int]) -> bool:
        elapsed = self._elapsed(here[0], before[0])
        if elapsed <= 0:
            return False
        return not self._turn or 0 < (here[1] - before[1]) % self._turn <= NEAR
