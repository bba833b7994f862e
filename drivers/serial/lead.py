"""How far a board's clock is ahead of the arrivals, which tells a clock that was set ahead from a gap.

No sample arrives before it is measured. So behind a gap a sample is no further ahead than the fastest ones before it,
however late they came; where it is, by more than half of what seems to be missing, its clock was set. Arrivals that say
nothing (none, or many packets in one read at the start) leave it a gap.
"""

SETTLED_NS = 1_000_000_000
"""The fastest arrival is known when none was faster, by `FASTER_NS`, for so long."""
FASTER_NS = 30_000_000
LEAST_NS = 300_000_000
"""A smaller step is taken for a gap, which is bridged and counted: no adapter holds bytes up for so long."""
DRIFT = 2000
"""What was the fastest fades by one part in so many of the time: either clock may drift."""


class Lead:
    """The lead of the fastest sample, int ns; times are those of `Timeline`, on which a set clock leaves no trace."""

    def __init__(self) -> None:
        self._most = 0
        self._at: int | None = None
        self._risen = 0
        self._settling = 0
        """The lead when it last rose by `FASTER_NS`: arrivals that say nothing rise by less each, and go on rising."""

    def note(self, time_ns: int, arrival_ns: int) -> None:
        """Take the sample that ended at `time_ns` and came at `arrival_ns`."""
        lead = time_ns - arrival_ns
        if self._at is None or lead > self._settling + FASTER_NS:
            self._risen, self._settling = time_ns, lead
        self._most = lead if self._at is None else max(lead, self._most - (time_ns - self._at) // DRIFT)
        self._settling = min(self._settling, self._most)
        self._at = time_ns

    def leaps(self, time_ns: int, arrival_ns: int, steps: int, period_ns: int) -> bool:
        """Whether the clock of a sample that seems to be `steps` periods on was set ahead."""
        if self._at is None or self._at - self._risen < SETTLED_NS:
            return False
        ahead = time_ns - arrival_ns - self._most
        return ahead > max((steps - 1) * period_ns // 2, LEAST_NS)
