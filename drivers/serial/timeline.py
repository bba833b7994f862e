"""The order of a board's samples, by its clock and, where it has one, its counter.

The next sample or a later one is taken, and what is missing is counted as lost: by the counter, whose turns the clock
resolves, or by the clock alone. The same sample again is a duplicate, one that was counted as lost comes late; either is
known by time and counter, or by a time on the grid of the samples. A counter that stands still while time goes on is
frozen; where it goes on and time jumps, the clock was set, unless time jumps by as much again: then it is the rate that
was changed. Without a counter a jump ahead is told from a gap by the arrivals (:mod:`drivers.serial.lead`). One that fits
neither counter nor clock is set aside: when the next one continues it, the board started anew, maybe at another rate;
else it was damage that its check did not show, or another board on the wire, and counts as `crc_errors`.
"""

from drivers import Counters
from drivers.serial.lead import Lead

NEAR = 8
"""Most samples that may be missing behind one that was set aside for it to count as continued, or the clock as set.

Also most duplicates in a row by which a board without a counter is not yet said to have set its clock back.
"""
WINDOW = 64
"""How far back a sample counts as late or as a duplicate."""

LONGEST_NS = 3_600_000_000_000
"""No gap is longer: a leap of the clock beyond it is damage, or a board that started anew."""
_ALL = (1 << WINDOW) - 1


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
        self._lead = Lead()
        self._seen = 1
        """Bit k: the sample k before the newest was there."""
        self._first = 0
        """Number of the sample with which the board started."""
        self._again = 0
        """Older ones that came once more since the newest sample."""
        self._pace = 0
        """Time for each number of the counter up to the last sample, where it did not fit the period; else 0."""
        self.period_ns = 0
        """Between the last two samples that followed each other; 0 while unknown."""
        self.time_ns = 0
        """Of the newest sample, unwrapped."""
        self.sequence = 0
        """Number of the newest sample, unwrapped."""

    def place(self, time_ns: int, counter: int, said_ns: int = 0, arrival_ns: int = 0) -> int:
        """The step in ns of a sample that ended at `time_ns`, covers `said_ns` (0: not said) and came at `arrival_ns`.

        0: do not use it.
        """
        here = (time_ns, counter)
        if self._last is None:
            self._last, self.time_ns = here, time_ns
            self.sequence = self._first = counter
            return said_ns
        elapsed = self._elapsed(time_ns, self._last[0])
        number = (counter - self._last[1]) % self._turn if self._turn else 0
        if elapsed == 0 and number == 0:
            self._counters.duplicated += 1
            return 0
        period = said_ns or self.period_ns
        steps = self._steps(elapsed, number, period) if 0 < elapsed <= LONGEST_NS else 0
        by_counter = 0 < number <= NEAR and steps <= 0 and period > 0
        by_arrival = (
            steps > 1 and not self._turn and self._lead.leaps(self.time_ns + elapsed, arrival_ns, steps, period)
        )
        pace = elapsed // number if by_counter and 0 < elapsed <= LONGEST_NS else 0
        slowed = pace > 0 and abs(pace - self._pace) <= pace // 8
        self._pace = pace
        if slowed:
            steps, self.period_ns = number, pace
        elif by_counter or by_arrival:
            self._counters.clock_steps += 1
            steps = max(number, 1)
            elapsed = steps * period
        elif steps <= 0:
            return self._refuse(here, elapsed, number, said_ns, arrival_ns)
        if self._aside is not None:
            self._counters.crc_errors += 1
            self._aside = None
        self._last, self._again = here, 0
        self.time_ns += elapsed
        self.sequence += steps
        self._seen = (self._seen << steps | 1) & _ALL if steps < WINDOW else 1
        self._counters.lost += steps - 1
        if steps == 1 or not self.period_ns:
            self.period_ns = said_ns or elapsed // steps
        self._lead.note(self.time_ns, arrival_ns)
        return said_ns or (elapsed if steps == 1 else self.period_ns)

    def _elapsed(self, time_ns: int, since: int) -> int:
        half = self._clock // 2
        return (time_ns - since + half) % self._clock - half

    def _steps(self, elapsed: int, number: int, period: int) -> int:
        """How many samples on; 0 when counter and clock disagree."""
        by_clock = round(elapsed / period) if period else 0
        if not self._turn:
            return max(1, by_clock)
        if not period:
            return number
        steps = number + self._turn * round((by_clock - number) / self._turn)
        return steps if abs(steps - by_clock) <= 1 + by_clock // 64 else 0

    def _refuse(self, here: tuple[int, int], elapsed: int, number: int, said_ns: int, arrival_ns: int) -> int:
        """Count one that does not go on; the step of one that continues what was set aside."""
        period = said_ns or self.period_ns
        back = round(-elapsed / period) if period else 0
        if self._turn:
            agrees = (number + back) % self._turn == 0
        else:  # many in a row are new samples of a clock that was set back
            agrees = abs(elapsed + back * period) <= period // 8 and self._again < NEAR
        if agrees and 0 < back < WINDOW and back <= self.sequence - self._first:
            if self._seen >> back & 1:
                self._counters.duplicated += 1
                self._again += 1
            else:
                self._seen |= 1 << back
                self._counters.late += 1
                self._counters.lost -= 1
            return 0
        if self._turn and number == 0 and 0 < elapsed <= LONGEST_NS:
            self._counters.frozen += 1
            return 0
        if self._aside is None or not self._continues(here, self._aside):
            self._counters.crc_errors += self._aside is not None
            self._aside = here
            return 0
        self._counters.restarts += 1
        self._counters.lost += 1  # the one that was set aside
        self._last, self._aside, self._seen, self._lead = self._aside, None, 1, Lead()
        self.time_ns, self.period_ns = self._last[0], 0  # what starts anew may have another rate
        self.sequence += 1  # with this one's a jump: the navigator sees that time does not go on
        self._first = self.sequence
        return self.place(*here, said_ns, arrival_ns)

    def _continues(self, here: tuple[int, int], before: tuple[int, int]) -> bool:
        if self._elapsed(here[0], before[0]) <= 0:
            return False
        return not self._turn or 0 < (here[1] - before[1]) % self._turn <= NEAR
