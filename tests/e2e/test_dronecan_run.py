"""An emulated DroneCAN node over a `unix:` bus, from ``hil`` to ``hil``: navigated, recorded, replayed to the same bit."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from commands import called

from drivers.can.samples import LEARN

HIL = (sys.executable, "-c", "from hil.cli import main; main()")
RATE_HZ, END_S, TURN_DEG_S = 200, 6, 5.0
LEARNT = LEARN + 1
"""Samples from which the driver learns the period: they are not navigated."""
SCENARIO = f"""
name = "dronecan"
driver = "dronecan-imu"
duration_s = {END_S}
[motion]
rest_s = 3
ramp_s = 1
heading = {{ offset = 40, rate = {TURN_DEG_S} }}
[head]
rate_hz = {RATE_HZ}
[navigation]
alignment = "level"
align_s = 2
start = {{ heading_deg = 40 }}
"""
EXACT_DEG = 2.0**-24 * END_S * TURN_DEG_S + math.degrees(1e-7)
"""What single precision makes of the turn, and a tenth of a microradian at the start."""
QUIET = ("--mavlink", "none", "--no-dashboard", "--json")


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    file = tmp_path / "dronecan.toml"
    file.write_text(SCENARIO)
    return file


def is_whole(summary: dict[str, Any], node: int) -> None:
    """All that the node sent was navigated, and rightly."""
    assert summary["head"] == {"node": node, "time_stamps": True}
    assert summary["samples"] == END_S * RATE_HZ - LEARNT
    faults = ("lost", "duplicated", "late", "crc_errors", "foreign", "short", "interpolated", "restarts")
    assert {name: summary[name] for name in faults} == dict.fromkeys(faults, 0)
    assert summary["frames"] == 7 * END_S * RATE_HZ, "a transfer is seven classic frames"
    assert summary["error"]["attitude_deg"]["max"] < EXACT_DEG


@pytest.mark.parametrize(("driver", "node"), [("dronecan-imu", 42), ("dronecan-imu@7", 7)])
@pytest.mark.parametrize("speed", ["1", "max"])
def test_a_run_brings_the_node_that_its_driver_follows(scenario: Path, driver: str, node: int, speed: str) -> None:
    scenario.write_text(SCENARIO.replace("dronecan-imu", driver))
    code, out, err = called("run", scenario, "--speed", speed, *QUIET)
    assert code == 0, err
    summary = json.loads(out)
    is_whole(summary, node)
    assert summary["feeder"] == {"sent": END_S * RATE_HZ, "dropped": 0}


def test_node_and_bridge_as_two_programs_with_a_recording(scenario: Path, tmp_path: Path) -> None:
    bus, recording = f"unix:dronecan-{os.getpid()}", tmp_path / "dronecan.dhil"
    command = [*HIL, "run", scenario, "--bus", bus, "--imu", "dronecan-imu@42", "--record", recording, *QUIET]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as bridge:
        try:
            assert bridge.stderr
            while "waiting for samples" not in bridge.stderr.readline():
                assert bridge.poll() is None
            sent = json.loads(called("imu", scenario, "--bus", bus, "--json")[1])
            while "silent" not in (line := bridge.stderr.readline()):
                assert line, "it has heard the end"
            bridge.terminate()
            summary = json.loads(bridge.communicate(timeout=60)[0])
        finally:
            bridge.kill()
    assert (sent["sent"], sent["dropped"]) == (END_S * RATE_HZ, 0)
    assert summary["samples"] == END_S * RATE_HZ - LEARNT
    assert summary["lost"] == summary["crc_errors"] == summary["short"] == 0
    replayed = json.loads(called("replay", recording, "--speed", "max", *QUIET)[1])
    assert replayed["navigation_digest"] == summary["navigation_digest"]
