"""Head and bridge on a real SocketCAN interface, with Debian's can-utils as independent peers.

Only counts, contents and ratios are asserted: in user-mode Linux system calls are slow.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from drivers.can import dtg_head_emulator
from drivers.can.convert import to_message
from drivers.can.dtg_head_emulator import HeadEncoder
from drivers.can.frames import FDF, FrameArray
from drivers.logs.recording import EVENT, RecordingReader
from hil.pytest_plugin import StartBridge
from hil.scenario import load
from hil.world.head import SimulatedHead
from nav.errors import HilError

pytestmark = pytest.mark.socketcan

HIL = (sys.executable, "-c", "from hil.cli import main; main()")
BUS = "socketcan:vcan0"
SCENARIO = """
name = "can"
[motion]
rest_s = 1
ramp_s = 2
attitude = "coordinated"
north = { rate = 30 }
east = { sines = [{ amplitude = 20, period_s = 20 }] }
[head]
rate_hz = 200
[navigation]
alignment = "truth"
silence_s = 5  # user-mode Linux may take a nap
"""

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    file = tmp_path / "can.toml"
    file.write_text(SCENARIO)
    return file


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts a program; what still runs is killed after the test."""
    programs: list[subprocess.Popen[str]] = []

    def call(*command: object, **options: Any) -> "subprocess.Popen[str]":
        if shutil.which(str(command[0])) is None:
            pytest.skip(f"{command[0]} is not installed: apt-get install can-utils")
        texts = [str(part) for part in command]
        options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
        programs.append(subprocess.Popen(texts, text=True, **options))
        return programs[-1]

    yield call
    for program in programs:
        program.kill()
        program.communicate()


def report_of(program: "subprocess.Popen[str]") -> dict[str, Any]:
    out, err = program.communicate(timeout=120)
    assert program.returncode == 0, err
    result: dict[str, Any] = json.loads(out)
    return result


def ip(*arguments: str) -> None:
    if os.geteuid() != 0:
        pytest.skip("changing the state of an interface needs root")
    subprocess.run(["ip", *arguments], check=True)


def frames_of(path: Path) -> FrameArray:
    reader, blocks = RecordingReader.open(path), []
    while len(block := reader.read()):
        blocks.append(block)
    reader.close()
    frames = np.concatenate(blocks)
    chosen: FrameArray = frames[frames["reserved"][:, 0] != EVENT]
    return chosen


def as_candump(frames: FrameArray) -> list[str]:
    """What candump's log format says of each frame: ``ID#DATA`` or ``ID##FLAGSDATA``, the flags without FDF."""
    lines = []
    for row in frames:
        data = bytes(row["data"][: int(row["length"])]).hex().upper()
        fd = f"#{int(row['flags']) & 3:X}" if int(row["flags"]) & FDF else ""
        lines.append(f"{int(row['can_id']):03X}#{fd}{data}")
    return lines


def candump_lines(text: str) -> list[str]:
    lines = []
    for line in text.splitlines():
        can_id, _, rest = line.split()[2].partition("#")
        if rest.startswith("#"):
            rest = f"#{int(rest[1], 16) & 3:X}{rest[2:]}"
        lines.append(f"{can_id}#{rest}")
    return lines


def cansend(frame: str) -> None:
    subprocess.run(["cansend", "vcan0", frame], check=True)


@pytest.mark.parametrize(("layout", "rate_hz"), [("fd", 500), ("classic", 100)])
def test_two_programs_lose_nothing(start: Start, tmp_path: Path, layout: str, rate_hz: int) -> None:
    file = tmp_path / "can.toml"
    file.write_text(SCENARIO.replace("rate_hz = 200", f'rate_hz = {rate_hz}\nlayout = "{layout}"'))
    common = (file, "--bus", BUS, "--duration", 4, "--json")
    bridge = start(*HIL, "run", *common, "--mavlink", "none")
    assert bridge.stderr
    while "waiting for samples" not in bridge.stderr.readline():
        assert bridge.poll() is None
    sent = report_of(start(*HIL, "imu", *common))
    summary = report_of(bridge)
    assert sent == {"scenario": "can", "sent": 4 * rate_hz, "dropped": 0}
    assert summary["samples"] == 4 * rate_hz
    assert summary["frames"] == 4 * rate_hz * (1 if layout == "fd" else 6) + 4 * 5
    for name in (
        "lost",
        "duplicated",
        "late",
        "crc_errors",
        "foreign",
        "short",
        "version_errors",
        "restarts",
        "overflowed",
    ):
        assert summary[name] == 0, name
    assert summary["error"]["position_m"]["max"] < 1e-3
    assert "problem" not in summary


