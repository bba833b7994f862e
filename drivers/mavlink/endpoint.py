"""A MAVLink component on its links: what is sent when, and what is made of the bytes that come in.

One `Endpoint` for each link holds what its `Station` may not share: sequence counter, parser, rates, counters. Nothing here
has a thread or a clock: the caller says what time it is and is told when to come again.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink.commands import answer
from drivers.mavlink.link import Link
from drivers.mavlink.messages import KINDS, Kind, Message
from drivers.mavlink.station import SEVERITIES, Station
from nav.state import Health, Mode

_ANNOUNCE_S = 0.5
"""Shortest time between two announcements of mode or health: a flapping flag may not fill the link."""
_AGAIN_S = 0.5
"""When to look again at a link without a peer."""
_TEXT = 50
"""Characters of one STATUSTEXT."""
_MARKERS = (mav.PROTOCOL_MARKER_V1, mav.PROTOCOL_MARKER_V2)

_MODE_TEXT = {
    Mode.INIT: "Waiting for the sensor",
    Mode.ALIGN: "Aligning: keep still",
    Mode.NAVIGATE: "Navigating",
    Mode.DEGRADED: "Navigation degraded",
}
_HEALTH_TEXT = {
    Health.SILENT: (mav.MAV_SEVERITY_ERROR, "No samples from the sensor"),
    Health.BRIDGED: (mav.MAV_SEVERITY_WARNING, "A gap in the samples was bridged"),
    Health.SENSOR: (mav.MAV_SEVERITY_ERROR, "The sensor reports a fault"),
    Health.MOVING: (mav.MAV_SEVERITY_NOTICE, "Alignment waits: the vehicle moves"),
    Health.UNITS: (mav.MAV_SEVERITY_ERROR, "Specific force at rest is not 1 g"),
    Health.RATE_TOO_SMALL: (mav.MAV_SEVERITY_WARNING, "Cannot find north: heading must be given"),
    Health.SPARE: (mav.MAV_SEVERITY_WARNING, "A redundant instrument has failed"),
    Health.UNAIDED: (mav.MAV_SEVERITY_NOTICE, "Position is not aided and drifts"),
}


@dataclass(slots=True)
class _Stream:
    """One message at its rate on one link."""

    kind: Kind
    interval_s: float
    due_s: float = -math.inf
    number: int = 0
    """Of the solution last sent."""


class Endpoint:
    """A station on one link.

    Parameters
    ----------
    station : Station
        Shared with the other links.
    link : Link
        Owned and closed by the caller.
    """

    def __init__(self, station: Station, link: Link) -> None:
        self.station = station
        self.link = link
        self.sent: Counter[str] = Counter()
        self.received: Counter[str] = Counter()
        self.bad_data = 0
        """Stretches of bytes that were no message."""
        self.dropped = 0
        """Messages that a link with a peer did not take."""
        self.waits = False
        """Whether something is due that goes out with the next solution."""
        self._mav = mav.MAVLink(None, station.identity.system_id, station.identity.component_id)
        self._mav.robust_parsing = True
        self._streams = {name: _Stream(kind, station.interval_s(name)) for name, kind in KINDS.items()}
        self._announced = (Mode.INIT, Health.GOOD)
        self._announce_s = -math.inf
        self._told = station.noted
        self._long_texts = 0
        station.on_rate.append(lambda name: self.set_interval(name, station.interval_s(name)))

    def poll(self, now_s: float) -> float:
        """Read what has arrived, answer it, send what is due; returns when to come again at the latest."""
        self.station.now_s = now_s
        data = self.link.receive()  # one piece: what is due may not wait behind a flood
        for message in self._parsed(data) if data else ():
            self._take(message)
        if not self.link.ready():
            self.waits, self._told = False, self.station.noted
            return now_s + _AGAIN_S
        self._announce(now_s)
        return self._send_due(now_s)

    def send(self, message: Message) -> None:
        """Send a message now."""
        frame = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        name = message.get_type()
        if not self.link.send(frame):
            self.dropped += 1
            return
        self.sent[name] += 1
        if name == "ATTITUDE":
            self.station.on_attitude()

    def say(self, severity: str, text: str) -> None:
        """Have something said at once, whatever else waits to be told."""
        if self.link.ready():
            self._say(SEVERITIES[severity], text)

    def send_now(self, name: str) -> bool:
        """Send the newest message `name`; False when there is nothing to say yet."""
        message = KINDS[name].build(self.station.solution, self.station.situation)
        if message is not None:
            self.send(message)
        return message is not None

    def interval_s(self, name: str) -> float:
        """Interval of message `name` on this link, s; 0 when it is off."""
        return self._streams[name].interval_s

    def set_interval(self, name: str, interval_s: float) -> None:
        """Set the interval of message `name` on this link, s; 0 switches it off."""
        stream = self._streams[name]
        if interval_s != stream.interval_s:
            stream.interval_s, stream.due_s = interval_s, -math.inf

    def _send_due(self, now_s: float) -> float:
        next_s = math.inf
        number = self.station.number
        self.waits = False
        for stream in self._streams.values():
            if stream.interval_s == 0.0:
                continue
            if stream.due_s <= now_s:
                if stream.kind.from_solution and stream.number == number:
                    self.waits = True
                    continue
                message = stream.kind.build(self.station.solution, self.station.situation)
                if message is not None:
                    self.send(message)
                stream.number = number
                stream.due_s += stream.interval_s
                if stream.due_s <= now_s:
                    stream.due_s = now_s + stream.interval_s
            next_s = min(next_s, stream.due_s)
        return next_s

    def _parsed(self, data: bytes) -> Iterator[Any]:
        """Messages in `data`; after a frame that was none, the search goes on at its second byte."""
        parser = self._mav
        if self.link.datagrams and data[0] in _MARKERS and parser.buf:
            parser.buf, parser.buf_index = bytearray(), 0  # the rest of that frame will never come
            self.bad_data += 1
        message = parser.parse_char(data)
        while message is not None:
            if message.get_type() == "BAD_DATA":
                self.bad_data += 1
                if message.data[0] in _MARKERS:
                    parser.buf[: parser.buf_index] = message.data[1:]
                    parser.buf_index = 0
            else:
                yield message
            message = parser.parse_char(b"")
        del parser.buf[: parser.buf_index]
        parser.buf_index = 0

    def _take(self, message: Any) -> None:
        identity = self.station.identity
        if (message.get_srcSystem(), message.get_srcComponent()) == (identity.system_id, identity.component_id):
            return  # our own, looped back
        name = message.get_type()
        self.received["UNKNOWN" if name.startswith("UNKNOWN_") else name] += 1  # there are 2^24 numbers of messages
        if self.station.intake is not None:
            self.station.intake.message(message, self.station)
        answer(message, self)

    def _announce(self, now_s: float) -> None:
        """STATUSTEXT of what has changed in mode and health since the last announcement, or else of the next note."""
        if now_s < self._announce_s:
            return
        mode, health = self.station.solution.mode, self.station.solution.health
        if (mode, health) != self._announced:
            self._tell_change(mode, health)
        elif self._told < self.station.noted:
            notes, waiting = self.station.notes, min(self.station.noted - self._told, len(self.station.notes))
            self._say(*notes[-waiting])
            self._told = self.station.noted - waiting + 1
        else:
            return
        self._announce_s = now_s + _ANNOUNCE_S

    def _tell_change(self, mode: Mode, health: Health) -> None:
        old_mode, old_health = self._announced
        self._announced = mode, health
        if mode != old_mode:
            severity = mav.MAV_SEVERITY_WARNING if mode == Mode.DEGRADED else mav.MAV_SEVERITY_INFO
            self._say(severity, _MODE_TEXT[mode])
        for flag, (severity, text) in _HEALTH_TEXT.items():
            if flag & health & ~old_health:
                self._say(severity, text)
            elif flag & old_health & ~health:
                self._say(mav.MAV_SEVERITY_INFO, f"Over: {text}")

    def _say(self, severity: int, text: str) -> None:
        """STATUSTEXT, of more than `_TEXT` characters in numbered pieces."""
        data, number = text.encode("ascii", "replace"), 0
        if len(data) > _TEXT:
            self._long_texts = number = self._long_texts % 65535 + 1
        for piece in range(0, max(len(data), 1), _TEXT):
            self.send(mav.MAVLink_statustext_message(severity, data[piece : piece + _TEXT], number, piece // _TEXT))
