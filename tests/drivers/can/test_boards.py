"""Boards on classic CAN against their emulators: what arrives is what was sent but for the board's own rounding.

Every fault of a wire is counted to the sample.
"""

import math
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from itertools import pairwise, permutations
from pathlib import Path

import cantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drivers import driver_names, emulator_names, make_driver, make_emulator
from drivers.can.emulation import EndRates
from drivers.can.frames import EFF, ERR, FDF, RTR, frames
from drivers.can.j1939 import J1939Imu
from drivers.can.j1939_emulator import J1939Emulator
from drivers.can.samples import LEARN, LEARN_LONG, SLOWER
from drivers.can.sbg_emulator import SbgEmulator
from drivers.can.xsens import Xsens, rotation_vector
from drivers.can.xsens_emulator import XsensEmulator
from nav.errors import HilError
from nav.increments import ImuIncrements, Validity

FIXTURES = Path(__file__).parents[3] / "fixtures" / "can"
SET_CLOCK = LEARN + 1
"""Samples at the start of a board's life that only set its clock."""


@dataclass(frozen=True)
class Board:
    """How a board rounds: one step of its rates (rad/s) and of its specific force (m/s^2); which frames of a sample matter."""

    period_us: int
    rate_step: float
    force_step: float
    inertial: tuple[int, ...]

    @property
    def period(self) -> float:
        return 1e-6 * self.period_us


BOARDS = {
    "sbg": Board(10_000, 1e-3, 1e-2, (0, 1, 2)),
    "xsens-can": Board(2_500, 2.0**-9, 2.0**-17 / 2.5e-3, (0, 3, 4)),
    "j1939-imu": Board(10_000, math.radians(1.0 / 128.0), 1e-2, (0, 1)),
}
boards = pytest.mark.parametrize("name", BOARDS)
with_clock = pytest.mark.parametrize("name", ["sbg", "xsens-can"])
_driver, _emulator = cache(make_driver), cache(lambda name: make_emulator(name, BOARDS[name].period_us))
"""Reading a message set takes longer than a test: fresh ones are copies of these."""


def driver_of(name):
    return deepcopy(_driver(name))


def smooth(n, period, first=0):
    """Exact increments of a shaken vehicle, samples `first` to `first` + n: sines of half a hertz, integrated in closed form."""
    edges = period * np.arange(first, first + n + 1)
    w = 2.0 * np.pi * np.array([0.5, 0.4, 0.3, 0.5, 0.4, 0.3])
    size = np.array([0.3, 0.2, 0.4, 2.0, 1.0, 1.5])
    mean = np.array([0.02, -0.03, 0.05, 0.3, -0.2, -9.81])
    change = np.diff(edges[:, None] * mean - size / w * np.cos(edges[:, None] * w), axis=0)
    step = np.full(n, period)
    return ImuIncrements(
        edges[1:], step, change[:, :3], change[:, 3:], np.zeros(n, np.int64), np.arange(first, first + n)
    )


def sent(name, n, first=0):
    """Frames of n samples, a row a sample."""
    batch = deepcopy(_emulator(name)).samples(smooth(n, BOARDS[name].period, first))
    return batch.reshape(n, -1)


def fed(driver, batch, cuts=()):
    """All samples out of `batch`, handed over in pieces, as columns; arrivals among them."""
    batch = batch.reshape(-1)
    edges = [0, *sorted(min(cut, len(batch)) for cut in cuts), len(batch)]
    columns = {field: [] for field in (*ImuIncrements.__dataclass_fields__, "arrival")}
    for start, stop in pairwise(edges):
        result = driver.decode(batch[start:stop])
        for field in ImuIncrements.__dataclass_fields__:
            columns[field].append(getattr(result, field).copy())
        columns["arrival"].append(driver.arrivals().copy())
    return {field: np.concatenate(values) for field, values in columns.items()}


def numbers(out, name):
    """Which of the samples sent these are, by their time."""
    return np.rint(out["time"] / BOARDS[name].period).astype(int) - 1


def assert_same(one, other):
    for field, values in one.items():
        np.testing.assert_array_equal(values, other[field], err_msg=field)


def faults(driver):
    return {
        field: count
        for field, count in driver.counters.as_dict().items()
        if count and field not in {"frames", "samples"}
    }


def test_boards_are_installed():
    assert set(BOARDS) <= set(driver_names())
    assert set(BOARDS) <= set(emulator_names())


