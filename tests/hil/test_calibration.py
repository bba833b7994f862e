"""`hil calibrate`: a simulated tumble and turntable find the drawn errors again, and the file makes the head navigate better."""

import json
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest

from drivers.logs.recording import RecordingWriter
from hil.bridge import EVENTS, Loop, LoopOrder, Outlets
from hil.calibrate import calibrate
from hil.calibration import UNITS, CalibrationFile, read, validated, write
from hil.calibration_sequence import SEQUENCE, built_in_sequence, simulate
from hil.cli import main
from hil.scenario import load, parse
from hil.world.head import SimulatedHead
from hil.world.instruments import drawn_errors, head_model
from nav.errors import HilError
from nav.instruments.calibration_terms import REQUIRED
from nav.rotation import dcm_from_euler

HEAD = {"instruments": "dtg", "grade": "dtg", "errors_factor": 10, "errors_seed": 5, "serial": 7, "rate_hz": 100}


def quiet(_: str) -> None:
    """Say nothing."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Recordings of a head whose errors are ten times those of the grade, their sequence, and the calibration."""
    folder = tmp_path_factory.mktemp("calibration")
    scenario = load("rest").with_changes(head=HEAD)
    recordings = simulate(scenario, folder, quiet, position_s=15.0, turn_s=12.5)
    file = calibrate(recordings, folder / SEQUENCE, None, None, quiet)
    write(folder / "head7.toml", file)
    return scenario, recordings, folder, file


def test_the_drawn_errors_are_found_within_their_sigmas(recorded):
    scenario, _, _, file = recorded
    drawn = drawn_errors(scenario.head, np.random.default_rng(np.random.SeedSequence(5).spawn(1)[0]))
    found = file.calibration()
    z = []
    for kind, got, want in zip(REQUIRED, (found.gyros, found.accelerometers), drawn, strict=True):
        for name, (unit, size) in UNITS[kind].items():
            if name in REQUIRED[kind]:
                sigma = size * np.array(getattr(getattr(file.sigma, kind), f"{name}_{unit}"))
                z += ((np.array(getattr(got, name)) - np.array(getattr(want, name))) / sigma).tolist()
    assert len(z) == 4 * 10 + 3 * 9
    assert np.abs(z).max() < 4.0
    assert 0.5 < np.mean(np.square(z)) < 1.8
    assert file.serial == 7
    assert file.residual.redundancy[0] > 90
    assert {name.split()[1].split("_")[1] for name in file.undetermined} == {"temperature[0]", "temperature[1]"}


def fly(scenario):
    """Navigate with the simulated head of `scenario` in this process: summary and events."""
    outlets = Outlets.make(recording=False, readers=1)
    loop, head = Loop(LoopOrder(scenario, paced=False), outlets), SimulatedHead(scenario)
    for _, slow, batch in head.chunks(round(scenario.duration_s / head.step)):
        if len(slow):
            loop.take(slow)
        loop.take(batch)
    rows = np.zeros(256, EVENTS)
    count, _ = outlets.events.pull(rows, 0)
    return loop.result(), [(row["severity"].decode(), row["text"].decode()) for row in rows[:count]]


@pytest.mark.slow
def test_the_calibrated_head_navigates_ten_times_better(recorded):
    _, _, folder, _ = recorded
    plain = load("flight").with_changes(
        duration_s=300, seed=99, head={**HEAD, "rate_hz": 200}, navigation={"alignment": "truth"}
    )
    calibrated = plain.with_changes(head={"calibration": str(folder / "head7.toml")})
    without, _ = fly(plain)
    with_it, events = fly(calibrated)
    assert with_it["error"]["position_m"]["final"] < 0.1 * without["error"]["position_m"]["final"]
    assert with_it["error"]["attitude_deg"]["final"] < 0.1 * without["error"]["attitude_deg"]["final"]
    assert not [text for severity, text in events if severity != "info" and "calibration" in text]


def small(**changes):
    table = {
        "serial": 7,
        "date": "2026-11-22",
        "gyro": {"scale_ppm": [1, 2, 3, 4]},
        "accelerometer": {"bias_ug": [1, 2, 3]},
    }
    return {**table, **changes}


def test_the_file_is_written_and_read_alike(recorded, tmp_path):
    _, _, folder, file = recorded
    assert read(folder / "head7.toml") == file
    full = validated(
        small(
            reference_c=[20, 20, 20],
            range_c=[[0, 50]] * 3,
            rotor=[{"spin_hz": 228, "damping_ratio": 9.1}, {"spin_hz": 227.9}],
            gyro={"bias_temperature_deg_h_k": [[1, 2, 3, 4], [0.1, 0.2, 0.3, 0.4]]},
        ),
        "t",
    )
    write(tmp_path / "full.toml", full)
    assert read(tmp_path / "full.toml") == full
    core = full.calibration()
    assert core.rotors[0].damping / core.rotors[0].equatorial_inertia == pytest.approx(9.1)
    assert np.degrees(core.gyros.bias_temperature[1][3]) * 3600 == pytest.approx(0.4)
    assert core.accelerometers.bias == pytest.approx((9.80665e-6, 2 * 9.80665e-6, 3 * 9.80665e-6))


