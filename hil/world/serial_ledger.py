"""What a bridge must count of a faulty serial line: as `hil.world.ledger`, by the rules of :mod:`drivers.serial.timeline`.

How often a search for packets starts falsely in damaged bytes depends on the bytes, so `crc_errors` is not said. How many bytes
are part of no packet is: right as long as no noise passes a check by chance.
"""

from dataclasses import dataclass

from drivers.serial.lead import LEAST_NS
from hil.wire_config import COUNTING
from hil.world.ledger import Ledger


@dataclass(slots=True)
class SerialLedger(Ledger):
    """Counts of a board whose packets are samples."""

    counting: bool = False
    """The board counts its samples."""
    unsaid: int = 0
    """Samples at the start that only set the clock: of a board that does not say the length of a step."""
    seem_lost: int = 0
    """Samples that seem to be missing where the clock was set ahead a little."""

    @classmethod
    def of(cls, driver: str, period_us: int) -> "SerialLedger":
        """The ledger of the board of `driver`."""
        return cls(1, period_us, counting=driver in COUNTING, unsaid=int(driver != "vectornav"))

    def _note_clock(self, steps: int, clock_us: int) -> None:
        jump, self._clock_us = clock_us - self._clock_us, clock_us
        elapsed = steps * self.period_us + jump
        by_clock = round(elapsed / self.period_us)
        if not self.samples:
            return
        if self.counting:
            self.clock_steps += elapsed <= 0 or abs(steps - by_clock) > 1 + by_clock // 64
        elif elapsed <= 0:
            self.restarts += 1
            self.samples -= 1  # it is set aside until the next one continues it
        elif by_clock > 1 and jump > max((by_clock - 1) * self.period_us // 2, LEAST_NS // 1000):
            self.clock_steps += 1
        else:  # taken for a gap
            self.seem_lost += by_clock - steps

    def as_dict(self) -> dict[str, int]:
        """Name to count; `skipped_bytes` is in `head` of the summary."""
        names = ("late", "duplicated", "frozen", "clock_steps", "restarts", "skipped_bytes")
        found = {name: getattr(self, name) for name in names}
        return {"samples": max(self.samples - self.unsaid, 0), **found, "lost": self.lost + self.seem_lost}
