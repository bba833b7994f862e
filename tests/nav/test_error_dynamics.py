"""Linear error dynamics against the navigator itself, closed forms at rest, and the exponential of F."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from hil.geometry import position_error
from hil.study.navigation.flights import flight
from nav.covariance import Path, response
from nav.earth import RATE, curvature_radii, normal_gravity
from nav.error_dynamics import fill_dynamics, fill_input, fill_transition
from nav.rotation import attitude_error
from nav.strapdown import Strapdown

SIZES = np.repeat([10.0, 0.01, 1e-5, 1e-8, 1e-5], 3)
"""Errors: m, m/s, rad at the start; rad/s, m/s^2 of the instruments."""
START = np.vstack([np.diag(SIZES[:9]), np.zeros((6, 9))])
CONSTANT = np.zeros((15, 6, 7))
CONSTANT[np.arange(9, 15), np.arange(6), 0] = SIZES[9:]
PLACE = np.dtype([("lat", "<f8"), ("lon", "<f8"), ("height", "<f8")])


def fly(state, step, dtheta, dvel, start, constant, hold=None):
    """Position, velocity and attitude of a run that starts and measures with these errors.

    `hold`: height and vertical velocity go back to those of `state` after so many steps.
    """
    lat, lon, height, vel_n, q_nb = state
    meridian, prime = curvature_radii(math.sin(lat))
    q = (Rotation.from_rotvec(start[6:9]) * Rotation.from_quat(q_nb, scalar_first=True)).as_quat(scalar_first=True)
    core = Strapdown("high-order:6", whole_record=hold is None)
    east = start[1] / ((prime + height) * math.cos(lat))
    core.start(lat + start[0] / (meridian + height), lon + east, height - start[2], vel_n + start[3:6], q)
    n = len(dtheta)
    turned, pushed = dtheta + step * constant[:3, 0], dvel + step * constant[3:, 0]
    out = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
    for first in range(0, n, hold or n):
        some = slice(first, first + (hold or n))
        core.advance(np.full(n, step)[some], turned[some], pushed[some], np.zeros(3), *(x[some] for x in out))
        if hold:
            core.solution[2], core.solution[5] = height, vel_n[2]
            core.hand_over("geographic")
    return out


def difference(one, other, rows):
    """(k, 9) errors of one run from another at some rows."""
    (p, v, q), (p0, v0, q0) = ([x[rows] for x in run] for run in (one, other))
    place = np.ascontiguousarray(p0).view(PLACE)[:, 0]
    return np.hstack([position_error(*np.ascontiguousarray(p.T), place), v - v0, attitude_error(q, q0)])


def worst(found, predicted):
    """Largest difference in position, velocity and attitude, relative to the largest error that is there."""
    blocks = [slice(3 * i, 3 * i + 3) for i in range(3)]
    apart = [np.linalg.norm(found[:, b] - predicted[:, b], axis=1).max() for b in blocks]
    return np.array(apart) / [np.linalg.norm(predicted[:, b], axis=1).max() + 1e-300 for b in blocks]


@pytest.mark.parametrize("name", ["smooth", "agile"])
def test_the_navigator_errs_as_predicted(name):
    """Ten minutes of flight; both signs of each error, so that the second order falls out."""
    motion, step, seconds = flight(name), 0.02, 600
    n, every = round(seconds / step), round(1.0 / step)
    dtheta, dvel = np.empty((n, 3)), np.empty((n, 3))
    motion.increments(0, n, step, dtheta, dvel)
    state = motion.truth([0.0])[["lat", "lon", "height", "vel_n", "q_nb"]][0]
    middles = motion.truth((np.arange(n) + 0.5) * step)
    path = Path(step, *(middles[key] for key in ("lat", "height", "vel_n", "q_nb", "w_ib_b", "f_b")))
    predicted = response(path, START, CONSTANT, every=every)
    assert predicted.shape == (seconds, 15, 9)
    rows = slice(every - 1, None, every)
    clean = fly(state, step, dtheta, dvel, START[0] * 0.0, CONSTANT[0])
    for k in range(15):
        plus, minus = (fly(state, step, dtheta, dvel, s * START[k], s * CONSTANT[k]) for s in (1.0, -1.0))
        found = 0.5 * (difference(plus, clean, rows) - difference(minus, clean, rows))
        if k == 1:  # nothing depends on the longitude: no velocity, no attitude error
            assert np.abs(found[:, 3:]).max() < 1e-12
            assert np.abs(predicted[:, k, 3:]).max() == 0.0
            found[:, 3:] = 0.0
        assert (worst(found, predicted[:, k]) < 1e-5).all(), f"error {k}"


@settings(max_examples=15)
@given(st.floats(-80, 80), st.floats(-300, 15e3), st.integers(0, 2**32 - 1))
def test_anywhere_at_any_velocity_and_attitude(lat_deg, height, seed):
    """A minute of steady rate and force from any state; the path is the navigator's own."""
    rng = np.random.default_rng(seed)
    half, n = 0.01, 6000
    vel_n, attitude = rng.uniform(-300, 300, 3) * [1, 1, 0.1], Rotation.random(random_state=seed)
    state = math.radians(lat_deg), 0.0, height, vel_n, attitude.as_quat(scalar_first=True)
    rate, force = rng.uniform(-0.05, 0.05, 3), attitude.inv().apply([0, 0, -9.8]) + rng.uniform(-1, 1, 3)
    dtheta, dvel = np.tile(rate * half, (n, 1)), np.tile(force * half, (n, 1))
    clean = fly(state, half, dtheta, dvel, START[0] * 0.0, CONSTANT[0])
    (p, v, q), steady = ([x[::2] for x in clean]), np.ones((n // 2, 1))
    path = Path(2.0 * half, p[:, 0], p[:, 2], v, q, steady * rate, steady * force)
    predicted = response(path, START, CONSTANT, every=100)
    mix = rng.standard_normal(15)
    start, constant = mix @ START, np.tensordot(mix, CONSTANT, 1)
    plus, minus = (fly(state, half, dtheta, dvel, s * start, s * constant) for s in (1.0, -1.0))
    rows = slice(199, None, 200)
    found = 0.5 * (difference(plus, clean, rows) - difference(minus, clean, rows))
    assert (worst(found, np.einsum("m,kmi->ki", mix, predicted)) < 2e-6).all()


# At rest


def at_rest(lat_deg, heading_deg=30.0):
    """State, body rate and specific force of a place on the ground."""
    lat = math.radians(lat_deg)
    attitude = Rotation.from_euler("ZYX", [heading_deg, 5, -8], degrees=True)
    rate = attitude.inv().apply([RATE * math.cos(lat), 0, -RATE * math.sin(lat)])
    force = attitude.inv().apply([0, 0, -normal_gravity(math.sin(lat), 0.0)])
    return (lat, 0.0, 0.0, np.zeros(3), attitude.as_quat(scalar_first=True)), rate, force


def rest_path(lat_deg, step, n):
    (lat, _, height, vel_n, q_nb), rate, force = at_rest(lat_deg)
    ones = np.ones((n, 1))
    return Path(step, lat * ones[:, 0], height * ones[:, 0], ones * vel_n, ones * q_nb, ones * rate, ones * force)


def dynamics_at_rest(lat_deg):
    (lat, _, height, vel_n, q_nb), _, force = at_rest(lat_deg)
    f, c_nb = np.full((9, 9), np.nan), Rotation.from_quat(q_nb, scalar_first=True).as_matrix()
    fill_dynamics(lat, height, vel_n, c_nb, force, f)
    return f, c_nb


@pytest.mark.parametrize("lat_deg", [-60.0, 0.0, 20.0, 45.0, 70.0])
def test_frequencies_at_rest(lat_deg):
    """Britting: Schuler split by Foucault's U sin B, the Earth's day, and a vertical channel that runs away."""
    f, _ = dynamics_at_rest(lat_deg)
    level = np.delete(np.delete(f, [2, 5], 0), [2, 5], 1)
    sin_lat = math.sin(math.radians(lat_deg))
    meridian, prime = curvature_radii(sin_lat)
    gravity = normal_gravity(sin_lat, 0.0)
    north, east = math.sqrt(gravity / meridian), math.sqrt(gravity / prime)
    # Two pendulums coupled by Coriolis: w^4 - w^2 (n^2 + e^2 + 4 (U sin B)^2) + n^2 e^2 = 0, to the order of U^2 / w^2
    total, product = north**2 + east**2 + 4 * (RATE * sin_lat) ** 2, (north * east) ** 2
    split = [math.sqrt((total + sign * math.sqrt(total**2 - 4 * product)) / 2) for sign in (1, -1)]
    found = np.linalg.eigvals(level)
    assert np.abs(found.real).max() < 1e-8
    frequencies = np.sort(found.imag[found.imag > 1e-6])
    np.testing.assert_allclose(frequencies, [RATE, split[1], split[0]], rtol=4e-3)
    if abs(lat_deg) > 10:
        assert frequencies[2] - frequencies[1] == pytest.approx(2 * RATE * abs(sin_lat), rel=0.03)
    assert np.linalg.eigvals(f).real.max() == pytest.approx(math.sqrt(2 * gravity / 6.371e6), rel=5e-3)


def test_foucault_turns_the_swing():
    """At 45 degrees a swing along the meridian lies across it after a quarter of 24 h / sin B."""
    quarter = 0.5 * math.pi / (RATE * math.sin(math.radians(45.0)))
    start = np.zeros((1, 9))
    start[0, 3] = 0.1
    step = 10.0
    path = rest_path(45.0, step, round((quarter + 2600.0) / step))
    v = response(path, start, np.zeros((1, 6, 7)), height_held=True)[:, 0, 3:5]
    first, last = v[: round(5064 / step)], v[-round(5064 / step) :]
    first, last = (np.sqrt((x**2).mean(axis=0)) for x in (first, last))
    assert first[0] > 5 * first[1]
    assert last[1] > 5 * last[0]
    assert last[1] == pytest.approx(first[0], rel=0.05)


def test_a_day_at_rest():
    """Height held: Schuler, Foucault and the day together, the navigator beside the prediction.

    The navigator's height is held every 10 s only; the vertical velocity in between brakes the swing by
    (2 U cos B)^2 / 2 times 5 s, up to 2e-3 in a day.
    """
    lat_deg = -35.0
    state, rate, force = at_rest(lat_deg)
    step, n = 1.0, 86_400
    dtheta, dvel = np.tile(rate * step, (n, 1)), np.tile(force * step, (n, 1))
    predicted = response(rest_path(lat_deg, 2.0, n // 2), START, CONSTANT, every=300, height_held=True)
    rows = slice(599, None, 600)
    clean = fly(state, step, dtheta, dvel, START[0] * 0.0, CONSTANT[0], hold=10)
    for k in (0, 3, 7, 8, 9, 10, 12):
        found = difference(fly(state, step, dtheta, dvel, START[k], CONSTANT[k], hold=10), clean, rows)
        assert (worst(found, predicted[:, k]) < 2.5e-3).all(), f"error {k}"
    drift = np.linalg.norm(predicted[:, 9:12, :3], axis=2).max(axis=0)
    assert (drift > 1e3).all()  # 0.002 deg/h grows to kilometres in a day, along whichever axis


def test_the_vertical_channel_runs_away():
    """dh(t) = dh(0) cosh(t sqrt(2 g / R)), with the Earth's oblateness and turn within one per cent of the exponent."""
    start = np.zeros((1, 9))
    start[0, 2] = 1.0
    down = response(rest_path(40.0, 1.0, 1800), start, np.zeros((1, 6, 7)))[:, 0, 2]
    exponent = np.arccosh(down[[899, 1799]]) / [900.0, 1800.0]
    np.testing.assert_allclose(exponent, math.sqrt(2 * 9.8 / 6.37e6), rtol=0.01)


# The step


def test_the_transition_is_that_of_the_exponential_to_second_order():
    f, c_nb = dynamics_at_rest(50.0)
    errors = []
    for step in (20.0, 10.0, 5.0):
        transition, gain = np.full((9, 9), np.nan), np.full((9, 6), np.nan)
        fill_transition(f, step, transition)
        fill_input(f, c_nb, step, gain)
        entry = np.zeros((9, 6))
        entry[6:, :3] = entry[3:6, 3:] = c_nb
        whole = expm(step * np.block([[f, entry / step], [np.zeros((6, 15))]]))
        errors.append([np.abs(transition - whole[:9, :9]).max(), np.abs(gain - whole[:9, 9:]).max()])
    order = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(order, [[3, 2]] * 2, atol=0.1)  # of one step: the input is integrated besides
