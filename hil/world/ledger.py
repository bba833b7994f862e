"""What a bridge must count of a faulty wire: the frames that went out, judged as the head's driver has to judge them.

Plain bookkeeping by the numbers that the encoder gave, without a look at the bytes: what the driver finds out from counters,
clocks and checks can be compared with it, and both must be the same number for number.
"""

from dataclasses import dataclass, field

KEPT = 64
"""How many of the newest samples are remembered, for duplicates and late ones."""


@dataclass(slots=True)
class Ledger:
    """Counts by the names of `drivers.Counters`, as frames go out; `parts` frames make a sample of `period_us`."""

    parts: int
    period_us: int
    frames: int = 0
    samples: int = 0
    late: int = 0
    duplicated: int = 0
    crc_errors: int = 0
    foreign: int = 0
    frozen: int = 0
    clock_steps: int = 0
    restarts: int = 0
    skipped_bytes: int = 0
    _first: int = -1
    _highest: int = -1
    _clock_us: int = 0
    """Error of the device's clock at the newest sample."""
    _seen: set[int] = field(default_factory=set)
    _open: int = -1
    _have: int = 0
    _completed: tuple[int, int] = (-1, -1)

    def add_part(self, sample: int, part: int, clock_us: int, *, frozen: bool) -> None:
        """An undamaged frame of a sample goes out; `clock_us` is the error of the sample's time."""
        bit = 1 << part
        if (sample == self._open and self._have & bit) or (self.parts > 1 and (sample, part) == self._completed):
            self.duplicated += 1
            return
        if sample != self._open:
            self._open, self._have = sample, 0
        self._have |= bit
        if self._have == (1 << self.parts) - 1:
            self._open, self._completed = -1, (sample, part)
            self._complete(sample, clock_us, frozen=frozen)

    def _complete(self, sample: int, clock_us: int, *, frozen: bool) -> None:
        if frozen:
            self.frozen += 1
        elif sample > self._highest:
            self._first = sample if self._first < 0 else self._first
            self._note_clock(sample - self._highest, clock_us)
            self._highest = sample
            self.samples += 1
            self._seen = (
                {one for one in self._seen if one > sample - KEPT} if len(self._seen) > 2 * KEPT else self._seen
            )
            self._seen.add(sample)
        elif sample in self._seen or sample < self._first:  # one from before the first was never missed
            self.duplicated += 1
        else:
            self._seen.add(sample)
            self.late += 1

    def _note_clock(self, steps: int, clock_us: int) -> None:
        jump, self._clock_us = clock_us - self._clock_us, clock_us
        is_back = steps * self.period_us + jump <= 0
        if self.samples and steps < KEPT and (is_back or abs(jump) > (1 + steps // 8) * self.period_us):
            self.clock_steps += 1

    @property
    def lost(self) -> int:
        """Samples missing between the first and the last that arrived."""
        return self._highest + 1 - max(self._first, 0) - self.samples - self.late

    def as_dict(self) -> dict[str, int]:
        """Name to count."""
        names = ("frames", "samples", "lost", "late", "duplicated", "crc_errors", "foreign", "frozen", "clock_steps")
        return {name: getattr(self, name) for name in names}
