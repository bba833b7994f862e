"""A magnetometer with iron beside it, through the whole chain: turned about, calibrated by `hil calibrate`, navigated with."""

import json

import numpy as np
import pytest

from drivers.can.aiding import is_aiding
from drivers.logs.recording import RecordingWriter
from hil.bridge import Loop, LoopOrder, Outlets
from hil.calibrate import calibrate
from hil.calibration import read, validated
from hil.cli import main
from hil.magnetic import magnetic_field
from hil.scenario import Scenario
from hil.world.head import SimulatedHead
from nav.errors import HilError
from nav.rotation import dcm_from_euler

HARD_IRON_UT = (9.0, -14.0, 6.0)
PLACE = np.radians([50.0, 36.25])
FIELD_UT = 1e6 * magnetic_field("dipole", *PLACE, 150.0, 2025.0)
TUMBLE = {
    "heading": {"rate": 25.0},
    "pitch": {"sines": [{"amplitude": 80.0, "period_s": 37.0}]},
    "roll": {"rate": 31.0},
}


def scenario(motion, duration, calibration=None, start=None):
    return Scenario.model_validate(
        {
            "bus": "unix:none",
            "duration_s": duration,
            "motion": motion,
            "head": {"rate_hz": 100, "calibration": calibration},
            "navigation": {"alignment": "level" if start else "truth", "aided": True, "start": start or {}},
            "aiding": {"magnetometer": [{"hard_iron_ut": HARD_IRON_UT}], "gnss": [{}]},
        }
    )


def frames_of(chosen):
    return [part for _, *parts in SimulatedHead(chosen).chunks(round(chosen.duration_s * 100)) for part in parts]


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A recording of the sensor tumbled about, and the calibration file that the command makes of it."""
    folder = tmp_path_factory.mktemp("swing")
    chosen = scenario(TUMBLE, 60.0)
    with RecordingWriter(
        folder / "swing.dhil", {"scenario": chosen.model_dump(mode="json"), "created_ns": 1}
    ) as writer:
        for part in frames_of(chosen):
            part["time_ns"] = 1
            writer.write(part)
    size = float(np.linalg.norm(FIELD_UT))
    (folder / "swing.toml").write_text(
        f'latitude_deg = 50.0\n[magnetometer]\nrecording = "swing.dhil"\nfield_ut = {size!r}\n'
    )
    return folder


def test_the_iron_is_found_and_its_heading_error_goes(calibrated, monkeypatch, capsys):
    arguments = [str(calibrated / "swing.dhil"), "--sequence", str(calibrated / "swing.toml")]
    monkeypatch.setattr("sys.argv", ["hil", "calibrate", *arguments, "--out", str(calibrated / "mag.toml"), "--json"])
    with pytest.raises(SystemExit, match="0"):
        main()
    listed = {(row["key"], row["axis"]): row for row in json.loads(capsys.readouterr().out)["rows"]}
    file = read(calibrated / "mag.toml")
    for axis, value, sigma, true in zip(
        "xyz", file.magnetometer.hard_iron_ut, file.magnetometer.hard_iron_sigma_ut, HARD_IRON_UT, strict=True
    ):
        assert abs(value - true) < 4.0 * sigma < 0.5
        assert listed["hard_iron_ut", f"m{axis}"]["sigma"] == pytest.approx(sigma)
    assert file.serial == 0

    def heading_error(calibration):
        chosen = scenario({"heading": {"offset": 70.0}}, 60.0, calibration, {"heading_deg": 70.4})
        loop = Loop(LoopOrder(chosen, paced=False), Outlets.make(recording=False, readers=1))
        for part in frames_of(chosen):
            loop.take(part)
        return loop.result()["error"]["attitude_deg"]["final"]

    # Started 0.4 deg off. With iron the magnetometer is not believed, without it the heading is drawn to it.
    before, after = heading_error(None), heading_error(str(calibrated / "mag.toml"))
    assert before > 0.35
    assert after < 0.1


def csv(path, columns, names):
    rows = "\n".join(",".join(repr(float(one)) for one in row) for row in columns)
    path.write_text(f"time_s,flux_x_ut,flux_y_ut,flux_z_ut,{names}\n{rows}\n")


@pytest.mark.parametrize("known", ["vertical", "attitude"])
def test_what_is_known_beside_the_readings_finds_the_turn(tmp_path, known):
    rng = np.random.default_rng(3)
    angles = rng.uniform([-180, -80, -180], [180, 80, 180], (300, 3))
    c_bn = np.array([dcm_from_euler(*np.radians(one)).T for one in angles])
    turned = dcm_from_euler(0.03, -0.02, 0.05)
    flux = c_bn @ FIELD_UT @ turned.T + HARD_IRON_UT + 0.1 * rng.standard_normal((300, 3))
    beside = angles if known == "attitude" else c_bn @ [0.0, 0.0, -9.81]
    names = "heading_deg,pitch_deg,roll_deg" if known == "attitude" else "force_x,force_y,force_z"
    csv(tmp_path / "swing.csv", np.column_stack([np.arange(300), flux, beside]), names)
    field = ", ".join(map(repr, FIELD_UT.tolist()))
    (tmp_path / "s.toml").write_text(
        f'latitude_deg = 50.0\n[magnetometer]\nrecording = "swing.csv"\nknown = "{known}"\nfield_ned_ut = [{field}]\n'
    )
    base = validated({"serial": 7, "date": "2026-01-02", "gyro": {"bias_deg_h": [1, 2, 3, 4]}, "accelerometer": {}}, "")
    file = calibrate([tmp_path / "swing.csv"], tmp_path / "s.toml", None, None, lambda _: None, base)
    np.testing.assert_allclose(np.array(file.magnetometer.matrix) @ turned, np.eye(3), atol=2e-3)
    assert file.serial == 7
    assert file.gyro.bias_deg_h == (1.0, 2.0, 3.0, 4.0)


def test_refusals(calibrated, tmp_path):
    swing = calibrated / "swing.dhil"

    def refused(table, recording=swing):
        (tmp_path / "s.toml").write_text(
            f'latitude_deg = 50.0\n[magnetometer]\nrecording = "{recording.name}"\n{table}\n'
        )
        with pytest.raises(HilError) as refusal:
            calibrate([recording], tmp_path / "s.toml", None, None, lambda _: None)
        return str(refusal.value)

    assert "either field_ut or field_ned_ut" in refused("")
    assert "needs field_ned_ut" in refused('field_ut = 50.0\nknown = "attitude"')
    assert "needs a CSV" in refused('field_ut = 50.0\nknown = "vertical"')
    assert "0 readings" in refused("field_ut = 50.0\nsource = 3")
    still = scenario({"heading": {"rate": 12.0}}, 30.0)
    with RecordingWriter(tmp_path / "level.dhil", {"created_ns": 1}) as writer:
        for part in frames_of(still):
            part["time_ns"] = 1
            writer.write(part[is_aiding(part["can_id"])])
    assert "lie in a plane" in refused("field_ut = 50.0", tmp_path / "level.dhil")
