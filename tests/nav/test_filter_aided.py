"""The aided navigator: order and time of arrival, batches, gates, outages and restarts."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hil.geometry import position_error
from hil.study.aiding import GNSS_SIGMA, STEP, begin, gnss_rows, record, turns
from hil.study.navigation.flights import flight
from nav.aiding import AIDING, Kind, aiding
from nav.errors import HilError
from nav.filter.aided import AidedNavigator, Settings
from nav.filter.health import Channel, Trust
from nav.filter.states import GNSS_DELAY, GYRO_BIAS, LEVER_ARM, Block, tuning
from nav.increments import ImuIncrements
from nav.instruments.grades import GRADES
from nav.rotation import attitude_error
from nav.strapdown import Strapdown

MOTION, MOTION_SMOOTH = flight("agile"), flight("smooth")
SECONDS = 12.0
IMU = record(MOTION, SECONDS)
TIMES = np.arange(1, 60) * 0.2 - 0.0031
TRUTH = MOTION.truth(TIMES)
ROWS = gnss_rows(TRUTH, np.random.default_rng(1))


def navigator(grade="tactical", core=None, **settings):
    found = AidedNavigator(core or Strapdown(), tuning(GRADES[grade], bias_removed=True), Settings(**settings))
    begin(found, MOTION.truth([0.0])[0], (0.002, 0.01), np.random.default_rng(0))
    return found


def outcome(found):
    return np.concatenate([found.solution, found.estimates, found.covariance.ravel()])


def batches(imu, cuts):
    edges = [0, *sorted(cuts), len(imu)]
    return [imu.rows(a, b) for a, b in pairwise(edges)]


def in_order(**settings):
    found = navigator(**settings)
    found.aid(ROWS)
    found.process(IMU)
    return outcome(found)


@pytest.mark.parametrize("core", [("two-sample", "wander"), ("high-order:4", "geographic"), ("picard3", "earth")])
def test_batches_and_arrival_change_no_bit(core):
    """Rows that come early, late and in disorder, and samples in any batches: the same state, to the last bit."""
    rng = np.random.default_rng(2)
    whole = navigator(core=Strapdown(*core))
    whole.aid(ROWS)
    whole.process(IMU)
    other = navigator(core=Strapdown(*core))
    arrival = TIMES + rng.uniform(-0.3, 1.5, len(TIMES))
    left = np.argsort(arrival)
    for part in batches(IMU, rng.integers(0, len(IMU), 80)):
        other.process(part)
        come = [k for k in left if len(part) and arrival[k] <= part.time[-1]]
        left = np.array([k for k in left if k not in come], int)
        if come:
            other.aid(ROWS[come])
    other.aid(ROWS[left])
    assert other.too_late == 0
    assert (outcome(other) == outcome(whole)).all()


@pytest.mark.parametrize("core", [("two-sample", "geographic"), ("high-order:4", "wander"), ("picard3", "earth")])
def test_single_samples_are_the_same_to_the_last_bit(core):
    whole, other = navigator(core=Strapdown(*core)), navigator(core=Strapdown(*core))
    whole.aid(ROWS)
    answers = whole.process(IMU)
    other.aid(ROWS[:30])
    for k in range(len(IMU)):
        found = other.push(IMU.time[k], IMU.step[k], *IMU.dtheta[k], *IMU.dvel[k])
        if k < 500:
            assert (found == np.concatenate([part[k] for part in answers])).all()
        if k == 650:
            other.aid(ROWS[30:])
    assert (outcome(other) == outcome(whole)).all()


def test_a_late_measurement_matters():
    """Left out, the state is another one: so the equality above says something."""
    without = navigator()
    without.aid(np.delete(ROWS, 30))
    without.process(IMU)
    assert np.abs(outcome(without) - in_order()).max() > 1e-6


def test_too_late_is_said_and_changes_nothing():
    found = navigator(buffer_s=0.5)
    found.process(IMU.rows(0, 500))
    before = outcome(found)
    found.aid(ROWS[3:5])
    assert found.too_late == 2
    assert (outcome(found) == before).all()


def test_answers_are_those_of_the_bare_core_without_measurements():
    """With nothing to take the solution is the core's own."""
    found, core = navigator(), Strapdown()
    core.start(*found.solution[:3], found.solution[3:6], found.solution[6:10])
    out = np.empty((len(IMU), 3)), np.empty((len(IMU), 3)), np.empty((len(IMU), 4))
    core.advance(IMU.step, IMU.dtheta, IMU.dvel, np.zeros(3), *out)
    for ours, bare in zip(found.process(IMU), out, strict=True):
        assert (ours == bare).all()


