"""The feed to ArduPilot's ExternalAHRS: a VectorNav VN-300 on a pseudo-terminal, a TCP port or a serial line."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from drivers.mavlink.link import Link, open_link
from drivers.mavlink.px4 import Claim
from drivers.mavlink.solution import Vector
from drivers.serial.pty import PtyLink
from drivers.serial.vectornav_ahrs import OUTPUTS, Ahrs, Measured, Output
from hil.feed.common import Maker, Socket
from hil.feed.config import FeedConfig
from hil.feed.tap import Rows, Tap
from hil.scenario import Scenario
from nav.errors import HilError

_PIECES = 16
"""Pieces of input that are taken before something is sent."""
_ROOM = 8192
"""Most solutions of one packet: what comes beyond is left out of its mean."""


class _Stream:
    """One binary output: the solutions since its last packet."""

    def __init__(self, output: Output) -> None:
        self.output = output
        self._rows: list[Rows] = []
        self._due: float | None = None

    def add(self, rows: Rows) -> Rows | None:
        """The solutions of a packet that is due with the newest of `rows`; None where none is."""
        now, period = float(rows["time"][-1]), self.output.period_s
        self._rows.append(rows)
        if self._due is None:
            self._due = now + period
        if now < self._due - 1e-6:
            return None
        self._due = self._due + period if now < self._due + period else now + period
        taken: Rows = np.concatenate(self._rows)[-_ROOM:]
        self._rows.clear()
        return taken


class VectorNavFeed:
    """See the module; satisfies `hil.feed.common.Feed`."""

    def __init__(self, config: FeedConfig, scenario: Scenario, joint: Socket) -> None:
        self._link, self.place = _opened(config)
        self._board = Ahrs()
        self._streams: list[_Stream] = []
        self._configured = 0
        self._claim = Claim(config.claim_m, config.claim_ms)
        self._compensated = config.rates == "compensated"
        self._make = Maker(config, scenario)
        self._tap = Tap(joint.states)
        self.sent: Counter[str] = Counter()
        self.heard_s = -1.0
        self.dropped = 0

    @property
    def hungry(self) -> bool:
        """Packets are wanted."""
        return self._board.measuring

    def fileno(self) -> int:
        """Descriptor to wait on for reading; constant."""
        return self._link.fileno()

    def step(self, now_s: float) -> float:
        """See `Feed.step`."""
        for _ in range(_PIECES):
            data = self._link.receive()
            if not data:
                break
            self.heard_s = now_s
            answer = self._board.answer(data)
            if answer:
                self._send("answers", answer)
        if self._board.configured != self._configured:
            self._configured = self._board.configured
            self._streams = [_Stream(output) for output in self._board.outputs]
            self._tap.skip()
        if self._link.ready() and self._board.measuring:
            rows = self._tap.take(0.0)
            if rows is not None:
                self._feed(rows)
        return now_s + 1.0

    def _feed(self, rows: Rows) -> None:
        for number, stream in zip(OUTPUTS, self._streams, strict=False):
            taken = stream.add(rows)
            solution = None if taken is None else self._make.solution(taken)
            if taken is None or solution is None:
                continue
            bias = taken["gyro_bias"][-1]
            raw = np.asarray(solution.w_ib_b) + (0.0 if self._compensated else bias)
            three: Vector = float(raw[0]), float(raw[1]), float(raw[2])
            measured = Measured(solution, three, self._make.around(solution), self._claim)
            self._send(f"output {number}", stream.output.packet(measured))

    def _send(self, name: str, data: bytes) -> None:
        if self._link.send(data):
            self.sent[name] += 1
        else:
            self.dropped += 1

    def counters(self) -> dict[str, Any]:
        """See `Feed.counters`."""
        return {
            "frames": sum(count for name, count in self.sent.items() if name != "answers"),
            "sent": dict(self.sent),
            "commands": self._board.commands,
            "bad_data": self._board.bad_data,
            "refused": getattr(self._link, "refused", 0),
            "dropped": self.dropped,
            "lost_solutions": self._tap.lost,
        }

    def close(self) -> None:
        """Give everything back."""
        self._link.close()


def _opened(config: FeedConfig) -> tuple[Link, str]:
    """The link of an address, and what the autopilot opens."""
    kind, _, rest = config.place.partition(":")
    try:
        if kind == "pty":
            terminal = PtyLink(Path(rest) if rest else None)
            return terminal, f"pty {terminal.url}"
        link = open_link(f"tcpin:{rest}" if kind == "tcp" else config.place)
    except HilError as error:
        raise HilError(f"feed {config.name}: {error}") from error
    port = getattr(link, "port", 0)
    return link, f"tcp {rest.rpartition(':')[0]}:{port}" if kind == "tcp" else config.place
