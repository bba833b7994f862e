"""``kill -9`` of each process, a full disk, a recording cut anywhere: what was recorded before is there, and the user is told."""

import contextlib
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav
from rows import note, recorded

from drivers.can.frames import frames
from drivers.logs.recording import RecordingWriter
from hil.pytest_plugin import Bridge, StartBridge
from nav.errors import HilError

HIL = (sys.executable, "-c", "from hil.cli import main; main()")
RATE_HZ = 1000
KEPT_S = 0.1
"""A process that is killed costs the recording no more than this."""
LIMIT = "`RLIMIT_FSIZE`: no file may grow"
FLIGHT = {"navigation": {"alignment": "truth"}, "head": {"rate_hz": RATE_HZ}}


def pid_of(bridge: Bridge, part: str) -> int:
    pid = bridge.session._parts[part].process.pid
    assert pid
    return pid


def kill(bridge: Bridge, part: str) -> float:
    """Kill a part; when."""
    os.kill(pid_of(bridge, part), signal.SIGKILL)
    return time.monotonic()


def wait_for(condition: Callable[[], bool], timeout_s: float = 30.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def recorder_has(bridge: Bridge, count: int) -> Callable[[], bool]:
    return lambda: bridge.session.outlets.control.recorded >= count


@pytest.mark.parametrize("part", ["feeder", "loop"])
def test_a_run_that_dies_leaves_all_that_the_loop_took(hil_bridge: StartBridge, tmp_path: Path, part: str) -> None:
    path = tmp_path / "run.dhil"
    bridge = hil_bridge(record=path, **FLIGHT)
    wait_for(recorder_has(bridge, 1000))
    killed, said = kill(bridge, part), ""
    with pytest.raises(HilError, match=f"the {part} process died") as raised:
        wait_for(lambda: not bridge.session.running)
    told_s, said = time.monotonic() - killed, str(raised.value)
    bridge.stop()
    taken = bridge.session.outlets.frames.count - bridge.summary()["silences"]
    found, problem = recorded(path)
    assert (len(found), problem) == (taken, ""), "to the last frame"
    note(
        30 + (part == "loop"),
        f"{part} killed",
        "`kill -9`",
        "-",
        [said],
        f"ends the run, told after {told_s:.3f} s",
        "0",
    )


def test_the_publisher_may_die(hil_bridge: StartBridge, tmp_path: Path) -> None:
    path = tmp_path / "run.dhil"
    bridge = hil_bridge(record=path, **FLIGHT)
    wait_for(recorder_has(bridge, 500))
    killed = kill(bridge, "publisher")
    wait_for(lambda: bridge.session.running and bool(bridge.session.problems))
    told_s, taken = time.monotonic() - killed, bridge.session.outlets.frames.count
    wait_for(recorder_has(bridge, taken + 200))
    summary = bridge.stop()
    assert summary["lost"] == 0
    assert len(recorded(path)[0]) == summary["frames"]
    note(32, "publisher killed", "`kill -9`", "-", summary["problems"], f"no MAVLink, told after {told_s:.3f} s", "0")


def test_a_killed_recorder_keeps_all_but_the_last_100_ms(hil_bridge: StartBridge, tmp_path: Path) -> None:
    path, worst = tmp_path / "run.dhil", 0
    bridge = hil_bridge(record=path, **FLIGHT)
    wait_for(recorder_has(bridge, 1000))
    taken = bridge.session.outlets.control.recorded
    killed = kill(bridge, "recorder")
    wait_for(lambda: bridge.session.running and bool(bridge.session.problems))
    told_s = time.monotonic() - killed
    summary = bridge.stop()
    found, problem = recorded(path)
    worst = taken - len(found)
    assert worst <= KEPT_S * RATE_HZ
    assert not problem or "truncated" in problem, "the last block may be cut"
    lost = f"what came after; {max(worst, 0)} ms before"
    note(33, "recorder killed", "`kill -9`", "-", summary["problems"], f"navigates on, told after {told_s:.3f} s", lost)


def test_a_killed_session_leaves_its_recording(tmp_path: Path) -> None:
    path, scenario = tmp_path / "run.dhil", tmp_path / "flight.toml"
    scenario.write_text('[navigation]\nalignment = "truth"\n')
    command = [*HIL, "run", str(scenario), "--mavlink", "none", "--record", str(path)]
    program = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    with contextlib.ExitStack() as stack:
        stack.callback(program.kill)
        wait_for(lambda: path.is_file() and path.stat().st_size > 80 * 2000, 120)
        program.send_signal(signal.SIGKILL)
        program.wait()
        killed_ns, size = time.time_ns(), -1
        while size != path.stat().st_size:  # the others end on their own, and write what they have
            size = path.stat().st_size
            time.sleep(1.0)
    found, problem = recorded(path)
    missing_s = (killed_ns - int(found["time_ns"][-1])) * 1e-9
    assert problem == ""
    assert missing_s <= KEPT_S
    note(34, "`hil run` killed", "`kill -9`", "-", "-", "ends the run; the other processes end too", "0")


@contextlib.contextmanager
def limited(pid: int, size: int) -> Iterator[None]:
    """No file of process `pid` may grow beyond `size`: writing fails, as on a full disk."""
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    yield
    resource.prlimit(pid, resource.RLIMIT_FSIZE, before)


@contextlib.contextmanager
def filled(folder: Path) -> Iterator[None]:
    """The disk of `folder` is full, until what fills it is deleted."""
    filler = folder / "filler"
    with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while file.write(bytes(4096)):
            pass
    yield
    filler.unlink()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 16 MiB of the test's own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", folder], check=False, capture_output=True)
    if made.returncode:
        pytest.skip("mounting a disk needs root")
    yield folder
    subprocess.run(["umount", folder], check=True)


class Station:
    """A ground station that reads STATUSTEXT, and the link to it."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.1)
        self.link = f"udpout:127.0.0.1:{self._socket.getsockname()[1]}?only=HEARTBEAT"
        self._parser = mav.MAVLink(None)
        self._texts: dict[int, str] = {}
        """By their numbers, as far as their pieces have come."""

    def heard(self, text: str) -> bool:
        """Whether a text of several pieces has come."""
        with contextlib.suppress(TimeoutError):
            for message in self._parser.parse_buffer(self._socket.recv(65536)) or []:
                if message.get_type() == "STATUSTEXT":
                    self._texts[message.id] = self._texts.get(message.id, "") + message.text
        return text in self._texts.values()


Stations = tuple[Station, Station]


@pytest.fixture
def stations() -> Stations:
    return Station(), Station()


def links_of(stations: Stations) -> dict[str, list[str]]:
    return {"links": [station.link for station in stations]}


def fly_over_a_full_disk(
    bridge: Bridge, path: Path, full: contextlib.AbstractContextManager[None], injected: str, stations: Stations
) -> None:
    problems = bridge.session.problems
    with full:
        began = time.monotonic()
        wait_for(lambda: bridge.session.running and bool(problems))
        told_s = time.monotonic() - began
        for station in stations:
            wait_for(partial(station.heard, problems[0]))
        kept, problem = recorded(path)
        assert not problem, "what was recorded before is whole while the disk is full"
        wait_for(recorder_has(bridge, bridge.session.outlets.control.recorded + 500))
    room = time.monotonic()
    wait_for(lambda: bridge.session.running and "room again" in problems[-1])
    back_s = time.monotonic() - room
    for station in stations:
        wait_for(partial(station.heard, problems[-1]))
    wait_for(recorder_has(bridge, bridge.session.outlets.control.recorded + 500))
    summary = bridge.stop()
    found, problem = recorded(path)
    recorder = summary["recorder"]
    assert not problem
    assert recorder["lost"] > 0
    silences = summary["silences"]  # events among the frames
    assert recorder["frames"] + recorder["lost"] == summary["frames"] + silences, "all is recorded or counted"
    assert recorder["frames"] - silences <= len(found) <= recorder["frames"]
    np.testing.assert_array_equal(found[: len(kept)], kept)
    assert summary["lost"] == 0, "the navigation does not notice"
    told = [text.replace(str(path), "run.dhil") for text in (problems[0], problems[-1])]
    lost = f"{recorder['lost']}, while it was full"
    number = 35 + (injected == LIMIT)
    back = f"{back_s:.3f}, told after {told_s:.3f} s"
    note(number, "disk full", injected, f"`recorder.lost` {recorder['lost']}", told, back, lost)


def test_a_disk_that_is_full_for_a_while(small_disk: Path, hil_bridge: StartBridge, stations: Stations) -> None:
    path = small_disk / "run.dhil"
    bridge = hil_bridge(record=path, mavlink=links_of(stations), **FLIGHT)
    wait_for(recorder_has(bridge, 1000))
    fly_over_a_full_disk(bridge, path, filled(small_disk), "a disk of 16 MiB is filled, then there is room", stations)
    path.unlink()


def test_a_file_that_may_not_grow_for_a_while(hil_bridge: StartBridge, tmp_path: Path, stations: Stations) -> None:
    path = tmp_path / "run.dhil"
    bridge = hil_bridge(record=path, mavlink=links_of(stations), **FLIGHT)
    wait_for(recorder_has(bridge, 1000))
    full = limited(pid_of(bridge, "recorder"), path.stat().st_size + 100)
    fly_over_a_full_disk(bridge, path, full, LIMIT, stations)


def test_a_recording_cut_at_every_byte_of_its_last_block(tmp_path: Path) -> None:
    path, cut = tmp_path / "run.dhil", tmp_path / "cut.dhil"
    batch = frames(20)
    batch["can_id"] = np.arange(20)
    with RecordingWriter(path, {}) as writer:
        writer.write(batch[:15])
        writer.flush()
        whole = path.stat().st_size
        writer.write(batch[15:])
    data = path.read_bytes()
    for size in range(whole, len(data)):
        cut.write_bytes(data[:size])
        found, problem = recorded(cut)
        np.testing.assert_array_equal(found, batch[:15])
        assert (f"offset {whole}" in problem) == (size > whole)
    told = [problem.replace(str(cut), "run.dhil")]
    note(
        37,
        "torn write",
        f"a recording cut at each of the last {len(data) - whole} bytes",
        "-",
        told,
        "-",
        "the cut block alone",
    )
