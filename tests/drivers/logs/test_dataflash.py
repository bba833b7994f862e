"""DataFlash logs, made here and of a real flight: units, axes, time, instances; damage never gives a wrong start or a crash."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.logs.dataflash import read_dataflash
from drivers.logs.imu_log import IRON_S
from nav.aiding import Kind
from nav.errors import HilError
from nav.rotation import euler_from_quaternion

CODES = {"B": "B", "H": "H", "I": "I", "Q": "Q", "h": "h", "f": "f", "c": "h", "C": "H", "e": "i", "E": "I", "L": "i"}
SCALES = {"c": 100, "C": 100, "e": 100, "E": 100, "L": 1e7}
TEXTS = {"n": "4s", "N": "16s", "Z": "64s"}
GEOID_M = 50.0
NEW = {
    "PARM": ("Nf", "Name,Value"),
    "IMU": ("QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "ATT": ("QccC", "TimeUS,Roll,Pitch,Yaw"),
    "GPS": ("QBBIHBcLLefffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,U"),
    "GPA": ("QBCCC", "TimeUS,I,HAcc,VAcc,SAcc"),
    "MAG": ("QBhhh", "TimeUS,I,MagX,MagY,MagZ"),
    "BARO": ("QBf", "TimeUS,I,Alt"),
}
OLD = {
    "PARM": ("Nf", "Name,Value"),
    "IMU": ("Iffffff", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "IMU2": ("Iffffff", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "ATT": ("IccC", "TimeMS,Roll,Pitch,Yaw"),
    "GPS": ("BIHBcLLeEefI", "Status,TimeMS,Week,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,T"),
    "UBX3": ("IBfff", "TimeMS,Instance,hAcc,vAcc,sAcc"),
    "MAG": ("Ihhh", "TimeMS,MagX,MagY,MagZ"),
    "MAG2": ("Ihhh", "TimeMS,MagX,MagY,MagZ"),
    "BARO": ("If", "TimeMS,Alt"),
}


class Writer:
    """The bytes of a log."""

    def __init__(self, formats):
        self.formats = {"FMT": (0x80, "BBnNZ"), **{n: (129 + k, f) for k, (n, (f, _)) in enumerate(formats.items())}}
        self.data = b""
        self.write("FMT", 0x80, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
        for name, (form, columns) in formats.items():
            size = 3 + struct.calcsize(self.layout(name))
            self.write("FMT", self.formats[name][0], size, name.encode(), form.encode(), columns.encode())

    def layout(self, name):
        return "<" + "".join(TEXTS.get(code) or CODES[code] for code in self.formats[name][1])

    def write(self, name, *values):
        number, form = self.formats[name]
        raw = [
            v if c in TEXTS else v if c == "f" else round(v * SCALES.get(c, 1))
            for v, c in zip(values, form, strict=True)
        ]
        self.data += struct.pack("<BBB", 0xA3, 0x95, number) + struct.pack(self.layout(name), *raw)


def rate_at(t):
    return [0.3 * math.sin(t), -0.1 * math.cos(2 * t), 0.05]


def new_log(seconds=30, clock=1.0, gap=range(0)):
    """A log of this day: 50 Hz, two receivers, magnetometers and barometers; `clock`: the board's seconds in a true one."""
    log = Writer(NEW)
    log.write("PARM", b"GPS_DELAY_MS", 120.0)
    log.write("PARM", b"EK3_MAG_M_NSE", 0.02)
    log.write("PARM", b"EK3_ALT_M_NSE", 1.5)
    for k in range(50 * seconds):
        us = 5_000_000 + round(20_000 * k * clock)
        t = k / 50
        if k not in gap:
            log.write("IMU", us, 0, *rate_at(t), 0.1, -0.2, -9.8)
            log.write("IMU", us + 10, 1, *rate_at(t), 9.0, 9.0, 9.0)
        if k % 5 == 0:
            log.write("ATT", us, 2.0, -3.0, 350.0)
            for i in (0, 1):
                log.write("MAG", us, i, 200 + i, -50, 400)
                log.write("BARO", us, i, 12.5 + i)
        if k % 10 == 0:
            for i in (0, 1):
                fix = (
                    3 if k >= 50 else 2,
                    1000 * k // 50,
                    2200,
                    12,
                    0.9,
                    50.0 + 1e-6 * k,
                    36.0,
                    100.0 + i,
                    10.0,
                    90.0,
                    -0.5,
                    1,
                )
                log.write("GPS", us, i, *fix)
                log.write("GPA", us, i, 1.5 + i, 2.5, 0.3)
    return log.data


