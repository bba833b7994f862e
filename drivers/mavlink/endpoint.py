"""A MAVLink component on its links: what is sent when, and what is made of the bytes that come in.

One `Station` holds what all links share: identity, the newest solution, home, parameters. One `Endpoint` for each link
holds what may not be shared: sequence counter, parser, rates, counters. Nothing here has a thread or a clock: the caller
says what time it is and is told when to come again.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink.commands import SHORTEST_INTERVAL_S, answer
from drivers.mavlink.intake import Intake
from drivers.mavlink.link import Link
from drivers.mavlink.messages import KINDS, VEHICLES, Kind, Message, Situation
from drivers.mavlink.parameters import Parameter, Parameters
from drivers.mavlink.solution import Home, Solution, Undulation
from nav.errors import HilError
from nav.state import NAV_STATE, Health, Mode

_SLOWEST_HEARTBEAT_HZ = 0.5
_ANNOUNCE_S = 0.5
"""Shortest time between two announcements of mode or health: a flapping flag may not fill the link."""
_AGAIN_S = 0.5
"""When to look again at a link without a peer."""
_NOTES = 16
"""Most notes that wait to be told."""
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
_SEVERITIES = {
    "info": mav.MAV_SEVERITY_INFO,
    "notice": mav.MAV_SEVERITY_NOTICE,
    "warning": mav.MAV_SEVERITY_WARNING,
    "error": mav.MAV_SEVERITY_ERROR,
}


@dataclass(frozen=True)
class Identity:
    """Who we are on the network."""

    system_id: int = 1
    component_id: int = 1
    vehicle: str = "fixed-wing"


class Station:
    """What all links share.

    Parameters
    ----------
    identity : Identity
        System, component, vehicle type (a key of `messages.VEHICLES`).
    rates_hz : mapping
        Message name to rate, over the built-in ones; 0 switches a message off.
    geoid : callable
        (lat, lon), rad, to the height of the geoid above the ellipsoid, m.
    on_command : callable
        Called with the name of what a ground station wants done: ``"align"``.
    intake : Intake, optional
        Takes what aids the navigator; without it nothing does.

    Raises
    ------
    HilError
        An unknown message name or vehicle, or a rate out of range.
    """

    def __init__(
        self,
        identity: Identity,
        rates_hz: Mapping[str, float],
        geoid: Undulation,
        on_command: Callable[[str], None],
        intake: Intake | None = None,
    ) -> None:
        if identity.vehicle not in VEHICLES:
            raise HilError(f"mavlink.vehicle = {identity.vehicle!r}: unknown; expected one of {', '.join(VEHICLES)}")
        for name, rate_hz in rates_hz.items():
            if name not in KINDS:
                raise HilError(f"mavlink.rates_hz.{name}: unknown message; expected one of {', '.join(KINDS)}")
            lowest = _SLOWEST_HEARTBEAT_HZ if name == "HEARTBEAT" else 0.0
            if not lowest <= rate_hz <= 1.0 / SHORTEST_INTERVAL_S:
                raise HilError(f"mavlink.rates_hz.{name} = {rate_hz}: expected {lowest:g} to 1000 Hz")
        self.identity = identity
        self.geoid = geoid
        self.on_command = on_command
        self.intake = intake
        self.on_rate: list[Callable[[str], None]] = []
        self._rates_hz = {name: kind.rate_hz for name, kind in KINDS.items()} | dict(rates_hz)
        self.parameters = Parameters(self._table())
        self.situation = Situation(vehicle_type=VEHICLES[identity.vehicle])
        self.solution = Solution.of(np.zeros(1, NAV_STATE)[0], geoid)
        self.number = 0
        """Counts solutions; 0 before the first one."""
        self.notes: deque[tuple[int, str]] = deque(maxlen=_NOTES)
        """The newest notes: severity and text."""
        self.noted = 0
        """Counts notes."""
        self.now_s = 0.0
        self._updated_s = 0.0

    def update(self, row: Any, now_s: float) -> None:
        """Take a new solution, one record of `NAV_STATE`; the first one that navigates sets home."""
        self.solution = Solution.of(row, self.geoid)
        self.number += 1
        self.now_s = self._updated_s = now_s
        if self.situation.home is None and self.solution.mode == Mode.NAVIGATE and self.solution.has_position:
            home = Home(self.solution.lat, self.solution.lon, self.solution.height)
            self.situation = replace(self.situation, home=home)

    def silence(self) -> None:
        """No solution has come for too long: say so in status and text until the next one."""
        mode = Mode.DEGRADED if self.solution.mode == Mode.NAVIGATE else self.solution.mode
        self.solution = replace(self.solution, mode=mode, health=self.solution.health | Health.SILENT)

    def tell(self, severity: str, text: str) -> None:
        """Have something said on every link: ``"info"``, ``"notice"``, ``"warning"`` or ``"error"``."""
        self.notes.append((int(_SEVERITIES[severity]), text))
        self.noted += 1

    def set_loss(self, lost: int, samples: int) -> None:
        """Sensor samples lost and received since the start."""
        if (lost, samples) != (self.situation.lost, self.situation.samples):
            self.situation = replace(self.situation, lost=lost, samples=samples)

    def device_ns(self) -> int:
        """Device time now, ns; the caller's clock before the first solution."""
        start_s = self.solution.time if self.number and self.solution.has_imu else 0.0
        return int(1e9 * (start_s + self.now_s - self._updated_s))

    def interval_s(self, name: str) -> float:
        """Interval that message `name` has on a new link, s; 0 when it is off."""
        rate_hz = self._rates_hz[name]
        return 1.0 / rate_hz if rate_hz > 0.0 else 0.0

    def _table(self) -> list[Parameter]:
        identity = self.identity
        table = [
            Parameter("SYSID_THISMAV", lambda: float(identity.system_id)),
            Parameter("HIL_COMPID", lambda: float(identity.component_id)),
            Parameter("HIL_VEHICLE", lambda: float(VEHICLES[identity.vehicle])),
        ]
        for name, kind in KINDS.items():
            lowest = _SLOWEST_HEARTBEAT_HZ if name == "HEARTBEAT" else 0.0
            table.append(Parameter(kind.parameter, self._get(name), self._set(name), lowest, 1.0 / SHORTEST_INTERVAL_S))
        return table

    def _get(self, name: str) -> Callable[[], float]:
        return lambda: self._rates_hz[name]

    def _set(self, name: str) -> Callable[[float], None]:
        def change(rate_hz: float) -> None:
            self._rates_hz[name] = rate_hz
            for told in self.on_rate:
                told(name)

        return change


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
        if self.link.send(frame):
            self.sent[message.get_type()] += 1
        else:
            self.dropped += 1

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
        self.received[message.get_type()] += 1
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
