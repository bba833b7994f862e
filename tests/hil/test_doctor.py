"""`hil doctor`: ports and interfaces are listed with their state, and the board on them is recognised."""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from beside import beside
from commands import hil
from serial.tools.list_ports_common import ListPortInfo

from drivers import make_emulator
from drivers.can.bus import open_port
from drivers.can.interface import read_link
from hil.doctor import judged
from nav.increments import ImuIncrements

ACTIVE = '[{"linkinfo": {"info_data": {"state": "ERROR-ACTIVE", "bittiming": {"bitrate": 500000}}}}]'
"""What ``ip -details -json link`` prints of an adapter at work, in short."""


def findings(*arguments: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(hil("doctor", *arguments, "--json")[0])["findings"]
    return found


def named(what: str, *arguments: str) -> list[dict[str, Any]]:
    return [finding for finding in findings(*arguments) if finding["what"] == what]


def test_serial_ports_are_listed_by_name_and_description(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    ours, theirs = os.openpty()
    there = ListPortInfo(os.ttyname(theirs), skip_link_detection=True)
    there.description = "IMU of the desk"
    gone = ListPortInfo(str(tmp_path / "ttyGone"), skip_link_detection=True)
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [gone, there])
    (ports,) = named("serial ports")
    assert f"{there.device} (IMU of the desk)" in ports["found"]
    assert [one["verdict"] for one in named(gone.device)] == ["lack"], "one that we may not open"
    assert named(there.device) == [], "one that we may, without --probe"
    os.close(theirs)
    os.close(ours)


def test_each_extra_names_its_mend() -> None:
    """In an installation that has none of them."""
    project = (Path(__file__).resolve().parents[2] / "pyproject.toml").read_text()
    extras = {"pyulog": "logs", "matplotlib": "plot", "pyarrow": "parquet", "mcap": "mcap"}
    script = (
        "import importlib.util as u, json, hil.doctor as d; found = u.find_spec\n"
        f"u.find_spec = lambda name: None if name in {tuple(extras)} else found(name)\n"
        "print(json.dumps([one.mend for one in d._extras()]))"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True).stdout
    assert json.loads(said) == [f"pip install 'dtg-hil[{extra}]'" for extra in extras.values()]
    for module, extra in extras.items():
        assert f'{extra} = ["{module}' in project


@pytest.mark.parametrize(
    ("state", "verdict", "says", "mend"),
    [
        ({"up": True, "mtu": 72}, "ok", "up, mtu 72, ERROR-ACTIVE, 500000 bit/s", ""),
        ({"up": True, "mtu": 16}, "info", "classic CAN only: FD layouts need mtu 72", ""),
        ({"up": False, "mtu": 16}, "lack", "classic CAN only: FD layouts need mtu 72", "sudo ip link set can3 up"),
        ({"up": False, "mtu": 72}, "lack", "down, mtu 72", "sudo ip link set can3 up"),
    ],
)
def test_classic_can_is_a_note_and_no_lack(state: dict[str, Any], verdict: str, says: str, mend: str) -> None:
    found = judged("can3", read_link(ACTIVE), **state)
    assert (found.verdict, found.mend) == (verdict, mend)
    assert says in found.found


def test_a_classic_interface_off_the_bus_is_a_lack() -> None:
    found = judged("can3", read_link(ACTIVE.replace("ERROR-ACTIVE", "BUS-OFF")), up=True, mtu=16)
    assert found.verdict == "lack"
    assert "wiring" in found.mend


@pytest.mark.socketcan
def test_a_real_classic_interface_is_a_note() -> None:
    if os.geteuid() != 0:
        pytest.skip("making an interface needs root")
    made = subprocess.run(["ip", "link", "add", "vcan8", "type", "vcan"], check=False, capture_output=True)
    assert made.returncode == 0, made.stderr
    try:
        subprocess.run(["ip", "link", "set", "vcan8", "mtu", "16", "up"], check=True)
        (found,) = named("vcan8")
    finally:
        subprocess.run(["ip", "link", "del", "vcan8"], check=True)
    assert found["verdict"] == "info"
    assert found["found"] == "up, mtu 16, classic CAN only: FD layouts need mtu 72"


@pytest.mark.socketcan
def test_a_can_interface_has_a_state_and_a_board() -> None:
    assert named("vcan0") == [{"what": "vcan0", "verdict": "ok", "found": "up, mtu 72", "mend": ""}]
    n = 40_000  # more than a minute: the first probe on a machine compiles
    imu = ImuIncrements.empty(n)
    imu.step[:], imu.time[:], imu.sequence[:] = 0.01, 0.01 * np.arange(1, n + 1), np.arange(n)
    imu.dvel[:, 2] = -0.0981
    emulator = make_emulator("xsens-can", 10_000)
    batch = emulator.samples(imu)

    def feed(ended: threading.Event) -> None:
        port = open_port("socketcan:vcan0", listen=False)
        for start in range(0, len(batch), 40):
            port.send(batch[start : start + 40].copy())
            if ended.wait(0.05):
                break
        port.close()

    with beside(feed):
        found = named("vcan0", "--probe")
    assert [one["found"] for one in found] == ["up, mtu 72", "hil run --imu xsens-can --bus socketcan:vcan0"]