@boards
def test_round_trip(name):
    board, n = BOARDS[name], 300
    truth, batch = smooth(n, board.period), sent(name, n)
    driver = driver_of(name)
    out = fed(driver, batch)
    assert faults(driver) == {}
    assert numbers(out, name).tolist() == list(range(SET_CLOCK, n))
    assert driver.period_s == pytest.approx(board.period)
    np.testing.assert_allclose(out["step"], board.period, rtol=1e-9)
    np.testing.assert_array_equal(np.diff(out["sequence"]), 1)
    np.testing.assert_array_equal(out["arrival"], batch["time_ns"][SET_CLOCK:, -1])
    assert not out["validity"].any()
    # What the board could say of the motion: the mean of both ends of each step where it sends rates
    ends = EndRates().rates(truth)
    mean = 0.5 * board.period * (ends[1:] + ends[:-1])[SET_CLOCK - 1 :]
    force = truth.dvel[SET_CLOCK:] if name == "xsens-can" else mean[:, 3:]
    assert np.abs(out["dtheta"] - mean[:, :3]).max() <= 0.5001 * board.rate_step * board.period
    assert np.abs(out["dvel"] - force).max() <= 0.5001 * board.force_step * board.period


def test_ends_of_rates_have_no_delay():
    """The trapezoid of the emulated end rates errs by the third power of the step: half the step, an eighth of the error."""

    def error(step):
        truth = smooth(round(4.0 / step), step)
        ends = EndRates().rates(truth)[1:]
        return np.abs(0.5 * step * (ends[1:] + ends[:-1]) - np.hstack([truth.dtheta, truth.dvel])[2:]).max()

    assert error(0.02) / error(0.01) == pytest.approx(8.0, rel=0.05)
    pieces, truth = EndRates(), smooth(90, 0.01)
    joined = np.vstack([pieces.rates(truth.rows(i, i + 30)) for i in range(0, 90, 30)])
    np.testing.assert_array_equal(joined, EndRates().rates(truth))


def decoded(file, batch):
    """What cantools reads out of the frames, by message name."""
    database = cantools.database.load_file(file, encoding="cp1252")
    said = {}
    for row in batch.reshape(-1):
        can_id = int(row["can_id"])
        if file.name.startswith("j1939"):
            can_id = can_id & 0xFFFFFF00 | 0xFE
        message = database.get_message_by_frame_id(can_id & 0x1FFFFFFF)
        assert message.is_extended_frame == bool(can_id & EFF)
        assert message.length == row["length"]
        said.setdefault(message.name, []).append(message.decode(bytes(row["data"][: row["length"]])))
    return {name: {key: np.array([row[key] for row in rows]) for key in rows[0]} for name, rows in said.items()}


def test_sbg_frames_by_the_vendors_database(hil_data):
    assert (hil_data / "sbgCan.dbc").read_bytes() == (FIXTURES / "sbgCan.dbc").read_bytes()
    truth, batch = smooth(50, 0.01), sent("sbg", 50)
    said = decoded(hil_data / "sbgCan.dbc", batch)
    assert [*said] == [f"SBG_ECAN_MSG_IMU_{part}" for part in ("INFO", "ACCEL", "GYRO")]
    info, accel, gyro = said.values()
    np.testing.assert_array_equal(info["TIME_STAMP"], 10_000 * np.arange(1, 51))
    ends = EndRates().rates(truth)
    for i, axis in enumerate("XYZ"):  # forward, right, down as ours
        np.testing.assert_allclose(gyro[f"GYRO_{axis}"], ends[:, i], atol=0.5001e-3)
        np.testing.assert_allclose(accel[f"ACCEL_{axis}"], ends[:, 3 + i], atol=0.5001e-2)


def test_xsens_frames_by_cantools():
    """Forward, left, up: what turns right, and what is pushed up against gravity, has the other sign of ours."""
    truth = smooth(50, 2.5e-3)
    emulator = XsensEmulator(2500, ("DeltaV", "RateOfTurn", "DeltaQ", "Acceleration"))
    said = decoded(FIXTURES / "xsens_mti600.dbc", emulator.samples(truth))
    ends, signs = EndRates().rates(truth), (1.0, -1.0, -1.0)
    np.testing.assert_array_equal(said["XCID_SampleTime"]["ticks"], 25 * np.arange(1, 51))
    np.testing.assert_array_equal(said["XCID_GroupCounter"]["counter"], np.arange(50))
    assert set(said["XCDI_DeltaV"]["exponent"]) == {17}  # the vendor's table at 400 Hz
    for i, axis in enumerate("xyz"):
        np.testing.assert_allclose(said["XCDI_RateOfTurn"][axis], signs[i] * ends[:, i], atol=0.5001 * 2**-9)
        np.testing.assert_allclose(said["XCDI_Acceleration"][axis], signs[i] * ends[:, 3 + i], atol=0.5001 * 2**-8)
        np.testing.assert_allclose(said["XCDI_DeltaV"][axis], signs[i] * truth.dvel[:, i] * 2**17, atol=0.5001)
    q = Rotation.from_rotvec(truth.dtheta * signs).as_quat(scalar_first=True)
    for i in range(4):
        np.testing.assert_allclose(said["XCDI_DeltaQ"][f"q{i}"], q[:, i], atol=0.5001 / 32767)


