"""Calibration of a magnetometer: exact where there is no noise, its covariance in Monte-Carlo, and what it refuses."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from nav.instruments.magnetometer import MagnetometerRefused, from_field, from_size, from_vertical

FIELD_N = np.array([20.0, 3.0, 44.0])
SIZE = float(np.linalg.norm(FIELD_N))
HARD = np.array([12.0, -7.0, 20.0])
SYMMETRIC = np.array([[1.06, 0.02, -0.03], [0.02, 0.93, 0.01], [-0.03, 0.01, 1.02]])
SKEW = SYMMETRIC @ Rotation.from_euler("xyz", [3.0, -5.0, 4.0], degrees=True).as_matrix()


def turned(n, seed):
    """Attitudes all round: flux in b and the direction up in b."""
    body = Rotation.random(n, rng=np.random.default_rng(seed))
    return body.inv().apply(FIELD_N), body.inv().apply([0.0, 0.0, -1.0])


def read(flux_b, soft, sigma=0.0, seed=0):
    return flux_b @ soft.T + HARD + sigma * np.random.default_rng(seed).standard_normal(flux_b.shape)


def errors(found, soft):
    """Of S by rows, then h."""
    return np.concatenate([(found.matrix - np.linalg.inv(soft)).ravel(), found.hard_iron - HARD])


offsets = st.floats(-60.0, 60.0)
scales = st.floats(0.7, 1.4)


@settings(max_examples=20, deadline=None)
@given(st.tuples(offsets, offsets, offsets), st.tuples(scales, scales, scales), st.integers(0, 1000))
def test_without_noise_the_ellipsoid_is_exact(offset, scale, seed):
    axes = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    soft = axes @ np.diag(scale) @ axes.T
    flux_b, _ = turned(100, seed)
    found = from_size(flux_b @ soft.T + offset, SIZE)
    np.testing.assert_allclose(found.take_off(flux_b @ soft.T + offset), flux_b, atol=1e-7 * SIZE)


def test_without_noise_the_turn_is_found_too():
    flux_b, up = turned(200, 1)
    for found in (from_vertical(read(flux_b, SKEW), 9.8 * up, SIZE), from_field(read(flux_b, SKEW), flux_b)):
        np.testing.assert_allclose(found.take_off(read(flux_b, SKEW)), flux_b, atol=1e-7 * SIZE)
    alone = from_size(read(flux_b, SKEW), SIZE)  # what the size cannot tell
    angle = Rotation.from_matrix(alone.matrix @ SKEW).magnitude()
    assert angle == pytest.approx(Rotation.from_euler("xyz", [3.0, -5.0, 4.0], degrees=True).magnitude(), rel=0.05)


@pytest.mark.parametrize("way", ["size", "vertical", "field"])
def test_the_covariance_is_that_of_many_runs(way):
    runs, sigma = 80, 0.3
    flux_b, up = turned(150, 2)
    soft = SYMMETRIC if way == "size" else SKEW
    distances, residuals = [], []
    for seed in range(runs):
        flux = read(flux_b, soft, sigma, seed)
        found = {
            "size": lambda m=flux: from_size(m, SIZE),
            "vertical": lambda m=flux: from_vertical(m, up, SIZE),
            "field": lambda m=flux: from_field(m, flux_b),
        }[way]()
        wrong = errors(found, soft)
        values, axes = np.linalg.eigh(found.covariance / sigma**2)
        free = values > 1e-12 * values[-1]  # a symmetric S has six elements
        distances.append(np.sum((axes[:, free].T @ wrong / sigma) ** 2 / values[free]))
        residuals.append(found.residual)
    freedom = int(free.sum())
    assert freedom == (9 if way == "size" else 12)
    # Beside the spread of the mean, the residual stands for sigma.
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], freedom * runs) / runs
    assert 0.95 * low < np.mean(distances) < 1.05 * high
    assert np.mean(residuals) == pytest.approx(sigma, rel=0.02)


def test_noise_falls_with_the_root_of_the_readings():
    def spread(n):
        flux_b, _ = turned(n, 3)
        return np.std([from_size(read(flux_b, SYMMETRIC, 0.5, seed), SIZE).hard_iron - HARD for seed in range(25)])

    assert spread(100) / spread(900) == pytest.approx(3.0, rel=0.4)


def test_gauss_newton_beats_the_quadric():
    """Few readings over half of the ellipsoid, much noise: the quadric is drawn inwards."""
    flux_b, _ = turned(3000, 4)
    flux_b = flux_b[flux_b[:, 2] > -5.0][:400]
    wrong = []
    for seed in range(40):
        flux = read(flux_b, SYMMETRIC, 0.7, seed)
        x, y, z = (flux - HARD).T / SIZE
        rows = np.stack([x * x, 2 * x * y, 2 * x * z, y * y, 2 * y * z, z * z, 2 * x, 2 * y, 2 * z], axis=1)
        q = np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)[0]
        shape = np.array([[q[0], q[1], q[2]], [q[1], q[3], q[4]], [q[2], q[4], q[5]]])
        quadric = -SIZE * np.linalg.solve(shape, q[6:])
        wrong.append([quadric[2], from_size(flux, SIZE).hard_iron[2] - HARD[2]])
    bias = np.abs(np.mean(wrong, axis=0))
    assert bias[1] < 0.5 * bias[0]


def test_a_level_turn_is_refused_and_says_what_lacks():
    heading = np.linspace(0.0, 2.0 * math.pi, 200)
    level = Rotation.from_rotvec(np.outer(heading, [0.0, 0.0, 1.0])).inv().apply(FIELD_N)
    with pytest.raises(MagnetometerRefused, match=r"in a plane.*(down and up|up and down)"):
        from_size(read(level, SYMMETRIC, 0.3), SIZE)


def test_a_cap_is_refused_and_names_the_other_side():
    flux_b, _ = turned(4000, 5)
    cap = flux_b[flux_b[:, 2] > 0.75 * SIZE]
    with pytest.raises(MagnetometerRefused, match=r"points .*up.*: turn the vehicle there") as refusal:
        from_size(read(cap, SYMMETRIC, 1.0), SIZE)
    assert " down" not in str(refusal.value)


def test_other_refusals():
    flux_b, up = turned(100, 6)
    with pytest.raises(MagnetometerRefused, match="not a number"):
        from_size(np.where(np.arange(300).reshape(100, 3) == 7, np.nan, flux_b), SIZE)
    with pytest.raises(MagnetometerRefused, match="not positive"):
        from_vertical(flux_b, up, 0.0)
    with pytest.raises(MagnetometerRefused, match="9 readings for 9 unknowns"):
        from_size(flux_b[:9], SIZE)
    with pytest.raises(MagnetometerRefused, match="left unexplained"):
        from_field(read(flux_b, SKEW), flux_b[::-1])
