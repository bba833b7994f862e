"""`hil navigate`: files in and out to the last bit, errors that name the place, and the analytic flight navigated."""

import math
from functools import partial

import numpy as np
import pytest

from hil.aid_file import AID_HEADER, read_aiding
from hil.offline import IMU_HEADER, NAV_HEADER, navigate, read_init, thin
from hil.scenario import load
from hil.tables import read_table, write_table
from hil.world.motion import Motion
from nav.errors import HilError
from nav.rotation import euler_from_quaternion

START = 70.0
ROWS = np.column_stack([0.01 * np.arange(1, 6), np.random.default_rng(1).normal(size=(5, 6)) * 1e-3])


def start_of(motion, time):
    (row,) = motion.truth([time])
    heading, pitch, roll = np.degrees(euler_from_quaternion(row["q_nb"][None])[0])
    place = (math.degrees(row["lat"]), math.degrees(row["lon"]), row["height"])
    return dict(zip(NAV_HEADER, (time, *place, *row["vel_n"], roll, pitch, heading), strict=True))


@pytest.fixture(scope="module")
def flight():
    motion, n, step = Motion(load("flight").motion), 6000, 0.01
    dtheta, dvel = np.empty((n, 3)), np.empty((n, 3))
    motion.increments(round(START / step), n, step, dtheta, dvel)
    return motion, np.column_stack([START + step * np.arange(1, n + 1), dtheta, dvel])


@pytest.mark.parametrize("suffix", ["csv", "npz"])
def test_tables_come_back_to_the_last_bit(tmp_path, suffix):
    path = tmp_path / f"imu.{suffix}"
    write_table(path, IMU_HEADER, ROWS)
    np.testing.assert_array_equal(read_table(path, IMU_HEADER), ROWS)
    if suffix == "csv":
        assert path.read_text().splitlines()[0] == "time_s,dtheta_x,dtheta_y,dtheta_z,dvel_x,dvel_y,dvel_z"


def test_the_header_of_the_solution():
    assert ",".join(NAV_HEADER) == (
        "time_s,lat_deg,lon_deg,height_m,vel_north,vel_east,vel_down,roll_deg,pitch_deg,heading_deg"
    )


@pytest.mark.parametrize(
    ("attitude", "mechanization"),
    [
        *[("two-sample", name) for name in ("geographic", "wander", "earth", "inertial")],
        ("high-order:6", "geographic"),
        ("picard3", "wander"),
    ],
)
def test_the_flight_is_navigated(flight, tmp_path, attitude, mechanization):
    motion, table = flight
    write_table(tmp_path / "imu.csv", IMU_HEADER, table)
    rows = navigate(read_table(tmp_path / "imu.csv", IMU_HEADER), start_of(motion, START), attitude, mechanization)
    truth = motion.truth(table[:, 0])
    assert rows.shape == (6000, 10)
    np.testing.assert_array_equal(rows[:, 0], table[:, 0])
    assert np.abs(rows[:, 1] - np.degrees(truth["lat"])).max() * 111e3 < 0.01
    assert np.abs(rows[:, 2] - np.degrees(truth["lon"])).max() * 71e3 < 0.01
    assert np.abs(rows[:, 3] - truth["height"]).max() < 0.01
    assert np.abs(rows[:, 4:7] - truth["vel_n"]).max() < 1e-3
    angles = np.degrees(euler_from_quaternion(truth["q_nb"]))[:, ::-1]
    assert np.abs((rows[:, 7:] - angles + 180) % 360 - 180).max() < 1e-7


@pytest.mark.parametrize(
    ("text", "say"),
    [
        ("", "line 1"),
        ("time,x\n1,2\n", "line 1"),
        (",".join(reversed(IMU_HEADER)) + "\n", "line 1"),
        (",".join(IMU_HEADER) + "\n", "no rows"),
        (",".join(IMU_HEADER) + "\n1,0,0,0,0,0,0\n2,0,0,nan,0,0,0\n", "row 2"),
        (",".join(IMU_HEADER) + "\n1,0,0,0,0,0\n2,0,0,0,0,0\n", "6 columns"),
    ],
)
@pytest.mark.filterwarnings("ignore:loadtxt")
def test_bad_tables_are_refused_with_their_place(tmp_path, text, say):
    (tmp_path / "imu.csv").write_text(text)
    with pytest.raises(HilError, match=say) as refusal:
        read_table(tmp_path / "imu.csv", IMU_HEADER)
    assert "imu.csv" in str(refusal.value)


