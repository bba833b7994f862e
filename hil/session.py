"""A run as a whole: starts the processes, watches them, gathers the summary. What `hil run` and the tests stand on.

    feeder (simulated head or player) --bus--> loop --rings--> publisher (MAVLink), recorder, feeds, dashboard, this process
                                receivers --rings--^

Each box is a process of its own. The session notices a process that dies, and stops all when the loop is done.
"""

import contextlib
import multiprocessing as mp
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from drivers.can.unix_bus import remove
from drivers.utc import PulseClock
from hil.bridge import EVENTS, LoopOrder, Outlets, run_loop
from hil.clock import clock_summary
from hil.control import READERS, run_part, undisturbed
from hil.dashboard import Sources, Window, recording_name, run_dashboard
from hil.feed.group import FeedGroup
from hil.link_stats import LinkStats
from hil.mcap_recorder import run_mcap
from hil.publisher import Taps, link_options, run_publisher
from hil.receiver import run_receiver
from hil.recorder import run_recorder
from hil.ring import Wake
from hil.stats import Phase, Times
from hil.warmup import STEPS
from hil.world.head import run_head
from nav.errors import HilError
from nav.state import NAV_STATE, Mode

START_S = 180.0
"""Longest time for the processes to get ready (the first compilation is in it)."""
NICE = {"publisher": 10, "mcap": 10, "dashboard": 5}
"""How far a part steps back behind the loop where processors are few."""
RECORDER_STOP_S = 60.0
"""The recorder gets longer: what is in the ring is not to be lost."""
STOP_S = 10.0
"""Longest time for a process to end on its own."""
HURRY_S = 1.0
"""The same before the run has begun: one that still compiles has nothing to lose."""
STOPPED_S = 3.0
"""A reader without a beat for so long has stopped."""
BUSY_NS = 500_000_000
"""A loop that has not asked for frames for so long is busy with those that it has."""
DRAIN_S = 1.0
"""Time for the loop to take what is on its way when the feeder has ended; as fast as it goes, time without a new frame."""

_Answers = dict[str, Any]


@dataclass(slots=True)
class _Part:
    name: str
    process: BaseProcess
    connection: Connection
    answers: _Answers = field(default_factory=dict)
    problems: list[tuple[str, str]] = field(default_factory=list)
    """(severity, text) of what it has told at once, and nobody has taken yet."""

    def read(self) -> None:
        """Take what the process has answered."""
        with contextlib.suppress(EOFError, OSError):
            while self.connection.poll():
                said = self.connection.recv()
                self.problems += [said.pop("problem")] if self.name == "recorder" and "problem" in said else []
                self.answers.update(said)


