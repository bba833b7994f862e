"""The loop: frames in, solutions into the ring. It owns its process, blocks on the bus only, and never formats or logs.

    source -> driver -> head compensation -> navigator -> lever arm -> ring (publisher, status line, dashboard)
         \\-> aiding (to the navigator)                            \\-> frames ring (recorder)

Every batch of frames runs through `Loop.take`; nothing in it depends on how frames were batched: a measurement is taken
between the samples between which it came. Measurements from the network and from receivers at ports of their own come as
frames too, each in a ring of its sender's, and are recorded like those of the bus. What the loop does on its own account
(silence, an ordered alignment) goes into the recording as an event, so that a replay repeats it.
"""

import gc
import hashlib
import math
import os
import time
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers import FrameDriver, Selective, make_driver
from drivers.can.aiding import AidingDecoder, has_aiding, is_aiding
from drivers.can.dtg_head import DtgHead
from drivers.can.frames import FrameArray, frames
from drivers.logs.recording import EVENT, MARK, REALIGN, SILENCE, event_record
from hil.calibration import NO_HEAD, validated
from hil.clock import LoopClock
from hil.control import Control
from hil.feed.quantisation import warnings
from hil.feed.tap import Gate
from hil.health import HEALTH, HealthWriter
from hil.lane import DECODED, DONE, OTHER, Lane
from hil.magnetometer import correct
from hil.other_attitude import Estimator, OtherAttitude
from hil.realtime import SharedProcessor, claim, doze, rest, wake_in_time
from hil.reference import Reference, Trace
from hil.ring import Ring
from hil.scenario import Scenario
from hil.settings import settings_of
from hil.source import BusSource, FileSource, Source
from hil.stats import Phase, Stats, Times
from hil.warmup import warm_loop
from hil.wire_watch import WireWatch
from hil.world.instruments import head_model, mounting
from hil.world.truth import TruthKeeper
from nav.aiding import AIDING, Kind, of_receivers
from nav.cut import Cut
from nav.errors import HilError
from nav.filter.record import Recorder
from nav.increments import FloatArray, HeadIncrements, ImuIncrements, IntArray
from nav.instruments.head import HeadCombiner
from nav.navigator import Navigator
from nav.state import HOST_FIELDS, NAV_STATE

BATCH = 1024
"""Most frames taken at once."""
TICK_S = 0.02
"""Longest wait for a frame."""
AIDING_FAULTS = ("lost", "duplicated", "crc_errors", "foreign", "short", "version_errors", "restarts")
"""Counters of aiding frames that the summary shows."""
EVENTS = np.dtype([("time", "<f8"), ("severity", "S8"), ("text", "S240"), ("station", "?")])
"""A message for the user, as it lies in the ring of events."""


@dataclass(frozen=True, slots=True)
class LoopOrder:
    """What the loop shall do; picklable.

    Attributes
    ----------
    scenario : Scenario
        Everything the user chose.
    file : Path, optional
        Take frames from this recording and not from the scenario's bus.
    paced : bool
        Real time; False: as fast as it goes, lossless.
    reference : Reference, optional
        An attitude to compare with (another estimator's, from a log).
    keep_trace : bool
        Give our attitudes back with the result (``trace``: times, attitudes).
    own_world : bool
        The samples are of the scenario's own world, also where the board cannot say so.
    realtime : bool
        Claim priority, locked memory and a processor (:mod:`hil.realtime`).
    """

    scenario: Scenario
    file: Path | None = None
    paced: bool = True
    reference: Reference | None = None
    keep_trace: bool = False
    own_world: bool = False
    realtime: bool = False

    @property
    def live(self) -> bool:
        """In real time on a bus: what comes from elsewhere now belongs to the samples that come now."""
        return self.paced and self.file is None