@pytest.mark.parametrize("bad", ["3,0,x,0,0,0,0", "3,0,0,0,0,0", "3,0,0,0,0,0,0,0", "3,0,0,0,0,0,"])
def test_a_bad_line_is_named_as_an_editor_counts(tmp_path, bad):
    lines = [",".join(IMU_HEADER), "1,0,0,0,0,0,0", "2,0,0,0,0,0,0", bad, "4,0,0,0,0,0,0"]
    (tmp_path / "imu.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(HilError, match="line 4"):
        read_table(tmp_path / "imu.csv", IMU_HEADER)


@pytest.mark.parametrize(
    ("name", "content"),
    [("imu.csv", b"\xff\xfe\0\1"), ("imu.npz", b""), ("imu.npz", b"not a zip"), ("imu.npz", b"PK\3\4 cut short")],
)
def test_files_that_are_something_else(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(HilError, match=name):
        read_table(tmp_path / name, IMU_HEADER)


def test_columns_of_unequal_length(tmp_path):
    columns = {name: ROWS[:, k] for k, name in enumerate(IMU_HEADER)}
    np.savez(tmp_path / "short.npz", **{**columns, "dvel_z": ROWS[:2, 6]})
    with pytest.raises(HilError, match=r"short\.npz"):
        read_table(tmp_path / "short.npz", IMU_HEADER)


def test_archives_that_are_none_or_damaged(tmp_path):
    """A bare array, and members that zipfile refuses in ways of its own; tables and measurements."""
    path = tmp_path / "odd.npz"
    with path.open("wb") as file:
        np.save(file, ROWS)
    for read in (partial(read_table, header=IMU_HEADER), read_aiding):
        with pytest.raises(HilError, match=r"odd\.npz: .*no archive of columns"):
            read(path)
    for header, read in ((IMU_HEADER, partial(read_table, header=IMU_HEADER)), (AID_HEADER, read_aiding)):
        np.savez(path, **{name: np.ones(3) for name in header})
        whole = bytearray(path.read_bytes())
        at = whole.index(b"PK\1\2")
        for place, value in ((at + 8, 1), (at + 10, 99)):  # encrypted; packed in a way that is unknown
            path.write_bytes(whole[:place] + bytes([value]) + whole[place + 1 :])
            with pytest.raises(HilError, match=r"odd\.npz: not a readable \.npz file"):
                read(path)


def test_parquet_of_no_numbers(tmp_path):
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    column = arrow.array([{"a": 1.0}] * 3)
    parquet.write_table(arrow.table(dict.fromkeys(IMU_HEADER, column)), tmp_path / "odd.parquet")
    with pytest.raises(HilError, match=r"odd\.parquet"):
        read_table(tmp_path / "odd.parquet", IMU_HEADER)


def test_archives_that_lack_something(tmp_path):
    columns = {name: ROWS[:, k] for k, name in enumerate(IMU_HEADER[:-1])}
    np.savez(tmp_path / "lacks.npz", **columns)
    with pytest.raises(HilError, match="dvel_z"):
        read_table(tmp_path / "lacks.npz", IMU_HEADER)
    with pytest.raises(HilError, match="No such file"):
        read_table(tmp_path / "none.csv", IMU_HEADER)


@pytest.mark.parametrize("row", [0, 3])
def test_time_that_does_not_increase_is_named(row):
    table = ROWS.copy()
    table[row, 0] = table[row - 1, 0] if row else 0.0
    start = dict.fromkeys(NAV_HEADER, 0.0)
    with pytest.raises(HilError, match=f"row {row + 1}: time_s"):
        navigate(table, start, "two-sample", "geographic")
    with pytest.raises(HilError, match="there is: two-sample"):
        navigate(ROWS, start, "three-sample", "geographic")


def test_the_pole_is_crossed_by_every_mechanization():
    """At rest in inertial axes nothing but gravitation acts; what matters is that geographic hands over and agrees."""
    table = np.column_stack([np.arange(1.0, 401.0), np.zeros((400, 5)), np.full(400, -9.832)])
    start = dict.fromkeys(NAV_HEADER, 0.0) | {"lat_deg": 89.9, "vel_north": 50.0}
    geographic, wander = (navigate(table, start, "two-sample", name) for name in ("geographic", "wander"))
    assert geographic[:, 1].max() > 89.99
    np.testing.assert_allclose(geographic[-1, 1:4], wander[-1, 1:4], rtol=0, atol=1e-6)


GOOD = "\n".join(f"{name} = {k}" for k, name in enumerate(NAV_HEADER))


def test_start_is_read(tmp_path):
    (tmp_path / "init.toml").write_text(GOOD)
    start, believed = read_init(tmp_path / "init.toml")
    assert believed is None
    assert start == {name: float(k) for k, name in enumerate(NAV_HEADER)}


@pytest.mark.parametrize(
    ("text", "say"),
    [
        (GOOD.replace("lat_deg = 1", ""), "lat_deg = None"),
        (GOOD.replace("lat_deg = 1", "lat_deg = 91"), "-90..90"),
        (GOOD.replace("lat_deg = 1", 'lat_deg = "1"'), "lat_deg = '1': expected a number"),
        (GOOD.replace("lat_deg = 1", "lat_deg = nan"), "lat_deg = nan"),
        (GOOD.replace("lat_deg = 1", "lat_deg = true"), "lat_deg = True"),
        (GOOD + "\nspeed = 1", "unknown key 'speed'"),
        (GOOD.replace("lat_deg = 1", f"lat_deg = {10**400}"), "expected a number"),
        ("lat_deg = = 1", "not TOML"),
    ],
)
def test_bad_starts_name_the_key(tmp_path, text, say):
    (tmp_path / "init.toml").write_text(text)
    with pytest.raises(HilError) as refusal:
        read_init(tmp_path / "init.toml")
    assert say in str(refusal.value)
    assert "init.toml" in str(refusal.value)


def test_thinning_keeps_the_grid_and_the_end():
    rows = np.column_stack([5.0 + 0.01 * np.arange(1, 1004), np.zeros(1003)])
    kept = thin(rows, 0.1)[:, 0]
    np.testing.assert_allclose(kept[:-1], 5.01 + 0.1 * np.arange(101), atol=1e-12)
    assert kept[-1] == rows[-1, 0]
