"""What an aided navigator is worth: its sigmas, how the measurements meet it, and what becomes of their sources.

It is looked at every `LOOK_S` of the samples' own time, so what is found does not depend on how they were batched.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nav.chi_square import quantile
from nav.filter.aided import AidedNavigator, Judged
from nav.filter.health import Channel, ChannelHealth, Trust
from nav.increments import FloatArray
from nav.state import Ratio

LOOK_S = 0.1
FRESH_S = 5.0
"""An older measurement says nothing of the present, s."""
STREAK = 3
"""A source is rejected, or taken again, when so many of its measurements in a row are: a single one may be chance."""
SURE_M = 100.0
NOISY = 4.0
"""The stated variance is multiplied by so much when a source is called noisy: its noise is twice what it says."""

_RATIOS = {
    Channel.GNSS_POSITION: Ratio.POSITION,
    Channel.GNSS_VELOCITY: Ratio.VELOCITY,
    Channel.BARO: Ratio.HEIGHT,
    Channel.MAGNETIC: Ratio.DIRECTION,
    Channel.HEADING: Ratio.DIRECTION,
    Channel.ATTITUDE: Ratio.DIRECTION,
    Channel.BODY_VELOCITY: Ratio.VELOCITY,
    Channel.ZERO_RATE: Ratio.REST,
    Channel.GRAVITY: Ratio.REST,
}
_WORDS = {channel: channel.name.replace("_", " ").lower().replace("gnss", "GNSS") for channel in Channel}


class Note(NamedTuple):
    """Something that the user is told of a source; `time` in s."""

    time: float
    bad: bool
    text: str


@dataclass(slots=True)
class _Source:
    """Newest measurement, how many in a row were accepted (negative: rejected), and what has been told."""

    time: float = -math.inf
    distance: float = 0.0
    ratio: float = 0.0
    streak: int = 0
    rejected: bool = False
    noisy: bool = False


class Watch:
    """See the module.

    Attributes
    ----------
    sigma : (9,) float32
        Of position (m), velocity (m/s) and attitude (rad) north, east, down.
    ratio : (len(Ratio),) float32
        Innovation over its gate, of the sources of the last `FRESH_S` the one that fits worst; 0 without one. A measurement
        that was rejected has 1 and more.
    fixed : bool
        A receiver's position has been taken, and the level position is as sure as `SURE_M` still.
    """

    def __init__(self, aided: AidedNavigator) -> None:
        self._aided = aided
        self._gates = [quantile(aided.settings.gate, m) for m in (1, 2, 3)]
        self._sources: dict[tuple[Channel, int], _Source] = {}
        self._notes: list[Note] = []
        self._next = -math.inf
        self.fixed = False
        self.sigma, self.ratio = np.full(9, np.inf, np.float32), np.zeros(len(Ratio), np.float32)

    def start(self) -> None:
        """The navigator has begun anew."""
        self._sources.clear()
        self._next = -math.inf
        self.sigma[:], self.ratio[:] = self._aided.sigma[:9], 0.0
        self.fixed = False

    def notes(self) -> list[Note]:
        """What has become of the sources since the last call."""
        notes, self._notes = self._notes, []
        return notes

    def part(self, time: FloatArray) -> int:
        """How many of the samples that end at `time` (n,), s, come before the next look; looks if it is due before the first."""
        if time[0] >= self._next:
            self._look(float(time[0]))
        return int(np.searchsorted(time, self._next))

    def _look(self, time: float) -> None:
        self._next = (math.floor(time / LOOK_S) + 1) * LOOK_S
        if self._next <= time:  # rounding
            self._next += LOOK_S
        self.sigma[:] = self._aided.sigma[:9]
        for one in self._aided.judged():
            self._note(one)
        self.ratio[:] = 0.0
        for (channel, _), source in self._sources.items():
            if time - source.time <= FRESH_S:
                self.ratio[_RATIOS[channel]] = max(self.ratio[_RATIOS[channel]], source.ratio)
        taken = False
        for found in self._aided.health:
            taken = taken or (found.channel == Channel.GNSS_POSITION and found.source >= 0 and found.accepted > 0)
            self._tell(found)
        self.fixed = bool((self.fixed or taken) and np.hypot(self.sigma[0], self.sigma[1]) < SURE_M)

    def _note(self, one: Judged) -> None:
        source = self._sources.setdefault((one.channel, one.source), _Source())
        if one.time <= source.time:
            return  # taken again
        source.time, source.distance = one.time, math.sqrt(max(one.nis, 0.0))
        ratio = source.distance / math.sqrt(self._gates[one.freedom - 1])
        source.ratio = ratio if one.accepted else max(ratio, 1.0)
        sign = 1 if one.accepted else -1
        source.streak = source.streak + sign if sign * source.streak > 0 else sign

    def _tell(self, found: ChannelHealth) -> None:
        source = self._sources.get((found.channel, found.source))
        if source is None:
            return
        if source.rejected != (source.streak < 0) and abs(source.streak) >= STREAK:
            source.rejected = not source.rejected
            why = "it pulls one way" if found.trust & Trust.DRIFTING else f"{source.distance:.1f} sigma"
            self._say(source.time, found, source.rejected, f"is rejected: {why}", "is taken again")
        if source.noisy != (found.inflation >= NOISY) and (found.inflation >= NOISY or found.inflation == 1.0):
            source.noisy = not source.noisy
            self._say(source.time, found, source.noisy, "is noisier than it says", "is as good as it says")

    def _say(self, time: float, found: ChannelHealth, bad: bool, when_bad: str, when_good: str) -> None:
        what = f"{_WORDS[found.channel]} {found.source}"
        self._notes.append(Note(time, bad, f"{what} {when_bad if bad else when_good}"))