def test_j1939_frames_by_cantools():
    """Accelerations forward, left, up; rates about forward, right, down."""
    truth = smooth(50, 0.01)
    batch = J1939Emulator(10_000, source=0x17).samples(truth)
    assert set(batch["can_id"] & 0xFF) == {0x17}
    assert set(batch["can_id"] >> 26 & 7) == {3}
    said, ends = decoded(FIXTURES / "j1939_imu.dbc", batch), EndRates().rates(truth)
    for i, axis in enumerate(("roll", "pitch", "yaw")):
        np.testing.assert_allclose(said["ARI"][f"{axis}_rate"], np.degrees(ends[:, i]), atol=0.5001 / 128)
    for i, (axis, sign) in enumerate((("longitudinal", 1), ("lateral", -1), ("vertical", -1))):
        np.testing.assert_allclose(said["ACCS"][axis], sign * ends[:, 3 + i], atol=0.005001)


def test_j1939_values_as_a_makers_manual_prints_them():
    """Frames printed in the manual of the Honeywell TARS-LCASS: no rate, one g upwards, from address 0xE2."""
    row = frames(2)
    row["can_id"], row["length"] = [0x0CF02AE2 | EFF, 0x0CF02DE2 | EFF], 8
    row["data"][:, :8] = [list(bytes.fromhex("007D007D007D0005")), list(bytes.fromhex("007D007DD5800005"))]
    batch = np.concatenate([row] * (SET_CLOCK + 1))
    batch["time_ns"] = np.repeat(10_000_000 * np.arange(1, SET_CLOCK + 2), 2)
    driver = J1939Imu()
    out = fed(driver, batch)
    assert driver.identity()["source_address"] == 0xE2
    np.testing.assert_array_equal(out["dtheta"], [[0.0, 0.0, 0.0]])
    np.testing.assert_allclose(out["dvel"] / 0.01, [[0.0, 0.0, -9.81]], atol=0.005)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from([*BOARDS]), st.data())
def test_lost_frames_are_counted_to_the_sample(name, data):
    """A sample arrives when none of its frames is lost, is never made of two, and the rest is missing by number."""
    board, n = BOARDS[name], 70
    batch = sent(name, n)
    places = st.tuples(st.integers(SET_CLOCK + 2, n - 1), st.sampled_from(board.inertial))
    gone = data.draw(st.sets(places, max_size=40))
    keep = np.ones(batch.shape, bool)
    for place in gone:
        keep[place] = False
    cuts = data.draw(st.lists(st.integers(0, batch.size), max_size=6))
    driver, other = driver_of(name), driver_of(name)
    out = fed(driver, batch[keep])
    assert_same(out, fed(other, batch[keep], cuts))
    assert driver.counters == other.counters
    expected = sorted(set(range(SET_CLOCK, n)) - {k for k, _ in gone})
    assert numbers(out, name).tolist() == expected
    assert faults(driver).keys() <= {"lost", "duplicated"}
    assert driver.counters.samples + driver.counters.lost == expected[-1] - SET_CLOCK + 1
    assert driver.counters.samples == len(expected)
    # After a gap a sample covers one period, and its rate is that at its end
    np.testing.assert_allclose(out["step"], board.period, rtol=1e-9)
    clean = fed(driver_of(name), batch)
    whole = np.diff(expected, prepend=expected[0] - 1) == 1
    rows = np.array(expected) - SET_CLOCK
    np.testing.assert_array_equal(out["dtheta"][whole], clean["dtheta"][rows[whole]])
    np.testing.assert_array_equal(out["dvel"][whole], clean["dvel"][rows[whole]])
    ends = EndRates().rates(smooth(n, board.period))[expected] * board.period
    assert np.abs(out["dtheta"] - ends[:, :3])[~whole].max(initial=0.0) <= 0.5001 * board.rate_step * board.period


@with_clock
def test_late_and_repeated_samples(name):
    batch = sent(name, 60)
    order = [*range(20), 21, 20, 22, 23, 21, *range(25, 30), 22, *range(30, 60), 5]
    driver = driver_of(name)
    out = fed(driver, batch[order])
    assert numbers(out, name).tolist() == sorted(set(range(SET_CLOCK, 60)) - {20, 24})
    count = driver.counters
    assert (count.lost, count.late, count.restarts) == (1, 1, 0)
    assert count.duplicated == 3  # 21 and 22 again, and 5 from before the first, which was never counted as lost
    assert count.samples + count.lost + count.late == 60 - SET_CLOCK


@boards
def test_a_frame_that_comes_twice_makes_no_other_sample(name):
    batch = sent(name, 40)
    columns = [0, *range(batch.shape[1])] if name == "j1939-imu" else np.repeat(np.arange(batch.shape[1]), 2)
    driver = driver_of(name)
    out = fed(driver, batch[:, columns])
    clean = fed(driver_of(name), batch)
    np.testing.assert_array_equal(out["dtheta"], clean["dtheta"])
    np.testing.assert_array_equal(out["dvel"], clean["dvel"])
    if name != "j1939-imu":
        # The status word says what holds from then on, and may be said as often as the board likes
        repeated = batch.shape[1] - (name == "xsens-can")
        assert faults(driver) == {"duplicated": repeated * 40}


