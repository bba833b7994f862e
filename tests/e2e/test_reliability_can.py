"""Faults of a real CAN interface: down, deleted and made again, bus-off. In user-mode Linux only counts are asserted."""

import json
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from rows import counts, note, recorded

from drivers.can.bus_errors import BUS_OFF, CONTROLLER, RESTARTED
from drivers.can.frames import ERR
from hil.pytest_plugin import Bridge, StartBridge

pytestmark = pytest.mark.socketcan

HIL = (sys.executable, "-c", "from hil.cli import main; main()")
BUS, INTERFACE = "socketcan:vcan7", "vcan7"
FLIGHT = """
name = "can"
[motion]
north = { rate = 30 }
[head]
rate_hz = 200
[navigation]
alignment = "truth"
silence_s = 0.3
"""


def ip(*arguments: str) -> None:
    subprocess.run(["ip", "link", *arguments], check=True)


def make() -> None:
    ip("add", INTERFACE, "type", "vcan")
    ip("set", INTERFACE, "mtu", "72", "up")


@pytest.fixture
def interface() -> Iterator[None]:
    """An interface of the test's own."""
    try:
        make()
    except subprocess.CalledProcessError:
        pytest.skip("making an interface needs root")
    yield
    subprocess.run(["ip", "link", "del", INTERFACE], check=False, capture_output=True)


def wait_for(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.fixture
def flight(interface: None, hil_bridge: StartBridge, tmp_path: Path) -> "Iterator[tuple[Bridge, Callable[[], int]]]":
    """A bridge that navigates, and what ends its head and says how many samples that has sent."""
    scenario = tmp_path / "can.toml"
    scenario.write_text(FLIGHT)
    bridge = hil_bridge(scenario, simulate_head=False, bus=BUS, record=tmp_path / "run.dhil", mavlink={"links": ()})
    command = [*HIL, "imu", str(scenario), "--bus", BUS, "--json"]
    head = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)

    def end() -> int:
        head.send_signal(signal.SIGINT)
        sent: int = json.loads(head.communicate(timeout=60)[0])["sent"]
        return sent

    bridge.wait_mode("navigate")
    yield bridge, end
    head.kill()
    head.communicate()


@pytest.mark.parametrize("how", ["down", "deleted"])
def test_an_interface_that_goes_and_comes_back(
    flight: "tuple[Bridge, Callable[[], int]]", tmp_path: Path, how: str
) -> None:
    bridge, end = flight
    ip(*(("set", INTERFACE, "down") if how == "down" else ("del", INTERFACE)))
    mend = (
        f"raise it with: sudo ip link set {INTERFACE} up"
        if how == "down"
        else f"no interface {INTERFACE}; make it with"
    )
    wait_for(lambda: bridge.summary()["silences"] >= 1 and any(mend in text for _, _, text in bridge.events()))
    before = bridge.summary()["samples"]
    if how == "down":
        ip("set", INTERFACE, "up")
    else:
        make()
    up = time.monotonic()
    wait_for(lambda: bridge.summary()["samples"] > before)
    back_s = time.monotonic() - up
    wait_for(lambda: bridge.summary()["samples"] > before + 100)
    sent = end()
    wait_for(lambda: bridge.summary()["silences"] >= 2)
    summary = bridge.stop()
    assert summary["lost"] > 0
    assert summary["samples"] + summary["lost"] == sent, "every sample of the head is accounted for"
    assert len(recorded(tmp_path / "run.dhil")[0]) == summary["frames"]
    told = [text for _, _, text in bridge.events()]
    assert f"{BUS} is back" in told
    told = [text for text in told if "navigating" not in text and "navigate" not in text]
    note(
        24 + (how == "deleted"),
        f"interface {how} and back",
        f"`ip link` on {INTERFACE}",
        counts(summary),
        told,
        f"{back_s:.2f}",
        "0",
    )


def send_error(said: int, state: int = 0) -> None:
    """What a CAN controller says of itself, as its driver hands it to all sockets."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind((INTERFACE,))
        raw.send(struct.pack("<IB3x8s", ERR | said, 8, bytes([0, state])))


def test_a_controller_that_leaves_the_bus(flight: "tuple[Bridge, Callable[[], int]]", tmp_path: Path) -> None:
    bridge, end = flight
    send_error(CONTROLLER, 0x20)
    send_error(BUS_OFF)
    wait_for(lambda: any("off the bus" in text for _, _, text in bridge.events()))
    send_error(RESTARTED)
    wait_for(lambda: any("back on the bus" in text for _, _, text in bridge.events()))
    sent = end()
    wait_for(lambda: bridge.summary()["silences"] >= 1)
    summary = bridge.stop()
    assert summary["bus_errors"] == {"bus_off": 1, "restarted": 1, "error_passive": 1}
    assert summary["samples"] == sent
    assert summary["foreign"] == 3
    told = [text for _, _, text in bridge.events() if "controller" in text]
    assert any("restart-ms 100" in text and f"ip link set {INTERFACE} type can restart" in text for text in told)
    assert len(recorded(tmp_path / "run.dhil")[0]) == summary["frames"]
    note(26, "bus-off", "error frames of a controller", summary["bus_errors"], told, "the controller's restart", "0")
