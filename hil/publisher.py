"""The publisher: a process that sends the newest solution as MAVLink, and hears what ground stations want.

It sleeps until something is due. Then, unless the sensor is slow, it waits for the next solution and sends that one: what
goes out has just been computed. The loop that computes never waits for it.
"""

import math
import os
import selectors
import time
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.mavlink.hub import Hub, total
from drivers.mavlink.intake import Intake
from drivers.mavlink.options import LinkOptions, parse_options
from drivers.mavlink.signing import Signer, read_key
from drivers.mavlink.solution import Solution
from drivers.mavlink.station import Identity, Station
from drivers.mavlink.store import Store, state_folder
from hil.clock import clock_reading
from hil.control import Control
from hil.geoid import undulation
from hil.link_stats import LinkStats
from hil.realtime import SharedProcessor
from hil.ring import Ring, Wake
from hil.scenario import MavlinkConfig
from hil.stats import Stats
from nav.aiding import AIDING
from nav.errors import HilError
from nav.state import NAV_STATE
from nav.turn import euler_of

_SILENCE_S = 1.0
"""Without a solution for this long the status says so, whatever the last solution said."""
_COLD_S = 0.005
"""What was not done for so long is in no cache of the processor any more, and takes two to three times as long."""
_READ_S = 0.1
"""A solution is read at least this often, for the status."""
_AGES = 1 << 16
"""How many ages of solutions are kept for the statistics."""
LOOP_DIED = "the navigation loop died: no solutions any more"
_LOOK_S = 0.002
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
    stats : Stats, optional
        What the loop's clock says is published.
    fixes : Ring, optional
        Of `AIDING`: what receivers have measured.
    links : LinkStats, optional
        Told a few times a second what went over the links.
    looks : bool
        The publisher looks for a solution that is due instead of waiting to be woken.
    """

    states: Ring
    reader: int
    events: Ring
    control: Control
    aiding: Ring | None = None
    early: bool = False
    stats: Stats | None = None
    fixes: Ring | None = None
    links: LinkStats | None = None
    looks: bool = False


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
        Brings (severity, text) of what is to be said on every link. Gets one dictionary at the end: ``sent`` and ``received``
        (by message), ``refused`` (by reason), ``bad_data``, ``dropped``, ``lost``, ``links`` (the same for each URL),
        ``latency_us`` (arrival of the sample to its ATTITUDE on a link, `None` without one) and, where measurements are taken,
        ``aiding`` (``taken`` by message, ``refused`` by reason); or ``failed``, a text, when a link could not be
        opened or the configuration is wrong.
    """
    with ExitStack() as stack:
        try:
            identity = Identity(config.system_id, config.component_id, config.vehicle)
            intake = _intake(config, taps)
            order = partial(_obey, control=taps.control)
            station = Station(identity, config.rates_hz, undulation, order, intake, _parameter_store(config))
            signer = _signer(config)
            if signer is not None:
                stack.callback(signer.close)
            hub = Hub(station, link_options(config), signer)
            stack.callback(hub.close)
        except HilError as error:
            _tell(report, {"failed": str(error)})
            return
        _warm_up(station, taps.states)
        publisher = _Publisher(taps, station, hub)
        stack.callback(publisher.close)
        publisher.run(stop, report)
        _tell(report, publisher.counters())


