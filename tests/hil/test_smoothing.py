"""`hil replay --smooth`: the smoothed navigation of a recording beside the truth, and recordings that cannot be smoothed."""

import json
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from drivers.can.aiding import is_aiding
from drivers.logs.recording import RecordingWriter
from hil import cli
from hil.offline_aided import AIDED_HEADER
from hil.scenario import Scenario
from hil.smoothing import smooth_recording
from hil.tables import read_table
from hil.world.head import SimulatedHead
from hil.world.motion import Motion
from nav.errors import HilError

SECONDS = 60
SCENARIO = Scenario.model_validate(
    {
        "name": "smoothed",
        "bus": "unix:none",
        "seed": 3,
        "head": {"rate_hz": 100, "instruments": "dtg", "grade": "tactical", "lever_arm_m": (3.0, -1.0, 0.5)},
        "motion": {
            "rest_s": 3,
            "ramp_s": 7,
            "attitude": "coordinated",
            "north": {"rate": 50.0, "sines": [{"amplitude": 120.0, "period_s": 45.0}]},
            "east": {"sines": [{"amplitude": 250.0, "period_s": 40.0}]},
        },
        "navigation": {"alignment": "truth", "aided": True},
        "aiding": {
            "gnss": [{"delay_s": 0.12, "outages": [{"start_s": 25, "end_s": 45}]}],
            "baro": [{"bias_sigma_m": 0.3}],
        },
    }
)


@pytest.fixture(scope="module")
def frames():
    return np.concatenate([part for _, *parts in SimulatedHead(SCENARIO).chunks(SECONDS * 100) for part in parts])


def write(path, frames, scenario=SCENARIO):
    with RecordingWriter(path, {"scenario": scenario.model_dump(mode="json"), "created_ns": time.time_ns()}) as writer:
        writer.write(frames)
    return path


def test_a_recording_is_smoothed_by_the_command(frames, tmp_path, monkeypatch, capsys):
    """Better than the navigation of the replay itself; where the vehicle is, not where the head is; an assertion reads it."""
    recording, out = write(tmp_path / "flight.dhil", frames), tmp_path / "smooth.csv"
    wanted = "smoothed.error.position_m.rms < 1.5"
    line = ["hil", "replay", recording, "--smooth", out, "--speed", "max", "--mavlink", "none", "--assert", wanted]
    monkeypatch.setattr(sys, "argv", [*map(str, line), "--json"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["smoothed"]["file"] == str(out)
    for name, share in (("position_m", 0.6), ("velocity_ms", 0.6), ("attitude_deg", 1.0)):
        assert summary["smoothed"]["error"][name]["rms"] < share * summary["error"][name]["rms"]
    rows = read_table(out, AIDED_HEADER)
    assert len(rows) == summary["smoothed"]["rows"] >= 50 * SECONDS
    assert (np.diff(rows[:, 0]) > 0.0).all()
    truth = Motion(SCENARIO.motion).truth(rows[:, 0])
    ratio = (rows[:, 3] - truth["height"]) / rows[:, 12]
    assert 0.3 < np.sqrt(np.mean(ratio**2)) < 2.0


def test_it_is_aided_even_if_the_scenario_is_not(frames, tmp_path):
    path = write(tmp_path / "flight.dhil", frames[:4000])
    bare = SCENARIO.with_changes(navigation={"aided": False})
    one, other = tmp_path / "one.csv", tmp_path / "other.csv"
    assert smooth_recording(path, SCENARIO, one)["rows"] == smooth_recording(path, bare, other)["rows"]
    assert one.read_bytes() == other.read_bytes()


def test_what_cannot_be_smoothed(frames, tmp_path):
    out = tmp_path / "out.csv"
    bare = write(tmp_path / "bare.dhil", frames[~is_aiding(frames["can_id"])][:3000])
    with pytest.raises(HilError, match=r"nothing in .* aids the navigator"):
        smooth_recording(bare, SCENARIO, out)
    moving = SCENARIO.with_changes(navigation={"alignment": "gyrocompass"}, head={"grade": "dtg"})
    with pytest.raises(HilError, match="alignment does not end"):
        smooth_recording(write(tmp_path / "flight.dhil", frames[:3000]), moving, out)
    with pytest.raises(HilError, match="No such file"):
        smooth_recording(Path("none.dhil"), SCENARIO, out)
    assert not out.exists()
