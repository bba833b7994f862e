"""The navigator's modes, and that nothing it says depends on how samples were batched."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nav.earth import RATE, normal_gravity
from nav.errors import HilError
from nav.gaps import GapPolicy
from nav.increments import ImuIncrements, Validity
from nav.navigator import Navigator, Settings
from nav.rotation import attitude_error
from nav.state import Health, Mode

LAT = math.radians(50.0)
HZ = 100
ATTITUDE = Rotation.from_euler("ZYX", [70, 3, -5], degrees=True)
Q = ATTITUDE.as_quat(scalar_first=True)
GYRO = Settings(lat=LAT, lon=0.6, height=100.0, align_s=2.0)
LEVEL = Settings(lat=LAT, lon=0.6, height=100.0, align_s=2.0, alignment="level", heading=math.radians(70))


def rest(seconds, first=0, noise=0.0, bias=(0.0, 0.0, 0.0), seed=0):
    """A board that stands on the Earth."""
    n = round(seconds * HZ)
    random = np.random.default_rng(seed)
    rate = ATTITUDE.inv().apply([RATE * math.cos(LAT), 0, -RATE * math.sin(LAT)]) + bias
    force = ATTITUDE.inv().apply([0, 0, -normal_gravity(math.sin(LAT), 100.0)])
    imu = ImuIncrements.empty(n)
    imu.sequence[:] = np.arange(first, first + n)
    imu.time[:] = (imu.sequence + 1) / HZ
    imu.step[:] = 1 / HZ
    imu.dtheta[:] = (rate + noise * random.normal(size=(n, 3))) / HZ
    imu.dvel[:] = (force + 100 * noise * random.normal(size=(n, 3))) / HZ
    return imu


def pick(imu, rows):
    return ImuIncrements(*(getattr(imu, name)[rows].copy() for name in ImuIncrements.__dataclass_fields__))


def texts(navigator):
    return [event.text for event in navigator.events()]


def aligned(choice=GYRO, **kwargs):
    navigator = Navigator(choice)
    navigator.process(rest(2.5, **kwargs))
    assert navigator.mode == Mode.NAVIGATE
    navigator.events()
    return navigator


def test_from_the_first_sample_to_navigation():
    navigator = Navigator(GYRO)
    assert navigator.mode == Mode.INIT
    rows = navigator.process(rest(4.0)).copy()
    assert len(rows) == 400
    assert set(rows["mode"][:199]) == {Mode.ALIGN}
    assert set(rows["mode"][199:]) == {Mode.NAVIGATE}
    assert (rows["lat"][:199] == LAT).all()
    assert not rows["vel_n"][:199].any()
    assert (np.diff(rows["progress"]) >= 0).all()
    assert rows["progress"][[0, 99, 399]] == pytest.approx([0.0, 0.5, 1.0])
    assert np.abs(attitude_error(rows["q_nb"][199:], np.tile(Q, (201, 1)))).max() < 1e-12
    np.testing.assert_allclose(rows["f_b"], np.tile(rows["f_b"][0], (400, 1)), atol=1e-12)
    assert not rows["health"].any()
    say = texts(navigator)
    assert say[0].startswith("aligning: stand still for 2 s")
    assert "aligned in 2.0 s: heading 70.000 pitch 3.000 roll -5.000 deg" in say[1]


def test_motion_delays_the_alignment_and_is_told():
    shaken = rest(6.0)
    shaken.dtheta[100:150] += 0.05 / HZ
    navigator = Navigator(GYRO)
    rows = navigator.process(shaken)
    first = int(np.argmax(rows["mode"] == Mode.NAVIGATE))
    assert 349 <= first <= 399
    assert (rows["health"] & Health.MOVING).any()
    assert not rows["health"][first:].any()
    assert any("the vehicle moves" in text for text in texts(navigator))


@pytest.mark.parametrize(("factor", "say"), [(1 / 9.80665, "0.10 g"), (32.0, "32.0")])
def test_wrong_units_are_named_and_never_navigated(factor, say):
    imu = rest(5.0)
    imu.dvel[:] *= factor
    navigator = Navigator(GYRO)
    rows = navigator.process(imu)
    assert set(rows["mode"]) == {Mode.ALIGN}
    assert rows["health"][-1] & Health.UNITS
    assert any(say in text for text in texts(navigator))


def test_a_consumer_board_is_told_to_give_a_heading_and_then_levels():
    bias = np.array([0.01, -0.02, 0.005])
    navigator = Navigator(GYRO)
    rows = navigator.process(rest(5.0, bias=bias))
    assert set(rows["mode"]) == {Mode.ALIGN}
    assert rows["health"][-1] & Health.RATE_TOO_SMALL
    assert any("heading_deg" in text for text in texts(navigator))
    navigator = Navigator(LEVEL)
    rows = navigator.process(rest(5.0, bias=bias))
    assert rows["mode"][-1] == Mode.NAVIGATE
    np.testing.assert_allclose(rows["gyro_bias"][-1], bias, atol=1e-12)
    assert np.abs(attitude_error(rows["q_nb"][-1], Q)).max() < 1e-9
    with pytest.raises(HilError, match="heading_deg"):
        Navigator(Settings(alignment="level"))


def test_silence_degrades_and_mends():
    navigator = aligned()
    before = navigator.process(rest(0.1, first=250))[-1].copy()
    row = navigator.silent()
    assert len(row) == 1
    assert row["mode"][0] == Mode.DEGRADED
    assert row["health"][0] & Health.SILENT
    for name in ("time", "sequence", "lat", "lon", "height", "vel_n", "q_nb"):
        np.testing.assert_array_equal(row[name][0], before[name])
    rows = navigator.process(rest(0.1, first=260))
    assert set(rows["mode"]) == {Mode.NAVIGATE}
    assert not rows["health"].any()
    assert [event for event in texts(navigator) if "silent" in event or "again" in event]


def test_ordered_alignment_keeps_the_place():
    navigator = aligned()
    navigator.realign(2.5, "ordered")
    rows = navigator.process(rest(3.0, first=250))
    assert rows["mode"][0] == Mode.ALIGN
    assert rows["mode"][-1] == Mode.NAVIGATE
    assert abs(rows["lat"][-1] - LAT) * 6.4e6 < 1e-3


@pytest.mark.parametrize(
    ("missing", "mode", "health"),
    [(5, Mode.NAVIGATE, 0), (50, Mode.DEGRADED, Health.BRIDGED), (1100, Mode.ALIGN, 0)],
)
def test_gaps_by_length(missing, mode, health):
    navigator = aligned()
    rows = navigator.process(rest(0.5, first=250 + missing))
    assert rows["mode"][-1] == mode
    assert rows["health"][-1] == health
    assert len(rows) == (50 if mode == Mode.ALIGN else 50 + missing)
    if mode != Mode.ALIGN:  # standing still, the bridge is right
        assert np.abs(attitude_error(rows["q_nb"][-1], Q)).max() < 1e-10
        np.testing.assert_array_equal(np.diff(rows["sequence"]), 1)


def test_a_bridged_gap_is_distrusted_until_the_next_alignment():
    navigator = aligned()
    navigator.process(rest(0.5, first=300))
    assert navigator.process(rest(5, first=350))["mode"][-1] == Mode.DEGRADED
    navigator.realign(9.0, "ordered")
    assert navigator.process(rest(3, first=850))["mode"][-1] == Mode.NAVIGATE


def test_the_sensors_own_flag():
    navigator = aligned()
    imu = rest(1.0, first=250)
    imu.validity[30:60] = Validity.SENSOR
    rows = navigator.process(imu)
    flagged = np.zeros(100, bool)
    flagged[30:60] = True
    np.testing.assert_array_equal(rows["mode"] == Mode.DEGRADED, flagged)
    np.testing.assert_array_equal((rows["health"] & Health.SENSOR) != 0, flagged)


def test_aligned_on_flagged_samples_is_degraded():
    imu = rest(3.0)
    imu.validity[:] = Validity.SENSOR
    rows = Navigator(GYRO).process(imu)
    assert set(rows["mode"][199:]) == {Mode.DEGRADED}
    assert rows["progress"][-1] == 1.0


def test_a_given_start():
    navigator = Navigator(Settings(position_trusted=False))
    navigator.begin(LAT, 0.6, 100.0, np.zeros(3), Q, 0.0)
    rows = navigator.process(rest(1.0))
    assert set(rows["mode"]) == {Mode.NAVIGATE}
    assert set(rows["health"]) == {Health.UNAIDED}
    assert np.abs(rows["vel_n"]).max() < 1e-9


@pytest.mark.parametrize("field", ["time", "step", "dtheta", "dvel"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_a_number_is_refused_by_its_number(field, value):
    navigator = aligned()
    imu = rest(0.1, first=250)
    getattr(imu, field)[7] = value
    with pytest.raises(HilError, match="257 is not a number"):
        navigator.process(imu)
    rows = navigator.process(rest(0.1, first=250))  # and the state was not touched
    assert np.abs(attitude_error(rows["q_nb"][-1], Q)).max() < 1e-10


def test_bias_is_tracked_at_rest_and_not_in_motion():
    choice = Settings(lat=LAT, alignment="level", heading=math.radians(70), align_s=2.0, track_bias_at_rest=True)
    navigator = aligned(choice)
    warm = np.array([1e-4, -2e-4, 5e-5])  # the board warms up
    rows = navigator.process(rest(60.0, first=250, bias=warm))
    np.testing.assert_allclose(rows["gyro_bias"][-1], warm, atol=3e-6)
    kept = navigator.gyro_bias.copy()
    navigator.process(rest(20.0, first=6250, bias=warm + np.array([0.0, 0.0, 0.05])))
    np.testing.assert_array_equal(navigator.gyro_bias, kept)
    still = aligned(LEVEL)
    still.process(rest(20.0, first=250, bias=warm))
    assert np.abs(still.gyro_bias).max() < 1e-12


def eventful(seed):
    """Six seconds with noise, motion, flags and gaps of each kind."""
    random = np.random.default_rng(seed)
    imu = rest(12.0, noise=1e-6, seed=seed)
    for _ in range(3):
        start = random.integers(0, 1100)
        imu.validity[start : start + random.integers(1, 60)] = Validity.SENSOR
    start = random.integers(0, 300)
    imu.dtheta[start : start + 40] += 0.05 / HZ
    kept = np.ones(len(imu), bool)
    for length in (1, 3, 8, 30, 90, 250):
        start = random.integers(0, 900)
        kept[start : start + length] = False
    return pick(imu, kept)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 1200), max_size=12), st.sampled_from([GYRO, LEVEL]))
def test_batches_do_not_matter(seed, cuts, choice):
    choice = Settings(
        lat=LAT,
        align_s=2.0,
        alignment=choice.alignment,
        heading=choice.heading,
        track_bias_at_rest=choice is LEVEL,
        gaps=GapPolicy(0.05, 2.0),
    )
    imu = eventful(seed)
    whole, split = Navigator(choice), Navigator(choice)
    expected = whole.process(imu).copy()
    edges = [0, *sorted(min(cut, len(imu)) for cut in cuts), len(imu)]
    parts = [split.process(imu.rows(a, b)).copy() for a, b in pairwise(edges)]
    assert np.concatenate(parts).tobytes() == expected.tobytes()
    assert split.events() == whole.events()
    assert split.mode == whole.mode
    assert split.health == whole.health


@pytest.mark.parametrize(
    ("attitude", "mechanization"),
    [
        ("two-sample", "geographic"),
        ("high-order:6", "wander"),
        ("high-order", "earth"),
        ("two-sample", "inertial-source"),
        ("poisson-rk4", "geographic"),
    ],
)
def test_one_sample_at_a_time(attitude, mechanization):
    imu, choice = eventful(3), replace(GYRO, attitude=attitude, mechanization=mechanization)
    whole, single = Navigator(choice), Navigator(choice)
    expected = whole.process(imu).copy()
    got = np.concatenate([single.process(imu.rows(k, k + 1)).copy() for k in range(len(imu))])
    assert got.tobytes() == expected.tobytes()
    assert single.events() == whole.events()
    assert single.silent().tobytes() == whole.silent().tobytes(), "the row that is kept is the last one"


def test_a_sample_alone_that_is_no_number_is_refused():
    navigator = aligned()
    bad = rest(0.01, first=250)
    bad.dvel[0, 1] = np.nan
    with pytest.raises(HilError, match="increment 250 is not a number"):
        navigator.process(bad)