class _Publisher:
    """The state of one run."""

    def __init__(self, taps: Taps, station: Station, hub: Hub) -> None:
        self._ring, self._wake, self._control = taps.states, taps.states.wakes[taps.reader], taps.control
        self._stats, self._looks, self._processor = taps.stats, taps.looks, SharedProcessor()
        self._links, self._told_s = taps.links, -math.inf
        self._station, self._hub = station, hub
        station.on_attitude = self._attitude_sent
        self._row = np.zeros(1, NAV_STATE)
        self._fixes, self._fix, self._fixed = taps.fixes, np.zeros(1, AIDING), 0
        self._events, self._event_number = taps.events, 0
        self._notes = np.zeros(16, taps.events.dtype)
        self._seen = 0
        self._read_s = self._heard_s = -math.inf
        self._silent = False
        self._ages_ns = np.zeros(_AGES, np.int64)
        self._aged = 0
        self._selector = selectors.DefaultSelector()
        self._watching = False
        self._loop: int | None = None
        """Descriptor of the loop's process; -1: it had ended before we looked."""
        self._selector.register(hub, selectors.EVENT_READ)

    def close(self) -> None:
        self._selector.close()
        if self._loop not in {None, -1}:
            os.close(self._loop)

    def run(self, stop: Wake, report: Connection) -> None:
        self._selector.register(stop, selectors.EVENT_READ)
        self._selector.register(report, selectors.EVENT_READ)
        next_s = time.monotonic()
        while True:
            self._control.beat("publisher")
            if self._loop is None and (pid := self._control.loop_pid):
                self._watch_loop(pid)
            ready = [key.fileobj for key, _ in self._selector.select(max(0.0, next_s - time.monotonic()))]
            if self._loop is not None and self._loop in ready:
                self._selector.unregister(self._loop)
                if self._control.loop_pid:
                    self._say_died()
            if stop in ready or (report in ready and not self._hear(report)):
                self._follow()
                self._poll(time.monotonic())
                return
            next_s = self._step(self._wake in ready)

    def _hear(self, report: Connection) -> bool:
        """Say what the session wants said; False when it is gone."""
        try:
            self._station.tell(*report.recv())
        except (EOFError, OSError):
            return False
        return True

    def _watch_loop(self, pid: int) -> None:
        try:
            self._loop = os.pidfd_open(pid)
        except ProcessLookupError:
            self._loop = -1
            if self._control.loop_pid:
                self._say_died()
        else:
            self._selector.register(self._loop, selectors.EVENT_READ)

    def _say_died(self) -> None:
        self._silent = True
        self._station.silence()
        for endpoint in self._hub.endpoints:
            endpoint.say("error", LOOP_DIED)

    def _step(self, called: bool) -> float:
        """Do what is due now; returns when to come again."""
        if called:
            self._wake.clear()
        now_s = time.monotonic()
        if called or now_s - self._read_s > _READ_S:
            self._read(now_s)
        next_s = self._poll(now_s)
        if now_s - self._heard_s > _READ_S or self._events.count != self._event_number:
            self._heard_s = now_s
            self._follow()  # behind what is due: that may not wait
            next_s = self._poll(now_s)
        if self._links is not None and now_s - self._told_s > _TELL_S:
            self._told_s = now_s
            self._links.tell(self._hub.tallies())
        if self._hungry() and self._ring.count - self._seen != 1 and now_s - self._read_s > _COLD_S:
            self._rehearse()
        fresh = self._ring.count - self._seen
        slow = fresh == 1  # do not wait for its next solution
        looks = self._looks and self._processor.is_free and fresh * _LOOK_S >= now_s - self._read_s  # they come quickly
        if self._hungry() and (slow or (looks and self._look())):
            now_s = time.monotonic()
            self._read(now_s)
            next_s = self._poll(now_s)
        self._watch(self._hungry())
        return next_s

    def _look(self) -> bool:
        """Whether the next solution comes within `_LOOK_S`, while nobody else wants this processor."""
        newest, until = self._ring.count, time.monotonic() + _LOOK_S
        while self._ring.count == newest and time.monotonic() < until and self._processor.is_free:
            self._processor.give_way()
        return self._ring.count != newest

    def _hungry(self) -> bool:
        return any(endpoint.waits is not None for endpoint in self._hub.endpoints)

    def _rehearse(self) -> None:
        """Do with the last solution what the next one will need, so that its way is in the processor's caches."""
        row = np.zeros(1, NAV_STATE)
        if self._ring.latest(row):
            solution = Solution.of(row[0], self._station.geoid)
            for endpoint in self._hub.endpoints:
                endpoint.rehearse(solution)

    def _poll(self, now_s: float) -> float:
        return self._hub.poll(now_s)

    def _attitude_sent(self) -> None:
        self._ages_ns[self._aged % _AGES] = time.time_ns() - self._row["arrival_ns"][0]
        self._aged += 1

    def _read(self, now_s: float) -> None:
        count = self._ring.count
        if count != self._seen and self._ring.latest(self._row):
            self._seen = count
            self._read_s, self._silent = now_s, False
            self._station.update(self._row[0], now_s)
        elif self._seen and not self._silent and now_s - self._read_s > _SILENCE_S:
            self._silent = True
            self._station.silence()

    def _follow(self) -> None:
        """Take over what else the loop says."""
        self._station.set_loss(self._control.lost, self._control.samples)
        if self._stats is not None:
            self._station.set_clock(clock_reading(self._stats))
        if self._fixes is not None and self._fixes.count != self._fixed and self._fixes.latest(self._fix):
            self._fixed = self._fixes.count
            self._station.set_fix(self._fix[0])
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
        links = self._hub.tallies()
        totals = total(links.values())
        if (intake := self._station.intake) is not None:
            totals["aiding"] = {"taken": dict(intake.taken), "refused": dict(intake.refused)}
        return totals | {"links": links, "latency_us": self._latency()}

    def _latency(self) -> dict[str, float] | None:
        ages_us = self._ages_ns[: min(self._aged, _AGES)] / 1e3
        if not len(ages_us):
            return None
        p50, p99, p999 = np.percentile(ages_us, (50.0, 99.0, 99.9))
        return {"p50": float(p50), "p99": float(p99), "p999": float(p999), "max": float(ages_us.max())}


