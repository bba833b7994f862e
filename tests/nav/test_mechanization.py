"""The level mechanization: rest, an analytic flight, convergence, Schuler's pendulum, symmetry, the pole."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hil.geometry import position_error
from hil.scenario import load
from hil.world.motion import Motion
from nav.earth import RATE, normal_gravity
from nav.errors import HilError
from nav.navigator import Navigator, Settings
from nav.rotation import attitude_error
from nav.strapdown import Strapdown

FLIGHT = load("flight").motion
TAKE_OFF = 62.0
"""The flight is followed from here, in the acceleration: every term of the equations is at work."""


def run(core, step, dtheta, dvel, bias=(0.0, 0.0, 0.0)):
    n = len(step)
    out = np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.full((n, 4), np.nan)
    done = core.advance(step, np.ascontiguousarray(dtheta), np.ascontiguousarray(dvel), np.array(bias, float), *out)
    return done, *out


def started(lat, lon, height, vel_n, q_nb):
    core = Strapdown("two-sample", "geographic", "normal")
    core.start(lat, lon, height, vel_n, q_nb)
    return core


def start_of(truth, turn=0.0):
    row = truth[0]
    return started(row["lat"], math.remainder(row["lon"] + turn, 2 * math.pi), row["height"], row["vel_n"], row["q_nb"])


def fly(config, start, duration, step, pieces=None):
    """Fly on exact increments; the errors at the end in position (m), velocity (m/s), attitude (rad)."""
    motion = Motion(config)
    n, first = round(duration / step), round(start / step)
    dtheta, dvel = np.empty((n, 3)), np.empty((n, 3))
    motion.increments(first, n, step, dtheta, dvel)
    steps = np.full(n, step)
    if pieces is not None:  # join steps into unequal ones
        edges = np.concatenate(([0], np.cumsum(pieces)))
        edges = np.unique(np.append(edges[edges < n], n))
        dtheta, dvel = (np.add.reduceat(x, edges[:-1]) for x in (dtheta, dvel))
        steps = np.diff(edges) * step
    core = start_of(motion.truth([start]))
    done, position, velocity, attitude = run(core, steps, dtheta, dvel)
    assert done == len(steps)
    truth = motion.truth([start + duration])
    return (
        np.abs(position_error(*position[-1:].T, truth)).max(),
        np.abs(velocity[-1] - truth["vel_n"][0]).max(),
        np.abs(attitude_error(attitude[-1], truth["q_nb"][0])).max(),
    )


@pytest.mark.parametrize("lat_deg", [-65.0, 0.0, 50.0, 85.0])
def test_an_hour_at_rest(lat_deg):
    lat, step = math.radians(lat_deg), 0.02
    n = round(3600 / step)
    attitude = Rotation.from_euler("ZYX", [130, 5, -8], degrees=True)
    rate = attitude.inv().apply([RATE * math.cos(lat), 0, -RATE * math.sin(lat)])
    force = attitude.inv().apply([0, 0, -normal_gravity(math.sin(lat), 120.0)])
    core = started(lat, 2.0, 120.0, np.zeros(3), attitude.as_quat(scalar_first=True))
    done, position, velocity, q = run(
        core, np.full(n, step), np.tile(rate * step, (n, 1)), np.tile(force * step, (n, 1))
    )
    assert done == n
    # The vertical channel grows 270-fold in an hour (cosh of t sqrt(2 g / R)); a step's own error there is near 1e-12 g
    assert np.abs(position[:, 2] - 120.0).max() < 2e-3
    assert np.abs(position[:, :2] - [lat, 2.0]).max() * 6.4e6 < 1e-3
    assert np.abs(velocity).max() < 1e-5
    assert np.abs(attitude_error(q[-1], attitude.as_quat(scalar_first=True))).max() < 1e-9


def test_the_flight_is_met_at_every_rate_with_second_order():
    errors = np.array([fly(FLIGHT, TAKE_OFF, 120.0, step) for step in (0.005, 0.01, 0.02)])
    assert (errors[0] < [1e-4, 2e-6, 1e-11]).all()  # m, m/s, rad at 5 ms
    for finer, coarser in ((0, 1), (1, 2)):
        order = np.log2(errors[coarser] / errors[finer])
        assert (order > 1.9).all(), f"order of position, velocity, attitude {order}"


@settings(max_examples=8)
@given(st.integers(0, 2**32 - 1))
def test_unequal_steps_cost_no_order(seed):
    """Steps of 5, 10 and 15 ms in any order are at worst as wrong as steps of 15 ms."""
    pieces = np.random.default_rng(seed).integers(1, 4, size=20_000)
    jittered = fly(FLIGHT, TAKE_OFF, 60.0, 0.005, pieces)
    regular = fly(FLIGHT, TAKE_OFF, 60.0, 0.015)
    assert all(a < 2.0 * b + 1e-9 for a, b in zip(jittered, regular, strict=True))


@pytest.mark.parametrize("name", ["turns", "coning", "harmonic_roll"])
def test_built_in_motions(name):
    motion = load(name).motion
    start = motion.rest_s + 0.5 * motion.ramp_s
    coarse, fine = (fly(motion, start, 20.0, step) for step in (0.004, 0.001))
    # Second order, or so exact already that rounding decides
    assert all(a < b / 10.0 + floor for a, b, floor in zip(fine, coarse, (1e-6, 1e-8, 1e-10), strict=True))


def test_a_step_of_zero_changes_nothing():
    motion = Motion(FLIGHT)
    dtheta, dvel = np.empty((200, 3)), np.empty((200, 3))
    motion.increments(6200, 200, 0.01, dtheta, dvel)
    plain, padded = start_of(motion.truth([62.0])), start_of(motion.truth([62.0]))
    run(plain, np.full(200, 0.01), dtheta, dvel)
    steps = np.zeros(400)
    steps[::2] = 0.01
    done, *_ = run(padded, steps, dtheta.repeat(2, 0), dvel.repeat(2, 0))
    assert done == 400
    np.testing.assert_array_equal(plain.solution, padded.solution)


def test_batches_do_not_matter():
    motion = Motion(FLIGHT)
    dtheta, dvel = np.empty((100, 3)), np.empty((100, 3))
    motion.increments(6200, 100, 0.01, dtheta, dvel)
    whole, split = start_of(motion.truth([62.0])), start_of(motion.truth([62.0]))
    run(whole, np.full(100, 0.01), dtheta, dvel)
    for rows in (slice(0, 1), slice(1, 1), slice(1, 37), slice(37, 100)):
        run(split, np.full(100, 0.01)[rows], dtheta[rows], dvel[rows])
    np.testing.assert_array_equal(whole.solution, split.solution)


def test_bias_is_taken_off():
    motion = Motion(FLIGHT)
    dtheta, dvel = np.empty((100, 3)), np.empty((100, 3))
    motion.increments(6200, 100, 0.01, dtheta, dvel)
    clean, biased = start_of(motion.truth([62.0])), start_of(motion.truth([62.0]))
    bias = np.array([0.01, -0.02, 0.03])
    run(clean, np.full(100, 0.01), dtheta, dvel)
    run(biased, np.full(100, 0.01), dtheta + 0.01 * bias, dvel, bias)
    np.testing.assert_allclose(biased.solution, clean.solution, rtol=1e-15, atol=1e-13)


def test_schuler_period():
    """A tilt of 10 arc seconds swings with 84.4 min: the north velocity crosses zero at half and at the whole period."""
    lat, step = 0.0, 0.1
    n = round(100 * 60 / step)
    tilt = math.radians(10 / 3600)
    core = started(lat, 0.0, 0.0, np.zeros(3), Rotation.from_rotvec([0, tilt, 0]).as_quat(scalar_first=True))
    rate = np.array([RATE * math.cos(lat), 0.0, -RATE * math.sin(lat)])
    force = np.array([0.0, 0.0, -normal_gravity(0.0, 0.0)])
    _, _, velocity, _ = run(core, np.full(n, step), np.tile(rate * step, (n, 1)), np.tile(force * step, (n, 1)))
    north = velocity[:, 0]
    crossings = np.flatnonzero(np.diff(np.sign(north[100:]))) + 100
    assert 2 * crossings[0] * step / 60 == pytest.approx(84.4, rel=0.01)
    assert crossings[1] * step / 60 == pytest.approx(84.4, rel=0.01)
    # Amplitude of a pendulum of the meridian's radius, tilt * sqrt(g R), before the Earth rate turns the tilt into heading
    assert -north[: round(30 * 60 / step)].min() == pytest.approx(tilt * math.sqrt(9.78 * 6.3354e6), rel=0.005)


@settings(max_examples=10)
@given(st.floats(-math.pi, math.pi))
def test_longitude_is_a_symmetry(turn):
    motion = Motion(FLIGHT)
    dtheta, dvel = np.empty((500, 3)), np.empty((500, 3))
    motion.increments(9000, 500, 0.01, dtheta, dvel)
    truth = motion.truth([90.0])
    one, other = start_of(truth), start_of(truth, turn)
    run(one, np.full(500, 0.01), dtheta, dvel)
    _, position, *_ = run(other, np.full(500, 0.01), dtheta, dvel)
    assert (np.abs(position[:, 1]) <= math.pi).all()
    assert math.remainder(other.solution[1] - one.solution[1] - turn, 2 * math.pi) == pytest.approx(0.0, abs=1e-14)
    np.testing.assert_array_equal(np.delete(one.solution, 1), np.delete(other.solution, 1))


@pytest.mark.parametrize(
    ("choice", "say"),
    [
        ({"attitude": "magic"}, "unknown attitude method 'magic'; there is: "),
        ({"mechanization": "polar"}, "'polar'"),
        ({"gravity": "moon"}, "unknown gravity 'moon'; there is: normal, j2"),
    ],
)
def test_unknown_choices_are_named(choice, say):
    with pytest.raises(HilError, match=say):
        Strapdown(**choice)
    with pytest.raises(HilError, match=say):
        Navigator(Settings(**choice))