@dataclass(frozen=True, slots=True)
class Outlets:
    """The loop's shared memory; picklable to a spawned process."""

    states: Ring
    frames: Ring
    events: Ring
    aiding: tuple[Ring, ...]
    """Frames of measurements, a ring a writer: that of the publisher, then those of the receivers."""
    fixes: Ring
    """What receivers have measured, for the publisher."""
    health: Ring
    """What the loop says of the sensor a few times a second: of `hil.health.HEALTH`."""
    stats: Stats = field(default_factory=Stats)
    control: Control = field(default_factory=Control)
    gate: Gate | None = None
    """In simulated time with feeds: no solution is overwritten before they have it."""

    @staticmethod
    def make(*, recording: bool, readers: int, receivers: int = 0) -> "Outlets":
        """New rings, with `readers` wake-ups for solutions and one for frames; `receivers` have one more each."""
        from drivers.can.frames import FRAME

        outlets = Outlets(
            Ring(NAV_STATE, 8192, readers),
            Ring(FRAME, 1 << 16, 1),
            Ring(EVENTS, 256, 1),
            tuple(Ring(FRAME, 1024, 0) for _ in range(1 + receivers)),
            Ring(AIDING, 64, 0),
            Ring(HEALTH, 16, 0),
        )
        outlets.control.recording = recording
        return outlets


