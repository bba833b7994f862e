"""`hil export`: the samples of every kind of recording, as CSV and as Parquet that pyarrow reads."""

import json
import re
import sys
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from commands import hil

sys.path.append(str(Path(__file__).parents[1] / "drivers" / "serial"))
from pty_board import BOARDS, moving

from drivers import driver_names, make_driver, make_emulator
from drivers.can.convert import to_message
from drivers.can.frames import FrameArray
from drivers.logs.recording import RecordingWriter
from drivers.serial.chunks import to_chunks
from hil.offline import IMU_HEADER
from hil.scenario import Scenario
from hil.tables import read_table
from hil.world.head import SimulatedHead

parquet = pytest.importorskip("pyarrow.parquet", reason="Parquet needs the extra 'parquet'")
DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "cli.md"
HEAD = Scenario.model_validate({"bus": "unix:none", "head": {"rate_hz": 200, "instruments": "dtg", "grade": "mems"}})


def of_head() -> FrameArray:
    return np.concatenate([part for _, *parts in SimulatedHead(HEAD).chunks(400) for part in parts])


def of_sbg() -> FrameArray:
    emulator = make_emulator("sbg", 10_000)
    return np.concatenate([emulator.slow(), emulator.samples(moving(200))])


def of_serial() -> FrameArray:
    emulator = BOARDS["vectornav"][1]()
    return to_chunks(b"".join(emulator.packets(moving(200))))


def own(path: Path, batch: FrameArray, driver: str) -> Path:
    writer = RecordingWriter(path, {"scenario": HEAD.with_changes(driver=driver).model_dump(mode="json")})
    writer.write(batch)
    writer.close()
    return path


def foreign(path: Path, batch: FrameArray) -> Path:
    batch["time_ns"] += 1_700_000_000_000_000_000
    with can.Logger(path) as log:
        for row in batch:
            log.on_message_received(to_message(row, "can0"))
    return path


def exported(path: Path, tmp_path: Path, *more: object) -> dict[str, Any]:
    """The columns that Parquet holds, after they were found in the CSV too."""
    said = json.loads(hil("export", path, tmp_path / "out.parquet", *more, "--json")[0])
    hil("export", path, tmp_path / "out.csv", *more)
    table = parquet.read_table(tmp_path / "out.parquet")
    assert table.column_names == said["columns"]
    assert table.num_rows == said["samples"] > 0
    assert {str(kind) for kind in table.schema.types} == {"double"}
    columns = {name: table[name].to_numpy() for name in table.column_names}
    header = (tmp_path / "out.csv").read_text().split("\n", 1)[0].split(",")
    assert header == table.column_names
    text = np.genfromtxt(tmp_path / "out.csv", delimiter=",", skip_header=1)
    np.testing.assert_array_equal(text, np.stack(list(columns.values()), axis=1), "to the last digit")
    return columns


@pytest.mark.parametrize("ending", ["dhil", "log", "blf"])
def test_a_head(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"head.{ending}"
    batch = of_head()
    samples = make_driver("dtg-head").decode(batch.copy())
    if ending == "dhil":
        columns = exported(own(path, batch, "dtg-head"), tmp_path)
    else:
        columns = exported(foreign(path, batch), tmp_path, "--imu", "dtg-head")
    np.testing.assert_array_equal(columns["dtheta_g2z"], samples.dtheta[:, 3])
    np.testing.assert_array_equal(columns["rotor_g1x"], samples.rotor[:, 0])
    np.testing.assert_array_equal(columns["time_s"], samples.time)


@pytest.mark.parametrize("ending", ["dhil", "log", "blf", "asc"])
def test_a_board_on_can(tmp_path: Path, ending: str) -> None:
    path, batch = tmp_path / f"board.{ending}", of_sbg()
    columns = exported(own(path, batch, "sbg") if ending == "dhil" else foreign(path, batch), tmp_path, "--imu", "sbg")
    imu = moving(200)
    there = np.searchsorted(
        imu.time, columns["time_s"] - columns["time_s"][0] + imu.time[-len(columns["time_s"])] - 1e-6
    )
    # A board rounds rates to 1 mrad/s and forces to 1 cm/s^2, and the driver joins two ends: not exact, but that motion
    for i, axis in enumerate("xyz"):
        assert np.corrcoef(columns[f"dvel_{axis}"], imu.dvel[there, i])[0, 1] > 0.9


@pytest.mark.skipif("vectornav" not in driver_names(), reason="installed before these boards were added")
def test_a_board_on_a_serial_port(tmp_path: Path) -> None:
    columns = exported(own(tmp_path / "port.dhil", of_serial(), "vectornav"), tmp_path)
    imu = moving(200)
    assert len(columns["time_s"]) == 200
    for i, axis in enumerate("xyz"):
        np.testing.assert_allclose(columns[f"dtheta_{axis}"], imu.dtheta[:, i], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["px4_board.ulg", "ardupilot_copter.bin"])
def test_a_flight_log(hil_data: Path, tmp_path: Path, name: str) -> None:
    """A table of the increments, which `hil navigate` and `hil allan` take."""
    if name.endswith(".ulg"):
        pytest.importorskip("pyulog", reason="reading ULog needs the extra 'logs'")
    columns = exported(hil_data / name, tmp_path)
    assert (np.diff(columns["time_s"]) > 0.0).all()
    force = np.stack([columns[f"dvel_{axis}"] for axis in "xyz"], axis=1) / columns["step_s"][:, None]
    assert np.median(np.linalg.norm(force, axis=1)) == pytest.approx(9.81, rel=0.05)
    assert read_table(tmp_path / "out.parquet", IMU_HEADER).shape == (len(columns["time_s"]), 7)


def test_every_column_and_its_unit_is_documented(tmp_path: Path) -> None:
    section = DOCUMENT.read_text().split("## `hil export")[1].split("\n## ")[0]
    said = set(re.findall(r"`([a-z0-9_]+)`", section))
    for path in (own(tmp_path / "a.dhil", of_head(), "dtg-head"), own(tmp_path / "b.dhil", of_sbg(), "sbg")):
        hil("export", path, tmp_path / "x.csv")
        assert set((tmp_path / "x.csv").read_text().split("\n", 1)[0].split(",")) <= said