@pytest.mark.parametrize("layout", ["fd", "classic"])
def test_candump_saw_what_we_recorded(
    hil_bridge: StartBridge, start: Start, scenario: Path, tmp_path: Path, layout: str
) -> None:
    scenario.write_text(SCENARIO.replace("[head]", f'[head]\nlayout = "{layout}"'))
    ours = tmp_path / "ours.dhil"
    bridge = hil_bridge(scenario, simulate_head=False, bus=BUS, record=ours, duration_s=2)
    live = start("candump", "-r", "8000000", "-L", "vcan0", stdout=(tmp_path / "live.txt").open("w"))
    logged = start("candump", "-r", "8000000", "-l", "vcan0", cwd=tmp_path)
    time.sleep(1.0)
    report_of(start(*HIL, "imu", scenario, "--bus", BUS, "--duration", 2, "--json"))
    summary = bridge.wait_end(60)
    for program in (live, logged):
        program.send_signal(signal.SIGINT)
        program.wait(20)
    frames = frames_of(ours)
    expected = as_candump(frames)
    assert len(expected) == summary["frames"] == 400 * (1 if layout == "fd" else 6) + 10
    assert candump_lines((tmp_path / "live.txt").read_text()) == expected
    (log,) = tmp_path.glob("candump-*.log")
    assert candump_lines(log.read_text()) == expected
    stamps = [float(line.split()[0].strip("()")) for line in log.read_text().splitlines()]
    assert np.abs(np.array(stamps) - frames["time_ns"] * 1e-9).max() < 2e-6, "both show the kernel's time stamp"


def test_canplayer_drives_the_bridge_as_the_head_did(
    hil_bridge: StartBridge, start: Start, scenario: Path, tmp_path: Path
) -> None:
    ours, log = tmp_path / "ours.dhil", tmp_path / "export.log"
    changes: dict[str, Any] = {"simulate_head": False, "bus": BUS, "duration_s": 3}
    bridge = hil_bridge(scenario, record=ours, **changes)
    report_of(start(*HIL, "imu", scenario, "--bus", BUS, "--duration", 3, "--json"))
    live = bridge.wait_end(60)
    final = bridge.state()
    with can.Logger(log) as writer:
        for row in frames_of(ours):
            writer.on_message_received(to_message(row, "can0"))
    played = hil_bridge(scenario, **changes)
    player = start("canplayer", "-I", log, "vcan0=can0")
    summary = played.wait_end(120)
    assert player.wait(60) == 0
    assert summary["samples"] == live["samples"] == 600
    assert summary["lost"] == summary["crc_errors"] == 0
    assert summary["navigation_digest"] == live["navigation_digest"]
    np.testing.assert_array_equal(played.state()["q_nb"], final["q_nb"])