class Loop:
    """The state of one run: driver, navigator and what is counted; a `recorder` notes what the filter does."""

    def __init__(self, order: LoopOrder, outlets: Outlets, recorder: Recorder | None = None) -> None:
        scenario = order.scenario
        self.scenario = scenario
        self.driver: FrameDriver = make_driver(scenario.driver)
        self.navigator = Navigator(settings_of(scenario), recorder)
        self.finished = False
        """The scenario's duration is over."""
        self.samples = 0
        """Navigated so far."""
        selective = self.driver if isinstance(self.driver, Selective) else None
        self._watch = WireWatch(self.driver.counters, scenario.bus, selective)
        self._aiding = AidingDecoder()
        self._now: float | None = None
        """Device time of the newest sample."""
        self._first: float | None = None
        """Device time at which the first sample began."""
        self._withheld = 0
        self._combiner = HeadCombiner(head_model(scenario.head))
        turn = mounting(scenario.head)
        self._mounting = None if (turn == np.eye(3)).all() else turn
        calibration = validated(scenario.head.calibration or NO_HEAD, "in the loop")
        self._calibrated = calibration.serial or None  # 0: of no particular head
        self._magnetometer = calibration.magnetometer
        self._outlets = outlets
        self._live = order.live
        self._own_truth = TruthKeeper(scenario)  # made now: it takes tens of milliseconds
        self._truth = self._own_truth if order.own_world else None
        self._from_truth = scenario.navigation.alignment == "truth"
        self._trace = Trace() if order.reference is not None else None
        self._reference = order.reference
        self._other = OtherAttitude(self.driver) if isinstance(self.driver, Estimator) else None
        self._keep_trace = order.keep_trace
        self._clock = LoopClock(outlets.stats, partial(self.navigator.tell, station=True))
        head = self.driver if isinstance(self.driver, DtgHead) else None
        self._lane = None if head is None else Lane(head, self._combiner, self.navigator, outlets.states)
        self._restarts = 0
        self._arrival_ns = 0
        self._started: float | None = None
        self._covered = 0.0
        self._marked = 0
        self._align_requests, self._marks = outlets.control.align_requests, outlets.control.marks
        self._health = HealthWriter(outlets.health, self._combiner)
        self._world = scenario.world_id()
        self._digest = hashlib.blake2b(digest_size=16)
        for feed in scenario.feed:
            for text in warnings(feed, scenario):
                self.navigator.tell(0.0, "warning", text)

    def take(self, batch: FrameArray) -> bool:
        """Decode and navigate a batch of frames; True when it held a sample."""
        lone = self._lone(self._lane, batch) if len(batch) == 1 and self._lane is not None else None
        got = self._batch(batch) if lone is None else lone
        self._health.count(batch)
        return got

    def _batch(self, batch: FrameArray) -> bool:
        driver, got, start = self.driver, False, 0
        while driver.period_s is None and start < len(batch):  # one by one until the board has said what it is
            got = self._between(batch[start : start + 1]) or got
            start += 1
        return self._between(batch[start:] if start else batch) or got

    def _between(self, batch: FrameArray) -> bool:
        """Take frames, the measurements among them in their place between the samples."""
        if not has_aiding(batch["can_id"]):
            return len(batch) > 0 and self._take(batch)
        aided = is_aiding(batch["can_id"])
        rows, places = self._aiding.decode(batch, self._now)
        if self._magnetometer is not None:
            correct(self._magnetometer, rows)
        if (fixes := of_receivers(rows)).any():
            self._outlets.fixes.push(rows[fixes])
        cuts = np.flatnonzero(aided[1:] & ~aided[:-1]) + 1
        got, start, taken = False, 0, 0
        for stop in (*cuts.tolist(), len(batch)):
            end = int(np.searchsorted(places, stop))
            if end > taken:
                self.navigator.aid(self._given(rows[taken:end]))
            got = self._take(batch[start:stop]) or got
            start, taken = stop, end
        return got

    def _given(self, rows: NDArray[Any]) -> NDArray[Any]:
        """The measurements that are not withheld."""
        if self._first is None:
            return rows
        for outage in self.scenario.navigation.filter.withheld:
            since = rows["time"] - self._first
            there = (since >= outage.start_s) & (since < outage.end_s) & (rows["kind"] == Kind[outage.kind.upper()])
            self._withheld += int(there.sum())
            rows = rows[~there]
        return rows

    def _lone(self, lane: Lane, batch: FrameArray) -> bool | None:
        """As `take` for a lone frame, by the quick lane as far as that goes; None, and nothing has changed, when it does not."""
        is_ready = self._calibrated is None and not (self._from_truth or self.finished)
        if self._started is None or not is_ready or (self._truth is None and self.driver.world_id == self._world):
            return None
        duration = self.scenario.duration_s
        stage = lane.take(batch, math.inf if duration is None else self._started + duration)
        if stage == OTHER:
            return None
        raw = lane.samples(stage)
        if stage == DECODED:
            return self._decoded(batch, raw)
        self._now = time_s = float(raw.time[0])
        self._covered = time_s - self._started
        self.samples += 1
        imu = self._combiner.told(raw, lane.answer)
        self._tell_notes()
        arrivals = self.driver.arrivals()
        if stage == DONE:
            self._follow(raw, self.navigator.passed(time_s), arrivals, lane.in_ring_ns)
        else:
            self._navigate(raw, imu, arrivals)
        self._count(batch)
        return True

    def _take(self, batch: FrameArray) -> bool:
        return self._decoded(batch, self.driver.decode(batch))

    def _decoded(self, batch: FrameArray, raw: HeadIncrements | ImuIncrements) -> bool:
        """Navigate what the driver has found in a batch."""
        driver = self.driver
        if len(raw) == 0:
            self._count(batch)
            return False
        self._now = float(raw.time[-1])
        if self._first is None:
            self._first = float(raw.time[0] - raw.step[0])
        arrivals, start = driver.arrivals(), 0
        if driver.counters.restarts != self._restarts:  # its clock begins anew, maybe in the middle of the batch
            self._restarts = driver.counters.restarts
            for stop in (np.flatnonzero(np.diff(raw.time) < 0.0) + 1).tolist():
                self._pass(raw.rows(start, stop), arrivals[start:stop])
                start, self._started = stop, None
            self._clock.reset()
            self._started = None
        self._pass(raw.rows(start, len(raw)), arrivals[start:])
        self._count(batch)
        return True

    def _pass(self, raw: HeadIncrements | ImuIncrements, arrivals: IntArray) -> None:
        """Navigate samples of one life of the device."""
        if self.finished:
            return
        raw = self._cut(raw)
        self.samples += len(raw)
        if len(raw) == 0:
            return
        if self._truth is None and self.driver.world_id == self._world:
            self._truth = self._own_truth
        if self._from_truth and not self._begin(raw):
            return
        self._navigate(raw, self._combine(raw) if isinstance(raw, HeadIncrements) else self._turned(raw), arrivals)

    def _navigate(self, raw: HeadIncrements | ImuIncrements, imu: ImuIncrements, arrivals: IntArray) -> None:
        """Put the solutions of `imu`, which are the samples `raw` in body axes, into the ring."""
        rows = self.navigator.process(imu)
        rows["arrival_ns"] = arrivals[-1] if len(rows) != len(arrivals) else arrivals
        self._follow(raw, rows, arrivals, self._push(rows))

    def _follow(
        self, raw: HeadIncrements | ImuIncrements, rows: NDArray[Any], arrivals: IntArray, in_ring_ns: int
    ) -> None:
        """What comes behind the ring, where the `rows` of the samples `raw` are."""
        self._arrival_ns = int(arrivals[-1])
        self._compare(rows)
        self._health.take(raw, self._truth is not None)
        stats = self._outlets.stats
        if self._live:
            stats.count_since(Times.LATENCY, in_ring_ns, arrivals)
            self._clock.take(float(raw.time[-1]), self._arrival_ns)
        if len(rows) != len(raw):
            stats["interpolated"] += len(rows) - len(raw)

    def _tell_notes(self) -> None:
        for note in self._combiner.notes():
            self.navigator.tell(note.time, "error" if note.bad else "notice", note.text)

    def _combine(self, raw: HeadIncrements) -> ImuIncrements:
        imu = self._combiner.combine(raw)
        self._tell_notes()
        if self._calibrated is not None and "serial" in (identity := self.driver.identity()):
            if identity["serial"] != self._calibrated:
                text = f"the calibration is of head {self._calibrated}, and head {identity['serial']} is connected"
                self.navigator.tell(float(raw.time[0]), "warning", text)
            self._calibrated = None
        return imu

    def _turned(self, raw: ImuIncrements) -> ImuIncrements:
        """A board's increments in body axes."""
        if self._mounting is None:
            return raw
        return replace(raw, dtheta=raw.dtheta @ self._mounting.T, dvel=raw.dvel @ self._mounting.T)

    def _cut(self, raw: HeadIncrements | ImuIncrements) -> HeadIncrements | ImuIncrements:
        """Up to the scenario's duration: the device time covered so far, all lives of the device together."""
        if self._started is None:
            self._started = float(raw.time[0] - raw.step[0]) - self._covered
        duration = self.scenario.duration_s
        if duration is not None:
            end = self._started + duration + 1e-9
            if raw.time[-1] >= end - raw.step[-1]:
                self.finished = True
                raw = raw.rows(0, int(np.searchsorted(raw.time, end, "right")))
        if len(raw):
            self._covered = float(raw.time[-1]) - self._started
        return raw

    def _begin(self, raw: HeadIncrements | ImuIncrements) -> bool:
        """Start from the truth; False while the head's world is not known to be ours."""
        if self._truth is None:
            if self.driver.world_id:
                raise HilError(
                    'navigation.alignment = "truth" needs the head of this very scenario on the bus; '
                    "the head there simulates another world"
                )
            return False
        truth = self._truth.motion.truth(np.array([raw.time[0] - raw.step[0]]))
        row = truth[0]
        position = row["lat"], row["lon"], row["height"]
        self.navigator.begin(*position, row["vel_n"], row["q_nb"], float(row["time"]), row["w_ib_b"])
        self._from_truth = False
        return True

    def obey(self, event: int) -> None:
        """Repeat an event: silence, or an ordered alignment."""
        if event == SILENCE:
            rows = self.navigator.silent()
            rows["arrival_ns"] = self._arrival_ns
            self._push(rows)
            self._compare(rows)
            self._outlets.stats["silences"] += 1
        elif event == REALIGN:
            self._combiner.renew()
            self.navigator.realign(float(self._last()["time"]), "ordered")
        elif event == MARK:
            self._marked += 1
            self.navigator.tell(float(self._last()["time"]), "notice", f"mark {self._marked}")

    def ordered_event(self) -> int:
        """An alignment or a mark that another process has ordered since the last look; 0 for none."""
        control = self._outlets.control
        if (requests := control.align_requests) != self._align_requests:
            self._align_requests = requests
            return REALIGN
        if control.marks != self._marks:
            self._marks += 1
            return MARK
        return 0

    def _last(self) -> Any:
        """The newest solution; all zeros before the first."""
        row = np.zeros(1, NAV_STATE)
        self._outlets.states.latest(row)
        return row[0]

    def _push(self, rows: NDArray[Any]) -> int:
        """Put solutions into the ring; when they were there, by the host's clock."""
        rows["solution_ns"] = time.time_ns()
        self._outlets.states.push(rows)
        return time.time_ns()

    def _compare(self, rows: NDArray[Any]) -> None:
        """Add solutions to what is known of all, and tell what happened."""
        outlets = self._outlets
        self._digest.update(rows.view(np.uint8).reshape(len(rows), -1)[:, HOST_FIELDS:].tobytes())
        for event in self.navigator.events():
            self._note(event.time, event.severity, event.text, event.station)
        if self._truth is not None and len(rows):
            self._truth.compare(rows)
            if self._truth.position.count:
                outlets.stats["position_error_mm"] = round(min(self._truth.position.final, 1e12) * 1000.0)
        if self._trace is not None:
            self._trace.add(rows)
        if self._other is not None and len(rows):
            self._other.compare(rows)

    def _count(self, batch: FrameArray) -> None:
        counters = self.driver.counters
        counts = counters.as_list()
        self._outlets.stats.set_block("frames", counts)
        self._outlets.stats["covered_us"] = round(self._covered * 1e6)
        self._outlets.stats["samples"] = self.samples  # not those of the last batch that lie beyond the duration
        self._outlets.control.set_loss(counters.lost, self.samples)
        for said in self._watch.look(batch, counts, self._now or 0.0):
            self.say(said.severity, said.text, station=said.station)

    def say(self, severity: str, text: str, *, station: bool = False) -> None:
        """Tell the user something that is not of the navigator's."""
        self._note(self._now or 0.0, severity, text, station)

    def _note(self, time_s: float, severity: str, text: str, station: bool) -> None:
        note = np.zeros(1, EVENTS)
        note["time"], note["severity"], note["station"] = time_s, severity.encode(), station
        note["text"] = text.encode()[:240]
        self._outlets.events.push(note)

    def result(self) -> dict[str, Any]:
        """What the summary needs beyond the shared counters."""
        result: dict[str, Any] = {
            "mode": self.navigator.mode.name.lower(),
            "navigation_digest": self._digest.hexdigest(),
            "gyro_bias_deg_h": [float(b) for b in np.degrees(self.navigator.gyro_bias) * 3600.0],
            "head": self.driver.identity(),
            "failed_axes": self._combiner.failed(),
            "aiding": {kind.name: count for kind, count in self._aiding.heard.items() if count},
        }
        if errors := self._watch.errors.as_dict():
            result["bus_errors"] = errors
        if self._other is not None:
            result["other_attitude"] = self._other.summary()
        if self._withheld:
            result["withheld"] = self._withheld
        if self._aiding.counters.frames:
            faults = self._aiding.counters.as_dict()
            result["aiding_faults"] = {name: faults[name] for name in AIDING_FAULTS}
        if self._truth is not None and (error := self._truth.summary()) is not None:
            result["error"] = error
        if self.samples and (sigma := _totals(self._last()["sigma"].astype(float))) is not None:
            result["estimate"] = {"sigma": sigma, "ratio": self._truth.ratios() if self._truth is not None else {}}
        if self._trace is not None and self._reference is not None:
            result.update(self._reference.differences(self._trace))
            if self._keep_trace:
                result["trace"] = self._trace.arrays()
        return result


