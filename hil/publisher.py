"""The publisher: a process that sends the newest solution as MAVLink, and hears what ground stations want.

It sleeps until something is due. Then, unless the sensor is slow, it waits for the next solution and sends that one: what
goes out has just been computed. The loop that computes never waits for it.
"""

import math
import selectors
import signal
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.mavlink.endpoint import Endpoint
from drivers.mavlink.intake import Intake
from drivers.mavlink.link import open_link
from drivers.mavlink.station import Identity, Station
from hil.control import Control
from hil.geoid import undulation
from hil.link_stats import LinkStats
from hil.ring import Ring, Wake
from hil.scenario import MavlinkConfig
from nav.errors import HilError
from nav.state import NAV_STATE

_SILENCE_S = 1.0
"""Without a solution for this long the status says so, whatever the last solution said."""
_READ_S = 0.1
"""A solution is read at least this often, for the status."""
_AGES = 1 << 16
"""How many ages of solutions are kept for the statistics."""
_TELL_S = 0.2
"""What went over the links is told so often."""


@dataclass(frozen=True, slots=True)
class Taps:
    """What the publisher shares with the loop; picklable to a spawned process.

    Attributes
    ----------
    states : Ring
        Of `NAV_STATE`.
    reader : int
        Which of its wake-ups is ours.
    events : Ring
        Of `hil.bridge.EVENTS`: those for ground stations are told.
    control : Control
        Takes alignment requests to the loop; brings the loss of samples.
    aiding : Ring, optional
        Of `FRAME`: takes measurements from the network to the loop.
    early : bool
        They serve the alignment as well.
    links : LinkStats, optional
        Told a few times a second what went over the links.
    """

    states: Ring
    reader: int
    events: Ring
    control: Control
    aiding: Ring | None = None
    early: bool = False
    links: LinkStats | None = None