def test_corrupt_frames_are_counted_and_do_no_harm(
    hil_bridge: StartBridge, start: Start, scenario: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if shutil.which("cansend") is None:
        pytest.skip("cansend is not installed: apt-get install can-utils")
    bridge = hil_bridge(scenario, simulate_head=False, bus=BUS)
    head = start(*HIL, "imu", scenario, "--bus", BUS, "--json")
    bridge.wait_mode("navigate")

    counter = np.arange(1, 2)
    good = HeadEncoder("fd", 5000).samples(counter, counter * 5000, np.zeros((1, 4)), np.zeros((1, 3)))
    bad = good.copy()
    bad["data"][0, 30] ^= 1
    monkeypatch.setattr(dtg_head_emulator, "PROTOCOL", 2)
    other = HeadEncoder("fd", 5000).samples(counter, counter * 5000, np.zeros((1, 4)), np.zeros((1, 3)))
    sample_id = f"{int(good['can_id'][0]):03X}"
    for _ in range(3):
        cansend(as_candump(bad)[0])
        cansend(as_candump(other)[0])
        cansend("7FF#00112233")
        cansend("1ABCDEF0#00")
        cansend(f"{sample_id}#0011")
        cansend(f"{sample_id}#R")
    before = bridge.summary()["samples"]
    wait_for(lambda: bridge.summary()["samples"] > before + 200)
    head.send_signal(signal.SIGINT)
    sent = report_of(head)["sent"]
    wait_for(lambda: bridge.summary()["samples"] == sent)
    summary = bridge.stop()
    assert summary["crc_errors"] == 3
    assert summary["version_errors"] == 3
    assert summary["short"] == 3
    assert summary["foreign"] == 9, "another id, an extended one and a remote request, three times each"
    assert summary["lost"] == summary["restarts"] == summary["interpolated"] == 0
    assert summary["error"]["position_m"]["max"] < 1e-3


@pytest.mark.parametrize("command", ["run", "imu", "record"])
def test_missing_interface_is_named_with_the_command(start: Start, tmp_path: Path, command: str) -> None:
    target = (tmp_path / "x.dhil",) if command == "record" else ()
    program = start(*HIL, command, *target, "--bus", "socketcan:vcan9")
    out, err = program.communicate(timeout=60)
    assert program.returncode == 2
    assert out == ""
    (line,) = [line for line in err.splitlines() if line.startswith("hil: ")]
    assert (
        "no interface vcan9; make it with: sudo sh -c 'ip link add vcan9 type vcan && ip link set vcan9 mtu 72 up'"
        in line
    )


def test_interface_goes_down_and_comes_up(hil_bridge: StartBridge, start: Start, scenario: Path) -> None:
    bus = "socketcan:vcan1"
    bridge = hil_bridge(scenario, simulate_head=False, bus=bus, navigation={"silence_s": 0.3})
    head = start(*HIL, "imu", scenario, "--bus", bus, "--json")
    bridge.wait_mode("navigate")
    try:
        for count in (1, 2):
            ip("link", "set", "vcan1", "down")
            wait_for(lambda count=count: bridge.summary()["silences"] >= count)
            before = bridge.summary()["samples"]
            ip("link", "set", "vcan1", "up")
            wait_for(lambda before=before: bridge.summary()["samples"] > before + 100)
    finally:
        ip("link", "set", "vcan1", "up")
    head.send_signal(signal.SIGINT)
    sent = report_of(head)
    wait_for(lambda: bridge.summary()["silences"] >= 3)
    summary = bridge.stop()
    assert summary["problem"].startswith("the bus failed ")
    assert summary["restarts"] == summary["crc_errors"] == 0
    assert summary["lost"] > 0
    assert summary["samples"] + summary["lost"] == sent["sent"], "every sample of the head is accounted for"
    texts = [text for _, _, text in bridge.events()]
    assert texts.count("no samples: the sensor is silent") == 3
    assert texts.count("samples arrive again") == 2


def test_interface_that_is_down_at_the_start(hil_bridge: StartBridge, scenario: Path) -> None:
    """It is refused at once, with the command that mends it."""
    ip("link", "set", "vcan1", "down")
    try:
        with pytest.raises(HilError, match="vcan1 is down; raise it with: sudo ip link set vcan1 up"):
            hil_bridge(scenario, simulate_head=False, bus="socketcan:vcan1")
    finally:
        ip("link", "set", "vcan1", "up")


def wait_for(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_burst_is_held(hil_bridge: StartBridge, scenario: Path) -> None:
    """Two simulated seconds at once, faster than real: the receive buffer holds it."""
    bridge = hil_bridge(scenario, simulate_head=False, bus=BUS)
    chosen = load(scenario)
    head, bus = SimulatedHead(chosen), can.Bus(interface="socketcan", channel="vcan0", fd=True)
    for _, slow, batch in head.chunks(400):
        for row in np.concatenate([slow, batch]):
            bus.send(to_message(row), timeout=1.0)
    bus.shutdown()
    wait_for(lambda: bridge.summary()["samples"] == 400)
    summary = bridge.stop()
    assert summary["head"]["world_id"] == chosen.world_id()
    assert summary["lost"] == 0