def _totals(sigma: FloatArray) -> dict[str, float] | None:
    """Roots of summed variances of the sigmas of a `NAV_STATE` row (9,), as the summary names them; None: not known."""
    if not np.isfinite(sigma).all():
        return None
    parts = {"position_m": sigma[0:3], "velocity_ms": sigma[3:6]}
    angles = {"attitude_deg": sigma[6:9], "tilt_deg": sigma[6:8], "heading_deg": sigma[8:9]}
    return {name: math.hypot(*part) for name, part in parts.items()} | {
        name: math.degrees(math.hypot(*part)) for name, part in angles.items()
    }


def run_loop(order: LoopOrder, outlets: Outlets, answer: Connection) -> None:
    """Target of the loop's process: runs until told to stop, the duration is over or the source is exhausted.

    Sends through `answer` a dict: the result, or ``{"failed": message}``.
    """
    stats = outlets.stats
    try:
        warm_loop(order.scenario, lambda done: stats.__setitem__("warm_loop", done))
        loop = Loop(order, outlets)
        source: Source = (
            FileSource(order.file, paced=order.paced)
            if order.file is not None
            else BusSource(order.scenario.bus, paced=order.paced)
        )
        try:
            gc.collect()
            gc.freeze()
            granted = claim() if order.realtime else None
            for lack in granted.lacking if granted else ():
                loop.navigator.tell(0.0, "warning", lack)
            outlets.control.loop_begins()
            stats["phase"] = Phase.READY
            _run(loop, source, order, outlets, alone=granted is not None and granted.processor >= 0)
        finally:
            source.close()
        if source.exhausted and loop.samples == 0:
            driver, count = order.scenario.driver, stats["frames"]
            raise HilError(
                f"{order.file}: no sample of {driver} in {count} frames: name its driver in a scenario, --scenario FILE"
            )
        result = loop.result() | {"overflowed": source.overflowed}
        if granted:
            result["realtime"] = granted.as_dict()
        if source.refused:
            result["refused"] = dict(source.refused)
        if source.problem():
            result["problem"] = source.problem()
        stats["phase"] = Phase.DONE
        outlets.control.loop_ends()
        answer.send(result)
    except HilError as error:
        stats["phase"] = Phase.FAILED
        outlets.control.loop_ends()
        answer.send({"failed": str(error)})
    finally:
        answer.close()