class Session:
    """One run; use as a context manager.

    Parameters
    ----------
    order : LoopOrder
        What the loop does.
    feeder : callable, optional
        Target of the process that feeds the bus, called ``feeder(*feeder_args, control, stats, connection)``; the
        simulated head is `simulated_head`.
    record : Path, optional
        Recording to write.
    publish : bool
        Send MAVLink on the links of the scenario.
    mcap : Path, optional
        File for Foxglove to write; in real time only.
    window : Window, optional
        Where the dashboard is served; None: nowhere.
    """

    def __init__(
        self,
        order: LoopOrder,
        *,
        feeder: tuple[Callable[..., None], Sequence[Any]] | None = None,
        record: Path | None = None,
        publish: bool = True,
        mcap: Path | None = None,
        window: Window | None = None,
    ) -> None:
        if mcap is not None and not order.paced:
            raise HilError("--mcap needs real time: record the run with --record FILE, then `hil export FILE out.mcap`")
        self.order = order
        self.links = LinkStats(link_options(order.scenario.mavlink) if publish else ())
        self.recordings: list[dict[str, Any]] = []
        """What became of the recordings that were asked for while running."""
        self._window = window
        self.feeds = FeedGroup(order.scenario, paced=order.paced)
        self._receivers = {f"receiver {k}": one for k, one in enumerate(order.scenario.receiver if order.live else ())}
        readers = 1 + len(self.feeds.names)
        outlets = Outlets.make(recording=record is not None, readers=readers, receivers=len(self._receivers))
        self.outlets = replace(outlets, gate=self.feeds.gate)
        self._feeder = feeder
        self._record = record
        self._publish = publish
        self._mcap = mcap
        self._publisher_stop = Wake()
        self._parts: dict[str, _Part] = {}
        self._event_number = 0
        self._row = np.zeros(1, NAV_STATE)
        self._feeder_ended: float | None = None
        self._drained = 0
        """Frames that the loop had taken when it was last seen at work after the feeder's end."""
        self._pulses = PulseClock()
        self._began = 0.0
        self._ended = 0.0
        self._notes: list[tuple[float, str, str]] = []
        self._stopped: set[str] = set()
        """Readers that do not answer."""
        self.problems: list[str] = []
        """What went wrong with a part of the run without ending it."""

    def __enter__(self) -> "Session":
        try:
            self._start()
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def _launch(self, name: str, target: Callable[..., None], *args: Any) -> None:
        context = mp.get_context("forkserver")
        ours, theirs = context.Pipe()
        aside = self.order.realtime and name != "loop"
        process = context.Process(
            target=run_part,
            args=(self.outlets.control, NICE.get(name, 0), aside, target, *args, theirs),
            name=f"hil-{name}",
            daemon=True,
        )
        process.start()
        theirs.close()
        self._parts[name] = _Part(name, process, ours)

    def _launch_recorder(self, path: Path) -> None:
        header = {"scenario": self.order.scenario.model_dump(mode="json"), "created_ns": time.time_ns()}
        self.outlets.control.forget_beat("recorder")
        self._launch("recorder", run_recorder, path, header, self.outlets)

    def _start(self) -> None:
        scenario, outlets, launch = self.order.scenario, self.outlets, self._launch
        preload = ["hil.bridge", "hil.publisher", "hil.recorder", "hil.world.head"]
        mp.get_context("forkserver").set_forkserver_preload([*preload, "hil.receiver"] if self._receivers else preload)
        resource_tracker.ensure_running()
        with undisturbed():  # it tells how the others end
            forkserver.ensure_running()
        if self._record is not None:
            self._launch_recorder(self._record)
        if self._mcap is not None:
            launch("mcap", run_mcap, self._mcap, outlets)
        launch("loop", run_loop, self.order, outlets)
        if self._feeder is not None:
            target, args = self._feeder
            launch("feeder", target, *args, outlets.control, outlets.stats)
        if self._window is not None:
            simulated = self._feeder is not None and self._feeder[0] is run_head
            launch(
                "dashboard",
                run_dashboard,
                self._window,
                Sources(self.order, outlets, self.links, simulated=simulated, recorded=self._record is not None),
            )
            self._window.socket.close()  # the port lives as long as its process
        if self._publish and scenario.mavlink.links:
            network, early = outlets.aiding[0] if self.order.live else None, scenario.navigation.aligned_by_aiding
            looks = self.order.live and len(os.sched_getaffinity(0)) > 1
            shared = outlets.stats, outlets.fixes, self.links, looks
            taps = Taps(outlets.states, 0, outlets.events, outlets.control, network, early, *shared)
            launch("publisher", run_publisher, scenario.mavlink, taps, self._publisher_stop)
        self.feeds.launch(launch, outlets.states, 1, outlets.control)
        for k, (name, config) in enumerate(self._receivers.items()):
            launch(name, run_receiver, config, k, outlets.stats, outlets.aiding[1 + k], outlets.control)

    def compiling(self) -> tuple[int, int]:
        """(steps done, steps in all) of getting ready."""
        stats = self.outlets.stats
        total = STEPS * (2 if self._feeder is not None else 1)
        return stats["warm_loop"] + (stats["warm_head"] if self._feeder is not None else 0), total

    @property
    def ready(self) -> bool:
        """The loop listens; on the first call that finds it so, the feeder begins.

        Raises
        ------
        HilError
            A part of the run failed, or did not get ready in time.
        """
        self._watch()
        if self.outlets.control.go:
            return True
        heralds = [part for name, part in self._parts.items() if name in {"recorder", "mcap", *self._receivers}]
        if self.outlets.stats["phase"] == Phase.STARTING or any("ready" not in part.answers for part in heralds):
            return False
        if len(self.feed_places()) < len(self.feeds.names):
            return False
        self._began = time.monotonic()
        self.outlets.control.order_go()
        return True

    @property
    def running(self) -> bool:
        """The loop is at work.

        Raises
        ------
        HilError
            The loop or the feeder failed.
        """
        self._watch()
        self._pulses.poll()
        if not self.ready:
            return not self.outlets.control.stop
        feeder = self._parts.get("feeder")
        if feeder is not None and not feeder.process.is_alive():
            frames = self.outlets.stats["frames"]
            at_work = frames != self._drained or time.monotonic_ns() - self.outlets.stats["beat_ns"] > BUSY_NS
            if self._feeder_ended is None or (not self.order.paced and at_work):
                self._feeder_ended, self._drained = time.monotonic(), frames
            if time.monotonic() - self._feeder_ended > DRAIN_S:
                self.stop()
        if self._record is None:
            self._record_as_wanted()
        return self.outlets.stats["phase"] in (Phase.READY, Phase.RUNNING) and not self.outlets.control.stop

    def _record_as_wanted(self) -> None:
        """Begin or end a recording that was asked for while running."""
        control, recorder = self.outlets.control, self._parts.get("recorder")
        if recorder is None:
            if control.record_since:
                control.recorded = self.outlets.frames.count
                control.recording = True
                self._launch_recorder(Path(recording_name(control.record_since)))
            return
        if not control.record_since:
            control.recording = False
        if not recorder.process.is_alive():
            self._watch()
            control.recording, control.record_since = False, 0
            self._stopped.discard("recorder")
            self.recordings.append(self._answers("recorder"))
            del self._parts["recorder"]

    def wait_ready(self, on_wait: Callable[[], None] = lambda: None) -> None:
        """Block until the loop listens; `on_wait` is called ten times a second."""
        deadline = time.monotonic() + START_S
        while not self.ready:
            if time.monotonic() > deadline:
                raise HilError(f"the bridge was not ready after {START_S:g} s")
            on_wait()
            time.sleep(0.1)

    def wait_mode(self, *modes: Mode, timeout_s: float = 60.0) -> Any:
        """Block until the navigator is in one of `modes`; the state then.

        Raises
        ------
        HilError
            It was not in time, or the run ended before.
        """
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            state = self.state()
            if state is not None and state["mode"] in modes:
                return state
            if not self.running:
                break
            time.sleep(0.02)
        names = " or ".join(mode.name.lower() for mode in modes)
        raise HilError(f"mode {names} was not reached in {timeout_s:g} s")

    def state(self) -> Any:
        """A copy of the newest `NAV_STATE` row; None before the first."""
        return self._row[0].copy() if self.outlets.states.latest(self._row) else None

    def wait(self, timeout_s: float) -> None:
        """Sleep, but not longer than a part of the run lives."""
        wait([part.process.sentinel for part in self._parts.values() if part.process.is_alive()], timeout_s)

    def events(self) -> list[tuple[float, str, str]]:
        """(device time, severity, text) of what happened since the last call."""
        notes, self._notes = self._notes, []
        rows = np.zeros(64, EVENTS)
        copied, first = self.outlets.events.pull(rows, self._event_number)
        self._event_number = first + copied
        return notes + [
            (float(row["time"]), row["severity"].decode(), row["text"].decode(errors="replace"))
            for row in rows[:copied]
        ]

    def feed_places(self) -> list[str]:
        """Where the autopilots find the feeds that listen."""
        return [feed["place"] for feed in self._feed_summaries() if "place" in feed]

    def _feed_summaries(self) -> list[_Answers]:
        return self.feeds.summary({name: part.answers for name, part in self._parts.items()})

    def stop(self) -> None:
        """Tell the loop to end."""
        self.outlets.control.order_stop()

    def _watch(self) -> None:
        for part in self._parts.values():
            self._read(part)
            failed = part.answers.get("failed")
            died = part.process.exitcode not in (None, 0) and not failed
            if died:
                failed = f"the {part.name} process died (exit code {part.process.exitcode})"
            if not failed:
                continue
            if part.name in {"loop", "feeder"} or not self.outlets.control.go:
                raise HilError(str(failed))
            if part.name == "recorder":
                self.outlets.control.recorder_is_gone()
            if failed not in self.problems:
                self._note(str(failed), "error", problem=True)
                if part.name in self.feeds.names:
                    self.feeds.gone(part.name)
        for name in READERS:
            self._look_at(name)

    def _read(self, part: _Part) -> None:
        part.read()
        for severity, text in part.problems:
            self.problems.append(text)
            self._tell_stations(severity, text)
        part.problems.clear()

    def _tell_stations(self, severity: str, text: str) -> None:
        """Have the publisher say it on every link; one that does not answer is not waited for."""
        publisher = self._parts.get("publisher")
        if publisher is not None and "publisher" not in self._stopped:
            with contextlib.suppress(OSError):  # it is gone
                publisher.connection.send((severity, text))

    def _look_at(self, reader: str) -> None:
        """Say that a reader has stopped, or goes on."""
        part = self._parts.get(reader)
        if part is None or part.process.exitcode is not None:
            return
        stopped = self.outlets.control.beat_age_s(reader) > STOPPED_S
        if stopped and reader not in self._stopped:
            self._stopped.add(reader)
            waits = "nothing" if self.order.paced or reader == "publisher" else "simulated time"
            text = f"the {reader} process does not answer: it is stopped or starved, and {waits} waits for it"
            self._note(text, "error", problem=True)
        elif not stopped and reader in self._stopped:
            self._stopped.discard(reader)
            self._note(f"the {reader} process answers again", "notice")

    def _note(self, text: str, severity: str, *, problem: bool = False) -> None:
        state = self.state()
        self._notes.append((0.0 if state is None else float(state["time"]), severity, text))
        if problem:
            self.problems.append(text)
        self._tell_stations(severity, text)

    def _end(self) -> None:
        try:
            self._stop_parts()
        except BaseException:  # a second Ctrl-C
            for part in self._parts.values():
                part.process.kill()
            raise

    def _stop_parts(self) -> None:
        self._ended = time.monotonic()
        control, stats = self.outlets.control, self.outlets.stats
        control.order_stop()
        deadline = time.monotonic() + (STOP_S if control.go else HURRY_S)
        for name in (
            "loop",
            "feeder",
            "recorder",
            "mcap",
            "publisher",
            *self._receivers,
            *self.feeds.names,
            "dashboard",
        ):
            part = self._parts.get(name)
            if part is None:
                continue
            if name == "publisher":
                self._publisher_stop.call()
            elif name in self.feeds.names:
                self.feeds.stop(name)
            patience = RECORDER_STOP_S if name in {"recorder", "mcap"} else 0.0
            while part.process.is_alive() and time.monotonic() < deadline + patience:
                part.read()
                part.process.join(0.02)
            if part.process.is_alive():
                part.process.kill()
                part.process.join()
                if control.go:
                    self.problems.append(f"the {name} process did not end and was killed")
            if name == "loop" and stats["phase"] not in (Phase.DONE, Phase.FAILED):
                stats["phase"] = Phase.FAILED  # it died: the recorder must know
            self._read(part)
        if self.order.scenario.bus == private_bus():
            remove(private_bus().removeprefix("unix:"))

    def _answers(self, name: str) -> _Answers:
        part = self._parts[name]
        part.read()
        return {key: value for key, value in part.answers.items() if key not in {"failed", "ready"}}

    def summary(self) -> dict[str, Any]:
        """What the run showed, as `hil run --json` prints it; complete after the end."""
        stats = self.outlets.stats
        names = ("frames", "samples", "lost", "duplicated", "late", "crc_errors", "foreign", "short", "version_errors")
        more = ("restarts", "frozen", "clock_steps", "interpolated", "silences", "overruns")
        wall = max((self._ended or time.monotonic()) - self._began, 1e-9) if self._began else 0.0
        device_s = stats["covered_us"] * 1e-6
        result: dict[str, Any] = {"scenario": self.order.scenario.name}
        result.update({name: stats[name] for name in (*names, *more)})
        result["rate_hz"] = stats["samples"] / device_s if device_s > 0 else 0.0
        result["wall_s"], result["device_s"] = wall, device_s
        result["speed"] = device_s / wall if wall else 0.0
        result["latency_us"] = stats.quantiles_us(Times.LATENCY)
        result["times_us"] = {what.name.lower(): stats.quantiles_us(what) for what in Times}
        if (clock := clock_summary(stats)) is not None:
            result["clock"] = clock
            if (utc := self._pulses.summary()) is not None:
                clock["utc"] = utc
        for name in ("loop", "feeder", "publisher", "recorder", "mcap", "dashboard"):
            if name in self._parts:
                answers = self._answers(name)
                if name == "loop":
                    result.update(answers)
                else:
                    result[name] = answers
        if self.recordings:
            result["recordings"] = self.recordings
        if feeds := self._feed_summaries():
            result["feeds"] = feeds
        if "wire" in result.get("feeder", {}):
            result["wire"] = result["feeder"].pop("wire")
        if self._receivers:
            result["receivers"] = [self._answers(name) for name in self._receivers]
        result["mavlink_sent"] = result.get("publisher", {}).get("sent", {})
        told = [one["problem"] for one in result.get("receivers", []) if "problem" in one]
        if self.problems or told:
            result["problems"] = self.problems + told
        return result


def private_bus() -> str:
    """The bus of this process's run and of nobody else."""
    return f"unix:run-{os.getpid()}"


def simulated_head(order: LoopOrder) -> tuple[Callable[..., None], Sequence[Any]]:
    """The feeder that simulates the head of the order's scenario."""
    return run_head, (order.scenario, order.paced)