def old_log(seconds=30):
    log = Writer(OLD)
    log.write("PARM", b"EKF_POS_DELAY", 220.0)
    for k in range(50 * seconds):
        ms, t = 70_000 + 20 * k, k / 50
        log.write("IMU", ms, *rate_at(t), 0.1, -0.2, -9.8)
        log.write("IMU2", ms, 7.0, 7.0, 7.0, 7.0, 7.0, 7.0)
        if k % 5 == 0:
            log.write("ATT", ms, 2.0, -3.0, 350.0)
            log.write("MAG", ms, 200, -50, 400)
            log.write("MAG2", ms, 300, -50, 400)
            log.write("BARO", ms, 12.5)
        if k % 10 == 0:
            log.write("GPS", 3, 400_000_000 + 20 * k, 1821, 9, 1.2, 50.0, 36.0, 100.0, 10.0, 90.0, -0.5, ms)
            log.write("UBX3", ms, 0, 0.8, 1.1, 0.4)
    return log.data


def read(data, tmp_path, name="made.bin"):
    path = tmp_path / name
    path.write_bytes(data)
    return read_dataflash(path, lambda lat, lon: GEOID_M)


def of(log, kind, source=0):
    chosen = (log.aiding["kind"] == kind) & (log.aiding["source"] == source)
    return log.aiding[chosen], log.arrival_us[chosen]


@pytest.mark.parametrize("make", [new_log, old_log])
def test_units_axes_and_times_of_both_generations(make, tmp_path):
    log = read(make(), tmp_path)
    assert (len(log.time_us), log.period_us, log.counter[-1]) == (1500, 20_000, 1499)
    at = (log.time_us - log.time_us[0]) * 1e-6
    ends = np.array([rate_at(t) for t in at])
    np.testing.assert_allclose(log.rate[1:], 0.5 * (ends[1:] + ends[:-1]), atol=1e-7)
    np.testing.assert_allclose(log.force, [[0.1, -0.2, -9.8]] * 1500, atol=1e-6)
    np.testing.assert_allclose(np.degrees(euler_from_quaternion(log.attitude)), [[350.0, -3.0, 2.0]] * 300, atol=1e-9)
    fixes, arrivals = of(log, Kind.GNSS)
    delay, stated = (0.12, (1.5, 2.5, 0.3)) if make is new_log else (0.22, (0.8, 1.1, 0.4))
    np.testing.assert_allclose(arrivals * 1e-6 - fixes["time"], delay, atol=1e-6)
    np.testing.assert_allclose(
        fixes["value"][0, :3], [math.radians(fixes_lat(make)), math.radians(36.0), 150.0], rtol=1e-9
    )
    np.testing.assert_allclose(fixes["value"][:, 3:], [[0.0, 10.0, -0.5]] * len(fixes), atol=1e-6)
    h, v, s = stated
    np.testing.assert_allclose(fixes["sigma"], [[h, h, v, s, s, s]] * len(fixes), rtol=1e-6)
    assert log.place == tuple(fixes["value"][0, :3])
    field, heard = of(log, Kind.MAGNETIC)
    np.testing.assert_allclose(field["value"][:, :3], [[200e-7, -50e-7, 400e-7]] * 300)
    np.testing.assert_allclose(heard * 1e-6, field["time"])
    np.testing.assert_allclose(of(log, Kind.MAGNETIC, 1)[0]["value"][:, 0], 201e-7 if make is new_log else 300e-7)
    heights, _ = of(log, Kind.BARO)
    np.testing.assert_allclose(heights["value"][:, 0], 12.5)
    assert (np.diff(log.arrival_us) >= 0).all()


def fixes_lat(make):
    """Latitude of the first good fix: the new log's first second has none in three dimensions."""
    return 50.0 + 50e-6 if make is new_log else 50.0


def test_deviations_are_those_of_the_autopilots_filter(tmp_path):
    log = read(new_log(), tmp_path)
    magnetic = of(log, Kind.MAGNETIC)[0]
    lasting = np.sqrt(2.0 * IRON_S / np.median(np.diff(magnetic["time"])))
    np.testing.assert_allclose(magnetic["sigma"][:, :3], 2e-6 * lasting, rtol=1e-6)
    np.testing.assert_allclose(of(log, Kind.BARO)[0]["sigma"][:, 0], 1.5)


def test_integral_of_the_samples_is_the_turn(tmp_path):
    """The trapezoid leaves h^2/12 of the change of the rate's slope: a sum over 10 s closes on the closed form to 2e-5 rad."""
    log = read(new_log(10), tmp_path)
    turn = (log.rate * log.step_us[:, None] * 1e-6)[1:].sum(axis=0)
    t = (log.time_us[-1] - log.time_us[0]) * 1e-6
    np.testing.assert_allclose(turn, [0.3 * (1 - math.cos(t)), -0.05 * math.sin(2 * t), 0.05 * t], atol=2e-5)


def test_a_gap_is_counted_and_not_averaged_over(tmp_path):
    log = read(new_log(gap=range(400, 430)), tmp_path)
    assert len(log.time_us) == 1470
    assert np.flatnonzero(log.after_gap).tolist() == [400]
    assert log.counter[400] == 430
    assert log.step_us[400] == 20_000
    np.testing.assert_allclose(log.rate[400], rate_at(430 / 50), atol=1e-7)


