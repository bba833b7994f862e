"""`hil navigate --aid`: a simulated flight from files to files, filtered and smoothed, and files that are refused."""

import csv
import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from commands import called

from hil.aid_file import AID_HEADER, read_aiding
from hil.geometry import position_error
from hil.magnetic import magnetic_field
from hil.offline import IMU_HEADER, NAV_HEADER
from hil.offline_aided import AIDED_HEADER
from hil.offline_filter import FilterConfig, read_filter
from hil.study.aiding import _full, record, turns
from hil.tables import read_table, write_table
from hil.world.motion import Motion
from nav.aiding import Kind
from nav.errors import HilError
from nav.instruments.grades import GRADES
from nav.rotation import attitude_error, conjugate, euler_from_quaternion, quaternion_from_euler, rotated

SECONDS, OUTAGE, ARM = 120.0, (50.0, 90.0), np.array([0.8, -0.3, -1.0])
MOTION: Motion = turns()
INIT = """
[filter]
grade = "tactical"
attitude_sigma_deg = [0.1, 0.1, 0.5]
velocity_sigma_ms = [0.05, 0.05, 0.05]
position_sigma_m = [1.5, 1.5, 2.5]
bias_removed = true
lever_arm_m = [0.8, -0.3, -1.0]
field = "dipole"
gnss_delay_s = 0.05
"""


def cell(number):
    return repr(float(number))


def line(time, kind, values=(), sigmas=(), source=0):
    """A line of the file, its numbers as they are."""
    wide = [*map(cell, values), *[""] * (6 - len(values)), *map(cell, sigmas), *[""] * (6 - len(sigmas))]
    return [cell(time), kind, str(source), *wide]


@cache
def flight():
    """IMU rows of tactical instruments, start, lines of measurements of all kinds but those of rest, and the truth."""
    rng, *parts = np.random.default_rng(2).spawn(4)
    true = record(MOTION, SECONDS)
    imu = np.column_stack([true.time, *_full(GRADES["tactical"], true.dtheta, true.dvel, parts)])
    (first,) = MOTION.truth([0.0])
    heading, pitch, roll = np.degrees(euler_from_quaternion(first["q_nb"])) + rng.normal(0.0, [0.5, 0.1, 0.1])
    north, east, up = rng.normal(0.0, [1.5, 1.5, 2.5])
    place = math.degrees(first["lat"] + north / 6.37e6), math.degrees(first["lon"] + east / 4.1e6), first["height"] + up
    start = dict(zip(NAV_HEADER, (0.0, *place, *first["vel_n"], roll, pitch, heading), strict=True))
    lines = []
    for time in np.arange(1, 5 * SECONDS) * 0.2:
        (row,) = MOTION.truth([time])
        if not OUTAGE[0] < time < OUTAGE[1]:
            arm, swing = rotated(row["q_nb"], ARM), rotated(row["q_nb"], np.cross(row["w_ib_b"], ARM))
            noise = rng.normal(0.0, [1.5, 1.5, 2.5, 0.05, 0.05, 0.08])
            n, e, d, *vel = np.concatenate([arm, row["vel_n"] + swing]) + noise
            lat = math.degrees(row["lat"] + n / 6.37e6)
            lon = math.degrees(row["lon"] + e / (6.39e6 * math.cos(row["lat"])))
            antenna = lat, lon, row["height"] - d, *vel
            lines.append(line(time + 0.05, "gnss", antenna, (1.5, 1.5, 2.5, 0.05, 0.05, 0.08)))
        lines.append(line(time, "baro", [row["height"] + 7.0 + rng.normal(0.0, 0.3)], [0.3]))
        flux = rotated(conjugate(row["q_nb"]), magnetic_field("dipole", row["lat"], row["lon"], row["height"], 2026.0))
        lines.append(line(time, "MAGNETIC", 1e6 * flux + rng.normal(0.0, 0.5, 3), [0.5] * 3))
    return imu, start, lines, MOTION.truth(true.time)