def _intake(config: MavlinkConfig, taps: Taps) -> Intake | None:
    """What is taken from the network, as frames of a sender of its own to the loop."""
    ring = taps.aiding
    if ring is None or not (config.aiding or config.operator):
        return None
    from drivers.can.aiding import AidingEncoder

    encoder = AidingEncoder()

    def relay(rows: NDArray[Any]) -> None:
        batch = encoder.frames(rows)
        batch["time_ns"] = time.time_ns()
        ring.push(batch)

    how = {"early": taps.early, "measurements": config.aiding}
    return Intake(config.aiding_from, config.master, config.aiding_delay_s, relay, **how)


def link_options(config: MavlinkConfig) -> list[LinkOptions]:
    """The links of a configuration.

    Raises
    ------
    HilError
        An unknown option of a link, or a wrong value.
    """
    return [parse_options(one) if isinstance(one, str) else LinkOptions(**one.model_dump()) for one in config.links]


def _signer(config: MavlinkConfig) -> Signer | None:
    """What signs; its times outlive the run, whatever the key."""
    if not config.signing_key:
        return None
    store = Store(state_folder() / "mavlink-signing.json")
    return Signer(read_key(Path(config.signing_key).expanduser()), store, config.accept_unsigned)


def _parameter_store(config: MavlinkConfig) -> Store | None:
    if not config.keep_parameters:
        return None
    return Store(state_folder() / f"parameters-{config.system_id}-{config.component_id}.json")


def _obey(command: str, control: Control) -> None:
    if command == "align":
        control.request_align()


def _warm_up(station: Station, states: Ring) -> None:
    """Compile or load every kernel before the first message is due, and before the first beat."""
    station.geoid(0.0, 0.0)
    euler_of(1.0, 0.0, 0.0, 0.0)
    states.latest(np.zeros(1, NAV_STATE))


def _tell(report: Connection, what: dict[str, Any]) -> None:
    try:
        report.send(what)
    except OSError:
        pass  # nobody is left to hear it
