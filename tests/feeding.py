"""A feed as it runs, a process, and the ring that it reads."""

import multiprocessing
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from hil.control import Control
from hil.feed.common import ACTUATORS, Socket
from hil.feed.config import FeedConfig
from hil.feed.process import run_feed
from hil.feed.tap import Gate
from hil.ring import Ring, Wake
from hil.scenario import load
from nav.rotation import quaternion_from_euler
from nav.state import NAV_STATE, Mode

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["hil.feed.process", "hil.session"])
START = (np.radians(50.0), np.radians(36.25), 150.0)
"""Of the default scenario: latitude, longitude, height."""


def flight(count: int, first: int = 1, rate_hz: float = 1000.0) -> Any:
    """Solutions of a vehicle that turns, climbs and goes away from the start; every number of a row is its own."""
    rows = np.zeros(count, NAV_STATE)
    k = np.arange(first, first + count)
    rows["time"], rows["sequence"], rows["mode"] = k / rate_hz, k, Mode.NAVIGATE
    rows["arrival_ns"] = 1_790_000_000_000_000_000 + k * round(1e9 / rate_hz)
    rows["lat"], rows["lon"], rows["height"] = START[0] + 1e-8 * k, START[1] - 2e-8 * k, START[2] + 1e-3 * k
    rows["vel_n"] = np.stack([63.7 + 1e-4 * k, -82.1 + 1e-4 * k, -1.0 - 1e-4 * k], 1)
    rows["q_nb"] = [quaternion_from_euler(-0.9 + 1e-4 * n, 0.1, -0.2) for n in k]
    rows["w_ib_b"] = np.stack([1e-2 + 1e-5 * k, 2e-2 - 1e-5 * k, -3e-2 + 1e-6 * k], 1)
    rows["f_b"] = np.stack([0.3 + 1e-5 * k, -0.2 + 1e-5 * k, -9.8 + 1e-4 * k], 1)
    rows["gyro_bias"], rows["sigma"] = (1e-4, -2e-4, 3e-4), np.inf
    return rows


class RunningFeed:
    """One feed; `paced` False: in simulated time."""

    def __init__(self, *, paced: bool = True, changes: dict[str, Any] | None = None, **config: Any) -> None:
        self.ring = Ring(NAV_STATE, 4096, 1)
        self.actuators, self.gate = Ring(ACTUATORS, 16, 0), None if paced else Gate(1)
        self.stop, self.pushed = Wake(), 0
        self.report, theirs = _CONTEXT.Pipe()
        socket = Socket(self.ring, 0, self.actuators, self.gate, 0, Control())
        arguments = (FeedConfig(**config), load(None).with_changes(**changes or {}), socket, self.stop, theirs)
        self.process = _CONTEXT.Process(target=run_feed, args=arguments, daemon=True)
        self.process.start()
        theirs.close()
        self.said = self.hear()

    def hear(self, seconds: float = 60.0) -> dict[str, Any]:
        assert self.report.poll(seconds)
        answer: dict[str, Any] = self.report.recv()
        return answer

    @property
    def place(self) -> str:
        return str(self.said["place"])

    @property
    def port(self) -> int:
        return int(self.place.rpartition(":")[2])

    def push(self, count: int = 1) -> Any:
        """Push the next solutions; they are returned."""
        rows = flight(count, self.pushed + 1)
        self.ring.push(rows)
        self.pushed += count
        return rows

    def end(self) -> dict[str, Any]:
        """Stop it; its counters."""
        self.stop.call()
        counters = self.hear()
        self.process.join(10.0)
        assert self.process.exitcode == 0
        return counters

    def commanded(self) -> Any:
        """The newest row of `ACTUATORS`."""
        row = np.zeros(1, ACTUATORS)
        return row[0] if self.actuators.latest(row) else None


@contextmanager
def running_feed(**options: Any) -> Iterator[RunningFeed]:
    """A feed that does not outlive the block."""
    feed = RunningFeed(**options)
    try:
        yield feed
    finally:
        feed.process.kill()
        feed.process.join()


def until(condition: Any, seconds: float = 20.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)
