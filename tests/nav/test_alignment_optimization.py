"""Alignment in motion: exact data, exact attitude; answers do not depend on batches; errors are as the covariance says."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hil.scenario import Channel, MotionConfig, Sine, load
from hil.world.motion import Motion
from nav.aiding import AIDING, Kind
from nav.alignment.analytic import AlignmentRefused
from nav.alignment.optimization import MotionAlignment, davenport, mooring
from nav.alignment.rest import Sensors
from nav.increments import ImuIncrements
from nav.rotation import attitude_error

DEG = math.radians(1.0)
LAT, HEIGHT = 50.0 * DEG, 20.0
EARTH_RATE, G = 7.292115e-5, 9.8
STEP = 0.02


def swing(amplitude, period, phase=0.0, offset=0.0):
    return Channel(offset=offset, sines=(Sine(amplitude=amplitude, period_s=period, phase_deg=phase),))


SHIP = Motion(
    MotionConfig(
        latitude_deg=50.0,
        height_m=HEIGHT,
        heading=swing(1.5, 9.7, 0.0, 217.0),
        pitch=swing(2.0, 6.1, 40.0, 3.0),
        roll=swing(5.0, 8.3, 100.0),
        up=swing(0.3, 7.3, 20.0),
        north=swing(0.2, 9.1),
    )
)
TURNING = Motion(MotionConfig(latitude_deg=50.0, height_m=HEIGHT, heading=swing(20.0, 9.7), roll=swing(5.0, 8.3)))
FLIGHT = Motion(load("flight").motion.model_copy(update={"rest_s": 0.0, "ramp_s": 0.0}))


def record(motion, seconds, dtheta_error=0.0):
    n = round(seconds / STEP)
    imu = ImuIncrements.empty(n)
    imu.sequence[:] = np.arange(n)
    imu.step[:], imu.time[:] = STEP, STEP * (imu.sequence + 1)
    motion.increments(0, n, STEP, imu.dtheta, imu.dvel)
    imu.dtheta[:] += dtheta_error
    return imu


def true_fixes(motion, times, place=1.0, speed=0.1):
    truth = motion.truth(times)
    rows = np.zeros(len(truth), AIDING)
    rows["time"], rows["kind"] = truth["time"], Kind.GNSS
    for k, name in enumerate(("lat", "lon", "height")):
        rows["value"][:, k] = truth[name]
    rows["value"][:, 3:] = truth["vel_n"]
    rows["sigma"][:, :3], rows["sigma"][:, 3:] = place, speed
    return rows


def swayed(imu, sensors=None, sway=0.3):
    found = MotionAlignment(*[sensors] if sensors else [])
    found.add(imu, mooring(imu, LAT, HEIGHT, sway))
    return found


def error(found, motion, time):
    return attitude_error(found.result().q_nb, motion.truth([time])["q_nb"][0]) / DEG


@given(q=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1), seed=st.integers(0, 99))
def test_davenport_is_the_rotation_of_least_squares(q, seed):
    turn, random = Rotation.from_quat(q, scalar_first=True), np.random.default_rng(seed)
    in_b = random.standard_normal((6, 3))
    in_a = turn.apply(in_b) + 0.05 * random.standard_normal((6, 3))
    found, fit = davenport(in_a.T @ in_b)
    peer, _ = Rotation.align_vectors(in_a, in_b)
    assert (Rotation.from_quat(found, scalar_first=True) * peer.inv()).magnitude() < 1e-7
    assert fit == pytest.approx(np.sum(in_a * peer.apply(in_b)), rel=1e-9)


def test_turning_on_the_spot_with_exact_sensors_is_exact():
    """The place stands: nothing but rounding is left, and what two samples leave of the coning."""
    imu = record(TURNING, 300.0)
    assert np.abs(error(swayed(imu, sway=1e-3), TURNING, 300.0)).max() < 2e-6


def test_sway_goes_fast():
    """The cubic in time that shows north is fitted ever better: the heading's error falls as the 4th power of time or so."""
    imu = record(SHIP, 480.0)
    short, long = (abs(error(swayed(imu.rows(0, n)), SHIP, n * STEP)[2]) for n in (6000, 24000))
    assert long < 5e-3
    assert long < short / 20.0


