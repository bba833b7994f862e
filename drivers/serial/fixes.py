"""What receivers of satellite navigation have in common: epochs out of messages, and the fix that an epoch is.

An epoch is all messages of one time. It is complete with the message that is the last one of an epoch by experience, so that
nothing waits for the next epoch; where that message is missing, the next epoch ends it. Two in a row with another last message
change the experience, one is damage.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from drivers.can.aiding import AidingArray
from nav.aiding import AIDING
from nav.errors import HilError

SMALLEST_M, SMALLEST_MS, SMALLEST_RAD = 0.01, 0.01, 1e-3
"""No receiver is believed to be better than this."""


class Refused(HilError):
    """An epoch that is no measurement; the text is the reason in a word or two."""


@dataclass(frozen=True, slots=True)
class Stated:
    """What a receiver does not say itself, one sigma.

    Attributes
    ----------
    range_m : float
        Error of a range of a plain fix, which the dilution of precision makes one of the position, m.
    speed_ms : float
        Error of the velocity, an axis, m/s.
    heading : float
        Error of a heading, rad.
    """

    range_m: float = 4.0
    speed_ms: float = 0.3
    heading: float = 0.02


@dataclass(frozen=True, slots=True)
class Fix:
    """What one epoch says.

    Attributes
    ----------
    arrival_ns : int
        Of its first message, host clock.
    utc_s : float, optional
        When it was true, s since 1970 (UTC); None where the receiver does not know date or time.
    rows : (n,) array of AIDING
        Measurements, their time and source still 0; none where `refused`.
    refused : str
        Why it is no measurement; empty for a good one.
    """

    arrival_ns: int
    utc_s: float | None
    rows: AidingArray
    refused: str = ""


@dataclass(slots=True)
class Epoch:
    """Messages of one time, by name."""

    key: object
    arrival_ns: int
    parts: dict[str, Any]
    done: bool = False


class Epochs:
    """Messages to epochs; see the module."""

    def __init__(self) -> None:
        self._epoch: Epoch | None = None
        self._last = ""
        self._others = 0

    def add(self, key: object, name: str, message: Any, arrival_ns: int) -> list[Epoch]:
        """The epochs that a message ends; a `key` of None is that of the epoch at hand."""
        ended, epoch = [], self._epoch
        if epoch is None or (key is not None and key != epoch.key):
            if key is None:
                return []
            if epoch is not None:
                self._learn(next(reversed(epoch.parts)))
                if not epoch.done:
                    ended.append(epoch)
            epoch = self._epoch = Epoch(key, arrival_ns, {})
        epoch.parts.pop(name, None)  # the order is that of the last time
        epoch.parts[name] = message
        if name == self._last and not epoch.done:
            epoch.done = True
            ended.append(epoch)
        return ended

    def _learn(self, last: str) -> None:
        self._others = self._others + 1 if last != self._last else 0
        if self._others > 1 or not self._last:
            self._last, self._others = last, 0


def fix_of(epoch: Epoch, utc: datetime | None, rows: Sequence[Any], refused: str = "") -> Fix:
    """A fix of `epoch`."""
    utc_s = None if utc is None else utc.timestamp()
    return Fix(epoch.arrival_ns, utc_s, np.array(list(rows), AIDING), refused)
