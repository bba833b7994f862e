"""The head and the bridge as two programs on a `unix:` bus: any order, silence, sudden death, wrong requests."""

import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.can.dtg_head import DtgHead
from drivers.logs.recording import EVENT, RecordingReader

HIL = (sys.executable, "-c", "from hil.cli import main; main()")
SCENARIO = """
name = "bench"
[motion]
rest_s = 2
ramp_s = 4
attitude = "coordinated"
north = { rate = 30 }
[head]
rate_hz = 500
[navigation]
alignment = "truth"
"""
SILENCE_S = 0.1
SLACK_S = 0.06
"""The loop looks every 20 ms; the rest is for a busy machine."""


class Program:
    """``hil ARGUMENT... --json`` at work."""

    def __init__(self, *arguments: object) -> None:
        self.process = subprocess.Popen(
            [*HIL, *map(str, arguments), "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.said: list[str] = []
        self._lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stderr
        for line in self.process.stderr:
            self._lines.put(line)

    def wait_for(self, text: str, timeout_s: float = 60.0) -> str:
        """The next line with `text`."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            try:
                line = self._lines.get(timeout=0.1)
            except queue.Empty:
                assert self.process.poll() is None, f"ended with {self.process.returncode}: {''.join(self.said)}"
                continue
            self.said.append(line)
            if text in line:
                return line
        raise AssertionError(f"{text!r} was not said in {timeout_s:g} s, but: {''.join(self.said)}")

    def kill(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def end(self, number: signal.Signals | None = signal.SIGINT) -> dict[str, Any]:
        """Stop it (or wait for its own end); what it reported."""
        if number is not None:
            self.process.send_signal(number)
        assert self.process.stdout
        out = self.process.stdout.read()
        assert self.process.wait(30) == 0
        result: dict[str, Any] = json.loads(out)
        return result


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Program]]:
    """Starts ``hil COMMAND bench.toml ...``; what still runs is killed after the test."""
    (tmp_path / "bench.toml").write_text(SCENARIO)
    programs: list[Program] = []

    def call(command: str, *arguments: object) -> Program:
        quiet = ("--mavlink", "none", "--no-dashboard") if command == "run" else ()
        programs.append(Program(command, tmp_path / "bench.toml", *quiet, *arguments))
        return programs[-1]

    yield call
    for program in programs:
        program.kill(signal.SIGCONT)
        program.process.kill()
        program.process.wait()


def bus_name(what: str) -> str:
    return f"unix:{what}-{os.getpid()}"


def test_either_may_start_first_stop_and_start_again(start: Callable[..., Program]) -> None:
    bus = bus_name("order")
    bridge = start("run", "--bus", bus)
    bridge.wait_for("waiting for samples")
    head = start("imu", "--bus", bus)
    bridge.wait_for("navigating from a given start")
    late = start("run", "--bus", bus)  # joins a head that is at work
    late.wait_for("navigating from a given start")
    time.sleep(0.5)

    sent = head.end()
    bridge.wait_for("the sensor is silent", 5)
    again = start("imu", "--bus", bus)
    bridge.wait_for("samples arrive again")
    bridge.wait_for("aligning")  # its clock began anew: nothing is known of what was between
    time.sleep(0.3)
    summary = bridge.end()
    late_summary = late.end()
    assert again.end()["dropped"] == 0, "listeners that leave cost the head nothing"

    assert sent["dropped"] == 0
    assert summary["samples"] >= sent["sent"], "all of the first head and some of the second"
    assert (summary["lost"], summary["restarts"], summary["silences"]) == (0, 1, 1)
    assert (late_summary["lost"], late_summary["restarts"]) == (0, 1)
    assert late_summary["samples"] < summary["samples"] + sent["sent"]


def test_duration_ends_both(start: Callable[..., Program]) -> None:
    bus = bus_name("both")
    bridge = start("run", "--bus", bus, "--duration", 2)
    bridge.wait_for("waiting for samples")
    head = start("imu", "--bus", bus, "--duration", 2)
    assert head.end(None) == {"scenario": "bench", "sent": 1000, "dropped": 0}
    summary = bridge.end(None)
    assert summary["samples"] == 1000
    assert summary["lost"] == summary["duplicated"] == summary["crc_errors"] == 0
    assert summary["error"]["position_m"]["max"] < 1e-3, "the head announced our own world"
    assert summary["latency_us"]["p50"] > 0


@pytest.mark.slow
def test_other_world_is_navigated_but_not_judged(start: Callable[..., Program]) -> None:
    bus = bus_name("world")
    bridge = Program("run", "rest", "--bus", bus, "--mavlink", "none")
    bridge.wait_for("waiting for samples")
    head = start("imu", "--bus", bus, "--seed", 9)
    bridge.wait_for("aligning")
    time.sleep(0.3)
    head.end()
    summary = bridge.end()
    assert summary["samples"] > 0
    assert "error" not in summary


def test_silence_degrades_in_time_and_ends(start: Callable[..., Program], tmp_path: Path) -> None:
    bus, file = bus_name("silence"), tmp_path / "silence.dhil"
    bridge = start("run", "--bus", bus, "--record", file)
    bridge.wait_for("waiting for samples")
    head = start("imu", "--bus", bus)
    bridge.wait_for("navigating")
    for _ in range(3):
        time.sleep(0.4)
        head.kill(signal.SIGSTOP)
        assert "error" not in bridge.wait_for("no samples: the sensor is silent", 5).lower().split("silent")[1]
        head.kill(signal.SIGCONT)
        bridge.wait_for("samples arrive again", 5)
        bridge.wait_for("mode navigate", 5)
    time.sleep(0.3)
    summary = bridge.end()
    assert (summary["silences"], summary["lost"], summary["restarts"]) == (3, 0, 0)
    assert summary["mode"] == "navigate"
    assert summary["error"]["position_m"]["final"] < 1e-3, "a head that only paused loses nothing"

    reader, blocks = RecordingReader.open(file), []
    while len(block := reader.read()):
        blocks.append(block)
    reader.close()
    frames = np.concatenate(blocks)
    events = np.flatnonzero(frames["reserved"][:, 0] == EVENT)
    assert len(events) == 3
    delays = [(int(frames["time_ns"][k]) - int(frames["time_ns"][k - 1])) * 1e-9 for k in events]
    print(f"silence was said {', '.join(f'{1000 * delay:.1f}' for delay in delays)} ms after the last frame")
    assert max(delays) <= SILENCE_S + SLACK_S
    assert min(delays) > SILENCE_S / 2


@pytest.mark.slow
def test_sudden_death_of_the_head(start: Callable[..., Program]) -> None:
    bus = bus_name("death")
    bridge = start("run", "--bus", bus)
    bridge.wait_for("waiting for samples")
    head = start("imu", "--bus", bus)
    bridge.wait_for("navigating")
    time.sleep(0.3)
    head.kill(signal.SIGKILL)
    bridge.wait_for("the sensor is silent", 5)
    heir = start("imu", "--bus", bus)
    bridge.wait_for("samples arrive again")
    time.sleep(0.3)
    summary = bridge.end()
    assert (summary["restarts"], summary["silences"], summary["crc_errors"]) == (1, 1, 0)
    assert heir.end()["sent"] > 0


def test_sudden_death_of_the_bridge_leaves_nothing_behind(start: Callable[..., Program]) -> None:
    bridge = start("run")  # with a head of its own
    bridge.wait_for("navigating")
    family = descendants(bridge.process.pid)
    assert len(family) >= 2
    bridge.kill(signal.SIGKILL)
    bridge.process.wait()
    deadline = time.monotonic() + 5.0
    while any(alive(pid) for pid in family) and time.monotonic() < deadline:
        time.sleep(0.05)
    left = [pid for pid in family if alive(pid)]
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert not left


def descendants(pid: int) -> list[int]:
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in map(int, (task / "children").read_text().split()):
            found += [child, *descendants(child)]
    return found


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def refusal(*arguments: object) -> str:
    """What a wrong request is answered with."""
    done = subprocess.run([*HIL, *map(str, arguments)], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("hil: ")]
    assert len(lines) == 1, done.stderr
    return lines[0]


@pytest.mark.parametrize("command", ["run", "imu", "record"])
def test_missing_interface_is_named_with_its_mend(command: str, tmp_path: Path) -> None:
    target = (tmp_path / "x.dhil",) if command == "record" else ()
    line = refusal(command, *target, "--bus", "socketcan:vcan9")
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        assert "this kernel has no SocketCAN; use unix:NAME or udp_multicast" in line
    else:
        assert "no interface vcan9; make it with: sudo sh -c 'ip link add vcan9 type vcan" in line


def test_wrong_key_is_named(tmp_path: Path) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text(SCENARIO.replace("rate_hz", "rate_khz"))
    assert refusal("imu", file) == f"hil: scenario {file}: head.rate_khz = 500: unknown key"


@pytest.mark.slow
def test_what_the_head_sends_is_what_the_driver_reads(start: Callable[..., Program], tmp_path: Path) -> None:
    """``hil record`` as a third participant hears all that the bridge hears."""
    bus, file = bus_name("third"), tmp_path / "third.dhil"
    bridge = start("run", "--bus", bus, "--duration", 1)
    bridge.wait_for("waiting for samples")
    recorder = subprocess.Popen(
        [*HIL, "record", str(file), "--bus", bus, "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 20
    while not file.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    start("imu", "--bus", bus, "--duration", 1).end(None)
    summary = bridge.end(None)
    time.sleep(0.2)
    recorder.send_signal(signal.SIGTERM)
    out, err = recorder.communicate(timeout=20)
    assert recorder.returncode == 0, err
    assert json.loads(out)["frames"] == summary["frames"] == 500 + 5
    reader, driver = RecordingReader.open(file), DtgHead()
    while len(block := reader.read()):
        driver.decode(block)
    assert driver.counters.samples == 500