def run_publisher(config: MavlinkConfig, taps: Taps, stop: Wake, report: Connection) -> None:
    """Publish until `stop` is called or the other end of `report` is closed; target of a spawned process.

    Parameters
    ----------
    config : MavlinkConfig
        Links, identity and rates.
    taps : Taps
        Shared with the loop.
    stop : Wake
        Ends the publisher.
    report : Connection
        Gets one dictionary at the end: ``sent`` and ``received`` (by message), ``bad_data``, ``dropped``, ``links`` (the
        same for each URL), ``latency_us`` (arrival of the sample to the end of sending, `None` without one) and, where
        measurements are taken, ``aiding`` (``taken`` by message, ``refused`` by reason); or
        ``failed``, a text, when a link could not be opened or the configuration is wrong.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to end
    with ExitStack() as stack:
        try:
            identity = Identity(config.system_id, config.component_id, config.vehicle)
            intake = _intake(config, taps)
            order = partial(_obey, control=taps.control)
            station = Station(identity, config.rates_hz, undulation, order, intake)
            endpoints = []
            for url in config.links:
                link = open_link(url)
                stack.callback(link.close)
                endpoints.append(Endpoint(station, link))
        except HilError as error:
            _tell(report, {"failed": str(error)})
            return
        _warm_up(station)
        publisher = _Publisher(taps, station, endpoints)
        stack.callback(publisher.close)
        publisher.run(stop, report)
        _tell(report, publisher.counters())


class _Publisher:
    """The state of one run."""

    def __init__(self, taps: Taps, station: Station, endpoints: Sequence[Endpoint]) -> None:
        self._ring, self._wake, self._control = taps.states, taps.states.wakes[taps.reader], taps.control
        self._station, self._endpoints = station, endpoints
        self._links, self._told_s = taps.links, -math.inf
        self._row = np.zeros(1, NAV_STATE)
        self._events, self._event_number = taps.events, 0
        self._notes = np.zeros(16, taps.events.dtype)
        self._seen = 0
        self._read_s = -math.inf
        self._silent = False
        self._ages_ns = np.zeros(_AGES, np.int64)
        self._aged = 0
        self._selector = selectors.DefaultSelector()
        self._watching = False
        for endpoint in endpoints:
            self._selector.register(endpoint.link, selectors.EVENT_READ)

    def close(self) -> None:
        self._selector.close()

    def run(self, stop: Wake, report: Connection) -> None:
        self._selector.register(stop, selectors.EVENT_READ)
        self._selector.register(report, selectors.EVENT_READ)  # readable: the parent is gone
        ends = (stop, report)
        next_s = time.monotonic()
        while True:
            ready = [key.fileobj for key, _ in self._selector.select(max(0.0, next_s - time.monotonic()))]
            if any(one in ends for one in ready):
                return
            next_s = self._step(self._wake in ready)

    def _step(self, called: bool) -> float:
        """Do what is due now; returns when to come again."""
        if called:
            self._wake.clear()
        now_s = time.monotonic()
        if called or now_s - self._read_s > _READ_S:
            self._read(now_s)
        next_s = self._poll(now_s)
        if self._links is not None and now_s - self._told_s > _TELL_S:
            self._told_s = now_s
            self._links.tell(self._endpoints)
        if self._hungry() and self._ring.count - self._seen == 1:  # a slow sensor: do not wait for its next solution
            self._read(now_s)
            next_s = self._poll(now_s)
        self._watch(self._hungry())
        return next_s

    def _hungry(self) -> bool:
        return any(endpoint.waits for endpoint in self._endpoints)

    def _poll(self, now_s: float) -> float:
        before = sum(endpoint.sent["ATTITUDE"] for endpoint in self._endpoints)
        next_s = min((endpoint.poll(now_s) for endpoint in self._endpoints), default=now_s + _SILENCE_S)
        if sum(endpoint.sent["ATTITUDE"] for endpoint in self._endpoints) != before:
            self._ages_ns[self._aged % _AGES] = time.time_ns() - self._row["arrival_ns"][0]
            self._aged += 1
        return next_s

    def _read(self, now_s: float) -> None:
        count = self._ring.count
        if count != self._seen and self._ring.latest(self._row):
            self._seen = count
            self._read_s, self._silent = now_s, False
            self._station.update(self._row[0], now_s)
        elif self._seen and not self._silent and now_s - self._read_s > _SILENCE_S:
            self._silent = True
            self._station.silence()
        self._station.set_loss(self._control.lost, self._control.samples)
        copied, first = self._events.pull(self._notes, self._event_number)
        self._event_number = first + copied
        for note in self._notes[:copied][self._notes["station"][:copied]]:
            self._station.tell(note["severity"].decode(), note["text"].decode(errors="replace"))

    def _watch(self, wanted: bool) -> None:
        """Wait for the loop's call only while a new solution is wanted: it calls a thousand times a second."""
        if wanted == self._watching:
            return
        self._watching = wanted
        if not wanted:
            self._selector.unregister(self._wake)
            return
        if self._ring.count != self._seen:
            self._wake.clear()  # those have aged already: the next one is wanted
        self._selector.register(self._wake, selectors.EVENT_READ)

    def counters(self) -> dict[str, Any]:
        """What was sent and received, for the report."""
        links = {
            endpoint.link.url: {
                "sent": dict(endpoint.sent),
                "received": dict(endpoint.received),
                "bad_data": endpoint.bad_data,
                "dropped": endpoint.dropped,
            }
            for endpoint in self._endpoints
        }
        total: dict[str, Any] = {
            key: dict(sum((getattr(endpoint, key) for endpoint in self._endpoints), Counter[str]()))
            for key in ("sent", "received")
        }
        for key in ("bad_data", "dropped"):
            total[key] = sum(getattr(endpoint, key) for endpoint in self._endpoints)
        if (intake := self._station.intake) is not None:
            total["aiding"] = {"taken": dict(intake.taken), "refused": dict(intake.refused)}
        return total | {"links": links, "latency_us": self._latency()}

    def _latency(self) -> dict[str, float] | None:
        ages_us = self._ages_ns[: min(self._aged, _AGES)] / 1e3
        if not len(ages_us):
            return None
        p50, p99, p999 = np.percentile(ages_us, (50.0, 99.0, 99.9))
        return {"p50": float(p50), "p99": float(p99), "p999": float(p999), "max": float(ages_us.max())}


def _intake(config: MavlinkConfig, taps: Taps) -> Intake | None:
    """What is taken from the network, as frames of a sender of its own to the loop."""
    ring = taps.aiding
    if ring is None or not config.aiding:
        return None
    from drivers.can.aiding import AidingEncoder

    encoder = AidingEncoder()

    def relay(rows: NDArray[Any]) -> None:
        batch = encoder.frames(rows)
        batch["time_ns"] = time.time_ns()
        ring.push(batch)

    return Intake(config.aiding_from, config.master, config.aiding_delay_s, relay, early=taps.early)


def _obey(command: str, control: Control) -> None:
    if command == "align":
        control.request_align()


def _warm_up(station: Station) -> None:
    """Compile or load every kernel before the first message is due."""
    station.geoid(0.0, 0.0)


def _tell(report: Connection, what: dict[str, Any]) -> None:
    try:
        report.send(what)
    except OSError:
        pass  # nobody is left to hear it
