"""Independent clients on a publisher that is fed a moving vehicle: MAVSDK, node-mavlink, MAVProxy, pymavlink and its tools.

Each is a program of its own with its own implementation of the protocol. HIL_CLIENT_S sets how long loss is counted.
"""

import hashlib
import json
import math
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
from pymavlink import mavutil
from test_mavproxy import angles, feed, start

from nav.state import Mode

CLIENTS = Path(__file__).parents[1] / "clients"
SECONDS = float(os.environ.get("HIL_CLIENT_S", "15"))
FAST = dict.fromkeys(
    (
        "ATTITUDE",
        "ATTITUDE_QUATERNION",
        "HIGHRES_IMU",
        "GLOBAL_POSITION_INT",
        "LOCAL_POSITION_NED",
        "VFR_HUD",
        "ODOMETRY",
    ),
    250.0,
)
"""More than 500 messages a second, on a machine that has little time for the test too."""
STEADY = {"ATTITUDE": 220.0, "HIGHRES_IMU": 220.0}
"""With the other built-in rates 530 messages a second."""
PASSPHRASE = "passphrase-of-the-test"
pytestmark = [pytest.mark.slow]


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Bridge:
    """A publisher, fed by a thread until it is ended."""

    def __init__(self, url: str, **config: Any) -> None:
        self.process, self.ring, self.stop, self.report = start(url, **config)
        self._done = Event()
        self._thread = Thread(target=self._feed, daemon=True)
        self._thread.start()

    def _feed(self) -> None:
        device_s = 100.0
        while not self._done.is_set():
            device_s = feed(self.ring, 0.2, device_s, Mode.NAVIGATE)

    def end(self) -> dict[str, Any]:
        self._done.set()
        self._thread.join()
        self.stop.call()
        assert self.report.poll(20.0)
        counters: dict[str, Any] = self.report.recv()
        self.process.join(20.0)
        return counters


@pytest.fixture
def key(tmp_path: Path) -> Path:
    """What MAVProxy, QGroundControl and Mission Planner make of a passphrase."""
    path = tmp_path / "key"
    path.write_text(hashlib.sha256(PASSPHRASE.encode()).hexdigest())
    path.chmod(0o600)
    return path


