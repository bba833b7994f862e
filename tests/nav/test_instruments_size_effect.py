"""The size effect, its compensation and the layouts: closed forms, the printed equations, streams and the best centre."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from nav.errors import HilError
from nav.instruments.layout import (
    best_axes,
    best_centre,
    common_layout,
    honeywell_layout,
    ideal_layout,
    motion_gram,
    moved,
    size_error,
    spectrum_gram,
)
from nav.instruments.pendulum import Pendulum, apparent_force
from nav.instruments.size_effect import MEMORY, compensate, integrate_twice, size_coefficients, size_terms

RNG = np.random.default_rng(5)
SCATTERED = tuple(
    replace(Pendulum(), hinge=tuple(place), axes=tuple(map(tuple, turn)))
    for place, turn in zip(
        RNG.uniform(-0.15, 0.15, (3, 3)), Rotation.random(3, random_state=5).as_matrix(), strict=True
    )
)
vectors = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


@given(vectors, vectors)
def test_nine_coefficients_are_the_pendulum_in_equilibrium(rate, acceleration):
    found = size_coefficients(SCATTERED) @ size_terms(rate[None], acceleration[None])[0]
    expected = [apparent_force(p, np.zeros(3), rate, acceleration)[0] for p in SCATTERED]
    np.testing.assert_allclose(found, expected, atol=1e-13)


def compensated(step, dtheta, dvel, coefficients, splits=()):
    memory, out = np.zeros(MEMORY), np.empty_like(dvel)
    for a, b in zip([0, *splits], [*splits, len(step)], strict=True):
        compensate(memory, coefficients, step[a:b], dtheta[a:b], dvel[a:b], out[a:b])
    return out


@pytest.mark.parametrize("steps", [(1e-3, 1e-3, 1e-3), (1e-3, 2.7e-3, 0.4e-3)])
def test_exact_for_a_rate_linear_in_time(steps):
    """Unequal steps as well: the integral of the nine terms by Gauss nodes."""
    a, b = np.array([0.4, -2.0, 1.0]), np.array([300.0, 100.0, -200.0])
    edges = np.cumsum([0.0, *steps])
    rows = size_coefficients(SCATTERED)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    dtheta, expected = [], []
    for t0, t1 in pairwise(edges):
        time = 0.5 * (t0 + t1) + 0.5 * (t1 - t0) * nodes
        rate = a + b * time[:, None]
        dtheta.append(0.5 * (t1 - t0) * weights @ rate)
        expected.append(0.5 * (t1 - t0) * weights @ size_terms(rate, np.tile(b, (3, 1))) @ rows.T)
    found = -compensated(np.array(steps), np.array(dtheta), np.zeros((3, 3)), rows)
    np.testing.assert_allclose(found[1:], expected[1:], rtol=1e-12)
    assert found[0] == pytest.approx(rows[:, :6] @ size_terms((dtheta[0] / steps[0])[None], a[None])[0, :6] * steps[0])


def test_equal_steps_are_the_printed_equation():
    """Eqs. 2.8, 2.9, 2.11 for one channel whose axes are those of the block."""
    p = replace(Pendulum(), hinge=(0.12, 0.0, 0.07))
    m, n, l, _ = p.coefficients  # noqa: E741
    t, (d0, d1) = 1e-3, RNG.normal(0.0, 1e-3, (2, 3))
    a, b = (d1 + d0) / (2 * t), (d1 - d0) / t**2
    printed = (
        m * (a[0] * a[2] * t + (a[0] * b[2] + b[0] * a[2]) * t**2 / 2 + b[0] * b[2] * t**3 / 3)
        + n * ((a[1] ** 2 + a[2] ** 2) * t + (a[1] * b[1] + a[2] * b[2]) * t**2 + (b[1] ** 2 + b[2] ** 2) * t**3 / 3)
        + l * b[1] * t
    )
    out = compensated(np.array([t, t]), np.array([d0, d1]), np.zeros((2, 3)), size_coefficients([p] * 3))
    np.testing.assert_allclose(-out[1], printed, rtol=1e-12)


@settings(max_examples=30)
@given(st.lists(st.integers(0, 60), max_size=6).map(sorted))
def test_streams_do_not_depend_on_batches(splits):
    rng = np.random.default_rng(1)
    step = rng.choice([1e-3, 1.3e-3, 0.0], 60, p=[0.6, 0.3, 0.1])
    dtheta, dvel = rng.normal(0, 1e-3, (60, 3)), rng.normal(0, 1e-2, (60, 3))
    rows = size_coefficients(SCATTERED)
    whole = compensated(step, dtheta, dvel, rows)
    np.testing.assert_array_equal(compensated(step, dtheta, dvel, rows, splits), whole)
    np.testing.assert_array_equal(whole[step == 0.0], dvel[step == 0.0])
    assert np.isfinite(whole).all()

    def twice(cuts):
        memory, v, s = np.zeros(10), np.empty((60, 3)), np.empty((60, 3))
        for a, b in zip([0, *cuts], [*cuts, 60], strict=True):
            integrate_twice(memory, step[a:b], dvel[a:b], v[a:b], s[a:b])
        return np.concatenate([v, s])

    np.testing.assert_array_equal(twice(splits), twice([]))


def test_compensates_in_place():
    step, dtheta, dvel = np.full(20, 1e-3), RNG.normal(0, 1e-3, (20, 3)), RNG.normal(0, 1e-2, (20, 3))
    expected = compensated(step, dtheta, dvel, size_coefficients(SCATTERED))
    compensate(np.zeros(MEMORY), size_coefficients(SCATTERED), step, dtheta, dvel, dvel)
    np.testing.assert_array_equal(dvel, expected)


def test_second_integral_is_exact_for_a_force_linear_in_time_and_unequal_steps():
    edges = np.cumsum([0.0, 1e-3, 2e-3, 0.7e-3, 1.9e-3])
    a, b = np.array([3.0, -1.0, 9.8]), np.array([800.0, -300.0, 0.0])
    velocity = np.outer(edges, a) + 0.5 * np.outer(edges**2, b)
    position = 0.5 * np.outer(edges**2, a) + np.outer(edges**3, b) / 6.0
    v, s = np.empty((4, 3)), np.empty((4, 3))
    integrate_twice(np.zeros(10), np.diff(edges), np.diff(velocity, axis=0), v, s)
    np.testing.assert_allclose(v, velocity[1:], atol=1e-15)
    first = position[1] - s[0]  # the slope over the first step is not known
    np.testing.assert_allclose(first, -b * edges[1] ** 3 / 12.0, atol=1e-15)
    np.testing.assert_allclose(s[1:] + first, position[2:], atol=1e-15)


def test_second_integral_for_equal_steps_is_the_pages_formula():
    t, dvel = 1e-3, RNG.normal(0, 0.01, (2, 3))
    v, s = np.empty((2, 3)), np.empty((2, 3))
    integrate_twice(np.zeros(10), np.full(2, t), dvel, v, s)
    np.testing.assert_allclose(s[1] - s[0], v[0] * t + t / 12 * (5 * dvel[1] + dvel[0]), rtol=1e-12)


def test_optimal_layouts_have_anisoinertia_only():
    k = Pendulum().anisoinertia
    for layout in (ideal_layout, honeywell_layout):
        block = layout(Pendulum())
        np.testing.assert_array_equal([p.axes[0] for p in block], np.eye(3))
        rows = size_coefficients(block)
        np.testing.assert_allclose(rows[:, [0, 1, 2, 6, 7, 8]], 0.0, atol=1e-17)
        np.testing.assert_allclose(np.abs(rows).sum(axis=1), k, rtol=1e-12)
        for p in block:
            np.testing.assert_allclose(p.centre_of_percussion, 0.0, atol=1e-17)
        places = np.array([p.hinge for p in block])
        apart = np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1)
        assert apart.min() > Pendulum().percussion_radius  # no two cases in one place


@given(vectors, vectors, st.floats(-3.1, 3.1))
def test_common_layout_is_the_printed_one(rate, acceleration, alpha):
    """Eqs. 1.10 and 1.11."""
    p, out = Pendulum(), 0.09
    block = common_layout(p, out, alpha)
    a, b, c = p.inertia
    moment = p.mass * p.arm
    m1, n1 = (b + c - a) / moment, -out
    m3, n3, l3 = -p.arm - (a - c) / moment, -p.percussion_radius, -p.percussion_radius
    (wx, wy, wz), (ex, ey, _) = rate, acceleration
    printed = [
        m1 * wx * wz + n1 * (wy**2 + wz**2),
        m1 * wy * wz + n1 * (wx**2 + wz**2),
        m3 * wz * (wy * math.sin(alpha) - wx * math.cos(alpha))
        + n3 * (wx**2 + wy**2)
        + l3 * (ex * math.sin(alpha) + ey * math.cos(alpha)),
    ]
    found = size_coefficients(block) @ size_terms(rate[None], acceleration[None])[0]
    np.testing.assert_allclose(found, printed, atol=1e-13)


def test_moving_the_centre_is_rigid_body_kinematics():
    d, rate, acceleration = np.array([0.03, -0.06, 0.02]), np.array([1.0, -2.0, 0.5]), np.array([20.0, 5.0, -9.0])
    terms = size_terms(rate[None], acceleration[None])[0]
    change = (size_coefficients(moved(SCATTERED, d)) - size_coefficients(SCATTERED)) @ terms
    there = np.cross(acceleration, d) + np.cross(rate, np.cross(rate, d))
    np.testing.assert_allclose(change, [-there @ p.axes[0] for p in SCATTERED], atol=1e-13)


def gaussian_motion(n=200_000):
    mix = np.random.default_rng(8).normal(0, 1, (6, 6))
    samples = np.random.default_rng(9).normal(0, 1, (n, 6)) @ mix.T
    return samples[:, :3], samples[:, 3:] * 50.0, mix @ mix.T


def test_spectrum_is_the_mean_over_gaussian_motion():
    rate, acceleration, covariance = gaussian_motion()
    closed = spectrum_gram(covariance[:3, :3], 2500.0 * covariance[3:, 3:])
    found = motion_gram(size_terms(rate, acceleration))
    scale = np.sqrt(np.outer(np.diag(closed), np.diag(closed)))
    assert np.abs((found - closed) / scale).max() < 0.03


def test_best_centre_beside_a_search():
    rate, acceleration, _ = gaussian_motion(500)
    gram = motion_gram(size_terms(rate, acceleration))
    found = best_centre(SCATTERED, gram)
    search = minimize(
        lambda d: size_error(moved(SCATTERED, d), gram), np.zeros(3), method="BFGS", options={"gtol": 1e-8}
    )
    np.testing.assert_allclose(found, search.x, atol=1e-5)
    terms = size_terms(rate, acceleration) @ size_coefficients(SCATTERED).T
    assert size_error(SCATTERED, gram) == pytest.approx(math.sqrt((terms**2).sum(axis=1).mean()))


@given(vectors.map(lambda v: 0.1 * v))
def test_best_centre_of_an_ideal_block_is_its_own(hidden):
    rate, acceleration, _ = gaussian_motion(100)
    found = best_centre(moved(ideal_layout(Pendulum()), hidden), motion_gram(size_terms(rate, acceleration)))
    # Anisoinertia pulls it aside by a share of its 1.8 mm; without it the centre is found
    plate = replace(Pendulum(), inertia=(sum(Pendulum().inertia[1:]), *Pendulum().inertia[1:]))
    assert np.linalg.norm(found + hidden) < Pendulum().anisoinertia
    exact = best_centre(moved(ideal_layout(plate), hidden), motion_gram(size_terms(rate, acceleration)))
    np.testing.assert_allclose(exact, -hidden, atol=1e-9)


def test_what_the_motion_does_not_show_stays():
    """In a steady turn about z, no force depends on the height of O."""
    rate = np.tile([0.0, 0.0, 0.3], (10, 1))
    found = best_centre(SCATTERED, motion_gram(size_terms(rate, np.zeros((10, 3)))))
    assert found[2] == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(HilError, match="gram"):
        best_centre(SCATTERED, -np.eye(9))


def test_best_axes_are_orthogonal_and_nearest():
    bent = Rotation.from_rotvec([[0, 0.01, 0], [0.02, 0, 0], [0.0, 0.005, 0.3]]).as_matrix()
    block = [
        replace(p, axes=tuple(map(tuple, np.array(p.axes) @ c)))
        for p, c in zip(ideal_layout(Pendulum()), bent, strict=True)
    ]
    axes, sensing = best_axes(block), np.array([p.axes[0] for p in block])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    least = np.linalg.norm(axes - sensing)
    for turn in Rotation.from_rotvec(RNG.normal(0, 1e-3, (20, 3))):
        assert np.linalg.norm(axes @ turn.as_matrix() - sensing) > least
    with pytest.raises(HilError, match="one plane"):
        best_axes([block[0], block[0], block[1]])
