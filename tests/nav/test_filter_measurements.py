"""Each model: no residual for the truth, taken back by the age; H is the derivative of the residual."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hil.study.navigation.flights import flight
from nav.aiding import Kind
from nav.earth import RATE, curvature_radii
from nav.filter import measurements as models
from nav.filter.states import STATES
from nav.lever_arm import shift
from nav.rotation import euler_from_quaternion

MOTION = flight("agile")
ARM, DELAY, OFFSET = np.array([2.0, -1.0, -0.5]), 0.01, 12.0
FIELD = np.array([20e-6, 3e-6, 45e-6])
AGE = 0.004
TIMES = (3.0, 11.3, 40.7)
SMALL = np.repeat([1.0, 0.1, 1e-4, 1e-6, 1e-4, 1e-5, 1e-5, 1e-7, 1e-2], 3)
"""Errors that are small, in the order of the states up to the lever arm."""


def row(time):
    return MOTION.truth([time])[0]


def instant(truth, x=None):
    """The navigator at a time, with the errors `x` in what it computes."""
    at = np.zeros(models.INSTANT)
    at[:10] = truth["lat"], truth["lon"], truth["height"], *truth["vel_n"], *truth["q_nb"]
    rate, force = truth["w_ib_b"].copy(), truth["f_b"].copy()
    if x is not None:
        meridian, prime = curvature_radii(math.sin(at[0]))
        at[0:3] += (
            x[0] / (meridian + at[2]),
            x[1] / ((prime + at[2]) * math.cos(at[0])),
            -x[2],
        )
        at[3:6] += x[3:6]
        turned = Rotation.from_rotvec(x[6:9]) * Rotation.from_quat(truth["q_nb"], scalar_first=True)
        at[6:10] = turned.as_quat(scalar_first=True)
        rate += x[9:12] + x[15:18] * rate + x[21:24] * force
        force += x[12:15] + x[18:21] * force
    at[models.MEAN_PART] = at[models.LAST_PART] = np.concatenate([rate, force])
    return at


def antenna(truth):
    one = [np.array([truth[name]]) for name in ("lat", "lon", "height")]
    vel, q, w = truth["vel_n"][None].copy(), truth["q_nb"][None].copy(), truth["w_ib_b"][None].copy()
    shift(*one, vel, q, w, ARM)
    return np.array([part[0] for part in one]), vel[0]


def run(kind, at, then, age, x=None, sigma=None):
    """Residual, H, variance of a measurement that is true of `then`."""
    x = np.zeros(STATES) if x is None else x
    h, residual, variance = np.full((3, STATES), np.nan), np.full(3, np.nan), np.full(3, np.nan)
    sigma = np.array([0.1, 0.2, 0.3]) if sigma is None else sigma
    c = Rotation.from_quat(then["q_nb"], scalar_first=True)
    to = (sigma, age, h, residual, variance)
    arm, delay = ARM - x[24:27], DELAY - x[27]
    if kind == "gnss position":
        m = models.gnss_position(at, arm, delay, antenna(then)[0], *to)
    elif kind == "gnss velocity":
        m = models.gnss_velocity(at, arm, delay, antenna(then)[1], *to)
    elif kind == Kind.BARO:
        m = models.barometer(at, OFFSET - x[28], np.array([then["height"] + OFFSET]), *to)
    elif kind == Kind.HEADING:
        m = models.heading(at, euler_from_quaternion(then["q_nb"])[:1], *to)
    elif kind == Kind.ATTITUDE:
        m = models.attitude(at, then["q_nb"].copy(), *to)
    elif kind == Kind.BODY_VELOCITY:
        m = models.body_velocity(at, c.inv().apply(then["vel_n"]), *to)
    elif kind == "magnetic heading":
        m = models.magnetic_heading(at, math.atan2(FIELD[1], FIELD[0]), 1e3 * c.inv().apply(FIELD), *to)
    else:
        m = models.magnetic(at, FIELD, c.inv().apply(FIELD), *to)
    return residual[:m], h[:m], variance[:m]


KINDS = {
    "gnss position": 2e-4,
    "gnss velocity": 4e-2,
    Kind.BARO: 2e-4,
    Kind.HEADING: 2e-5,
    Kind.ATTITUDE: 2e-5,
    Kind.BODY_VELOCITY: 1e-2,
    Kind.MAGNETIC: 1e-9,
    "magnetic heading": 4e-5,
}
"""What the steady velocity, acceleration and rate leave over the age."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("time", TIMES)
def test_the_truth_has_no_residual(kind, time):
    delay = DELAY if str(kind).startswith("gnss") else 0.0
    residual, h, variance = run(kind, instant(row(time)), row(time - AGE - delay), AGE)
    assert np.abs(residual).max() < KINDS[kind]
    assert np.isfinite(h).all()
    level = 1e3 * math.hypot(FIELD[0], FIELD[1]) if kind == "magnetic heading" else 1.0
    np.testing.assert_allclose(variance, (np.array([0.1, 0.2, 0.3])[: len(variance)] / level) ** 2, rtol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("time", TIMES)
def test_h_is_the_derivative(kind, time):
    """Central differences. Left out: what errors of the rate and the force do over the age."""
    truth, then = row(time), row(time - AGE)
    _, h, _ = run(kind, instant(truth), then, AGE)
    for state in range(29):
        x = np.zeros(STATES)
        x[state] = SMALL[state] if state < 27 else 1e-3
        plus, _, _ = run(kind, instant(truth, x), then, AGE, x)
        minus, _, _ = run(kind, instant(truth, -x), then, AGE, -x)
        found = 0.5 * (plus - minus)
        if state >= 12 and state < 24:
            assert np.abs(found).max() < 1e-3 * (1.0 if kind != "gnss position" else 1e-1)
            continue
        scale = np.abs(h).max(axis=1) * abs(x[state]) + 1e-12
        assert (np.abs(found - h[:, state] * x[state]) < 0.03 * scale).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_component_without_a_sigma_gives_no_row(kind):
    truth = row(3.0)
    whole = run(kind, instant(truth), row(3.1), 0.0)
    partial = run(kind, instant(truth), row(3.1), 0.0, sigma=np.array([math.inf, 0.2, 0.3]))
    for all_of_it, some in zip(whole, partial, strict=True):
        np.testing.assert_array_equal(some, all_of_it[1:] if len(all_of_it) == 3 else all_of_it[:0])


@pytest.mark.parametrize("kind", ["rate", "gravity"])
def test_pseudo_measurements(kind):
    """A still body turns with the Earth and feels gravity; H is the derivative."""
    truth = row(0.0).copy()
    c = Rotation.from_quat(truth["q_nb"], scalar_first=True)
    truth["vel_n"] = 0.0
    truth["w_ib_b"] = c.inv().apply(RATE * np.array([math.cos(truth["lat"]), 0.0, -math.sin(truth["lat"])]))
    truth["f_b"] = c.inv().apply([0.0, 0.0, -9.81])
    h, residual, variance = np.zeros((3, STATES)), np.zeros(3), np.zeros(3)

    def model(x):
        sigma, out = np.full(3, 0.1), np.empty(3)
        fill = models.earth_rate if kind == "rate" else models.gravity
        m = fill(instant(truth, x), sigma, h, out, variance)
        return out[:m].copy()

    assert np.abs(model(np.zeros(STATES))).max() < 1e-12
    expected = h.copy()
    for state in range(24):
        x = np.zeros(STATES)
        x[state] = SMALL[state]
        found = 0.5 * (model(x) - model(-x))
        np.testing.assert_allclose(
            found, expected[: len(found), state] * x[state], atol=1e-4 * np.abs(found).max() + 1e-10
        )
    assert residual.shape == (3,)


def test_gravity_is_not_believed_in_a_manoeuvre():
    h, residual, variance = np.zeros((3, STATES)), np.zeros(3), np.zeros(3)
    found = []
    for pull in (1.0, 1.3):
        truth = row(0.0).copy()
        truth["f_b"] = 0.0, 0.0, -9.81 * pull
        models.gravity(instant(truth), np.full(2, 0.1), h, residual, variance)
        found.append(variance[0])
    assert found[0] == pytest.approx(0.01, rel=0.02)
    assert math.sqrt(found[1]) > 0.3 * 9.81 * 0.4


def test_there_is_no_heading_when_the_nose_points_up():
    truth = row(0.0).copy()
    truth["q_nb"] = Rotation.from_euler("ZYX", [0.0, 89.9, 0.0], degrees=True).as_quat(scalar_first=True)
    residual, _, _ = run(Kind.HEADING, instant(truth), row(0.0), 0.0)
    assert len(residual) == 0


def test_a_vertical_flux_tells_no_heading():
    flat, arrays = instant(row(3.0)), (np.full((3, STATES), np.nan), np.full(3, np.nan), np.full(3, np.nan))
    flat[6:10] = 1.0, 0.0, 0.0, 0.0
    for level, rows in ((0.05, 0), (0.2, 1)):
        flux = np.array([level, 0.0, 1.0])
        assert models.magnetic_heading(flat, 0.0, flux, np.full(3, 0.1), 0.0, *arrays) == rows