def test_flight_with_exact_fixes():
    imu = record(FLIGHT, 60.0)
    found = MotionAlignment()
    found.add(imu, true_fixes(FLIGHT, np.arange(0.0, 60.1, 0.2)))
    assert np.abs(error(found, FLIGHT, 60.0)).max() < 1e-3


@pytest.mark.parametrize(("place", "speed"), [(1.0, np.inf), (np.inf, 0.1)])
def test_positions_or_velocities_alone_do(place, speed):
    imu = record(FLIGHT, 60.0)
    found = MotionAlignment()
    found.add(imu, true_fixes(FLIGHT, np.arange(0.113, 60.0, 0.2), place, speed))  # between samples
    assert np.abs(error(found, FLIGHT, 60.0)).max() < 5e-3


@settings(max_examples=15)
@given(cuts=st.lists(st.integers(1, 499), max_size=6))
def test_batches_do_not_matter(cuts):
    imu, fixes = record(FLIGHT, 10.0), true_fixes(FLIGHT, np.arange(0.05, 10.0, 0.2))
    whole, split = MotionAlignment(), MotionAlignment()
    whole.add(imu, fixes)
    edges = [0, *sorted(set(cuts)), len(imu)]
    split.add(imu.rows(0, 0), fixes[:9])  # fixes may be early
    for first, last in pairwise(edges):
        there = fixes[9:]["time"]
        before = imu.time[first - 1] if first else -np.inf
        split.add(imu.rows(first, last), fixes[9:][(there > before) & (there <= imu.time[last - 1])])
    assert (whole.result().q_nb == split.result().q_nb).all()
    assert (whole.result().covariance == split.result().covariance).all()


def test_the_looks_at_a_mooring_do_not_depend_on_batches():
    imu = record(TURNING, 10.0)
    parts = np.concatenate([mooring(imu.rows(k, k + 7), LAT, HEIGHT, 0.3) for k in range(0, len(imu), 7)])
    assert (parts == mooring(imu, LAT, HEIGHT, 0.3)).all()


def test_a_bias_turns_the_heading_as_the_classical_limit_says():
    """East bias over U cos B; the head looks north, so that its y axis is east."""
    bias = 0.01 * DEG / 3600
    still = Motion(MotionConfig(latitude_deg=50.0, height_m=HEIGHT))
    found = swayed(record(still, 600.0, dtheta_error=[0.0, bias * STEP, 0.0]), Sensors(gyro_bias=bias))
    limit = bias / (EARTH_RATE * math.cos(LAT)) / DEG
    assert abs(error(found, still, 600.0)[2]) == pytest.approx(limit, rel=0.01)
    assert found.result().sigma_heading / DEG == pytest.approx(limit, rel=0.02)


@pytest.mark.parametrize("size", [{"gyro_bias": 1e-8}, {"accelerometer_bias": 1e-4}], ids=["gyro", "accelerometer"])
@pytest.mark.parametrize("motion", [SHIP, FLIGHT], ids=["ship", "flight"])
def test_the_covariance_holds_the_exact_effect_of_each_bias(motion, size):
    """Three runs with a bias on one axis each: the squares of their effects add up to what the covariance gains."""
    seconds, true = 60.0, record(motion, 60.0)
    fixes = mooring(true, LAT, HEIGHT, 0.3) if motion is SHIP else true_fixes(motion, np.arange(0.2, seconds, 0.2))

    def aligned(sensors, bias):
        imu = record(motion, seconds)
        (imu.dtheta if "gyro_bias" in size else imu.dvel)[:] += STEP * bias
        found = MotionAlignment(sensors)
        found.add(imu, fixes)
        return found.result()

    clean, known = aligned(Sensors(), np.zeros(3)), aligned(Sensors(**size), np.zeros(3))
    (bias,) = size.values()
    effects = [attitude_error(aligned(Sensors(), bias * axis).q_nb, clean.q_nb) for axis in np.eye(3)]
    gained = np.diag(known.covariance - clean.covariance)
    np.testing.assert_allclose(np.square(effects).sum(axis=0), gained, rtol=0.02)


