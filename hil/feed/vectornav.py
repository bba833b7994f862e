"""The feed to ArduPilot's ExternalAHRS: a VectorNav VN-300 on a pseudo-terminal, a TCP port or a serial line."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from drivers.mavlink.link import Link, Listener, open_link
from drivers.mavlink.px4 import Claim
from drivers.mavlink.sole import SoleClient
from drivers.mavlink.solution import Solution
from drivers.serial.pty import PtyLink
from drivers.serial.vectornav_ahrs import OUTPUTS, Ahrs, Measured, Output
from hil.feed.common import Maker, Socket
from hil.feed.config import FeedConfig
from hil.feed.tap import Rows, Tap
from hil.scenario import Scenario
from nav.errors import HilError

_PIECES = 16
"""Pieces of input that are taken before something is sent."""
_LATE_S = 0.1
"""Packets that are later than this become one."""


class _Stream:
    """One binary output: the solutions since its last packet."""

    def __init__(self, output: Output) -> None:
        self.output = output
        self._rows: list[Rows] = []
        self._due: float | None = None

    def add(self, rows: Rows) -> Iterator[Rows]:
        """The solutions of each packet that is due with `rows`."""
        times, period, start = rows["time"], self.output.period_s, 0
        due = times[0] + period if self._due is None else self._due
        due = max(due, times[-1] - _LATE_S)
        while (at := int(times.searchsorted(due - 1e-6))) < len(rows):
            self._rows.append(rows[start : at + 1])
            yield np.concatenate(self._rows)
            self._rows.clear()
            start, due = at + 1, due + period
        self._rows.append(rows[start:])
        self._due = due


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
            for taken in stream.add(rows):
                solution = self._make.solution(taken)
                if solution is not None:
                    self._send(f"output {number}", stream.output.packet(self._measured(solution, taken)))

    def _measured(self, solution: Solution, taken: Rows) -> Measured:
        bias = 0.0 if self._compensated else taken["gyro_bias"][-1]
        x, y, z = (np.asarray(solution.w_ib_b) + bias).tolist()
        return Measured(solution, (x, y, z), self._make.around(solution), self._claim)

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
        opened = open_link(config.listens or config.place)
    except HilError as error:
        raise HilError(f"feed {config.name}: {error}") from error
    if isinstance(opened, Listener):
        return SoleClient(opened), f"tcp {rest.rpartition(':')[0]}:{opened.port}"
    return opened, config.place
