"""ULog of a real flight board, logs made here, and files that are none."""

import math
import struct

import numpy as np
import pytest

from drivers.logs.imu_log import IRON_S, ImuLog, make_log, steady
from drivers.logs.ulog import read_ulog
from nav.aiding import AIDING, Kind
from nav.errors import HilError
from nav.rotation import rotated

pytest.importorskip("pyulog", reason="reading ULog needs the extra 'logs'")


@pytest.fixture(scope="module")
def flight(hil_data):
    path = hil_data / "px4_board.ulg"
    if not path.is_file():
        pytest.skip(f"no {path}")
    return path


def test_a_real_board(flight):
    log = read_ulog(flight)
    n = len(log.time_us)
    assert n > 1000
    assert (np.diff(log.time_us) > 0).all()
    assert (np.diff(log.counter) >= 1).all()
    assert log.rate.shape == log.force.shape == (n, 3)
    # What the counter says is missing is what the clock says: the same number of periods to a per cent
    assert log.counter[-1] * log.period_us == pytest.approx(log.time_us[-1] - log.time_us[0], rel=0.01)
    assert (log.step_us > 0).all()
    assert np.median(np.linalg.norm(log.force, axis=1)) == pytest.approx(9.81, rel=0.05)
    np.testing.assert_allclose(np.linalg.norm(log.attitude, axis=1), 1.0, atol=1e-3)
    # The attitude's own vertical agrees with the mean force: conventions are ours, b to n, scalar first
    k = np.searchsorted(log.time_us, log.attitude_us).clip(0, n - 1)
    w, x, y, z = log.attitude.T
    down = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z], axis=1)
    assert np.mean(np.sum(-log.force[k] * down, axis=1)) == pytest.approx(9.81, rel=0.1)


def test_step_of_a_log_with_a_gap():
    time_us = np.array([1000, 2000, 3010, 8000, 9000])
    nothing = np.zeros(0, int), np.zeros((0, 4)), np.zeros(0, AIDING), np.zeros(0, int)
    log = ImuLog(time_us, np.array([0, 1, 2, 7, 8]), 1000, *[np.zeros((5, 3))] * 2, *nothing)
    assert log.step_us.tolist() == [1000, 1000, 1010, 1000, 1000]


@pytest.mark.parametrize("share", [0.0001, 0.001, 0.3, 0.999])
def test_truncated_is_read_as_far_as_it_goes_or_refused(flight, tmp_path, share):
    whole = flight.read_bytes()
    (tmp_path / "cut.ulg").write_bytes(whole[: int(len(whole) * share)])
    if share < 0.01:
        with pytest.raises(HilError, match=r"cut\.ulg"):
            read_ulog(tmp_path / "cut.ulg")
        return
    log, full = read_ulog(tmp_path / "cut.ulg"), read_ulog(flight)
    n = len(log.time_us)
    assert n > 0.5 * share * len(full.time_us)
    np.testing.assert_array_equal(log.time_us, full.time_us[:n])
    np.testing.assert_array_equal(log.rate, full.rate[:n])


@pytest.mark.parametrize("content", [b"", b"ULog", b"not a log at all\n" * 100, bytes(range(256)) * 40])
def test_foreign_files(tmp_path, content):
    (tmp_path / "foreign.ulg").write_bytes(content)
    with pytest.raises(HilError, match=r"foreign\.ulg"):
        read_ulog(tmp_path / "foreign.ulg")


def test_missing_file(tmp_path):
    with pytest.raises(HilError, match="No such file"):
        read_ulog(tmp_path / "none.ulg")


def test_the_boards_magnetometer(flight):
    """Its own times, 5 to 20 ms before the samples that it came with; the strength of the Earth's field."""
    log = read_ulog(flight)
    assert set(log.aiding["kind"].tolist()) == {Kind.MAGNETIC}, "barometer and position of this log are empty"
    assert (np.diff(log.aiding["time"]) > 0).all()
    assert (log.arrival_us * 1e-6 >= log.aiding["time"]).all()
    strength = np.linalg.norm(log.aiding["value"][:, :3], axis=1)
    assert 20e-6 < strength.min() < strength.max() < 70e-6
    # Turned into the level by the log's attitude it stands still: axes are the body's
    at = np.searchsorted(log.attitude_us, log.aiding["time"] * 1e6).clip(0, len(log.attitude_us) - 1)
    level = rotated(log.attitude[at], log.aiding["value"][:, :3]) / strength[:, None]
    assert np.linalg.norm(level - level.mean(axis=0), axis=1).mean() < 0.1