def test_lever_arm_delay_and_bias_are_found():
    """An antenna elsewhere, a receiver that is late, a gyro with a bias: each by its sigma, and better than at first."""
    arm, delay, bias = np.array([1.2, -0.8, -0.5]), 0.05, np.radians([0.02, -0.02, 0.01])
    blocks = Block.GYRO_BIAS, Block.LEVER_ARM, Block.GNSS_DELAY
    believed = tuning(replace(GRADES["mems"], gyro_g=0.0), blocks, bias_removed=False, lever_arm=1.0, delay=0.1)
    found = AidedNavigator(Strapdown(), believed, Settings(delay=0.03))
    motion = turns()
    begin(found, motion.truth([0.0])[0], (0.002, 0.01), np.random.default_rng(0))
    seconds = 60.0
    imu = record(motion, seconds)
    imu.dtheta[:] += bias * STEP
    truth = motion.truth(np.arange(1, 10 * seconds) * 0.1)
    sigma = np.array([0.02, 0.02, 0.02, 0.01, 0.01, 0.01])
    rows = gnss_rows(truth, np.random.default_rng(3), sigma, arm=arm)
    rows["time"] += delay
    found.aid(rows)
    found.process(imu)
    for part, true in ((LEVER_ARM, arm), (GYRO_BIAS, bias), (GNSS_DELAY, delay - 0.03)):
        wrong, sure = np.abs(found.estimates[part] - true), found.sigma[part]
        assert (wrong < 3.5 * sure + 1e-3 * np.abs(true)).all()
        assert (sure < 0.3 * believed.sigma[part]).all()


def spoiled(change, since=30.0, until=math.inf, duration=90.0, grade="tactical", **settings):
    """A flight with GNSS that `change` spoils in between: navigator, largest position error over its sigma, GNSS's health."""
    imu, looks = record(MOTION_SMOOTH, duration), MOTION_SMOOTH.truth(np.arange(duration + 1.0))
    truth = MOTION_SMOOTH.truth(np.arange(1, round(5 * duration) + 1) * 0.2)
    rows = gnss_rows(truth, np.random.default_rng(4))
    bad = (rows["time"] > since) & (rows["time"] <= until)
    part = rows[bad]
    change(part, part["time"] - since)
    rows[bad] = part
    found = AidedNavigator(Strapdown(), tuning(GRADES[grade], bias_removed=True), Settings(**settings))
    begin(found, looks[0], (0.002, 0.01), np.random.default_rng(5))
    found.aid(rows)
    ratio, size, trust = 0.0, 0.0, Trust.GOOD
    for k, look in enumerate(looks[1:]):
        found.process(imu.rows(100 * k, 100 * k + 100))
        at = found.solution
        wrong = np.abs(position_error(at[0:1], at[1:2], at[2:3], look[None])[0])
        if k > 10:
            ratio, size = max(ratio, float((wrong / found.sigma[:3]).max())), max(size, float(wrong.max()))
        for one in found.health:
            if one.channel == Channel.GNSS_POSITION:
                trust |= one.trust
    return found, ratio, size, trust


def north(metres):
    return metres / 6.37e6


def test_a_jump_is_rejected_and_survived():
    def jump(rows, age):
        rows["value"][:, 0] += north(100.0)

    found, ratio, size, trust = spoiled(jump, until=45.0)
    gnss = found.health[0]
    assert gnss.rejected >= 75
    assert trust & Trust.REJECTED
    assert ratio < 4.5
    assert size < 10.0
    assert gnss.trust == Trust.GOOD
    assert not found.restarts()


def test_a_drift_is_flagged_and_held():
    """2 m/s to the north, with a velocity that says nothing of it: 60 s of it would be 120 m."""

    def drift(rows, age):
        rows["value"][:, 0] += north(2.0 * age)

    _, _, size, trust = spoiled(drift, restart_s=math.inf)
    assert trust & (Trust.DRIFTING | Trust.REJECTED)
    assert size < 20.0


def test_a_wrong_covariance_is_seen_and_mended():
    """Noise five times what is said."""

    def noisy(rows, age):
        rng = np.random.default_rng(6)
        rows["value"][:, 0] += north(7.0) * rng.standard_normal(len(rows))
        rows["value"][:, 1] += north(7.0) / 0.6 * rng.standard_normal(len(rows))
        rows["value"][:, 2] += 12.0 * rng.standard_normal(len(rows))

    found, ratio, _, trust = spoiled(noisy)
    assert trust & Trust.NOISY
    assert ratio < 5.0
    gnss = found.health[0]
    assert 5.0 < gnss.inflation < 60.0
    assert gnss.rejected < 0.3 * gnss.accepted


def test_it_says_that_it_has_diverged_and_starts_again():
    """GNSS that stays 1 km away is right in the end."""

    def away(rows, age):
        rows["value"][:, 0] += north(1000.0)

    found, _, _, _ = spoiled(away, restart_s=20.0)
    (restart,) = found.restarts()
    assert restart.time == pytest.approx(50.2, abs=0.3)
    assert found.health[0].trust == Trust.GOOD
    truth = MOTION_SMOOTH.truth([found.time])
    at = found.solution
    wrong = position_error(at[0:1], at[1:2], at[2:3], truth)[0]
    assert wrong[0] == pytest.approx(1000.0, abs=5.0)