def write(folder, lines, header=AID_HEADER, init=INIT):
    """IMU.csv, INIT.toml and AID.csv in `folder`."""
    imu, start, _, _ = flight()
    write_table(folder / "imu.csv", IMU_HEADER, imu)
    (folder / "init.toml").write_text("\n".join(f"{name} = {float(start[name])!r}" for name in start) + init)
    with (folder / "aid.csv").open("w", newline="") as file:
        csv.writer(file).writerows([header, *lines])


@pytest.fixture
def hil():
    return called


def navigate(hil, folder, *options):
    return hil("navigate", folder / "imu.csv", "--init", folder / "init.toml", "--out", folder / "nav.csv", *options)


def errors(rows, truth):
    """Position, m, and attitude, rad, (n, 3) each."""
    q = quaternion_from_euler(*np.radians(rows[:, [9, 8, 7]]).T)
    place = np.radians(rows[:, 1]), np.radians(rows[:, 2]), rows[:, 3]
    return position_error(*place, truth), attitude_error(q, truth["q_nb"])


def rms(vectors):
    return math.sqrt((vectors**2).sum(axis=1).mean())


def test_a_flight_from_files_to_files(hil, tmp_path):
    """Filtered and smoothed beside the truth: errors by their sigmas, and the outage bridged from both sides."""
    imu, _, lines, truth = flight()
    write(tmp_path, lines)
    found = {}
    for options in ((), ("--smooth",)):
        code, out, err = navigate(hil, tmp_path, "--aid", tmp_path / "aid.csv", "--json", *options)
        assert (code, err) == (0, "")
        summary = json.loads(out)
        assert summary["unused"] == 0
        assert set(summary["aiding"]) == {"baro.0", "gnss_position.0", "gnss_velocity.0", "magnetic.0"}
        taken = {name: count["accepted"] for name, count in summary["aiding"].items()}
        assert taken["baro.0"] > 0.97 * 5 * SECONDS
        assert 0.97 < taken["gnss_position.0"] / (5 * (SECONDS - 40.0)) <= 1.01
        rows = read_table(tmp_path / "nav.csv", AIDED_HEADER)
        assert (rows[:, 0] == imu[:, 0]).all()
        assert summary["final"] == dict(zip(AIDED_HEADER, rows[-1].tolist(), strict=True))
        found[options] = rows
    filtered, smoothed = found[()], found["--smooth",]
    np.testing.assert_allclose(smoothed[-1, :10], filtered[-1, :10], rtol=1e-12, atol=1e-12)
    late = slice(1000, None)
    for rows in (filtered, smoothed):
        place, turn = errors(rows[late], truth[late])
        ratio = np.hstack([place, turn]) / np.hstack([rows[late, 10:13], np.radians(rows[late, 16:19])])
        assert (np.sqrt((ratio**2).mean(axis=0)) < 2.0).all()
        assert (np.sqrt((ratio**2).mean(axis=0)) > 0.2).all()
    out = slice(round(100 * OUTAGE[0]), round(100 * OUTAGE[1]))
    for part in (late, out):
        ours, theirs = errors(smoothed[part], truth[part]), errors(filtered[part], truth[part])
        assert rms(ours[0]) < 0.6 * rms(theirs[0])
        assert rms(ours[1]) < rms(theirs[1])
    assert rms(errors(smoothed[late], truth[late])[0]) < 1.0


def test_rows_apart_are_those_of_the_whole(hil, tmp_path):
    _, _, lines, _ = flight()
    write(tmp_path, lines)
    navigate(hil, tmp_path, "--aid", tmp_path / "aid.csv", "--smooth")
    whole = read_table(tmp_path / "nav.csv", AIDED_HEADER)
    code, _, _ = navigate(hil, tmp_path, "--aid", tmp_path / "aid.csv", "--smooth", "--every", 10)
    assert code == 0
    np.testing.assert_array_equal(read_table(tmp_path / "nav.csv", AIDED_HEADER)[:-1], whole[::1000])


def test_a_table_of_the_filter_changes_nothing_without_measurements(hil, tmp_path):
    write(tmp_path, [])
    navigate(hil, tmp_path)
    with_it = (tmp_path / "nav.csv").read_bytes()
    write(tmp_path, [], init="")
    navigate(hil, tmp_path)
    assert (tmp_path / "nav.csv").read_bytes() == with_it