@pytest.mark.parametrize(
    ("changes", "say"),
    [
        (
            {"gyro": {"scale_ppm": [1, 2, 3]}},
            ["gyro.scale_ppm = [1, 2, 3]", "4 numbers, for g1x, g1y, g2y, g2z; got 3"],
        ),
        ({"accelerometer": {"bias_ug": [1, 2, "x"]}}, ["accelerometer.bias_ug.2 = 'x'", "valid number"]),
        ({"accelerometer": {"bias_mg": [1, 2, 3]}}, ["accelerometer.bias_mg", "unknown key"]),
        ({"serial": -1}, ["serial = -1"]),
        ({"date": "today"}, ["date = 'today'"]),
        ({"gyro": {"bias_temperature_deg_h_k": [[1, 1, 1, 1]]}}, ["need reference_c and range_c"]),
        ({"reference_c": [20, 20, 20]}, ["belong together"]),
        ({"reference_c": [20, 20, 60], "range_c": [[0, 50]] * 3}, ["[0, 50] does not hold reference_c = 60"]),
        ({"rotor": [{"spin_hz": 228}]}, ["rotor"]),
    ],
)
def test_a_wrong_file_is_refused_by_key_value_and_expectation(changes, say):
    with pytest.raises(HilError) as refusal:
        validated(small(**changes), "my.toml")
    assert all(part in str(refusal.value) for part in ["calibration my.toml", *say]), str(refusal.value)


def test_the_scenario_names_the_file_beside_it_or_from_here(tmp_path, monkeypatch):
    write(tmp_path / "head.toml", validated(small(), "t"))
    (tmp_path / "my.toml").write_text('[head]\ncalibration = "head.toml"\n')
    scenario = load(tmp_path / "my.toml")
    monkeypatch.chdir(tmp_path)
    assert scenario == parse('[head]\ncalibration = "head.toml"', "here")
    assert scenario.head.calibration["gyro"]["scale_ppm"] == [1.0, 2.0, 3.0, 4.0]
    bare = scenario.with_changes(head={"calibration": None})
    assert bare.world_id() == scenario.world_id()
    # As it stands in the header of a recording, without the file.
    monkeypatch.chdir("/")
    assert parse("", "x").with_changes(**json.loads(json.dumps(scenario.model_dump(mode="json")))) == scenario
    assert head_model(scenario.head).calibration.gyros.scale == pytest.approx((1e-6, 2e-6, 3e-6, 4e-6))
    with pytest.raises(HilError, match=r"calibration none\.toml: No such file.*hil calibrate"):
        parse('[head]\ncalibration = "none.toml"', "x")
    with pytest.raises(HilError, match=r"skew_deg = 0, and head\.skew_deg = 45"):
        head_model(scenario.with_changes(head={"skew_deg": 45}).head)


def test_the_calibration_of_another_head_is_said_once():
    scenario = load("rest").with_changes(
        duration_s=1.5, head={"rate_hz": 200, "calibration": small(serial=8), "serial": 7}
    )
    _, events = fly(scenario)
    assert events.count(("warning", "the calibration is of head 8, and head 7 is connected")) == 1
    _, events = fly(scenario.with_changes(head={"serial": 8}))
    assert not [text for _, text in events if "calibration" in text]


def test_the_built_in_sequence_looks_down_along_faces_and_edges():
    positions, turns = built_in_sequence()
    down = np.array([dcm_from_euler(*np.radians(list(one.values())))[2] for one in positions])
    assert len(down) == 24
    assert len(np.unique(np.round(down, 6), axis=0)) == 18
    np.testing.assert_allclose(down.T @ down, 8.0 * np.eye(3), atol=1e-6)
    spun = [
        dcm_from_euler(*np.radians(list(one.values())[:3]))[2] * math.copysign(1, one["rate_deg_s"]) for one in turns
    ]
    assert len(np.unique(np.round(spun, 6), axis=0)) == 6


def hil(monkeypatch, capsys, *arguments):
    monkeypatch.setattr("sys.argv", ["hil", "calibrate", *map(str, arguments)])
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0), *capsys.readouterr()
    return 0, *capsys.readouterr()