@pytest.fixture(scope="session")
def node(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command of the node client, its package installed in a folder of the tests'."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("node or npm is not here: apt-get install nodejs npm")
    folder = tmp_path_factory.mktemp("node")
    for name in ("package.json", "node_client.mjs"):
        shutil.copy(CLIENTS / name, folder)
    done = subprocess.run(
        ["npm", "install", "--no-audit", "--no-fund", "--silent"],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    if done.returncode:
        pytest.skip(f"npm cannot install node-mavlink here: {done.stderr.strip()[-200:]}")
    return ["node", str(folder / "node_client.mjs")]


def said(command: list[str], timeout_s: float, **environment: str) -> Any:
    env = {**os.environ, **environment}
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False, env=env)
    assert done.returncode == 0, done.stdout + done.stderr
    print(done.stdout)
    return json.loads(done.stdout.strip().splitlines()[-1])


def agrees(time_s: float, roll: float, pitch: float, yaw: float) -> None:
    heading, true_pitch, true_roll = angles(time_s)
    assert abs(math.remainder(yaw - heading, 2.0 * math.pi)) < 1e-3
    assert (pitch, roll) == pytest.approx((true_pitch, true_roll), abs=1e-3)


def test_mavsdk_sees_and_sets(tmp_path: Path) -> None:
    pytest.importorskip("mavsdk")
    port = free_port()
    bridge = Bridge(f"udpout:127.0.0.1:{port}")
    found = said([sys.executable, str(CLIENTS / "mavsdk_client.py"), str(port)], 180.0, HOME=str(tmp_path))
    counters = bridge.end()
    assert (found["system"], found["components"]) == (1, [1])
    roll, pitch, yaw, time_us = found["attitude_deg"]
    agrees(1e-6 * time_us, *(math.radians(angle) for angle in (roll, pitch, yaw)))
    assert found["position"][0] == pytest.approx(math.degrees(0.87), abs=1e-2)
    assert found["health"]["is_home_position_ok"]
    assert len(found["parameters"]) == 19
    assert found["set"] == 7.0
    assert found["attitude_hz"] == pytest.approx(20.0, rel=0.25)
    assert found["home"] != 0
    assert found["version"] != [0, 0, 0]
    assert found["metadata_parameter"] == ["parameters", "version"]
    assert found["metadata_events"] == ["components", "version"]
    assert counters["bad_data"] == counters["dropped"] == 0


@pytest.mark.parametrize("signed", [False, True], ids=["plain", "signed"])
def test_node_mavlink_loses_nothing(node: list[str], key: Path, signed: bool) -> None:
    port = free_port()
    config: dict[str, Any] = {"signing_key": str(key)} if signed else {}
    bridge = Bridge(f"udpout:127.0.0.1:{port}", rates_hz=FAST, keep_parameters=False, **config)
    found = said([*node, str(port), str(SECONDS), *([key.read_text()] if signed else [])], SECONDS + 90.0)
    counters = bridge.end()
    total = sum(found["heard"].values())
    print(f"{total / SECONDS:.0f} messages a second, {found['lost']} lost")
    assert found["lost"] == 0
    assert total > 50.0 * SECONDS
    time_ms, roll, pitch, yaw = found["attitude"]
    agrees(1e-3 * time_ms, roll, pitch, yaw)
    assert found["parameters"]["SR_HUD_HZ"] == 7.0
    assert len(found["parameters"]) == 19
    assert (found["acks"]["511"], found["acks"]["512"]) == (0, 0)
    assert found["wrong"] == 0
    assert (found["signed"] > 0.9 * total) == signed
    assert counters["refused"] == {}


def mavproxy(tmp_path: Path, port: int, script: list[tuple[float, str]]) -> str:
    """What MAVProxy prints when lines are typed once it has found the vehicle, each after a pause."""
    program = [
        sys.executable,
        "-u",
        str(Path(sys.executable).parent / "mavproxy.py"),
        f"--master=udpin:127.0.0.1:{port}",
    ]
    more = ["--default-modules=param,wp,link,signing", "--state-basedir", str(tmp_path), "--streamrate=-1"]
    printed, found = tmp_path / "printed.txt", ""
    with printed.open("w") as out, subprocess.Popen(
        [*program, *more, "--logfile", str(tmp_path / "mav.tlog")],
        stdin=subprocess.PIPE, stdout=out, stderr=subprocess.STDOUT, cwd=tmp_path, text=True,
    ) as proxy:  # fmt: skip
        assert proxy.stdin is not None
        deadline = time.monotonic() + 90.0
        while "online system 1" not in found and time.monotonic() < deadline:
            time.sleep(0.2)
            found = printed.read_text()
        for pause_s, line in script:
            time.sleep(pause_s)
            proxy.stdin.write(line + "\n")
            proxy.stdin.flush()
        proxy.stdin.close()
        proxy.wait(timeout=60.0)
    found = printed.read_text()
    print(found)
    return found


def tool(name: str, *arguments: str) -> str:
    program = Path(sys.executable).parent / name
    done = subprocess.run(
        [sys.executable, str(program), *arguments], capture_output=True, text=True, timeout=120, check=True
    )
    print(done.stdout)
    return done.stdout


def test_mavproxy_and_the_log_tools_find_no_loss(tmp_path: Path) -> None:
    pytest.importorskip("MAVProxy")
    port, log = free_port(), tmp_path / "bridge.tlog"
    bridge = Bridge(f"udpout:127.0.0.1:{port}?tlog={log}", rates_hz=STEADY, keep_parameters=False)
    output = mavproxy(tmp_path, port, [(SECONDS, "link"), (2.0, "exit")])
    counters = bridge.end()
    assert "link 1 OK" in output
    assert "0.0% loss" in output
    assert " 0 lost" in output
    assert "Received 19 parameters" in output
    printed = tool("mavloss.py", str(log))
    ours = next(line.split() for line in printed.splitlines() if line.split()[:2] == ["1", "1"])
    assert (ours[3], ours[4]) == ("0", "0.0%")
    assert int(ours[2]) == sum(counters["sent"].values())
    assert tool("mavlogdump.py", "--types", "ATTITUDE", str(log)).count("ATTITUDE {") == counters["sent"]["ATTITUDE"]


@pytest.mark.parametrize("right", [True, False], ids=["right key", "wrong key"])
def test_a_signed_connection_with_mavproxy(tmp_path: Path, key: Path, right: bool) -> None:
    pytest.importorskip("MAVProxy")
    port = free_port()
    bridge = Bridge(f"udpout:127.0.0.1:{port}", signing_key=str(key), keep_parameters=False)
    lines = [
        (2.0, f"signing key {PASSPHRASE if right else 'another'}"),
        (2.0, "param fetch"),
        (6.0, "link"),
        (1.0, "exit"),
    ]
    output = mavproxy(tmp_path, port, lines)
    counters = bridge.end()
    assert "Setup signing key" in output
    assert counters["refused"]["unsigned"] > 0  # before it had the key
    if right:
        assert counters["received"]["PARAM_REQUEST_LIST"] > 0
        assert "Received 19 parameters" in output
        assert " 0 lost, 0.0% loss" in output
    else:
        assert counters["received"] == {}
        assert counters["refused"]["wrong signature"] > 0
        assert "Received 19 parameters" not in output


@pytest.fixture
def server() -> Iterator[tuple[Bridge, int]]:
    port = free_port()
    bridge = Bridge(f"tcpin:127.0.0.1:{port}", keep_parameters=False)
    yield bridge, port
    bridge.process.kill()


def test_ten_reconnects(server: tuple[Bridge, int]) -> None:
    bridge, port = server
    deadline = time.monotonic() + 60.0
    while socket.socket().connect_ex(("127.0.0.1", port)) and time.monotonic() < deadline:
        time.sleep(0.1)
    for _ in range(10):
        link = mavutil.mavlink_connection(f"tcp:127.0.0.1:{port}", source_system=250, dialect="ardupilotmega")
        assert link.wait_heartbeat(timeout=30) is not None
        link.mav.param_request_list_send(1, 1)
        names = set()
        deadline = time.monotonic() + 20.0
        while len(names) < 19 and time.monotonic() < deadline:
            message = link.recv_match(type="PARAM_VALUE", blocking=True, timeout=1)
            names |= {message.param_id} if message is not None else set()
        assert len(names) == 19
        assert link.mav_loss == 0
        link.close()
    counters = bridge.end()
    assert counters["received"]["PARAM_REQUEST_LIST"] == 10
    assert counters["links"][f"tcpin:127.0.0.1:{port}"]["turned_away"] == 0
    assert np.isfinite(counters["latency_us"]["p50"])