SENSORS = {
    "sensor_combined": (
        "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;int32_t magnetometer_timestamp_relative;"
        "float[3] magnetometer_ga;int32_t baro_timestamp_relative;float baro_alt_meter",
        "<Q3f3fi3fif",
    ),
    "vehicle_attitude": ("uint64_t timestamp;float[4] q", "<Q4f"),
    "vehicle_gps_position": (
        "uint64_t timestamp;int32_t lat;int32_t lon;int32_t alt_ellipsoid;float s_variance_m_s;float eph;float epv;"
        "float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;uint8_t fix_type",
        "<Qiii6fB",
    ),
    "sensor_gps": (
        "uint64_t timestamp;double latitude_deg;double longitude_deg;double altitude_ellipsoid_m;float s_variance_m_s;"
        "float eph;float epv;float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;uint8_t fix_type",
        "<Q3d6fB",
    ),
    "vehicle_magnetometer": ("uint64_t timestamp;float[3] magnetometer_ga", "<Q3f"),
    "vehicle_air_data": ("uint64_t timestamp;float baro_alt_meter", "<Qf"),
}


def made(path, topics, **parameters):
    """A ULog of `topics`: (name, instance) to rows of values."""

    def message(kind, body):
        return struct.pack("<HB", len(body), ord(kind)) + body

    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    for name in {name for name, _ in topics}:
        data += message("F", f"{name}:{SENSORS[name][0]};".encode())
    for key, value in parameters.items():
        name = f"float {key}".encode()
        data += message("P", bytes([len(name)]) + name + struct.pack("<f", value))
    for number, (name, instance) in enumerate(topics):
        data += message("A", struct.pack("<BH", instance, number) + name.encode())
    for number, ((name, _), rows) in enumerate(topics.items()):
        for row in rows:
            data += message("D", struct.pack("<H", number) + struct.pack(SENSORS[name][1], *row))
    path.write_bytes(data)
    return path