def test_the_bias_of_the_alignment_is_kept():
    """Through a measurement that was true before the first interval ended, and through a restart."""
    bias, imu = np.radians([0.5, -0.4, 0.3]), record(MOTION_SMOOTH, 20.0)
    imu.dtheta[:] += bias * STEP
    rows = gnss_rows(MOTION_SMOOTH.truth(np.arange(1, 100) * 0.2 - 0.195), np.random.default_rng(8))
    rows["value"][20:, 0] += north(1000.0)
    found = AidedNavigator(Strapdown(), tuning(GRADES["dtg"], bias_removed=True), Settings(restart_s=5.0))
    (truth,) = MOTION_SMOOTH.truth([0.0])
    sigma = np.array([1.5, 1.5, 2.5, 0.05, 0.05, 0.08, 1e-3, 1e-3, 1e-3])
    place = truth["lat"], truth["lon"], truth["height"]
    found.start(0.0, *place, truth["vel_n"], truth["q_nb"], sigma, bias)
    found.process(imu.rows(0, 100))
    found.aid(rows)
    found.process(imu.rows(100, 2000))
    assert len(found.restarts()) == 1
    assert np.abs(found.estimates[GYRO_BIAS] - bias).max() < 0.01 * np.abs(bias).min()
    assert (
        np.degrees(np.abs(attitude_error(found.solution[6:10], MOTION_SMOOTH.truth([found.time])["q_nb"][0]))).max()
        < 0.1
    )


def test_a_board_at_rest_stays_where_it_is():
    """Zero velocity and zero rate alone: tilt to the accelerometers' bias over g, no drift of the heading beyond its sigma."""
    found = AidedNavigator(Strapdown(), tuning(GRADES["mems"], bias_removed=True))
    n, step, lat = 12000, 0.01, 0.9
    sigma = np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01, 0.01, 0.01, 0.05])
    q = np.array([1.0, 0.0, 0.0, 0.0])
    found.start(0.0, lat, 0.0, 0.0, np.zeros(3), q, sigma)
    rng = np.random.default_rng(7)
    rate = 7.292115e-5 * np.array([math.cos(lat), 0.0, -math.sin(lat)])
    bias, force = np.radians([10, -5, 8]) / 3600, np.array([0.03, -0.02, 0.04])
    grade = GRADES["mems"]
    noise = rng.standard_normal((2, n, 3)) * math.sqrt(step)
    imu = ImuIncrements(
        step * np.arange(1, n + 1),
        np.full(n, step),
        step * (rate + bias) + grade.gyro_white * noise[0],
        step * (np.array([0.0, 0.0, -9.8111]) + force) + grade.accelerometer_white * noise[1],
        np.zeros(n, int),
        np.arange(n),
    )
    rows = []
    for time in np.arange(0.5, 120.0, 0.5):
        rows.append(aiding(time, Kind.BODY_VELOCITY, (0.0, 0.0, 0.0), (0.01,) * 3))
        rows.append(aiding(time, Kind.ZERO_RATE, (), (0.01,) * 3))
        rows.append(aiding(time, Kind.GRAVITY, (), (0.05,) * 2))
    found.aid(np.array(rows))
    found.process(imu)
    tilt = attitude_error(found.solution[6:10], q)
    assert np.abs(tilt[:2]).max() < 3.0 * 5e-3
    assert (np.abs(tilt) < 3.0 * found.sigma[6:9]).all()
    assert np.abs(found.solution[3:6]).max() < 0.02
    assert {one.channel for one in found.health} == {Channel.BODY_VELOCITY, Channel.ZERO_RATE, Channel.GRAVITY}


def test_what_cannot_be_is_refused():
    with pytest.raises(HilError, match="no start yet"):
        AidedNavigator(Strapdown(), tuning(GRADES["mems"])).process(IMU)
    found = navigator()
    with pytest.raises(HilError, match="no magnetic field"):
        found.aid(np.array([aiding(1.0, Kind.MAGNETIC, (1.0, 0.0, 0.0), (1.0, 1.0, 1.0))]))
    with pytest.raises(HilError, match="is no number"):
        found.aid(np.array([aiding(1.0, Kind.BARO, (math.nan,), (1.0,))]))
    unknown = np.zeros(1, AIDING)
    unknown["kind"] = 99
    with pytest.raises(HilError, match="unknown kind 99; there is: GNSS, BARO"):
        found.aid(unknown)
    found.process(IMU.rows(100, 200))
    with pytest.raises(HilError, match="time goes back"):
        found.process(IMU.rows(0, 10))
    with pytest.raises(HilError, match="predict_s"):
        Settings(predict_s=0.0)
    assert GNSS_SIGMA.shape == (6,)