def test_the_command_prints_every_value_with_its_sigma(recorded, tmp_path, monkeypatch, capsys):
    _, recordings, folder, file = recorded
    arguments = [*recordings, "--sequence", folder / SEQUENCE, "--out", tmp_path / "c.toml", "--date", "2026-02-03"]
    code, out, _ = hil(monkeypatch, capsys, *arguments, "--json")
    said = json.loads(out)
    assert code == 0
    assert said["serial"] == 7
    assert said["date"] == "2026-02-03"
    assert len(said["rows"]) == 4 * 13 + 3 * 12
    by_name = {(row["axis"], row["key"]): row for row in said["rows"]}
    assert by_name["g2z", "scale_ppm"]["value"] == pytest.approx(file.gyro.scale_ppm[3])
    assert by_name["ax", "scale_temperature_ppm_k[0]"]["sigma"] is None
    assert tomllib.loads((tmp_path / "c.toml").read_text())["accelerometer"]["bias_ug"] == pytest.approx(
        file.accelerometer.bias_ug, rel=1e-6
    )
    code, out, _ = hil(monkeypatch, capsys, *arguments)
    assert code == 0
    assert "misalignment_spin_arcsec" in out
    assert "not determined" in out


@pytest.mark.parametrize(
    ("arguments", "sequence", "say"),
    [
        ([], None, "give recordings and --sequence"),
        (["--simulate", "rest", "a.dhil"], None, "give nothing but --out"),
        (["P0", "--date", "soon"], "", "--date soon: expected YYYY-MM-DD"),
        (["P0"], "latitude_deg = 95", "latitude_deg = 95"),
        (
            ["P0"],
            "latitude_deg = 50\n[[position]]\nrecording = 'x.dhil'\nheading_deg = 0\npitch_deg = 0\nroll_deg = 0",
            "'x.dhil'",
        ),
        (["P0", "P1"], "latitude_deg = 50\nPOSITION", "nothing is said of the recording"),
        (["P0"], "latitude_deg = 50\nPOSITION", "1 positions at rest; it takes 6"),
        (["P0"], "latitude_deg = 50\nPOSITION\nfrom_s = 3", "from_s and to_s belong together"),
        (["P0"], "latitude_deg = 50\nPOSITION\nfrom_s = 3\nto_s = 2", "must come after"),
        (["P0"], "latitude_deg = 50\nTURN", "give either rate_deg_s or angle_deg"),
        (["P0"], "latitude_deg = 50\nTURN\nangle_deg = 360", "angle_deg needs from_s and to_s"),
    ],
)
def test_what_is_refused(recorded, tmp_path, monkeypatch, capsys, arguments, sequence, say):
    _, recordings, _, _ = recorded
    step = f"recording = '{recordings[0].name}'\nheading_deg = 0\npitch_deg = 45\nroll_deg = 180"
    words: list[object] = [recordings[int(a[1])] if a in {"P0", "P1"} else a for a in arguments]
    if sequence is not None:
        text = sequence.replace("POSITION", f"[[position]]\n{step}").replace("TURN", f"[[turn]]\n{step}")
        (tmp_path / "s.toml").write_text(text)
        words += ["--sequence", tmp_path / "s.toml"]
    code, out, err = hil(monkeypatch, capsys, *words, "--out", tmp_path / "c.toml")
    assert code == 2
    assert not out
    assert say in err, err


def test_a_swapped_recording_is_refused(recorded, tmp_path):
    _, recordings, folder, _ = recorded
    text = (folder / SEQUENCE).read_text()
    one, other = recordings[0].name, recordings[10].name
    Path(tmp_path / "s.toml").write_text(text.replace(one, "x").replace(other, one).replace('"x"', f'"{other}"'))
    with pytest.raises(HilError, match=r"reads .* and should read .*does not show what the sequence says"):
        calibrate(recordings, tmp_path / "s.toml", None, None, quiet)


def test_recordings_of_two_heads_are_refused(recorded, tmp_path):
    scenario, recordings, folder, _ = recorded
    other = tmp_path / recordings[0].name
    with RecordingWriter(other, {"scenario": scenario.model_dump(mode="json")}) as writer:
        for _, slow, batch in SimulatedHead(scenario.with_changes(head={"serial": 9})).chunks(500):
            writer.write(np.concatenate([slow, batch]))
    turned = (folder / SEQUENCE).read_text().splitlines()
    attitude = {"heading_deg": 37.0, "pitch_deg": 5.0, "roll_deg": 3.0}
    lines = [
        f"{k} = {attitude[k]}" if n < 8 and (k := line.split(" ")[0]) in attitude else line
        for n, line in enumerate(turned)
    ]
    (tmp_path / "s.toml").write_text("\n".join(lines))
    with pytest.raises(HilError, match=r"several heads: serial 9 in .*, 7 in "):
        calibrate([other, *recordings[1:]], tmp_path / "s.toml", None, None, quiet)


def test_a_calibration_of_nothing_navigates_alike():
    nothing = CalibrationFile.model_validate({"serial": 1, "date": "2026-11-22", "gyro": {}, "accelerometer": {}})
    scenario = load("rest").with_changes(
        duration_s=4, head={"instruments": "dtg", "grade": "dtg", "rate_hz": 200}, navigation={"align_s": 2}
    )
    digests = [
        fly(one)[0]["navigation_digest"]
        for one in (scenario, scenario.with_changes(head={"calibration": nothing.as_table()}))
    ]
    assert digests[0] == digests[1]
