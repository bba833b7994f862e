"""Rotations against an independent implementation (scipy), and their algebra as properties."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nav.rotation import (
    attitude_error,
    dcm_from_quaternion,
    euler_angles,
    euler_from_quaternion,
    from_rotation_vector,
    multiply,
    normalise,
    quaternion_from_dcm,
    quaternion_from_euler,
    rotate,
)

ROUNDING = 4e-15
angles = st.floats(-7.0, 7.0)
vectors = st.tuples(angles, angles, angles).map(np.array)
rotations = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1).map(Rotation.from_quat)


def quaternion(rotation):
    return np.ascontiguousarray(rotation.as_quat(canonical=True, scalar_first=True))


def angle_between(q, rotation):
    return (Rotation.from_quat(q, scalar_first=True) * rotation.inv()).magnitude()


@given(rotations, rotations, vectors)
def test_product_and_rotation_are_those_of_scipy(a, b, v):
    product = quaternion(a)
    multiply(product, quaternion(b), product)  # in place, as the kernels use it
    assert angle_between(product, a * b) < ROUNDING
    turned = v.copy()
    rotate(quaternion(a), turned, turned)
    np.testing.assert_allclose(turned, a.apply(v), atol=3e-14)


@given(rotations)
@example(Rotation.from_euler("x", 180, degrees=True))
@example(Rotation.from_euler("y", 180, degrees=True))
@example(Rotation.from_euler("z", 180, degrees=True))
@example(Rotation.identity())
def test_matrix_and_back(rotation):
    c = dcm_from_quaternion(quaternion(rotation))
    np.testing.assert_allclose(c, rotation.as_matrix(), atol=ROUNDING)
    q = quaternion_from_dcm(np.ascontiguousarray(rotation.as_matrix()))
    assert angle_between(q, rotation) < ROUNDING
    assert q[0] >= 0.0
    assert math.isclose(np.linalg.norm(q), 1.0, rel_tol=1e-15)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-9, 1e-4, 0.0316, 0.03163, 0.5, math.pi, 6.2, 20.0])
def test_rotation_vector_on_both_sides_of_its_series(size):
    x, y, z = vector = size * np.array([2.0, -3.0, 6.0]) / 7.0
    q = np.empty(4)
    from_rotation_vector(x, y, z, q)
    assert angle_between(q, Rotation.from_rotvec(vector)) < ROUNDING
    assert abs(np.linalg.norm(q) - 1.0) < 3e-16


def test_normalise_keeps_direction():
    q = np.array([3.0, -4.0, 12.0, 84.0])
    normalise(q)
    np.testing.assert_allclose(q * 85.0, [3.0, -4.0, 12.0, 84.0], rtol=1e-15)


@given(st.floats(0, 2 * math.pi), st.floats(-1.57, 1.57), st.floats(-math.pi, math.pi))
def test_euler_angles_are_intrinsic_yaw_pitch_roll(heading, pitch, roll):
    q = quaternion_from_euler(heading, pitch, roll)
    assert angle_between(q, Rotation.from_euler("ZYX", [heading, pitch, roll])) < ROUNDING
    back = euler_from_quaternion(q)
    near_lock = max(1.0, 1.0 / math.cos(pitch))
    for got, given_angle in zip(back, (heading, pitch, roll), strict=True):
        assert abs(math.remainder(got - given_angle, 2 * math.pi)) < 4e-15 * near_lock


@given(st.floats(-10, 10), st.floats(-10, 10), st.sampled_from([-1.0, 1.0]), st.floats(0, 3e-6))
def test_gimbal_lock_still_describes_the_attitude(heading, roll, sign, away):
    q = quaternion_from_euler(heading, sign * (0.5 * math.pi - away), roll)
    angles_back = euler_from_quaternion(q)
    again = quaternion_from_euler(*angles_back)
    assert (
        angle_between(again, Rotation.from_quat(q, scalar_first=True)) < 3e-6
    )  # twice the width in which roll is taken as 0
    assert all(math.isfinite(angle) for angle in angles_back)


@given(rotations)
@example(Rotation.from_euler("z", -1e-18))  # -tiny % 2 pi rounds to 2 pi
@example(Rotation.from_euler("ZYX", [-1e-17, 0.5 * math.pi, 0]))
def test_euler_ranges(rotation):
    heading, pitch, roll = euler_angles(quaternion(rotation)[None])[0]
    assert 0.0 <= heading < 2 * math.pi
    assert -0.5 * math.pi <= pitch <= 0.5 * math.pi
    assert -math.pi <= roll <= math.pi


@given(rotations, vectors, st.sampled_from([-1.0, 1.0]))
def test_attitude_error_is_the_short_rotation_vector_in_n(true, vector, sign):
    turn = Rotation.from_rotvec(vector)
    q = sign * quaternion(turn * true)
    error = attitude_error(q, quaternion(true))
    assert np.linalg.norm(error) <= math.pi + 1e-12
    assert (Rotation.from_rotvec(error) * turn.inv()).magnitude() < 2e-14


@given(rotations, st.floats(1e-14, 1e-9))
def test_attitude_error_resolves_small_angles(true, size):
    vector = size * np.array([0.6, 0.0, -0.8])
    q = quaternion(Rotation.from_rotvec(vector) * true)
    np.testing.assert_allclose(attitude_error(q[None], quaternion(true)[None])[0], vector, atol=2e-15)