def base(n=500, mag=-2000, baro=-5000):
    """A level board at rest, 250 Hz; its magnetometer and barometer speak with every fifth sample."""
    imu = []
    for k in range(n):
        new = k % 5
        imu.append(
            (10**6 + 4000 * k, 0, 0, 0, 0, 0, -9.81, mag - 4000 * new + new % 2, 0.2, 0.0, 0.4, baro - 4000 * new, 77.0)
        )
    attitude = [(10**6 + 20_000 * k, 1, 0, 0, 0) for k in range(n // 5)]
    return {("sensor_combined", 0): imu, ("vehicle_attitude", 0): attitude}


def test_a_log_may_end_anywhere(tmp_path):
    """Within the definitions too, and within a message of no known kind there, as long as all that was before it."""
    whole = made(tmp_path / "cut.ulg", base(3)).read_bytes()
    places = range(whole.index(b"Fsensor_combined"), whole.index(b"D\0\0") + 1)
    for end in places:
        for tail in (b"", struct.pack("<HB", end + 1 - 16, 0)):
            (tmp_path / "cut.ulg").write_bytes(whole[:end] + tail)
            with pytest.raises(HilError, match=r"cut\.ulg"):
                read_ulog(tmp_path / "cut.ulg")


def test_old_logs_carry_field_and_height_with_the_samples(tmp_path):
    log = read_ulog(made(tmp_path / "old.ulg", base(), EKF2_BARO_NOISE=2.0, EKF2_BARO_DELAY=30.0))
    lasting = np.sqrt(2.0 * IRON_S / 0.02)  # an error that lasts, at 50 Hz
    for kind, value, sigma, age in ((Kind.MAGNETIC, 20e-6, 5e-6 * lasting, 0.002), (Kind.BARO, 77.0, 2.0, 0.035)):
        rows = log.aiding[log.aiding["kind"] == kind]
        assert len(rows) == 100, "once for each that is new"
        np.testing.assert_allclose(rows["value"][:, 0], value, rtol=1e-6)
        np.testing.assert_allclose(rows["sigma"][:, 0], sigma, rtol=1e-6)
        arrivals = log.arrival_us[log.aiding["kind"] == kind] * 1e-6
        np.testing.assert_allclose(arrivals - rows["time"], age, atol=1e-9)


OLD_FIX = (500000000, 360000000, 150000, 0.4, 1.5, 2.5, 1.0, 2.0, -3.0)
NEW_FIX = (50.0, 36.0, 150.0, 0.4, 1.5, 2.5, 1.0, 2.0, -3.0)


@pytest.mark.parametrize(("topic", "fix"), [("vehicle_gps_position", OLD_FIX), ("sensor_gps", NEW_FIX)])
def test_fixes_of_old_and_new_logs(tmp_path, topic, fix):
    topics = base(mag=2**31 - 1 - 5, baro=0)
    topics["sensor_combined", 0] = [
        (*r[:7], 2**31 - 1, *r[8:11], 2**31 - 1, r[12]) for r in topics["sensor_combined", 0]
    ]
    topics[topic, 0] = [(10**6 + 200_000 * k, *fix, 3 if k else 2) for k in range(9)]
    log = read_ulog(made(tmp_path / "fix.ulg", topics, EKF2_GPS_DELAY=150.0))
    assert len(log.aiding) == 8, "the first has no height; magnetometer and barometer never spoke"
    np.testing.assert_allclose(
        log.aiding["value"], [[math.radians(50), math.radians(36), 150.0, 1.0, 2.0, -3.0]] * 8, rtol=1e-12
    )
    np.testing.assert_allclose(log.aiding["sigma"], [[1.5, 1.5, 2.5, 0.4, 0.4, 0.4]] * 8, rtol=1e-6)
    np.testing.assert_allclose(log.arrival_us * 1e-6 - log.aiding["time"], 0.15, atol=1e-8)
    assert log.place == pytest.approx((math.radians(50), math.radians(36), 150.0))


def test_several_instances_keep_apart(tmp_path):
    topics = base()
    topics["vehicle_magnetometer", 1] = [(10**6 + 10_000 * k, 0.3, 0, 0) for k in range(50)]
    topics["vehicle_air_data", 0] = [(10**6 + 50_000 * k, 80.0) for k in range(10)]
    log = read_ulog(made(tmp_path / "many.ulg", topics))
    second = log.aiding[(log.aiding["kind"] == Kind.MAGNETIC) & (log.aiding["source"] == 1)]
    assert len(second) == 50
    np.testing.assert_allclose(second["value"][:, 0], 30e-6, rtol=1e-6)
    assert (np.diff(log.arrival_us) >= 0).all()


def test_a_lone_leap_of_the_time_takes_no_other_sample_along():
    times = 1000 * np.arange(1, 50)
    times[0], times[20], times[30], times[48] = 10**13, 10**12, 3, 10**12
    assert np.flatnonzero(~steady(times)).tolist() == [0, 20, 30, 48]
    gap = np.array([1, 2, 2, 3, 5_000_000, 5_001_000, 5_002_000])
    assert steady(gap).tolist() == [True] * 2 + [False] + [True] * 4
    assert len(steady(np.zeros(0, np.int64))) == 0


@pytest.mark.parametrize("averaged", [False, True])
def test_what_shakes_is_told_from_what_moves(averaged):
    """White noise on a slow turn, as it is or in means of neighbours; across a gap nothing is compared."""
    rng, t = np.random.default_rng(4), np.arange(20_000) * 4000
    noise = rng.normal(0.0, 0.2, (len(t), 3))
    values = noise + 3.0 * np.sin(2e-6 * t)[:, None]
    if averaged:
        values[1:] = 0.5 * (values[1:] + values[:-1])
    values[10_000:] += 50.0
    time_us = t + 1_000_000 * (np.arange(len(t)) >= 10_000)
    log = make_log(time_us, values, values, time_us, np.tile([1.0, 0, 0, 0], (len(t), 1)), [])
    expected = 0.2 * np.sqrt(0.5 if averaged else 1.0)
    assert log.shake(log.rate) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("column", ["timestamp", "baro_timestamp_relative", "gyro_rad"])
def test_a_topic_without_its_column_is_named(tmp_path, column):
    path = made(tmp_path / "odd.ulg", base(15))
    path.write_bytes(path.read_bytes().replace(column.encode(), b"x" * len(column), 1))
    with pytest.raises(HilError, match=r"odd\.ulg: .*column|odd\.ulg: it has no topic"):
        read_ulog(path)
