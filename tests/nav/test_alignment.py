"""Alignment at rest: exact on the rotating Earth, wrong by the classical limits, refused where it cannot work."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nav.alignment import rest
from nav.alignment.analytic import AlignmentRefused, gyrocompass, level, magnetic_heading
from nav.alignment.rest import UNSTATED, Sensors
from nav.earth import normal_gravity
from nav.frames import earth_rate_in_body
from nav.rotation import attitude_error, euler_from_quaternion

EARTH_RATE = 7.292115e-5
DEG_H = math.radians(1 / 3600)
headings, pitches, rolls = st.floats(0, 360), st.floats(-89, 89), st.floats(-180, 180)
latitudes = st.floats(-85, 85).map(math.radians)


def at_rest(attitude, lat):
    """Specific force and rate in body axes of something that stands on the Earth."""
    f = attitude.inv().apply([0.0, 0.0, -normal_gravity(math.sin(lat), 0.0)])
    w = attitude.inv().apply([EARTH_RATE * math.cos(lat), 0.0, -EARTH_RATE * math.sin(lat)])
    return f, w


def averaged(f, w, sigma_f=0.0, sigma_w=0.0):
    return rest.Means(60.0, w, f, sigma_w, sigma_f, 120)


def error(result, attitude):
    return attitude_error(result.q_nb, attitude.as_quat(scalar_first=True))


@given(headings, pitches, rolls, latitudes)
def test_exact_on_the_rotating_earth(heading, pitch, roll, lat):
    attitude = Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True)
    f, w = at_rest(attitude, lat)
    found = gyrocompass(averaged(f, w), lat)
    assert np.linalg.norm(error(found, attitude)) < 1e-14 / math.cos(lat)
    given_heading = level(averaged(f, w), lat, math.radians(heading))
    assert np.linalg.norm(error(given_heading, attitude)) < 1e-14
    np.testing.assert_allclose(given_heading.gyro_bias, 0.0, atol=1e-16)
    np.testing.assert_allclose(earth_rate_in_body(attitude.as_quat(scalar_first=True), lat), w, atol=1e-19)


@given(headings, latitudes, st.sampled_from([-1.0, 1.0]))
def test_classical_limits(heading, lat, sign):
    """Tilt is accelerometer bias / g, heading the east gyro bias / (U cos lat); both in kind and sign."""
    attitude = Rotation.from_euler("Z", heading, degrees=True)
    f, w = at_rest(attitude, lat)
    g = float(np.linalg.norm(f))
    bias = sign * 1e-3
    tilt = error(
        gyrocompass(averaged(f + attitude.inv().apply([bias, 0, 0]), w), lat), attitude
    )  # north accelerometer: pitch
    assert tilt[1] == pytest.approx(bias / g, rel=1e-6)
    assert abs(tilt[0]) < 1e-9
    assert tilt[2] == pytest.approx(0.0, abs=2e-7 * max(1.0, math.tan(abs(lat)) ** 2))
    turn = error(
        gyrocompass(averaged(f + attitude.inv().apply([0, bias, 0]), w), lat), attitude
    )  # east accelerometer: roll
    assert turn[0] == pytest.approx(-bias / g, rel=1e-6)
    # The found level has no east rate: (e x U)_east = 0 couples a roll into the heading by -tan(lat)
    assert turn[2] == pytest.approx(-turn[0] * math.tan(lat), rel=2e-3, abs=1e-9)
    east = sign * 0.01 * DEG_H
    drift = error(gyrocompass(averaged(f, w + attitude.inv().apply([0, east, 0])), lat), attitude)
    assert abs(drift[2]) == pytest.approx(0.01 * DEG_H / (EARTH_RATE * math.cos(lat)), rel=1e-4)
    assert drift[2] * sign < 0.0  # a rate to the east reads as a nose turned west of north
    north = error(gyrocompass(averaged(f, w + attitude.inv().apply([east, 0, 0])), lat), attitude)
    assert np.linalg.norm(north) < 1e-9  # first order: the north gyro does not turn the heading


@given(headings, pitches, rolls, latitudes, st.tuples(*[st.floats(-0.05, 0.05)] * 3))
def test_level_alignment_captures_the_gyro_bias(heading, pitch, roll, lat, bias):
    attitude = Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True)
    f, w = at_rest(attitude, lat)
    result = level(averaged(f, w + bias), lat, math.radians(heading))
    np.testing.assert_allclose(result.gyro_bias, bias, atol=1e-16)
    assert euler_from_quaternion(result.q_nb)[1] == pytest.approx(math.radians(pitch), abs=1e-12)


@pytest.mark.parametrize(
    ("lat_deg", "sigma_w", "bias", "say"),
    [
        (89.99, 0.0, 0.0, "at a pole or beyond, where there is no north; give navigation.start.heading_deg"),
        (-90.0, 0.0, 0.0, "latitude -90.000 deg is at a pole"),
        # 3 x 5 deg/h against 15.04 cos(50 deg) = 9.668 deg/h: 60 s x (15 / 9.668)^2
        (50.0, 5 * DEG_H, 0.0, "noise of the mean rate is 5 deg/h; average longer (144 s) or give navigation.start"),
        (50.0, 3600 * DEG_H, 0.0, "average longer (867 days) or give"),  # a MEMS board of 1 deg/s
        (50.0, 0.0, 100 * DEG_H, "times the Earth's (gyro bias, or units)"),  # a MEMS board
        (50.0, 0.0, math.degrees(EARTH_RATE), "times the Earth's (gyro bias, or units)"),  # deg/s taken for rad/s
    ],
)
def test_refusals_say_why_and_what_to_do(lat_deg, sigma_w, bias, say):
    f, w = at_rest(Rotation.from_euler("ZYX", [30, 2, -3], degrees=True), math.radians(lat_deg))
    with pytest.raises(AlignmentRefused) as refusal:
        gyrocompass(averaged(f, w + np.array([bias, 0.0, 0.0]), 0.0, sigma_w), math.radians(lat_deg))
    assert say in str(refusal.value)


@pytest.mark.parametrize(
    ("told_deg", "sign", "sensors", "fits"),
    [
        (-50.0, 1.0, UNSTATED, "50.0 deg"),  # the other hemisphere
        (50.0, -1.0, UNSTATED, "-50.0 deg"),  # gyros of the other sign
        (51.0, 1.0, Sensors(gyro_bias=0.01 * DEG_H), "50.0 deg"),
        (49.0, 1.0, Sensors(gyro_bias=0.01 * DEG_H), "50.0 deg"),
    ],
)
def test_the_vertical_rate_tells_the_wrong_latitude(told_deg, sign, sensors, fits):
    f, w = at_rest(Rotation.from_euler("ZYX", [130, 12, -3], degrees=True), math.radians(50.0))
    with pytest.raises(
        AlignmentRefused, match=f"would fit latitude {fits}: mend the latitude, its hemisphere or the sig"
    ):
        gyrocompass(averaged(f, sign * w), math.radians(told_deg), sensors)


def test_the_vertical_rate_tells_only_what_noise_and_bias_let_it():
    f, w = at_rest(Rotation.from_euler("ZYX", [130, 12, -3], degrees=True), math.radians(50.0))
    assert gyrocompass(averaged(f, w), math.radians(51.0)).q_nb[0] > 0.0
    assert gyrocompass(averaged(f, w), math.radians(51.0), Sensors(gyro_bias=1.0 * DEG_H)).q_nb[0] > 0.0
    noisy = averaged(f, w, 0.0, 0.2 * DEG_H)
    assert gyrocompass(noisy, math.radians(51.0), Sensors(gyro_bias=0.01 * DEG_H)).q_nb[0] > 0.0


@pytest.mark.parametrize("broken", ["f", "w", "lat", "sigma"])
def test_what_is_not_a_number_is_refused(broken):
    f, w = at_rest(Rotation.identity(), 0.9)
    parts = {"f": f.copy(), "w": w.copy(), "lat": np.array([0.9]), "sigma": np.zeros(1)}
    parts[broken][0] = math.nan
    mean = averaged(parts["f"], parts["w"], 0.0, parts["sigma"][0])
    with pytest.raises(AlignmentRefused, match="is not a number"):
        gyrocompass(mean, parts["lat"][0])
    with pytest.raises(AlignmentRefused, match="is not a number"):
        level(mean, parts["lat"][0], 1.0)


def test_a_force_that_is_not_1_g_is_refused():
    f, w = at_rest(Rotation.identity(), 0.9)
    for align in (lambda mean: gyrocompass(mean, 0.9), lambda mean: level(mean, 0.9, 1.0)):
        with pytest.raises(AlignmentRefused, match=r"specific force at rest is 0\.10 g: units or signs"):
            align(averaged(f / 9.80665, w))


def test_a_heading_asked_for_has_its_time_or_its_limit():
    """sigma^2 = noise^2 60 s / T + bias^2, and by the classical limit 0.01 deg/h of east bias is 0.059 deg at 50 deg."""
    lat = math.radians(50.0)
    mean = averaged(*at_rest(Rotation.identity(), lat), 0.0, 0.04 * DEG_H)
    sensors = Sensors(gyro_bias=0.01 * DEG_H)
    noise, bias = (size * DEG_H / (EARTH_RATE * math.cos(lat)) for size in (0.04, 0.01))
    asked = math.radians(0.1)
    time = 60.0 * noise**2 / (asked**2 - bias**2)
    with pytest.raises(AlignmentRefused, match=f"0.1 deg are asked; average {time:.0f} s instead of 60 s"):
        gyrocompass(mean, lat, sensors, asked=asked)
    with pytest.raises(AlignmentRefused, match=f"the biases alone leave {math.degrees(bias):.3g} deg"):
        gyrocompass(mean, lat, sensors, asked=math.radians(0.05))
    assert gyrocompass(mean, lat, sensors, asked=1.01 * math.hypot(noise, bias)).sigma_heading < 1.01 * math.hypot(
        noise, bias
    )


@pytest.mark.parametrize(("sigma_w", "sigma_f", "what"), [(4.0, 1.0, "rate"), (1.0, 4.0, "specific force")])
def test_a_scatter_above_the_stated_noise_is_not_rest(sigma_w, sigma_f, what):
    sensors = Sensors(angle_random_walk=1e-7 * math.sqrt(60), velocity_random_walk=1e-5 * math.sqrt(60))
    mean = averaged(*at_rest(Rotation.identity(), 0.9), sigma_f * 1e-5, sigma_w * 1e-7)
    with pytest.raises(
        AlignmentRefused, match=f"the {what} scatters 4.0 times as much as the sensor's noise; stand still"
    ):
        gyrocompass(mean, 0.9, sensors)


def test_a_rate_along_the_vertical_has_no_north():
    """The wrong latitude: at the real place, a pole, all of the rate is vertical."""
    with pytest.raises(AlignmentRefused, match="upright"):
        gyrocompass(averaged(np.array([0.0, 0.0, -9.8]), np.array([0.0, 0.0, -EARTH_RATE])), 0.9)


@pytest.mark.parametrize(
    ("factor", "say"),
    [(1.0, None), (0.96, None), (1.04, None), (1 / 9.80665, "0.10 g"), (32.174, "32.17 g"), (0.0, "0.00 g")],
)
def test_gravity_verdict(factor, say):
    verdict = rest.gravity_verdict(factor * np.array([1.0, -2.0, -9.5]) * 9.80665 / math.sqrt(1 + 4 + 9.5**2))
    if say is None:
        assert verdict is None
    else:
        assert say in verdict
        assert "units" in verdict


def test_gravity_verdict_on_a_broken_accelerometer():
    assert rest.gravity_verdict(np.array([math.nan, 0.0, 9.8])) is not None


def average(rate, force, goal, hz=100.0, splits=()):
    """Run the averages over rows of rate and force; the sums and all events with their row."""
    sums, events, start = np.zeros(rest.SUMS), [], 0
    step = np.full(len(rate), 1 / hz)
    stops = [*splits, len(rate)]
    while start < len(rate):
        stop = next(s for s in stops if s > start)
        rows = slice(start, stop)
        used, event = rest.accumulate(sums, step[rows], rate[rows] / hz, force[rows] / hz, goal)
        start += used
        if event:
            events.append((start, event))
        if event == 2:
            break
    return sums, events


@given(st.lists(st.integers(1, 999), max_size=8), st.integers(0, 2**32 - 1))
def test_averages_do_not_depend_on_batches(splits, seed):
    random = np.random.default_rng(seed)
    rate, force = random.normal(0, 1e-3, (1000, 3)), random.normal([0, 0, -9.8], 5e-3, (1000, 3))
    whole = average(rate, force, 8.0)
    split = average(rate, force, 8.0, splits=sorted(set(splits)))
    assert whole[1] == split[1]
    np.testing.assert_array_equal(whole[0], split[0])
    mean = rest.means(whole[0])
    assert mean.time_s == pytest.approx(8.0)
    np.testing.assert_allclose(mean.w, rate[:800].mean(0), atol=1e-15)
    np.testing.assert_allclose(mean.f, force[:800].mean(0), atol=1e-12)
    # 800 samples of white noise, as seen in the scatter of 16 blocks, worst of three axes
    assert 0.5 * 1e-3 / math.sqrt(800) < mean.sigma_w < 2.0 * 1e-3 / math.sqrt(800)
    assert 0.5 * 5e-3 / math.sqrt(800) < mean.sigma_f < 2.0 * 5e-3 / math.sqrt(800)


@pytest.mark.parametrize(
    ("rate", "force"),
    [((0, 0, 0.02), (0, 0, 0)), ((0, 0, 0), (0.2, 0, 0)), ((0, -0.2, 0), (0, 0, 0)), ((0, 0, 0), (0, 0, 0.1))],
)
def test_motion_restarts_the_averages(rate, force):
    rates = np.zeros((1000, 3))
    forces = np.tile([0.0, 0.0, -9.8], (1000, 1))
    rates[400:], forces[400:] = rate, forces[400:] + force
    _, events = average(rates, forces, 5.0)
    assert 3 in [event for _, event in events]
    row = next(row for row, event in events if event == 3)
    assert 400 < row <= 450  # within the block of half a second
    assert not any(event == 2 for at, event in events if at < row + 500)


def test_steady_turning_is_motion_from_the_first_block():
    _, events = average(np.full((100, 3), [0.0, 0.0, 0.2]), np.full((100, 3), [0.0, 0.0, -9.8]), 5.0)
    assert {event for _, event in events} == {3}


@given(st.floats(-60, 60).map(math.radians), headings)
def test_a_bias_within_tolerance_is_not_refused_but_bounded(lat, heading):
    attitude = Rotation.from_euler("Z", heading, degrees=True)
    f, w = at_rest(attitude, lat)
    bias = attitude.inv().apply([0.0, 0.5 * DEG_H, 0.0])
    found = error(gyrocompass(averaged(f, w + bias), lat), attitude)
    assume(math.cos(lat) > 0.2)
    assert abs(found[2]) == pytest.approx(math.atan(0.5 * DEG_H / (EARTH_RATE * math.cos(lat))), rel=1e-6)


@given(headings, st.floats(-60, 60), rolls, st.floats(-0.5, 0.5))
def test_heading_by_the_magnetic_flux(heading, pitch, roll, declination):
    attitude = Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True)
    force = attitude.inv().apply([0.0, 0.0, -9.8])
    flux = attitude.inv().apply([20.0 * math.cos(declination), 20.0 * math.sin(declination), 45.0])
    found = magnetic_heading(force, flux, declination)
    assert math.remainder(found - math.radians(heading), 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)


def test_a_flux_that_stands_on_the_level_tells_no_heading():
    with pytest.raises(AlignmentRefused, match="heading_deg"):
        magnetic_heading(np.array([0.0, 0.0, -9.8]), np.array([0.1, 0.0, 45.0]), 0.0)