ALL = [
    line(3.0, "gnss", (50.0, 36.25, 150.0, 1.0, 2.0, 3.0), (1.0, 2.0, 3.0, 0.1, 0.2, 0.3), 1),
    line(2.0, "baro", [151.0], [0.5]),
    line(2.5, "magnetic", (20.0, -1.0, 45.0), (0.3, 0.4, 0.5)),
    line(2.6, "heading", [350.0], [0.2]),
    line(2.7, "attitude", (3.0, 5.0, 37.0), (0.1, 0.1, 0.2)),
    line(2.8, "body_velocity", (40.0, 0.0, 0.0), (0.1, 0.1, 0.1)),
    line(2.9, "zero_rate", (), (0.01, 0.01, 0.01)),
    line(4.0, "gravity", (), (0.05, 0.05)),
]


def columns():
    kinds = [Kind[one[1].upper()] for one in ALL]
    numbers = [[math.nan if not number else float(number) for number in [one[0], *one[2:]]] for one in ALL]
    table = np.array(numbers)
    found = dict(zip([AID_HEADER[0], *AID_HEADER[2:]], table.T, strict=True))
    return found, np.array([kind.name.lower() for kind in kinds]), np.array([int(kind) for kind in kinds])


def test_all_kinds_are_read_in_order_and_in_our_units(tmp_path):
    write(tmp_path, ALL)
    rows = read_aiding(tmp_path / "aid.csv")
    assert rows["time"].tolist() == [2.0, 2.5, 2.6, 2.7, 2.8, 2.9, 3.0, 4.0]
    kinds = ["BARO", "MAGNETIC", "HEADING", "ATTITUDE", "BODY_VELOCITY", "ZERO_RATE", "GNSS", "GRAVITY"]
    assert [Kind(row["kind"]).name for row in rows] == kinds
    gnss = rows[6]
    assert gnss["source"] == 1
    np.testing.assert_allclose(gnss["value"], [math.radians(50.0), math.radians(36.25), 150.0, 1.0, 2.0, 3.0])
    assert gnss["sigma"].tolist() == [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
    np.testing.assert_allclose(rows[1]["value"][:3], [2e-5, -1e-6, 4.5e-5])
    np.testing.assert_allclose(np.degrees(euler_from_quaternion(rows[3]["value"][:4])), [37.0, 5.0, 3.0])
    np.testing.assert_allclose(rows[5]["sigma"][:3], math.radians(0.01))
    assert np.isinf(rows[0]["sigma"][1:]).all()


@pytest.mark.parametrize("numbered", [False, True])
def test_an_archive_says_the_same(tmp_path, numbered):
    write(tmp_path, ALL)
    found, names, numbers = columns()
    np.savez(tmp_path / "aid.npz", kind=numbers if numbered else names, **found)
    assert read_aiding(tmp_path / "aid.npz").tobytes() == read_aiding(tmp_path / "aid.csv").tobytes()


def changed(column, text, kind="gnss"):
    values = {"gnss": ALL[0], "attitude": ALL[4], "baro": ALL[1]}[kind]
    return [text if name == column else old for name, old in zip(AID_HEADER, values, strict=True)]


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        (changed("time_s", ""), "time_s = '': a time is needed"),
        (changed("time_s", "soon"), "time_s = 'soon': not a number"),
        (changed("kind", "gps"), "kind = 'gps': expected gnss, baro, magnetic"),
        (changed("source", "1.5"), "source = '1.5': expected a whole number"),
        (changed("value_1", "91"), "value_1 = '91': a latitude lies in -90..90"),
        (changed("value_3", ""), "value_3 = '': there is a sigma and no value"),
        (changed("value_3", "nan"), "value_3 = 'nan': not a finite number"),
        (changed("sigma_2", "0"), "sigma_2 = '0': a sigma must be positive"),
        (changed("value_2", "3", "baro"), "value_2 = '3': baro has 1 of these"),
        (changed("sigma_1", "", "baro"), "sigma_1 = '': baro needs a sigma"),
        (changed("source", "9" * 30), f"source = '{'9' * 30}': expected a whole number in 0..2147483647"),
        (changed("value_2", "", "attitude"), "value_2 = '': there is a sigma and no value"),
        ([*ALL[0], "7"], "16 columns, expected 15"),
    ],
)
def test_a_bad_line_is_named_with_its_column(hil, tmp_path, bad, says):
    write(tmp_path, [ALL[1], [], bad])
    code, out, err = navigate(hil, tmp_path, "--aid", tmp_path / "aid.csv")
    assert (code, out) == (2, "")
    assert "aid.csv: line 4: " in err
    assert says in err


