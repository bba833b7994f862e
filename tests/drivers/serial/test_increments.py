"""Rotation vectors and velocity changes of a coning, sculling motion against the integrals that the navigator takes."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drivers.serial.driver import rotation_vector
from drivers.serial.increments import PAST, from_integrals, to_integrals
from nav.rotation import quaternion_from_rotation_vector

NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)
HALF, FREQUENCY = 0.2, 7.0
"""Half-angle of the cone, rad, and its frequency, rad/s."""


def attitude(t: NDArray[np.float64]) -> Rotation:
    """A body that cones: rotation vector of constant size about an axis that turns in the plane."""
    return Rotation.from_rotvec(HALF * np.stack([np.cos(FREQUENCY * t), np.sin(FREQUENCY * t), 0 * t], axis=-1))


def rate(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Its rate in body axes (closed form)."""
    sine, double = np.sin(HALF), 2.0 * np.sin(HALF / 2.0) ** 2
    return FREQUENCY * np.stack([-sine * np.sin(FREQUENCY * t), sine * np.cos(FREQUENCY * t), 0 * t - double], axis=-1)


def force(t: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.sin(5.0 * t), 2.0 * np.cos(3.0 * t), -9.8 + 0.5 * np.sin(FREQUENCY * t)], axis=-1)


def integral(function: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    return np.asarray(0.5 * step * np.tensordot(WEIGHTS, function, axes=(0, 0)))


def steps(step: float, n: int = 6) -> tuple[NDArray[np.float64], ...]:
    """Exact phi, u, dtheta, dvel of `n` steps."""
    rows = []
    for k in range(n):
        t = step * (k + 0.5 * (NODES + 1.0))
        here, there = attitude(np.array(step * k)), attitude(np.array(step * (k + 1)))
        turned = (here.inv() * attitude(t)).apply(force(t))
        rows.append(
            (
                (here.inv() * there).as_rotvec(),
                integral(turned, step),
                integral(rate(t), step),
                integral(force(t), step),
            )
        )
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def errors(step: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Largest errors of the third and later steps, with the conversion and without: of angle and velocity."""
    phi, u, dtheta, dvel = steps(step)
    raw = [np.abs(phi - dtheta)[2:].max(), np.abs(u - dvel)[2:].max()]
    to_integrals(phi, u, np.ones(len(phi), np.int64), np.arange(len(phi)), np.zeros(PAST))
    return np.array([np.abs(phi - dtheta)[2:].max(), np.abs(u - dvel)[2:].max()]), np.array(raw)


def test_the_closed_form_is_the_motion() -> None:
    t, h = np.array(0.3), 1e-5
    numeric = (attitude(t - h).inv() * attitude(t + h)).as_rotvec() / (2 * h)
    np.testing.assert_allclose(rate(t), numeric, atol=1e-8)


def test_coning_and_sculling_are_taken_off_to_the_order_of_the_rule() -> None:
    coarse, fine = errors(0.02), errors(0.01)
    order, raw = np.log2(coarse[0] / fine[0]), np.log2(coarse[1] / fine[1])
    assert (order > 3.5).all()
    assert raw[0] < 3.3
    assert raw[1] < 2.3
    assert (fine[0] < 0.02 * fine[1]).all()


def test_the_emulators_way_back_is_the_same() -> None:
    _, _, dtheta, dvel = steps(0.01)
    before, half = np.zeros((2, 3)), len(dtheta) // 2
    parts = [from_integrals(dtheta[rows], dvel[rows], before) for rows in (slice(half), slice(half, None))]
    phi, u = (np.concatenate(column) for column in zip(*parts, strict=True))
    exact_phi, exact_u, _, _ = steps(0.01)
    assert np.abs(phi - exact_phi)[1:].max() < 0.02 * np.abs(dtheta - exact_phi)[1:].max()
    assert np.abs(u - exact_u)[1:].max() < 0.02 * np.abs(dvel - exact_u)[1:].max()


def test_steady_turning_is_exact_with_and_without_a_step_before() -> None:
    """A steady turn under steady force has u = J(phi) dvel for any angle."""
    w, f, step = np.array([0.6, -0.4, 1.2]), np.array([1.0, 2.0, -9.8]), 0.1
    t = 0.5 * step * (NODES + 1.0)
    turned = Rotation.from_rotvec(t[:, None] * w).apply(np.tile(f, (len(t), 1)))
    phi, u = np.tile(w * step, (3, 1)), np.tile(integral(turned, step), (3, 1))
    sequence = np.array([4, 7, 8])  # a gap before the second
    to_integrals(phi, u, np.ones(3, np.int64), sequence, np.zeros(PAST))
    np.testing.assert_allclose(phi, np.tile(w * step, (3, 1)), atol=1e-15)
    expected = np.tile(f * step, (3, 1))
    np.testing.assert_allclose(u, expected, atol=1e-9)


def test_rotation_vector_is_the_logarithm() -> None:
    for phi in ([0.0, 0.0, 0.0], [1e-9, 0.0, 0.0], [0.3, -0.2, 0.1], [2.0, 1.0, -2.0]):
        q = quaternion_from_rotation_vector(phi)
        np.testing.assert_allclose(rotation_vector(*q), phi, atol=1e-15)
        np.testing.assert_allclose(rotation_vector(*(-3.0 * q)), phi, atol=1e-15)
    assert rotation_vector(0.0, 0.0, 0.0, 0.0) == (0.0, 0.0, 0.0)