@with_clock
def test_a_board_that_starts_anew(name):
    """Time begins again: the clock is set once more, and no step spans the restart."""
    board, driver = BOARDS[name], driver_of(name)
    out = fed(driver, np.concatenate([sent(name, 150, first=5000), sent(name, 50)]))
    assert driver.counters.restarts == 1
    assert driver.counters.lost == 0
    found = numbers(out, name).tolist()
    assert found == [*range(5000 + SET_CLOCK, 5150), *range(SET_CLOCK, 50)]
    jump = 150 - SET_CLOCK
    assert out["sequence"][jump] - out["sequence"][jump - 1] != 1
    np.testing.assert_allclose(out["step"], board.period, rtol=1e-9)


def test_the_clocks_wrap():
    """32 bits of us, 32 bits of 100 us, and the 16 bits of the counter."""
    first = 2**32 // 10_000 - 30
    driver = driver_of("sbg")
    out = fed(driver, sent("sbg", 60, first))
    np.testing.assert_array_equal(np.diff(numbers(out, "sbg")), 1)
    assert (len(out["time"]), faults(driver)) == (60 - SET_CLOCK, {})
    for first in (2**16 - 30, 2**32 // 25 - 30):
        driver = driver_of("xsens-can")
        out = fed(driver, sent("xsens-can", 60, first))
        np.testing.assert_array_equal(np.diff(numbers(out, "xsens-can")), 1)
        assert (len(out["time"]), faults(driver)) == (60 - SET_CLOCK, {})


def test_the_counter_counts_where_the_clock_is_coarse():
    """A period that is no whole number of ticks: over a long gap the clock alone is one or more out, the counter never."""
    n, gap = 600, slice(100, 500)
    truth = smooth(n, 1.0 / 60.0)
    time = np.floor(np.arange(1, n + 1) * 1e4 / 60.0) * 1e-4
    imu = ImuIncrements(time, truth.step, truth.dtheta, truth.dvel, truth.validity, truth.sequence)
    batch = XsensEmulator(16_600).samples(imu).reshape(n, -1)
    batch = np.delete(batch, gap, axis=0)
    counted, timed = driver_of("xsens-can"), driver_of("xsens-can")
    out = fed(counted, batch)
    fed(timed, np.delete(batch, 1, axis=1))  # the counter switched off
    assert faults(counted) == {"lost": 400}
    assert faults(timed).keys() == {"lost"}
    assert 0 < abs(timed.counters.lost - 400) < 4
    np.testing.assert_allclose(out["time"], np.delete(time, gap)[SET_CLOCK:], atol=1e-9)


def test_a_long_silence_is_a_restart():
    batch = np.concatenate([sent("sbg", 30), sent("sbg", 30, first=30 + 6001)])
    driver = driver_of("sbg")
    fed(driver, batch)
    assert faults(driver) == {"restarts": 1}
    driver = driver_of("sbg")
    fed(driver, np.concatenate([sent("sbg", 30), sent("sbg", 30, first=30 + 5990)]))
    assert faults(driver) == {"lost": 5990}


@pytest.mark.parametrize("times", [2, 3])
@pytest.mark.parametrize("name", ["sbg", "xsens-can", "xsens-can without its counter", "j1939-imu"])
def test_another_rate_is_learnt(name, times):
    """A board that is set to a half or a third of its rate loses nothing from then on; a counter tells it from lost samples."""
    name, *without = name.split(" without ")
    fast, slow = sent(name, 60), sent(name, 60 + 60 * times)[60 + times - 1 :: times]
    batch = np.concatenate([fast, slow])
    counted = name == "xsens-can" and not without
    if name == "xsens-can":
        lossy = driver_of(name)
        fed(lossy, batch)
        assert faults(lossy) == {"lost": 60 * (times - 1)}
        batch["data"][60:, 1, 0], batch["data"][60:, 1, 1] = 0, np.arange(60, 120)
        batch = batch if counted else np.delete(batch, 1, axis=1)
    driver = driver_of(name)
    out = fed(driver, batch)
    at_first = {"clock_steps": SLOWER - 1} if counted else {"lost": (SLOWER - 1) * (times - 1)}
    assert faults(driver) == {"restarts": 1} | at_first
    assert len(out["time"]) == 120 - 2 * SET_CLOCK
    np.testing.assert_allclose(out["step"][-20:], times * BOARDS[name].period, rtol=1e-9)


@pytest.mark.parametrize(("one", "other"), [*permutations(BOARDS, 2)])
def test_frames_of_other_boards_are_foreign(one, other):
    mine, theirs = sent(one, 40), sent(other, 40)
    driver = driver_of(one)
    out = fed(driver, np.concatenate([mine, theirs], axis=1))
    assert_same(out, fed(driver_of(one), mine))
    assert faults(driver) == {"foreign": theirs.size}


@boards
def test_flags_and_lengths(name):
    batch = sent(name, 12)
    bad = np.concatenate([batch[0, :1]] * 6)
    bad["can_id"][:3] = [bad["can_id"][0] ^ EFF, bad["can_id"][0] | RTR, bad["can_id"][0] | ERR]
    bad["length"][3:5] = [0, 5]
    bad["flags"][5] = FDF
    driver = driver_of(name)
    out = fed(driver, np.concatenate([batch.reshape(-1), bad]))
    assert len(out["time"]) == 12 - SET_CLOCK
    assert faults(driver) == {"foreign": 3, "short": 3}


def test_the_boards_other_messages_are_no_strangers():
    row = frames(2)
    row["can_id"], row["length"] = [0x132, 0x171], 6  # attitude, velocity of the receiver
    driver = driver_of("sbg")
    driver.decode(row)
    assert faults(driver) == {}


@settings(max_examples=120, deadline=None)
@given(st.sampled_from([*BOARDS]), st.data())
def test_whatever_comes_nothing_breaks(name, data):
    """Frames in any order, cut, garbled, at any time: no crash, only finite increments, and batches do not matter."""
    batch = sent(name, 30).reshape(-1)
    places = st.integers(0, len(batch) - 1)
    batch = batch[data.draw(st.lists(places, min_size=1, max_size=150))].copy() if data.draw(st.booleans()) else batch
    for _ in range(data.draw(st.integers(0, 12))):
        at = data.draw(places) % len(batch)
        batch["data"][at, data.draw(st.integers(0, 7))] ^= data.draw(st.integers(1, 255))
        batch["length"][at] = data.draw(st.sampled_from([batch["length"][at], 0, 3, 8]))
        batch["time_ns"][at] = data.draw(st.integers(0, 2**62))
    cuts = data.draw(st.lists(st.integers(0, len(batch)), max_size=8))
    driver, other = driver_of(name), driver_of(name)
    out = fed(driver, batch)
    assert_same(out, fed(other, batch, cuts))
    assert driver.counters == other.counters
    assert driver.identity() == other.identity()
    for field in ("time", "step", "dtheta", "dvel"):
        assert np.isfinite(out[field]).all()
    assert (out["step"] > 0.0).all()
    assert driver.counters.frames == len(batch)
    assert driver.counters.samples == len(out["time"])


def test_sbg_increments_are_preferred():
    """The means over the sample where they come; the rates beside them are not used."""
    truth = smooth(80, 0.01)
    means = SbgEmulator(10_000, "deltas").samples(truth).reshape(80, 3)
    wrong = sent("sbg", 80, first=500)[:, 1:]
    wrong["time_ns"] = means["time_ns"][:, 1:] + 200_000
    both = np.concatenate([means[:, :1], wrong, means[:, 1:]], axis=1)
    for batch, first in ((means, SET_CLOCK), (both, SET_CLOCK)):
        driver = driver_of("sbg")
        out = fed(driver, batch)
        assert faults(driver) == {}
        assert numbers(out, "sbg").tolist() == list(range(first, 80))
        assert np.abs(out["dtheta"] - truth.dtheta[first:]).max() <= 0.5001e-3 * 0.01
        assert np.abs(out["dvel"] - truth.dvel[first:]).max() <= 0.5001e-2 * 0.01


def test_a_message_that_is_switched_off_is_not_waited_for():
    batch = sent("sbg", 40)
    extra = SbgEmulator(10_000, "deltas").samples(smooth(40, 0.01)).reshape(40, 3)
    both = np.concatenate([batch[:20], extra[:20, 1:]], axis=1)
    driver = driver_of("sbg")
    out = fed(driver, np.concatenate([both.reshape(-1), batch[20:].reshape(-1)]))
    # Two samples are missed before the increments are known to be off
    assert numbers(out, "sbg").tolist() == [*range(SET_CLOCK, 20), *range(22, 40)]


@pytest.mark.parametrize(
    ("messages", "turn", "push"),
    [
        (("DeltaV", "DeltaQ"), "quaternion", "increment"),
        (("Acceleration", "RateOfTurn"), "rate", "rate"),
        (("DeltaV", "DeltaQ", "Acceleration", "RateOfTurn"), "rate", "increment"),
    ],
)
def test_xsens_sources(messages, turn, push):
    truth = smooth(80, 2.5e-3)
    driver = driver_of("xsens-can")
    out = fed(driver, XsensEmulator(2500, messages).samples(truth))
    assert faults(driver) == {}
    ends = EndRates().rates(truth)
    mean = 0.5 * 2.5e-3 * (ends[1:] + ends[:-1])[SET_CLOCK - 1 :]
    if turn == "rate":
        assert np.abs(out["dtheta"] - mean[:, :3]).max() <= 0.5001 * 2**-9 * 2.5e-3
    else:  # a step of the quaternion is twice as much of an angle; its scalar part is a step below one at most
        assert np.abs(out["dtheta"] - truth.dtheta[SET_CLOCK:]).max() <= 1.01 / 32767
    if push == "rate":
        assert np.abs(out["dvel"] - mean[:, 3:]).max() <= 0.5001 * 2**-8 * 2.5e-3
    else:
        assert np.abs(out["dvel"] - truth.dvel[SET_CLOCK:]).max() <= 0.5001 * 2**-17


@given(st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3), st.sampled_from([-1.0, 0.5, 1.0]))
def test_rotation_vectors_are_those_of_scipy(vector, scale):
    """Of either sign and of any length."""
    if math.hypot(*vector) > 3.1:
        return
    q = Rotation.from_rotvec(vector).as_quat(scalar_first=True)
    np.testing.assert_allclose(rotation_vector(scale * q[None])[0], vector, atol=1e-12)


