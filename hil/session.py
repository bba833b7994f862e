"""A run as a whole: starts the processes, watches them, gathers the summary. What `hil run` and the tests stand on.

    feeder (simulated head or player) --bus--> loop --rings--> publisher (MAVLink), recorder, dashboard, this process

Each box is a process of its own. The session notices a process that dies, and stops all when the loop is done.
"""

import contextlib
import multiprocessing as mp
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from hil.bridge import EVENTS, LoopOrder, Outlets, run_loop
from hil.control import run_part
from hil.dashboard import Sources, Window, recording_name, run_dashboard
from hil.link_stats import LinkStats
from hil.publisher import Taps, run_publisher
from hil.recorder import run_recorder
from hil.ring import Wake
from hil.stats import Phase
from hil.warmup import STEPS
from hil.world.head import run_head
from nav.errors import HilError
from nav.state import NAV_STATE, Mode

START_S = 180.0
"""Longest time for the processes to get ready (the first compilation is in it)."""
NICE = {"publisher": 10, "dashboard": 5}
"""How far a part steps back behind the loop where processors are few."""
RECORDER_STOP_S = 60.0
"""The recorder gets longer: what is in the ring is not to be lost."""
STOP_S = 10.0
"""Longest time for a process to end on its own."""
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

    def read(self) -> None:
        """Take what the process has answered."""
        with contextlib.suppress(EOFError, OSError):
            while self.connection.poll():
                self.answers.update(self.connection.recv())


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
        window: Window | None = None,
    ) -> None:
        self.order = order
        self.links = LinkStats(order.scenario.mavlink.links if publish else ())
        self.recordings: list[dict[str, Any]] = []
        """What became of the recordings that were asked for while running."""
        self._window = window
        self.outlets = Outlets.make(recording=record is not None, readers=1)
        self._feeder = feeder
        self._record = record
        self._publish = publish
        self._publisher_stop = Wake()
        self._parts: dict[str, _Part] = {}
        self._event_number = 0
        self._row = np.zeros(1, NAV_STATE)
        self._feeder_ended: float | None = None
        self._drained = 0
        """Frames that the loop had taken when it was last seen at work after the feeder's end."""
        self._began = 0.0
        self._ended = 0.0
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
        process = context.Process(
            target=run_part,
            args=(self.outlets.control, NICE.get(name, 0), target, *args, theirs),
            name=f"hil-{name}",
            daemon=True,
        )
        process.start()
        theirs.close()
        self._parts[name] = _Part(name, process, ours)

    def _launch_recorder(self, path: Path) -> None:
        header = {"scenario": self.order.scenario.model_dump(mode="json"), "created_ns": time.time_ns()}
        self._launch("recorder", run_recorder, path, header, self.outlets)

    def _start(self) -> None:
        scenario, outlets, launch = self.order.scenario, self.outlets, self._launch
        mp.get_context("forkserver").set_forkserver_preload(
            ["hil.bridge", "hil.publisher", "hil.recorder", "hil.world.head"]
        )
        if self._record is not None:
            self._launch_recorder(self._record)
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
            live = self.order.paced and self.order.file is None
            network, early = outlets.aiding if live else None, scenario.navigation.aligned_by_aiding
            taps = Taps(outlets.states, 0, outlets.events, outlets.control, network, early, self.links)
            launch("publisher", run_publisher, scenario.mavlink, taps, self._publisher_stop)

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
        recorder = self._parts.get("recorder")
        if self.outlets.stats["phase"] == Phase.STARTING or (recorder and "ready" not in recorder.answers):
            return False
        if not self.outlets.control.go:
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
        if not self.ready:
            return True
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
            recorder.read()
            control.recording, control.record_since = False, 0
            self.recordings.append(recorder.answers)
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

    def events(self) -> list[tuple[float, str, str]]:
        """(device time, severity, text) of what happened since the last call."""
        rows = np.zeros(64, EVENTS)
        copied, first = self.outlets.events.pull(rows, self._event_number)
        self._event_number = first + copied
        return [
            (float(row["time"]), row["severity"].decode(), row["text"].decode(errors="replace"))
            for row in rows[:copied]
        ]

    def stop(self) -> None:
        """Tell the loop to end."""
        self.outlets.control.order_stop()

    def _watch(self) -> None:
        for part in self._parts.values():
            part.read()
            failed = part.answers.get("failed")
            died = part.process.exitcode not in (None, 0) and not failed
            if died:
                failed = f"the {part.name} process died (exit code {part.process.exitcode})"
            if not failed:
                continue
            if part.name in {"loop", "feeder"} or not self.outlets.control.go:
                raise HilError(str(failed))
            if failed not in self.problems:
                self.problems.append(str(failed))

    def _end(self) -> None:
        self._ended = time.monotonic()
        control, stats = self.outlets.control, self.outlets.stats
        control.order_stop()
        deadline = time.monotonic() + STOP_S
        for name in ("loop", "feeder", "recorder", "publisher", "dashboard"):
            part = self._parts.get(name)
            if part is None:
                continue
            if name == "publisher":
                self._publisher_stop.call()
            patience = RECORDER_STOP_S if name == "recorder" else 0.0
            while part.process.is_alive() and time.monotonic() < deadline + patience:
                part.read()
                part.process.join(0.02)
            if part.process.is_alive():
                part.process.kill()
                part.process.join()
                self.problems.append(f"the {name} process did not end and was killed")
            if name == "loop" and stats["phase"] not in (Phase.DONE, Phase.FAILED):
                stats["phase"] = Phase.FAILED  # it died: the recorder must know
            part.read()

    def summary(self) -> dict[str, Any]:
        """What the run showed, as `hil run --json` prints it; complete after the end."""
        stats = self.outlets.stats
        names = ("frames", "samples", "lost", "duplicated", "late", "crc_errors", "foreign", "short", "version_errors")
        more = ("restarts", "interpolated", "silences")
        wall = max((self._ended or time.monotonic()) - self._began, 1e-9) if self._began else 0.0
        device_s = stats["covered_us"] * 1e-6
        result: dict[str, Any] = {"scenario": self.order.scenario.name}
        result.update({name: stats[name] for name in (*names, *more)})
        result["rate_hz"] = stats["samples"] / device_s if device_s > 0 else 0.0
        result["wall_s"], result["device_s"] = wall, device_s
        result["speed"] = device_s / wall if wall else 0.0
        result["latency_us"] = stats.latency_us()
        for name in ("loop", "feeder", "publisher", "recorder", "dashboard"):
            part = self._parts.get(name)
            if part is not None:
                part.read()
                answers = {key: value for key, value in part.answers.items() if key not in {"failed", "ready"}}
                if name == "loop":
                    result.update(answers)
                else:
                    result[name] = answers
        if self.recordings:
            result["recordings"] = self.recordings
        result["mavlink_sent"] = result.get("publisher", {}).get("sent", {})
        if self.problems:
            result["problems"] = self.problems
        return result


def simulated_head(order: LoopOrder) -> tuple[Callable[..., None], Sequence[Any]]:
    """The feeder that simulates the head of the order's scenario."""
    return run_head, (order.scenario, order.paced)