def _run(loop: Loop, source: Source, order: LoopOrder, outlets: Outlets, *, alone: bool) -> None:
    looks = source.live and (alone or len(os.sched_getaffinity(0)) > 1)
    processor = SharedProcessor()
    if looks:
        wake_in_time()
    batch = frames(BATCH)
    views = Cut[FrameArray](lambda n: batch[:n])
    silence_ns = round(order.scenario.navigation.silence_s * 1e9)
    wait = min(TICK_S, order.scenario.navigation.silence_s / 4)
    heard: int | None = None
    look_until = 0
    stats, control = outlets.stats, outlets.control
    relayed, relayed_numbers = frames(BATCH), [0] * len(outlets.aiding)
    trouble = ""
    while not (control.stop or loop.finished or source.exhausted):
        if outlets.gate is not None:
            outlets.gate.wait(outlets.states, outlets.states.capacity // 2, lambda: control.stop)
        looking = time.monotonic_ns() < look_until
        if looking and not alone:
            processor.give_way()
        n = source.receive(batch, 0.0 if looking else wait)
        woken_ns, now = time.time_ns(), time.monotonic_ns()
        if n:
            taken, samples = views[n], loop.samples
            try:
                if order.file is not None and taken["reserved"][:, 0].any():
                    got = take_with_events(loop, taken)
                else:
                    got = loop.take(taken)
            finally:
                _record(taken, outlets, order.paced)  # what ends the run is recorded as well
            if got:
                heard = now
                stats["phase"] = Phase.RUNNING
            if source.live:
                took = time.monotonic_ns() - now
                stats.count(Times.WAKE, woken_ns - int(taken["time_ns"][n - 1]))
                stats.count(Times.ROUND, took)
                if got and took > 1e9 * (loop.samples - samples) * (loop.driver.period_s or math.inf):
                    stats["overruns"] += 1
        stats["beat_ns"] = now
        if source.trouble != trouble:
            trouble = source.trouble
            loop.say("error" if trouble else "notice", trouble or f"{order.scenario.bus} is back", station=True)
        for k, ring in enumerate(outlets.aiding):
            if ring.count > relayed_numbers[k] and not loop.finished:
                copied, first = ring.pull(relayed, relayed_numbers[k])
                relayed_numbers[k] = first + copied
                _record(relayed[:copied], outlets, order.paced)
                loop.take(relayed[:copied])
        event = loop.ordered_event()
        if source.live and heard is not None and now - heard > silence_ns:
            heard = None
            event = event or SILENCE
        if event:
            _record(event_record(event, time.time_ns()), outlets, order.paced)
            loop.obey(event)
        if looks and heard == now:
            period_s = loop.driver.period_s
            if alone:
                look_until = rest(period_s)
            else:
                look_until = doze(source.watched, now, period_s) if processor.is_free else 0
    if outlets.gate is not None:
        outlets.gate.wait(outlets.states, 0, lambda: control.stop)


def take_with_events(loop: Loop, taken: FrameArray) -> bool:
    """Take recorded frames, the events among them in their place; True when there was a sample."""
    got, start = False, 0
    for mark in np.flatnonzero(taken["reserved"][:, 0] == EVENT):
        if mark > start:
            got = loop.take(taken[start:mark]) or got
        loop.obey(int(taken["data"][mark, 0]))
        start = int(mark) + 1
    return (loop.take(taken[start:]) if start < len(taken) else False) or got


def _record(taken: FrameArray, outlets: Outlets, paced: bool) -> None:
    ring, control = outlets.frames, outlets.control
    if not control.recording:
        return
    while not paced and ring.count + len(taken) - control.recorded > ring.capacity and not control.stop:
        time.sleep(0.001)
    ring.push(taken)