@pytest.mark.parametrize(
    ("init", "options", "says"),
    [
        ("", ("--aid",), "--aid needs the table [filter]"),
        (INIT, ("--smooth",), "--smooth needs measurements"),
        (INIT.replace('"tactical"', '"cheap"'), ("--aid",), "init.toml: filter: grade = 'cheap'"),
        (INIT.replace("0.1, 0.5", "0.1"), ("--aid",), "attitude_sigma_deg"),
        (INIT + "restart = 3", ("--aid",), "restart = 3: unknown key"),
        (INIT + 'estimate = ["bias"]', ("--aid",), "estimate = 'bias': expected some of gyro_bias"),
        (INIT.replace('field = "dipole"', ""), ("--aid",), "magnetic measurements need the field"),
    ],
)
def test_a_wrong_request_says_what_is_needed(hil, tmp_path, init, options, says):
    write(tmp_path, ALL, init=init)
    options = [part for one in options for part in ((one, tmp_path / "aid.csv") if one == "--aid" else (one,))]
    code, out, err = navigate(hil, tmp_path, *options)
    assert (code, out) == (2, "")
    assert says in err


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("aid.csv", b"", "line 1"),
        ("aid.csv", b"time_s,kind\n", "line 1"),
        ("aid.csv", b"\xff\xfe\0", "aid.csv"),
        ("aid.csv", ",".join(AID_HEADER).encode(), "no rows"),
        ("aid.npz", b"no archive", "aid.npz"),
    ],
)
def test_files_that_are_something_else(tmp_path, name, content, says):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(HilError, match=says):
        read_aiding(tmp_path / name)
    with pytest.raises(HilError, match="No such file"):
        read_aiding(tmp_path / "none.csv")


def test_an_archive_that_lacks_a_column(tmp_path):
    found, names, _ = columns()
    np.savez(tmp_path / "aid.npz", kind=names, **{name: found[name] for name in found if name != "sigma_6"})
    with pytest.raises(HilError, match="sigma_6"):
        read_aiding(tmp_path / "aid.npz")


def test_the_document_is_read(tmp_path):
    """Its example, every key of the table, and every kind."""
    text = (Path(__file__).resolve().parents[2] / "docs" / "cli.md").read_text()
    example = next(part for part in text.split("```text\n") if part.startswith(AID_HEADER[0] + ",kind"))
    (tmp_path / "aid.csv").write_text(example.split("```")[0])
    gnss, baro = read_aiding(tmp_path / "aid.csv")
    assert gnss["value"][2] == 153.1
    assert baro["sigma"][0] == 0.3
    rows = "".join(row for row in text.splitlines() if row.startswith("| `"))
    assert all(f"`{name}`" in rows for name in [*FilterConfig.model_fields, *(kind.name.lower() for kind in Kind)])
    assert all(f"`{name}`" in text for name in AIDED_HEADER[10:])


def test_the_settings_reach_the_filter():
    table = {
        "grade": "mems",
        "attitude_sigma_deg": [1.0, 2.0, 3.0],
        "estimate": ["gyro_bias"],
        "lever_arm_m": [1, 2, 3],
    }
    config = read_filter(table, "here")
    assert isinstance(config, FilterConfig)
    np.testing.assert_allclose(config.sigma[6:], np.radians([1.0, 2.0, 3.0]))
    assert [block.name for block in config.tuning().blocks] == ["GYRO_BIAS"]
    settings = replace(config.settings(0.9, 0.5, 0.0), field_n=(0.0, 0.0, 0.0))
    assert settings.lever_arm == (1.0, 2.0, 3.0)
