"""The feed to ArduPilot SITL by its JSON interface: each servo packet is answered with the next solution."""

import math
import socket
import time
from typing import Any

from drivers.mavlink.ardupilot_json import FrameCounter, Servos, parse_servos, sensor_line
from drivers.mavlink.solution import Home, Solution
from hil.feed.common import Commanded, Maker, Socket
from hil.feed.config import FeedConfig
from hil.feed.tap import Tap
from hil.scenario import Scenario
from hil.settings import settings_of
from nav.errors import HilError

_LONGEST_S = 0.1
"""Most time that one frame covers: SITL takes longer ones for a reset."""
_AT_ONCE = 64
"""Datagrams that are taken before something is sent."""
_SILENT_S = 1.0
"""After so long another autopilot may take the place of one that is silent."""


class JsonFeed:
    """See the module; satisfies `hil.feed.common.Feed`."""

    def __init__(self, config: FeedConfig, scenario: Scenario, joint: Socket) -> None:
        host, _, port = config.place.rpartition(":")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind((host, int(port)))
        except (OSError, UnicodeError) as error:
            self._socket.close()
            raise HilError(f"feed {config.name}: cannot listen there: {error}") from error
        self.place = "udp " + ":".join(map(str, self._socket.getsockname()))
        start = settings_of(scenario)
        self._origin = Home(start.lat, start.lon, start.height)
        self._make, self._commanded = Maker(config, scenario), Commanded(joint.actuators)
        self._tap = Tap(joint.states, joint.gate, joint.number)
        self._frames = FrameCounter()
        self._peer: tuple[str, int] | None = None
        self._pending: Servos | None = None
        self._answer = b""
        self._time_s = 0.0
        self._began = self._ended = 0.0
        self.heard_s = -math.inf
        self.bad_data = self.refused = self.peers = self.answered = self.unsent = 0

    @property
    def hungry(self) -> bool:
        """An autopilot waits for its answer."""
        return self._pending is not None

    def fileno(self) -> int:
        """Descriptor to wait on for reading; constant."""
        return self._socket.fileno()

    def step(self, now_s: float) -> float:
        """See `Feed.step`."""
        for _ in range(_AT_ONCE):
            try:
                packet, sender = self._socket.recvfrom(2048)
            except BlockingIOError:
                break
            except OSError:  # the refusal of an earlier answer
                continue
            self._hear(packet, sender, now_s)
        if self._pending is not None:
            span = 1.0 / self._pending.rate_hz if self._pending.rate_hz else 0.0
            rows = self._tap.take(min(span, _LONGEST_S))
            solution = None if rows is None else self._make.solution(rows)
            if solution is not None:
                self._reply(solution)
        return now_s + 1.0

    def _hear(self, packet: bytes, sender: tuple[str, int], now_s: float) -> None:
        servos = parse_servos(packet)
        if servos is None:
            self.bad_data += 1
            return
        if sender != self._peer:
            if self._peer is not None and now_s - self.heard_s < _SILENT_S:
                self.refused += 1
                return
            self._peer, self.peers = sender, self.peers + 1
            self._frames.forget()
            self._tap.skip()
        self.heard_s = now_s
        if self._frames.take(servos.count):
            self._pending = servos
            self._commanded.tell(self._time_s, servos.pwm)
        elif self._pending is None:
            self._send(self._answer)

    def _reply(self, solution: Solution) -> None:
        self._answer = sensor_line(solution, solution.relative_to(self._origin))
        self._time_s, self._pending = solution.time, None
        self._send(self._answer)
        self.answered += 1
        self._ended = time.monotonic()
        self._began = self._began or self._ended

    def _send(self, answer: bytes) -> None:
        assert self._peer is not None
        try:
            self._socket.sendto(answer, self._peer)
        except OSError:
            self.unsent += 1

    def counters(self) -> dict[str, Any]:
        """See `Feed.counters`."""
        frames, seconds = self._frames, self._ended - self._began
        return {
            "frames": self.answered,
            "frames_hz": (self.answered - 1) / seconds if seconds > 0.0 else 0.0,
            "resent": frames.resent,
            "restarts": frames.restarts,
            "lost_frames": frames.lost,
            "bad_data": self.bad_data,
            "refused": self.refused,
            "connections": self.peers,
            "dropped": self.unsent,
            "lost_solutions": self._tap.lost,
            "actuators": self._commanded.summary(),
        }

    def close(self) -> None:
        """Give everything back."""
        self._socket.close()
