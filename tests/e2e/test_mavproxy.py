"""A real ground station, MAVProxy without a display, on a publisher that is fed a moving vehicle."""

import math
import socket
import subprocess
import sys
import time
from collections import Counter
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.bridge import EVENTS
from hil.control import Control
from hil.publisher import Taps, run_publisher
from hil.ring import Ring, Wake
from hil.scenario import MavlinkConfig
from nav.rotation import quaternion_from_euler
from nav.state import NAV_STATE, Mode

pytest.importorskip("MAVProxy")
mavutil = pytest.importorskip("pymavlink.mavutil")

RATE_HZ = 500.0


def angles(time_s: float) -> tuple[float, float, float]:
    """Heading, pitch, roll of the vehicle, rad."""
    return (0.2 * time_s) % (2 * math.pi), 0.1 * math.sin(0.5 * time_s), 0.3 * math.sin(0.7 * time_s)


def feed(ring: Ring, duration_s: float, device_s: float, mode: Mode) -> float:
    """Push solutions in real time; returns the device time afterwards."""
    row = np.zeros(1, NAV_STATE)
    start_s = time.monotonic()
    for k in range(round(duration_s * RATE_HZ)):
        device_s += 1.0 / RATE_HZ
        row["time"], row["sequence"], row["mode"] = device_s, k, mode
        row["lat"], row["lon"], row["height"] = 0.87 + 1e-8 * k, 0.63, 150.0
        row["vel_n"], row["f_b"] = (31.8, 0.0, 0.0), (0.0, 0.0, -9.81)
        if mode != Mode.ALIGN:
            row["q_nb"] = quaternion_from_euler(*angles(device_s))
        row["arrival_ns"] = row["solution_ns"] = time.time_ns()
        ring.push(row)
        time.sleep(max(0.0, start_s + (k + 1) / RATE_HZ - time.monotonic()))
    return device_s


def start(url: str, **config: Any) -> tuple[Any, Ring, Wake, Any]:
    spawn = get_context("spawn")
    ring, stop = Ring(NAV_STATE, 1024, 1), Wake()
    report, report_end = spawn.Pipe()
    arguments = (MavlinkConfig(links=(url,), **config), Taps(ring, 0, Ring(EVENTS, 16, 0), Control()), stop, report_end)
    process = spawn.Process(target=run_publisher, args=arguments)
    process.start()
    report_end.close()
    return process, ring, stop, report


@pytest.mark.slow
def test_mavproxy_is_content(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process, ring, stop, report = start(f"udpout:127.0.0.1:{port}")
    program = [sys.executable, str(Path(sys.executable).parent / "mavproxy.py"), f"--master=udpin:127.0.0.1:{port}"]
    modules = "--default-modules=param,wp,link,fence,rally,ftp,arm,misc,cmdlong,calibration"
    with subprocess.Popen(
        [*program, modules, "--state-basedir", str(tmp_path), "--logfile", str(tmp_path / "mav.tlog")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        cwd=tmp_path,
        text=True,
    ) as proxy:
        assert proxy.stdin is not None
        device_s = feed(ring, 4.0, 100.0, Mode.ALIGN)
        device_s = feed(ring, 12.0, device_s, Mode.NAVIGATE)
        proxy.stdin.write("link\nparam show *\nparam set SR_HUD_HZ 7\nlong 31000 1\n")
        proxy.stdin.flush()
        feed(ring, 3.0, device_s, Mode.NAVIGATE)
        proxy.stdin.write("param show SR_HUD_HZ\nlink\n")
        proxy.stdin.flush()
        feed(ring, 2.0, device_s + 3.0, Mode.NAVIGATE)
        output, _ = proxy.communicate(timeout=20.0)
    stop.call()
    assert report.poll(10.0)
    counters = report.recv()
    process.join(10.0)
    print(output)
    print(counters)

    assert "link 1 OK" in output
    assert "0.0% loss" in output
    assert "Detected vehicle 1:1" in output
    assert "Received 19 parameters" in output
    assert "SYSID_THISMAV" in output
    assert "online system 1" in output
    for warning in (
        "fence breach",
        "no link",
        "link 1 down",
        "pre-arm",
        "time has wrapped",
        "failed",
        "error",
        "traceback",
    ):
        assert warning not in output.lower(), warning
    assert counters["received"]["PARAM_REQUEST_LIST"] == 1
    assert counters["received"].get("PARAM_REQUEST_READ", 0) == 0
    assert counters["bad_data"] == 0

    log = mavutil.mavlink_connection(str(tmp_path / "mav.tlog"), dialect="ardupilotmega")
    counts: Counter[str] = Counter()
    while (message := log.recv_match()) is not None:
        if message.get_srcSystem() != 1:
            continue
        counts[message.get_type()] += 1
        if message.get_type() == "ATTITUDE":
            heading, pitch, roll = angles(message.time_boot_ms * 1e-3)
            turn = math.remainder(message.yaw - heading, 2.0 * math.pi)
            assert abs(turn) < 2e-4  # half a millisecond of the time stamp at 0.2 rad/s
            assert (message.pitch, message.roll) == pytest.approx((pitch, roll), abs=2e-4)
    assert counts["BAD_DATA"] == 0
    assert counts["ATTITUDE"] > 40  # MAVProxy asks every stream for 4 Hz
    assert counts["GLOBAL_POSITION_INT"] > 40