@pytest.mark.parametrize("clock", [0.92, 1.05, 1.0, 1.0005])
def test_a_board_whose_clock_is_wrong_is_put_right_by_its_receiver(clock, tmp_path):
    """Beyond what a bad crystal does, the seconds are those of the receiver; the increments grow with them."""
    log = read(new_log(clock=clock), tmp_path)
    seconds = (log.time_us[-1] - log.time_us[0]) * 1e-6
    true = 1499 * 0.02
    assert seconds == pytest.approx(true if abs(clock - 1.0) > 1e-3 else true * clock, rel=1e-5)
    fixes, arrivals = of(log, Kind.GNSS)
    scale = 1.0 / clock if abs(clock - 1.0) > 1e-3 else 1.0
    np.testing.assert_allclose(arrivals * 1e-6 - fixes["time"], 0.12 * scale, atol=3e-6)


NO_LENGTH = (
    b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", 0x81, 0, b"IMU", b"QB", b"TimeUS,I") + b"\xa3\x95\x81" + bytes(200)
)
"""A message of no bytes: a reader that goes on by its length stays where it is."""
FOREIGN = b"", b"\xa3\x95\x80", b"not a log at all\n" * 100, bytes(range(256)) * 40, NO_LENGTH


@pytest.mark.parametrize("content", FOREIGN)
def test_foreign_files(tmp_path, content):
    with pytest.raises(HilError, match=r"made\.bin"):
        read(content, tmp_path)


def test_missing_file(tmp_path):
    with pytest.raises(HilError, match="No such file"):
        read_dataflash(tmp_path / "none.bin", lambda lat, lon: 0.0)


@pytest.mark.parametrize("share", [0.1, 0.4, 0.9])
def test_truncated_is_read_as_far_as_it_goes(tmp_path, share):
    whole = new_log(10)
    full, log = read(whole, tmp_path), read(whole[: int(len(whole) * share)], tmp_path)
    n = len(log.time_us)
    assert 0.8 * share * 500 < n <= share * 510
    np.testing.assert_array_equal(log.time_us, full.time_us[:n])
    np.testing.assert_array_equal(log.rate, full.rate[:n])


@settings(max_examples=60)
@given(st.data())
def test_damage_is_left_out(tmp_path_factory, data):
    """Bytes overwritten anywhere: refused by name, or a log that is finite, in order, and within what the wire carries."""
    bad = bytearray(DAMAGED)
    for _ in range(data.draw(st.integers(1, 20))):
        at = data.draw(st.integers(0, len(bad) - 1))
        piece = data.draw(st.binary(min_size=1, max_size=12))
        bad[at : at + len(piece)] = piece
    try:
        log = read(bytes(bad), tmp_path_factory.getbasetemp(), "damaged.bin")
    except HilError as error:
        assert "damaged.bin" in str(error)  # noqa: PT017
        return
    assert (np.diff(log.time_us) > 0).all()
    assert (np.diff(log.counter) > 0).all()
    assert (np.abs(log.rate) * log.step_us[:, None] * 1e-6 < 0.5).all()
    assert (np.abs(log.force) * log.step_us[:, None] * 1e-6 < 32.0).all()
    assert np.isfinite(log.aiding["value"]).all()
    assert np.isfinite(log.attitude).all()
    assert (np.diff(log.arrival_us) >= 0).all()


DAMAGED = new_log(3)


def test_nothing_is_printed(tmp_path, capfd):
    """The reader's own complaints would spoil ``--json``."""
    whole = bytearray(new_log(3))
    whole[2000:2600] = bytes(600)
    read(bytes(whole), tmp_path)
    assert capfd.readouterr() == ("", "")


def test_a_real_flight(hil_data):
    """A quadcopter whose board counts 335 s where the receiver counts 363 (see `CLOCK_TOLERANCE`)."""
    path = hil_data / "ardupilot_copter.bin"
    if not path.is_file():
        pytest.skip(f"no {path}")
    log = read_dataflash(path, lambda lat, lon: GEOID_M)
    fixes, _ = of(log, Kind.GNSS)
    # The receiver says a fix every 0.2 s
    assert (fixes["time"][-1] - fixes["time"][0]) / (len(fixes) - 1) == pytest.approx(0.2, rel=1e-3)
    # Its velocity is the change of its position
    step = np.diff(fixes["time"])
    north = np.diff(fixes["value"][:, 0]) * 6.37e6
    way = 0.5 * (fixes["value"][1:, 3] + fixes["value"][:-1, 3]) * step
    assert np.corrcoef(north, way)[0, 1] > 0.9
    # Up is where the autopilot says: axes of the unit are forward, right, down
    w, x, y, z = log.attitude.T
    down = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z], axis=1)
    k = np.searchsorted(log.time_us, log.attitude_us).clip(0, len(log.time_us) - 1)
    assert np.mean(np.sum(-log.force[k] * down, axis=1)) == pytest.approx(9.8, rel=0.03)
    assert {Kind(kind).name for kind in np.unique(log.aiding["kind"])} == {"GNSS", "BARO", "MAGNETIC"}
    assert math.degrees(log.place[0]) == pytest.approx(42.85, abs=0.01)
