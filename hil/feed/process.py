"""The process of a feed: it sleeps until the autopilot speaks or, where one is awaited, the next solution is there."""

import contextlib
import selectors
import time
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from drivers.mavlink.px4 import hil_state_quaternion
from hil.feed.ardupilot import JsonFeed
from hil.feed.common import ACTUATORS, Commanded, Feed, Maker, Socket
from hil.feed.config import FeedConfig
from hil.feed.px4 import Px4Feed
from hil.feed.tap import Tap
from hil.feed.vectornav import VectorNavFeed
from hil.ring import Ring, Wake
from hil.scenario import Scenario
from nav.errors import HilError
from nav.state import NAV_STATE, Mode

_MAKERS: dict[str, Callable[[FeedConfig, Scenario, Socket], Feed]] = {
    "ardupilot-json": JsonFeed,
    "px4": Px4Feed,
    "vectornav": VectorNavFeed,
}


def run_feed(config: FeedConfig, scenario: Scenario, joint: Socket, stop: Wake, report: Connection) -> None:
    """Feed until `stop` is called or the other end of `report` is closed; target of a spawned process.

    `report` gets ``{"place": text}`` when the autopilot may come and the counters at the end, or ``{"failed": text}``.
    """
    with ExitStack() as stack:
        try:
            _warm_up(config, scenario)
            feed = _MAKERS[config.kind](config, scenario, joint)
            stack.callback(feed.close)
            _tell(report, {"place": feed.place})
            patience_s = config.patience_s if joint.gate is not None else None
            _serve(feed, joint, stop, report, patience_s)
            _tell(report, feed.counters())
        except HilError as error:
            _tell(report, {"failed": str(error)})
        finally:
            if joint.gate is not None:
                joint.gate.open(joint.number)


def _serve(feed: Feed, joint: Socket, stop: Wake, report: Connection, patience_s: float | None) -> None:
    wake, watching = joint.states.wakes[joint.reader], False
    began_s: float | None = None
    with selectors.DefaultSelector() as selector:
        for one in (feed, stop, report):
            selector.register(one, selectors.EVENT_READ)
        next_s = 0.0
        while True:
            joint.control.beat(f"feed {joint.number}")
            ready = [key.fileobj for key, _ in selector.select(max(0.0, next_s - time.monotonic()))]
            if stop in ready or report in ready:
                return
            if wake in ready:
                wake.clear()
            now_s = time.monotonic()
            next_s = feed.step(now_s)
            if feed.hungry != watching:
                watching = feed.hungry
                if watching:
                    selector.register(wake, selectors.EVENT_READ)
                else:
                    selector.unregister(wake)
            if patience_s is None or joint.states.count == 0:
                continue
            began_s = began_s or now_s
            if now_s - max(began_s, feed.heard_s) > patience_s and not feed.hungry:
                raise HilError(f"no autopilot on {feed.place} for {patience_s:g} s: simulated time goes on without it")


def _warm_up(config: FeedConfig, scenario: Scenario) -> None:
    """Compile or load every kernel before the autopilot is asked to come."""
    ring, row = Ring(NAV_STATE, 4, 0), np.zeros(1, NAV_STATE)
    row["mode"], row["q_nb"] = Mode.NAVIGATE, (1.0, 0.0, 0.0, 0.0)
    ring.push(row)
    rows, make = Tap(ring).take(0.0), Maker(config, scenario)
    solution = None if rows is None else make.solution(rows)
    if solution is not None:
        make.around(solution)
        hil_state_quaternion(solution)
    Commanded(Ring(ACTUATORS, 4, 0)).tell(0.0, (0.0,))


def _tell(report: Connection, what: dict[str, Any]) -> None:
    with contextlib.suppress(OSError):  # nobody is left to hear it
        report.send(what)
