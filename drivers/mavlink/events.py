"""Named events: what changes in mode and health, as text for every client and as events of the MAVLink events interface.

An event has a number and a level; its words are in the metadata that clients fetch. Events are numbered in sequence for all
links, and the newest are kept for clients that have missed some.
"""

import math
from collections import deque
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mav

from nav.state import Health, Mode

PACE_S = 0.5
"""Shortest time between two looks at mode and health: a flapping flag may not fill a link."""
KEPT = 64
"""Events that can be asked for again."""
_COMPONENT = 1 << 24
"""Highest byte of an event's number: those of an autopilot or what stands in its place."""

MODE_TEXT = {
    Mode.INIT: "Waiting for the sensor",
    Mode.ALIGN: "Aligning: keep still",
    Mode.NAVIGATE: "Navigating",
    Mode.DEGRADED: "Navigation degraded",
}
HEALTH_TEXT = {
    Health.SILENT: (mav.MAV_SEVERITY_ERROR, "No samples from the sensor"),
    Health.BRIDGED: (mav.MAV_SEVERITY_WARNING, "A gap in the samples was bridged"),
    Health.SENSOR: (mav.MAV_SEVERITY_ERROR, "The sensor reports a fault"),
    Health.MOVING: (mav.MAV_SEVERITY_NOTICE, "Alignment waits: the vehicle moves"),
    Health.UNITS: (mav.MAV_SEVERITY_ERROR, "Specific force at rest is not 1 g"),
    Health.RATE_TOO_SMALL: (mav.MAV_SEVERITY_WARNING, "Cannot find north: heading must be given"),
    Health.SPARE: (mav.MAV_SEVERITY_WARNING, "A redundant instrument has failed"),
    Health.UNAIDED: (mav.MAV_SEVERITY_NOTICE, "Position is not aided and drifts"),
}


@dataclass(frozen=True)
class Named:
    """One kind of event."""

    number: int
    name: str
    severity: int
    text: str


def _table() -> dict[tuple[int, bool, bool], Named]:
    found = {}
    for mode, text in MODE_TEXT.items():
        severity = mav.MAV_SEVERITY_WARNING if mode == Mode.DEGRADED else mav.MAV_SEVERITY_INFO
        found[int(mode), False, True] = Named(_COMPONENT + 1 + int(mode), f"mode_{mode.name.lower()}", severity, text)
    for bit, (flag, (severity, text)) in enumerate(HEALTH_TEXT.items()):
        name, number = f"health_{str(flag.name).lower()}", _COMPONENT + 16 + 2 * bit
        found[int(flag), True, True] = Named(number, name, severity, text)
        found[int(flag), True, False] = Named(number + 1, f"{name}_over", mav.MAV_SEVERITY_INFO, f"Over: {text}")
    return found


_TABLE = _table()
EVENTS = tuple(_TABLE.values())
"""Every kind of event."""


def changes(old: tuple[Mode, Health], new: tuple[Mode, Health]) -> list[Named]:
    """What has happened from one mode and health to another."""
    found = [_TABLE[int(new[0]), False, True]] if new[0] != old[0] else []
    for flag in HEALTH_TEXT:
        if flag & new[1] & ~old[1]:
            found.append(_TABLE[int(flag), True, True])
        elif flag & old[1] & ~new[1]:
            found.append(_TABLE[int(flag), True, False])
    return found


@dataclass(frozen=True)
class Happened:
    """One event."""

    sequence: int
    time_ms: int
    kind: Named


class EventLog:
    """The events of a component, in sequence."""

    def __init__(self) -> None:
        self.count = 0
        """Events so far."""
        self._last: deque[Happened] = deque(maxlen=KEPT)
        self._seen = (Mode.INIT, Health.GOOD)
        self._next_s = -math.inf

    def follow(self, mode: Mode, health: Health, time_ms: int, now_s: float) -> None:
        """Note what has changed since the last look."""
        if now_s < self._next_s or (mode, health) == self._seen:
            return
        for kind in changes(self._seen, (mode, health)):
            self._last.append(Happened(self.count % 65536, time_ms, kind))
            self.count += 1
        self._seen, self._next_s = (mode, health), now_s + PACE_S

    def since(self, count: int) -> list[Happened]:
        """The events behind the first `count`, those that are still kept."""
        missing = min(self.count - count, len(self._last))
        return list(self._last)[-missing:] if missing > 0 else []

    def find(self, sequence: int) -> Happened | None:
        """The event of a number; None when it is kept no longer, or has not happened."""
        return next((one for one in self._last if one.sequence == sequence), None)

    @property
    def oldest(self) -> int:
        """Number of the oldest event that is kept; of the next one when none is."""
        return self._last[0].sequence if self._last else self.count % 65536

    @property
    def newest(self) -> int:
        """Number of the newest event."""
        return (self.count - 1) % 65536