MESSAGES = [
    ("sbg", 0, "IMU_INFO"),
    ("sbg", 1, "IMU_ACCEL"),
    ("sbg", 2, "IMU_GYRO"),
    ("xsens-can", 0, "SampleTime"),
    ("xsens-can", 3, "DeltaV"),
    ("xsens-can", 4, "RateOfTurn"),
    ("j1939-imu", 0, "PGN 61482 (rates)"),
    ("j1939-imu", 1, "PGN 61485 (accelerations)"),
]


@pytest.mark.parametrize("begins", [0, 50])
@pytest.mark.parametrize(("name", "column", "message"), MESSAGES)
def test_a_message_that_does_not_come_is_named(name, column, message, begins):
    """Switched off from the start or from the sample `begins` on: told after 3 s, each frame counted, however they are cut."""
    n = round(4.0 / BOARDS[name].period)
    batch = sent(name, begins + n)
    keep = np.ones(batch.shape, bool)
    keep[begins:, column] = False
    batch, status = batch[keep], xsens_status(batch[keep])
    start, soon = begins * keep.shape[1], begins * keep.shape[1] + 2 * (n // 3)
    driver, other = driver_of(name), driver_of(name)
    driver.decode(batch[:soon])
    assert driver.lacking() == ""
    driver.decode(batch[soon:])
    assert driver.lacking() == f"{message} does not come: switch it on"
    assert abs(driver.counters.short - np.count_nonzero(~status[start:])) <= keep.shape[1]
    fed(other, batch, range(0, len(batch), 3))
    assert (driver.counters, driver.lacking()) == (other.counters, other.lacking())
    driver.decode(sent(name, begins + n + 4, first=0)[-4:].reshape(-1))
    assert driver.lacking() == ""


@pytest.mark.parametrize("name", ["sbg", "xsens-can"])
def test_a_frame_that_comes_twice_is_counted_once(name):
    """The opening message and its repetition, nothing else: one is of no use, the other a duplicate."""
    batch = np.repeat(sent(name, round(4.0 / BOARDS[name].period))[:, :1], 2, axis=1)
    driver = driver_of(name)
    for row in batch:
        driver.decode(row)
    assert driver.lacking() != ""
    assert faults(driver) == {"duplicated": len(batch), "short": len(batch)}


def xsens_status(batch):
    """Which frames are of no sample alone."""
    return batch["can_id"] == 0x011


def test_a_message_without_values_is_named():
    batch = sent("j1939-imu", 400)
    batch["data"][:, 0, :2] = 0xFF
    driver = driver_of("j1939-imu")
    assert len(fed(driver, batch)["time"]) == 0
    assert driver.lacking().startswith("PGN 61482 (rates): every frame says that its values are not available")
    assert faults(driver) == {"short": batch.size}


@pytest.mark.parametrize("apart_us", [0, 70, 5000])
def test_two_boards_of_the_same_identifiers_are_told(apart_us):
    """Whether their frames come mixed or in turn."""
    one, other = sent("sbg", 500), sent("sbg", 500, first=70_037)
    other["time_ns"] = one["time_ns"] + 1000 * apart_us
    both = np.concatenate([one.reshape(-1), other.reshape(-1)])
    driver = driver_of("sbg")
    fed(driver, both[np.argsort(both["time_ns"], kind="stable")])
    assert "do two" in driver.lacking()
    assert driver.counters.short + driver.counters.restarts > 100


def test_a_damaged_exponent_is_dropped():
    batch = sent("xsens-can", 30)
    batch["data"][20, 3, 6] = 200
    driver = driver_of("xsens-can")
    out = fed(driver, batch)
    assert faults(driver) == {"short": 1, "lost": 1}
    assert 20 not in numbers(out, "xsens-can")


@with_clock
def test_what_the_board_says_of_itself_flags_its_samples(name):
    """A turn and a push beyond the range of the wire: held at its end, said in the status, flagged in the sample."""
    board, n = BOARDS[name], 40
    truth = smooth(n, board.period)
    truth.dtheta[20:22] += 70.0 * board.period
    truth.dvel[30:32] -= 400.0 * board.period
    driver = driver_of(name)
    out = fed(driver, deepcopy(_emulator(name)).samples(truth))
    flagged = numbers(out, name)[out["validity"] == Validity.SENSOR].tolist()
    assert {20, 21, 30, 31} <= set(flagged) <= {20, 21, 22, 30, 31, 32}
    assert np.abs(out["dtheta"]).max() <= 64.0 * board.period
    assert driver.identity()["temperature"] == 35.0 if name == "sbg" else "status" in driver.identity()


def test_temperature_and_failed_self_test_of_the_mti():
    emulator, driver = XsensEmulator(2500), Xsens()
    driver.decode(emulator.slow())
    assert driver.identity() == {"temperature": 35.0}
    batch = emulator.samples(smooth(30, 2.5e-3)).reshape(30, -1)
    batch["data"][15:, 2, :4] = 0  # the status word without its first bit
    out = fed(driver, batch)
    np.testing.assert_array_equal(out["validity"], np.where(numbers(out, "xsens-can") >= 15, Validity.SENSOR, 0))


def test_two_nodes_are_kept_apart():
    first, second = (
        J1939Emulator(10_000, source).samples(smooth(40, 0.01, at)) for source, at in ((0x10, 0), (0x20, 900))
    )
    second["time_ns"] = first["time_ns"] + 70_000
    both = np.column_stack([first, second]).reshape(-1)
    heard, chosen = J1939Imu(), make_driver("j1939-imu@0x20")
    assert_same(fed(heard, both), fed(J1939Imu(), first))
    assert_same(fed(chosen, both), fed(J1939Imu("32"), second))
    assert faults(heard) == faults(chosen) == {"foreign": 80}
    assert (heard.identity()["source_address"], chosen.identity()["source_address"]) == (0x10, 0x20)


def test_the_priority_does_not_matter():
    batch = sent("j1939-imu", 30)
    other = batch.copy()
    other["can_id"] = other["can_id"] & ~np.uint32(7 << 26) | np.uint32(6 << 26)
    assert_same(fed(driver_of("j1939-imu"), batch), fed(driver_of("j1939-imu"), other))


@pytest.mark.parametrize("raw", [0xFB00, 0xFE00, 0xFEFF, 0xFF00, 0xFFFF])
@pytest.mark.parametrize("frame", [0, 1])
def test_values_that_are_errors_or_not_available_are_not_used(raw, frame):
    batch = sent("j1939-imu", 40)
    batch["data"][20, frame, 2:4] = raw & 0xFF, raw >> 8
    batch["data"][25, frame, 6] = 0b10 << 2  # figure of merit of the middle value: error
    batch["data"][28, frame, 6] = 0b01 << 2  # degraded: used, and flagged
    batch["data"][33, frame, 6] = 0b111111  # says nothing
    driver = driver_of("j1939-imu")
    out = fed(driver, batch)
    assert numbers(out, "j1939-imu").tolist() == sorted(set(range(SET_CLOCK, 40)) - {20, 25})
    assert driver.identity()["unavailable"] == 2
    assert faults(driver) == {"lost": 2}
    assert numbers(out, "j1939-imu")[out["validity"] == Validity.SENSOR].tolist() == [28]


def test_slope_is_shown():
    row = frames(1)
    row["can_id"], row["length"] = 0x0CF029E2 | EFF, 8
    counts = round((3.5 + 250) * 32768), round((-1.25 + 250) * 32768)
    row["data"][0, :8] = [*counts[0].to_bytes(3, "little"), *counts[1].to_bytes(3, "little"), 0, 10]
    batch = np.concatenate([sent("j1939-imu", 30).reshape(-1), row])
    driver = driver_of("j1939-imu")
    fed(driver, batch)
    assert (driver.identity()["pitch_deg"], driver.identity()["roll_deg"]) == (3.5, -1.25)
    row["data"][0, :3] = 0xFF
    driver.decode(row)
    assert driver.identity()["pitch_deg"] is None
    assert faults(driver) == {}


def test_rates_about_an_axis_up():
    batch = sent("j1939-imu", 30)
    usual, up = fed(driver_of("j1939-imu"), batch), fed(make_driver("j1939-imu@z-up"), batch)
    np.testing.assert_array_equal(up["dtheta"], usual["dtheta"] * [1.0, -1.0, -1.0])
    np.testing.assert_array_equal(up["dvel"], usual["dvel"])


def test_frames_that_are_held_up_are_not_lost():
    """A host that stalls for three periods hands over all at once: what was taken for lost came late, and time is right again."""
    batch = sent("j1939-imu", 60)
    batch["time_ns"][30:33] = batch["time_ns"][33, 0] - 1_000_000 + np.arange(6).reshape(3, 2) * 1000
    driver = driver_of("j1939-imu")
    out = fed(driver, batch)
    count = driver.counters
    assert (count.samples + count.late, count.lost) == (60 - SET_CLOCK, 0)
    assert count.late == 3
    assert numbers(out, "j1939-imu")[-1] == 59


@pytest.mark.parametrize("seed", range(5))
def test_arrivals_that_jitter_move_the_grid_only_slowly(seed):
    """Frames held up by 0 to 6 ms of 10: what is missing was left out, and no sample is late."""
    n, rng = 3000, np.random.default_rng(seed)
    batch = sent("j1939-imu", n)
    gone = np.flatnonzero(rng.uniform(size=n - LEARN_LONG - 2) < 0.02) + LEARN_LONG + 1
    batch["time_ns"] += rng.integers(0, 6_000_000, (n, 1))
    driver = driver_of("j1939-imu")
    out = fed(driver, np.delete(batch, gone, axis=0))
    assert faults(driver) == {"lost": len(gone)}
    found = numbers(out, "j1939-imu")
    assert found[0] <= LEARN_LONG + 1
    assert found.tolist() == sorted(set(range(found[0], n)) - {*gone.tolist()})


@pytest.mark.parametrize("jitter", [0.0, 0.5])
@pytest.mark.parametrize("rate_hz", [20.0, 33.0, 62.5, 80.0, 100.0, 125.0, 200.0])
def test_any_rate_of_a_board_without_a_clock_is_found(rate_hz, jitter):
    """On the grid or off it, with 2 % lost: a turn is as large as it was, none is invented or missed."""
    n, rng = 1500, np.random.default_rng(7)
    batch = np.concatenate([sent("j1939-imu", 1)] * n)
    start = np.arange(n) + rng.uniform(0.0, jitter, n)
    batch["time_ns"] = np.rint(1e9 / rate_hz * start)[:, None] + [0, 150_000]
    gone = np.flatnonzero(rng.uniform(size=n - 1) < 0.02)
    driver = driver_of("j1939-imu")
    out = fed(driver, np.delete(batch, gone, axis=0))
    first = n - round((out["time"][-1] - out["time"][0]) * rate_hz) - 1
    assert first < 120
    assert faults(driver) == {"lost": np.count_nonzero(gone > first)}
    np.testing.assert_allclose(out["step"][-1000:], 1.0 / rate_hz, rtol=5e-3)


@pytest.mark.parametrize(("step_s", "lost"), [(-0.5, 0), (-3.0, 0), (-200.0, 0), (0.5, 50)])
def test_the_hosts_clock_is_set(step_s, lost):
    """Back: nobody takes it for lost samples, time and period go on. Forward: it looks like a gap, and then all is well."""
    batch = sent("j1939-imu", 900)
    batch["time_ns"][300:] += round(1e9 * (step_s + 300.0))
    batch["time_ns"][:300] += 300_000_000_000
    driver = driver_of("j1939-imu")
    out = fed(driver, batch)
    assert faults(driver) == ({"lost": lost} if lost else {})
    assert driver.period_s == pytest.approx(0.01)
    assert numbers(out, "j1939-imu")[-1] == 899 + lost


@pytest.mark.parametrize("name", ["j1939-imu@0x17", "j1939-imu@z-up", "j1939-imu@23,z-up", "dronecan-imu@7"])
def test_an_emulated_board_is_the_one_that_its_driver_follows(name):
    """Address and axes behind the ``@`` are those of the other end too: nothing is foreign, every rate has its sign."""
    driver, truth = make_driver(name), smooth(60, 0.01)
    imu = driver.decode(make_emulator(name, 10_000).samples(truth))
    assert driver.counters.foreign == 0
    np.testing.assert_allclose(imu.dtheta, truth.dtheta[-len(imu) :], atol=0.01 * math.radians(1.0 / 128.0))


@pytest.mark.parametrize("option", ["254", "-1", "x", "1,2", "z-down"])
def test_wrong_options_are_refused(option):
    with pytest.raises(HilError, match=f"j1939-imu@{option}: give a source address"):
        make_driver(f"j1939-imu@{option}")


def test_boards_without_options_and_unknown_ones():
    with pytest.raises(HilError, match="'sbg' takes no option"):
        make_driver("sbg@3")
    with pytest.raises(HilError, match="'sbg' takes no option"):
        make_emulator("sbg@3", 10_000)
    with pytest.raises(HilError, match=r"no emulator of 'gyrotron'.*dtg-head.*sbg"):
        make_emulator("gyrotron", 10_000)
    for name, period_us in (("sbg", 500), ("xsens-can", 1000), ("xsens-can", 2550), ("j1939-imu", 2500)):
        with pytest.raises(HilError, match=f"no sample period of {period_us} us"):
            make_emulator(name, period_us)
