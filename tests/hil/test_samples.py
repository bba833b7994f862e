"""`hil export` and `hil allan`: what is in a recording, as a table and as noise."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import hil

from drivers import make_driver
from drivers.can.frames import FrameArray
from drivers.logs.recording import RecordingWriter
from hil.offline import IMU_HEADER
from hil.samples import deviations, read_samples
from hil.scenario import Scenario
from hil.tables import read_table, write_table
from hil.world.head import SimulatedHead
from nav.instruments.grades import GRADES

SCENARIO = Scenario.model_validate(
    {"bus": "unix:none", "head": {"rate_hz": 100, "instruments": "dtg", "grade": "mems"}}
)


@cache
def sent() -> FrameArray:
    return np.concatenate([part for _, *parts in SimulatedHead(SCENARIO).chunks(18_000) for part in parts])


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """180 s of a MEMS head at rest, with ten samples missing after 30 s."""
    good = np.ones(len(sent()), bool)
    samples = np.flatnonzero(sent()["length"] == 64)
    good[samples[3000:3010]] = False
    path = tmp_path / "rest.dhil"
    writer = RecordingWriter(path, {"scenario": SCENARIO.model_dump(mode="json")})
    writer.write(sent()[good].copy())
    writer.close()
    return path


def test_the_table_is_what_the_driver_says(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "rest.npz"
    said = json.loads(hil("export", recording, out, "--json")[0])
    samples = make_driver("dtg-head").decode(sent().copy())
    with np.load(out) as table:
        assert list(table) == said["columns"]
        assert said["samples"] == len(table["time_s"]) == 17_990
        kept = np.isin(samples.sequence, table["sequence"])
        for i, axis in enumerate(("g1x", "g1y", "g2y", "g2z")):
            np.testing.assert_array_equal(table[f"dtheta_{axis}"], samples.dtheta[kept, i])
        np.testing.assert_array_equal(table["dvel_z"], samples.dvel[kept, 2])


def test_the_noise_is_that_of_the_grade(recording: Path) -> None:
    """Of the accelerometers at once; of the gyros where the rotors' lag no longer smooths it."""
    said: dict[str, Any] = json.loads(hil("allan", recording, "--json")[0])
    assert (said["samples"], said["left_out"]) == (14_990, 3000)
    rows, grade = {row["axis"]: row for row in said["rows"]}, GRADES["mems"]
    for axis in "xyz":
        white = rows[f"dvel_{axis}"]["white_ug_sqrt_hz"]
        assert white == pytest.approx(grade.accelerometer_white / 9.80665e-6, rel=0.05)
    fits, _, _ = deviations(read_samples(recording), 2.0)
    tau = np.array([2.0, 4.0])
    expected = np.sqrt(grade.gyro_white**2 / tau + grade.gyro_flicker**2 * 2.0 * np.log(2.0) / np.pi)
    curves = [fits[f"dtheta_{axis}"].curve(tau) for axis in ("g1x", "g1y", "g2y", "g2z")]
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(curves), axis=0)), expected, rtol=0.15)


def test_a_table_for_navigate_is_taken_too(recording: Path, tmp_path: Path) -> None:
    samples = read_samples(recording)
    columns = samples.columns
    axes = ("g1x", "g1y", "g2z")
    table = np.stack(
        [columns["time_s"], *(columns[f"dtheta_{a}"] for a in axes), *(columns[f"dvel_{a}"] for a in "xyz")], 1
    )
    write_table(tmp_path / "imu.csv", IMU_HEADER, table[4000:])
    np.testing.assert_array_equal(read_table(tmp_path / "imu.csv", IMU_HEADER), table[4000:])
    fits, count, period = deviations(read_samples(tmp_path / "imu.csv"))
    assert (count, period) == (len(table) - 4000, pytest.approx(0.01))
    assert fits["dvel_x"].white == pytest.approx(GRADES["mems"].accelerometer_white, rel=0.05)


def test_a_person_gets_tables_and_a_plot(recording: Path, tmp_path: Path) -> None:
    out, _ = hil("allan", recording, "--plot", tmp_path / "a.svg")
    assert "deg_sqrt_h" in out
    assert "3000 samples beyond gaps" in out
    assert (tmp_path / "a.svg").read_text().startswith("<?xml")


def test_what_cannot_be_read_is_named(tmp_path: Path, recording: Path) -> None:
    (tmp_path / "x.log").write_text("(1.0) can0 123#00\n")
    assert "give the driver with --imu" in hil("allan", tmp_path / "x.log", code=2)[1]
    assert "no samples of sbg" in hil("export", recording, tmp_path / "x.csv", "--imu", "sbg", code=2)[1]
    assert "tell nothing from 30 s on" in hil("allan", recording, "--from", 30, code=2)[1]
    assert "No such file" in hil("export", tmp_path / "none.dhil", tmp_path / "x.csv", "--imu", "sbg", code=2)[1]