def test_random_walk_scatters_as_the_covariance_says():
    walk, seeds = 0.02 * DEG / 60, 40
    sensors, clean, rng = Sensors(angle_random_walk=walk), record(TURNING, 100.0), np.random.default_rng(3)
    true = clean.dtheta.copy()
    errors = []
    for _ in range(seeds):
        clean.dtheta[:] = true + walk * math.sqrt(STEP) * rng.standard_normal(true.shape)
        found = swayed(clean, sensors, sway=1e-3)
        errors.append(error(found, TURNING, 100.0)[2])
    ratio = np.sqrt(np.mean(np.square(errors))) / (found.result().sigma_heading / DEG)
    assert ratio == pytest.approx(1.0, abs=4.0 / math.sqrt(2.0 * seeds))


def test_observability_grows_and_a_standing_vector_has_none():
    imu = record(TURNING, 200.0)
    early, late = (swayed(imu.rows(0, n)).observability for n in (2000, 10000))
    assert 0.0 < early < late < 1.0
    # Gravity turns by U cos B t: the spread is in proportion to time.
    assert late / early == pytest.approx(5.0, rel=0.05)


@pytest.mark.parametrize(
    ("sensors", "seconds", "why"),
    [
        (Sensors(gyro_bias=10 * DEG / 3600), 300.0, "too noisy.*biases alone"),
        (Sensors(angle_random_walk=0.3 * DEG / 60), 30.0, "too little is seen"),
        (Sensors(), 3.0, "needs 4 fixes and has 3"),
    ],
)
def test_refusals_say_why(sensors, seconds, why):
    with pytest.raises(AlignmentRefused, match=why):
        swayed(record(TURNING, seconds), sensors).result()


def test_what_was_asked_is_kept_or_refused():
    found = MotionAlignment(Sensors(gyro_bias=0.01 * DEG / 3600), asked=0.05 * DEG)
    imu = record(TURNING, 300.0)
    found.add(imu, mooring(imu, LAT, HEIGHT, 0.01))
    with pytest.raises(AlignmentRefused, match=r"0.05 deg are asked, and their biases alone leave 0.05\d+ deg"):
        found.result()


def test_a_ship_under_way_is_not_at_its_mooring():
    away = Motion(MotionConfig(latitude_deg=50.0, height_m=HEIGHT, north=swing(400.0, 300.0)))
    with pytest.raises(AlignmentRefused, match="does not fit the fixes"):
        swayed(record(away, 200.0)).result()


@pytest.mark.parametrize(
    ("field", "value", "why"),
    [
        ("value", np.nan, "no finite GNSS position"),
        ("kind", Kind.BARO, "no finite GNSS position"),
        ("sigma", 0.0, "sigma that is not positive"),
        ("sigma", np.nan, "sigma that is not positive"),
        ("time", 0.5, "in order of time"),
    ],
)
def test_bad_fixes_are_refused_and_nothing_is_taken(field, value, why):
    imu, fixes = record(FLIGHT, 20.0), true_fixes(FLIGHT, np.arange(0.2, 20.1, 0.2))
    found, same = MotionAlignment(), MotionAlignment()
    for one in (found, same):
        one.add(imu.rows(0, 500), fixes[:50])
    bad = fixes[50:].copy()
    bad[field][3] = value
    with pytest.raises(AlignmentRefused, match=why):
        found.add(imu.rows(500, 1000), bad)
    wrong = imu.rows(500, 1000)
    spoiled = ImuIncrements(wrong.time, wrong.step, wrong.dtheta * np.inf, wrong.dvel, wrong.validity, wrong.sequence)
    with pytest.raises(AlignmentRefused, match="increment 500 is not a number"), np.errstate(invalid="ignore"):
        found.add(spoiled, fixes[50:])
    for one in (found, same):
        one.add(imu.rows(500, 1000), fixes[50:])
    assert (found.result().q_nb == same.result().q_nb).all()
