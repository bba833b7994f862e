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

from drivers.logs.tlog import TlogWriter
from drivers.mavlink.commands import answer
from drivers.mavlink.events import PACE_S, Happened, changes
from drivers.mavlink.extra import CurrentEventSequence, Event
from drivers.mavlink.files import FileServer
from drivers.mavlink.link import Link
from drivers.mavlink.messages import KINDS, Kind, Message
from drivers.mavlink.options import LinkOptions
from drivers.mavlink.signing import Signer
from drivers.mavlink.solution import Solution
from drivers.mavlink.station import SEVERITIES, Station
from nav.state import Health, Mode

_EVENTS_S = 5.0
"""How often the number of the newest event is told, for clients that have missed it."""
_AGAIN_S = 0.5
"""When to look again at a link without a peer."""
_TEXT = 50
"""Characters of one STATUSTEXT."""
_LONGEST_GAP = 128
"""A gap in a sequence as long as this is a sender that began anew, or one that repeats itself."""
_MARKERS = (mav.PROTOCOL_MARKER_V1, mav.PROTOCOL_MARKER_V2)


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
    options : LinkOptions, optional
        What is different on this link.
    signer : Signer, optional
        Signs and checks; without it nothing is signed and nothing asked for.
    log : TlogWriter, optional
        Takes every frame that is sent, and every one received that is not refused.
    number : int
        Of the link, for signatures.
    """

    def __init__(
        self,
        station: Station,
        link: Link,
        options: LinkOptions | None = None,
        signer: Signer | None = None,
        log: TlogWriter | None = None,
        number: int = 0,
    ) -> None:
        self.station = station
        self.link = link
        self.options = options or LinkOptions(link.url)
        self.log = log
        self.sent: Counter[str] = Counter()
        self.received: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        """Messages whose signature was missing or wrong, by reason."""
        self.lost = 0
        """Messages missing in the sequences of the senders."""
        self.bad_data = 0
        """Stretches of bytes that were no message."""
        self.dropped = 0
        """Messages that a link with a peer did not take."""
        self.waits: Kind | None = None
        """What is due and goes out with the next solution, the most urgent of it."""
        self._signer, self._number = signer if self.options.sign else None, number
        self._packer = mav.MAVLink(None, station.identity.system_id, station.identity.component_id)
        self._rehearsal = mav.MAVLink(None, station.identity.system_id, station.identity.component_id)
        self._parser = mav.MAVLink(None)
        self._parser.robust_parsing = True
        self._sequences: dict[tuple[int, int], int] = {}
        self._streams = {name: _Stream(kind, self.default_s(name)) for name, kind in KINDS.items()}
        self._announced = (Mode.INIT, Health.GOOD)
        self._announce_s = -math.inf
        self._told = station.noted
        self.files = FileServer(station.files)
        self.wants_events = False
        """Whether a client has shown that it knows events: to one that does not, they look like losses."""
        self._event = station.events.count
        self._event_s = -math.inf
        self._long_texts = 0
        station.on_rate.append(self._renew)
        station.on_home.append(self._send_home)

    def close(self) -> None:
        """Take part in the station no longer."""
        self.station.on_rate.remove(self._renew)
        self.station.on_home.remove(self._send_home)

    def poll(self, now_s: float) -> float:
        """Send what is due, and answer what has arrived; returns when to come again at the latest."""
        self.station.now_s = now_s
        data = self.link.receive()  # one piece: what is due may not wait behind a flood; to send may end the connection
        next_s = self._send(now_s)
        if not data:
            return next_s
        for message in self._parsed(data):
            self._take(message)
        return self._send(now_s)  # what that has brought

    def _send(self, now_s: float) -> float:
        if not self.link.ready():
            self.waits, self._told, self._event = None, self.station.noted, self.station.events.count
            return now_s + _AGAIN_S
        self._announce(now_s)
        if self.wants_events:
            self._send_events(now_s)
        return self._send_due(now_s)

    def send(self, message: Message) -> None:
        """Send a message now."""
        if self._signer is not None:
            self._signer.sign(self._packer, self._number)
        frame = bytes(message.pack(self._packer))
        self._packer.seq = (self._packer.seq + 1) % 256
        name = message.get_type()
        if not self.link.send(frame):
            self.dropped += 1
            return
        self.sent[name] += 1
        if self.log is not None:
            self.log.write(frame)
        if name == "ATTITUDE":
            self.station.on_attitude()

    def rehearse(self, solution: Solution) -> None:
        """Build what waits for the next solution, of this one, and send nothing: its code is in the caches then."""
        if self.waits is not None and (message := self.waits.build(solution, self.station.situation)) is not None:
            message.pack(self._rehearsal)

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

    def _send_home(self) -> None:
        if self.allows("HOME_POSITION"):
            self.send_now("HOME_POSITION")

    def send_event(self, happened: Happened) -> None:
        """Send an event."""
        level = happened.kind.severity << 4 | happened.kind.severity
        numbers = happened.kind.number, happened.time_ms % 2**32, happened.sequence
        self.send(Event(0, 0, *numbers, level, [0] * 40))

    def _send_events(self, now_s: float) -> None:
        events = self.station.events
        for happened in events.since(self._event):
            self.send_event(happened)
        self._event = events.count
        if events.count and now_s >= self._event_s:
            self.send(CurrentEventSequence(events.newest, 0))
            self._event_s = now_s + _EVENTS_S

    def interval_s(self, name: str) -> float:
        """Interval of message `name` on this link, s; 0 when it is off."""
        return self._streams[name].interval_s

    def default_s(self, name: str) -> float:
        """Interval that message `name` has on this link unless a ground station asks for another, s; 0 when it is off."""
        if not self.allows(name):
            return 0.0
        rate_hz = self.options.rates_hz.get(name)
        if rate_hz is None:
            return self.station.interval_s(name)
        return 1.0 / rate_hz if rate_hz > 0.0 else 0.0

    def allows(self, name: str) -> bool:
        """Whether message `name` of the table may go out here."""
        return not self.options.only or name in self.options.only or name == "HEARTBEAT"

    def _renew(self, name: str) -> None:
        if name not in self.options.rates_hz:
            self.set_interval(name, self.default_s(name))

    def set_interval(self, name: str, interval_s: float) -> None:
        """Set the interval of message `name` on this link, s; 0 switches it off."""
        stream = self._streams[name]
        if interval_s != stream.interval_s:
            stream.interval_s, stream.due_s = interval_s, -math.inf

    def _send_due(self, now_s: float) -> float:
        next_s = math.inf
        number = self.station.number
        self.waits = None
        for stream in self._streams.values():
            if stream.interval_s == 0.0:
                continue
            if stream.due_s <= now_s:
                if stream.kind.from_solution and stream.number == number:
                    self.waits = self.waits or stream.kind
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
        parser = self._parser
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
        sender = message.get_srcSystem(), message.get_srcComponent()
        if sender == (identity.system_id, identity.component_id):
            return  # our own, looped back
        if self._signer is not None and (reason := self._signer.refusal(message)):
            if not self.refused[reason]:
                self.station.tell("warning", f"MAVLink from system {sender[0]} is refused: {reason}")
            self.refused[reason] += 1
            return
        self.link.heard()
        self._count(sender, message)
        if not self.options.hear:
            return
        if self.station.intake is not None:
            self.station.intake.message(message, self.station)
        answer(message, self)

    def _count(self, sender: tuple[int, int], message: Any) -> None:
        name = message.get_type()
        self.received["UNKNOWN" if name.startswith("UNKNOWN_") else name] += 1  # there are 2^24 numbers of messages
        number, last = message.get_seq(), self._sequences.get(sender)
        self._sequences[sender] = number
        missing = 0 if last is None else (number - last - 1) % 256
        if missing < _LONGEST_GAP:
            self.lost += missing
        if self.log is not None and name != "SETUP_SIGNING":  # it holds a key
            self.log.write(bytes(message.get_msgbuf()))

    def _announce(self, now_s: float) -> None:
        """STATUSTEXT of what has changed in mode and health since the last announcement, or else of the next note."""
        if now_s < self._announce_s:
            return
        mode, health = self.station.solution.mode, self.station.solution.health
        if (mode, health) != self._announced:
            for kind in changes(self._announced, (mode, health)):
                self._say(kind.severity, kind.text)
            self._announced = mode, health
        elif self._told < self.station.noted:
            notes, waiting = self.station.notes, min(self.station.noted - self._told, len(self.station.notes))
            self._say(*notes[-waiting])
            self._told = self.station.noted - waiting + 1
        else:
            return
        self._announce_s = now_s + PACE_S

    def _say(self, severity: int, text: str) -> None:
        """STATUSTEXT, of more than `_TEXT` characters in numbered pieces."""
        data, number = text.encode("ascii", "replace"), 0
        if len(data) > _TEXT:
            self._long_texts = number = self._long_texts % 65535 + 1
        for piece in range(0, max(len(data), 1), _TEXT):
            self.send(mav.MAVLink_statustext_message(severity, data[piece : piece + _TEXT], number, piece // _TEXT))
