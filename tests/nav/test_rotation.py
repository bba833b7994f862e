"""Rotations against an independent implementation (scipy), and their algebra as properties."""

import math
from itertools import permutations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from nav import rotation as algebra
from nav import turn
from nav.errors import HilError
from nav.rotation import (
    attitude_error,
    conjugate,
    dcm_from_euler,
    dcm_from_quaternion,
    dcm_from_rotation_vector,
    euler_from_dcm,
    euler_from_quaternion,
    euler_from_rotation_vector,
    normalised,
    orthonormal,
    product,
    quaternion_from_dcm,
    quaternion_from_euler,
    quaternion_from_rotation_vector,
    relative,
    rotated,
    rotation_vector_from_dcm,
    rotation_vector_from_euler,
    rotation_vector_from_quaternion,
    slerp,
)
from nav.turn import LOCK

ROUNDING = 4e-15
HALF_TURNS = [Rotation.from_euler(axis, 180, degrees=True) for axis in "xyz"]
angles = st.floats(-7.0, 7.0)
vectors = st.tuples(angles, angles, angles).map(np.array)
rotations = st.one_of(
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1).map(Rotation.from_quat),
    st.sampled_from([Rotation.identity(), *HALF_TURNS]),
)
sizes = st.one_of(st.just(0.0), st.floats(-12, -3).map(lambda exponent: 10.0**exponent))


def quaternion(rotation):
    return np.ascontiguousarray(rotation.as_quat(canonical=True, scalar_first=True))


def angle_between(q, rotation):
    return (Rotation.from_quat(q, scalar_first=True) * rotation.inv()).magnitude()


def many(seed, n):
    return Rotation.random(n, random_state=np.random.default_rng(seed))


@given(rotations, rotations, vectors)
def test_product_and_rotation_are_those_of_scipy(a, b, v):
    p, q = quaternion(a), quaternion(b)
    assert angle_between(product(p, q), a * b) < ROUNDING
    assert angle_between(relative(p, q), a.inv() * b) < ROUNDING
    assert angle_between(conjugate(p), a.inv()) < ROUNDING
    np.testing.assert_allclose(rotated(p, v), a.apply(v), atol=3e-14)


@given(rotations, rotations, vectors)
def test_the_kernels_of_loops_are_the_same_algebra(a, b, v):
    p, q = quaternion(a), quaternion(b)
    result = p.copy()
    turn.multiply(result, q, result)  # in place, as loops use it
    np.testing.assert_array_equal(result, product(p, q))
    turned = v.copy()
    turn.rotate(p, turned, turned)
    np.testing.assert_allclose(turned, rotated(p, v), atol=3e-14)
    np.testing.assert_allclose(turn.quaternion_of(*v), quaternion_from_rotation_vector(v), atol=3e-16)
    phi, matrix = np.empty(3), np.empty((3, 3))
    turn.vector_from_quaternion(p, phi)
    np.testing.assert_allclose(phi, rotation_vector_from_quaternion(p), atol=2e-15)
    turn.matrix_from_quaternion(p, matrix)
    np.testing.assert_allclose(matrix, dcm_from_quaternion(p), atol=1e-15)
    assert angle_between(turn.quaternion_from_matrix(matrix), a) < ROUNDING
    less = np.empty((1, 4))
    turn.turns_between(p[None], q[None], less)
    assert angle_between(less[0] + [1, 0, 0, 0], a.inv() * b) < 1e-7  # sqrt of rounding, at a half turn


@given(vectors, st.floats(-9, 0.4))
def test_turns_lose_nothing_to_the_identity(axis, exponent):
    """The scalar part less one is -2 sin^2(a/4), the change of a vector C v - v: relative digits at every size."""
    size = 10.0**exponent
    phi = size * (np.array([0.6, 0.0, -0.8]) if np.linalg.norm(axis) < 0.1 else axis / np.linalg.norm(axis))
    w, *vector = turn.turn_of(*phi)
    assert w == pytest.approx(-2.0 * math.sin(0.25 * size) ** 2, rel=4e-15)
    np.testing.assert_allclose(vector, math.sin(0.5 * size) / size * phi, rtol=2e-15)
    v = np.cross(phi, [0.3, -0.4, 1.1])
    change = turn.change_by_turn(*phi, *v)
    assert np.linalg.norm(change) == pytest.approx(2 * math.sin(0.5 * size) * np.linalg.norm(v), rel=2e-15)
    out = np.empty((1, 4))
    turn.turns_between(np.array([[1.0, 0, 0, 0]]), np.array([[w + 1.0, *vector]]), out)
    assert out[0, 0] == pytest.approx(w, rel=1e-14)


TO = {"quaternion": quaternion, "dcm": lambda r: r.as_matrix(), "rotation_vector": lambda r: r.as_rotvec()}
TO["euler"] = lambda r: r.as_euler("ZYX")
BACK = {
    "quaternion": lambda q: Rotation.from_quat(q, scalar_first=True),
    "dcm": Rotation.from_matrix,
    "rotation_vector": Rotation.from_rotvec,
    "euler": lambda angles: Rotation.from_euler("ZYX", angles),
}


@pytest.mark.filterwarnings("ignore:Gimbal lock:UserWarning")  # of scipy
@pytest.mark.parametrize(("source", "target"), [*permutations(TO, 2)])
@given(rotation=rotations)
def test_every_conversion_is_that_of_scipy(source, target, rotation):
    conversion = getattr(algebra, f"{target}_from_{source}")
    given_form = TO[source](rotation)
    got = conversion(*given_form) if source == "euler" else conversion(given_form)
    truth = BACK[source](given_form)  # next to gimbal lock scipy's own angles are not quite the rotation
    # Next to gimbal lock Euler angles hold the rotation to the width of the lock alone.
    locked = "euler" in (source, target) and abs(abs(truth.as_matrix()[2, 0]) - 1.0) < LOCK
    assert (BACK[target](got) * truth.inv()).magnitude() < (2.0 * LOCK if locked else ROUNDING)


@given(sizes, st.sampled_from(list(permutations((2.0, -3.0, 6.0)))))
def test_tiny_angles_keep_their_digits(size, axis):
    phi = size * np.array(axis) / 7.0
    exact = {"rtol": 4e-15, "atol": 1e-300}
    q = quaternion_from_rotation_vector(phi)
    np.testing.assert_allclose(q[1:], 0.5 * phi * (1 - size**2 / 24), **exact)
    np.testing.assert_allclose(rotation_vector_from_quaternion(q), phi, **exact)
    np.testing.assert_allclose(rotation_vector_from_dcm(dcm_from_quaternion(q)), phi, **exact)
    # Sin of the angle in the odd part of the matrix
    c = dcm_from_rotation_vector(phi)
    np.testing.assert_allclose(c[2, 1] - c[1, 2], 2 * phi[0] * np.sinc(size / math.pi), **exact)
    np.testing.assert_allclose(euler_from_quaternion(quaternion_from_euler(size, 0, 0)), [size, 0, 0], **exact)
    np.testing.assert_allclose(euler_from_quaternion(quaternion_from_euler(0, size, 0)), [0, size, 0], **exact)
    np.testing.assert_allclose(euler_from_quaternion(quaternion_from_euler(0, 0, size)), [0, 0, size], **exact)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-170, 1e-9, 1e-4, 0.0316, 0.5, math.pi, 6.2, 2 * math.pi, 20.0])
def test_rotation_vector_of_any_length(size):
    vector = size * np.array([2.0, -3.0, 6.0]) / 7.0
    q = quaternion_from_rotation_vector(vector)
    assert angle_between(q, Rotation.from_rotvec(vector)) < ROUNDING
    assert abs(np.linalg.norm(q) - 1.0) < 3e-16
    phi = rotation_vector_from_quaternion(q)
    assert np.linalg.norm(phi) == pytest.approx(abs(math.remainder(size, 2 * math.pi)), abs=3e-15)


@given(st.floats(0, 2 * math.pi), st.floats(-1.57, 1.57), st.floats(-math.pi, math.pi))
def test_euler_angles_are_intrinsic_yaw_pitch_roll(heading, pitch, roll):
    q = quaternion_from_euler(heading, pitch, roll)
    assert angle_between(q, Rotation.from_euler("ZYX", [heading, pitch, roll])) < ROUNDING
    back = euler_from_quaternion(q)
    near_lock = max(1.0, 1.0 / math.cos(pitch))
    for got, given_angle in zip(back, (heading, pitch, roll), strict=True):
        assert abs(math.remainder(got - given_angle, 2 * math.pi)) < 4e-15 * near_lock
    assert abs(back[1] - pitch) < 2e-15  # however near the vertical


@given(st.floats(-10, 10), st.floats(-10, 10), st.sampled_from([-1.0, 1.0]), st.floats(-16, -5))
def test_gimbal_lock_still_describes_the_attitude(heading, roll, sign, exponent):
    q = quaternion_from_euler(heading, sign * (0.5 * math.pi - 10.0**exponent), roll)
    angles_back = euler_from_quaternion(q)
    assert np.linalg.norm(attitude_error(quaternion_from_euler(*angles_back), q)) < 5e-12  # the width of the lock


def test_at_gimbal_lock_heading_takes_the_whole_turn():
    up = euler_from_quaternion(quaternion_from_euler(0.7, 0.5 * math.pi, 0.4))
    np.testing.assert_allclose(up, [0.3, 0.5 * math.pi, 0.0], atol=1e-15)
    down = euler_from_quaternion(quaternion_from_euler(0.7, -0.5 * math.pi, 0.4))
    np.testing.assert_allclose(down, [1.1, -0.5 * math.pi, 0.0], atol=1e-15)


@given(rotations)
@example(Rotation.from_euler("z", -1e-18))  # -tiny % 2 pi rounds to 2 pi
@example(Rotation.from_euler("ZYX", [-1e-17, 0.5 * math.pi, 0]))
def test_euler_ranges(rotation):
    heading, pitch, roll = euler_from_quaternion(quaternion(rotation))
    assert 0.0 <= heading < 2 * math.pi
    assert -0.5 * math.pi <= pitch <= 0.5 * math.pi
    assert -math.pi < roll <= math.pi


@given(rotations)
def test_the_scalar_part_of_a_matrix_is_not_negative(rotation):
    q = quaternion_from_dcm(rotation.as_matrix())
    assert q[0] >= 0.0
    assert math.isclose(np.linalg.norm(q), 1.0, rel_tol=1e-15)


@given(rotations, vectors, st.sampled_from([-1.0, 1.0]))
def test_attitude_error_is_the_short_rotation_vector_in_n(true, vector, sign):
    step = Rotation.from_rotvec(vector)
    q = sign * quaternion(step * true)
    error = attitude_error(q, quaternion(true))
    assert np.linalg.norm(error) <= math.pi + 1e-12
    assert (Rotation.from_rotvec(error) * step.inv()).magnitude() < 2e-14


@given(rotations, st.floats(1e-14, 1e-9))
def test_attitude_error_resolves_small_angles(true, size):
    vector = size * np.array([0.6, 0.0, -0.8])
    q = quaternion(Rotation.from_rotvec(vector) * true)
    np.testing.assert_allclose(attitude_error(q[None], quaternion(true)[None])[0], vector, atol=2e-15)


@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_slerp_is_that_of_scipy(seed, part):
    pair = many(seed, 2)
    ours = slerp(*quaternion(pair), part)
    assert angle_between(ours, Slerp([0, 1], pair)(part)) < 3e-14


@given(rotations, st.floats(-100, 100).map(lambda exponent: 10.0**exponent))
def test_quaternions_of_any_norm_are_the_rotation_they_stand_for(rotation, norm):
    q = norm * quaternion(rotation)
    assert angle_between(normalised(q), rotation) < ROUNDING
    np.testing.assert_allclose(dcm_from_quaternion(q), rotation.as_matrix(), atol=ROUNDING)
    np.testing.assert_allclose(rotated(q, [1.0, 2.0, 3.0]), rotation.apply([1.0, 2.0, 3.0]), atol=3e-14)


def test_normalise_keeps_direction():
    q = np.array([3.0, -4.0, 12.0, 84.0])
    np.testing.assert_allclose(normalised(q) * 85.0, [3.0, -4.0, 12.0, 84.0], rtol=1e-15)
    turn.normalise(q)
    np.testing.assert_allclose(q * 85.0, [3.0, -4.0, 12.0, 84.0], rtol=1e-15)


@given(rotations, st.tuples(*[st.floats(-0.3, 0.3)] * 9))
def test_the_nearest_rotation_of_a_skewed_matrix(rotation, skew):
    """scipy's alignment of the columns of C with the axes solves the same least squares."""
    c = rotation.as_matrix() @ (np.eye(3) + np.reshape(skew, (3, 3)))
    nearest = Rotation.align_vectors(c.T, np.eye(3))[0]
    if np.linalg.det(c) > 1e-3:
        assert (Rotation.from_matrix(orthonormal(c)) * nearest.inv()).magnitude() < 1e-12


def test_leading_axes_broadcast():
    a, b = many(1, 6), many(2, 3)
    p, q = quaternion(a).reshape(2, 3, 4), quaternion(b)
    np.testing.assert_allclose(product(p, q)[1, 2], product(p[1, 2], q[2]), atol=0)
    np.testing.assert_allclose(dcm_from_quaternion(p).reshape(6, 3, 3), a.as_matrix(), atol=ROUNDING)
    assert angle_between(quaternion_from_dcm(a.as_matrix()), a).max() < ROUNDING
    v = np.arange(9.0).reshape(3, 3)
    np.testing.assert_allclose(rotated(p, v)[1, 0], a[3].apply(v[0]), atol=1e-14)
    assert quaternion_from_euler(np.zeros((5, 1)), np.zeros(2), 0.0).shape == (5, 2, 4)


EMPTY = {"quaternion": (0, 4), "dcm": (0, 3, 3), "rotation_vector": (0, 3), "euler": (0, 3)}


@pytest.mark.parametrize(("source", "target"), [*permutations(EMPTY, 2)])
def test_empty_arrays_stay_empty(source, target):
    conversion = getattr(algebra, f"{target}_from_{source}")
    nothing = np.zeros(EMPTY[source])
    got = conversion(*nothing.T) if source == "euler" else conversion(nothing)
    assert got.shape == EMPTY[target]


NAN4, NAN3 = [1.0, math.nan, 0.0, 0.0], [0.0, math.inf, 0.0]
BAD_MATRIX = np.full((3, 3), math.nan)


@pytest.mark.parametrize(
    ("call", "say"),
    [
        (lambda: product(NAN4, [1, 0, 0, 0]), r"quaternion: element \(1,\) is nan"),
        (lambda: conjugate([[1, 0, 0, 0], NAN4]), r"element \(1, 1\) is nan"),
        (lambda: rotated([1, 0, 0, 0], NAN3), r"vector: element \(1,\) is inf"),
        (lambda: attitude_error(NAN4, [1, 0, 0, 0]), "is nan"),
        (lambda: quaternion_from_rotation_vector(NAN3), "rotation vector: element"),
        (lambda: quaternion_from_euler(0.0, math.nan, 0.0), r"Euler angles: element \(1,\) is nan"),
        (lambda: rotation_vector_from_euler(0.0, 0.0, math.inf), "Euler angles"),
        (lambda: dcm_from_euler(math.nan, 0.0, 0.0), "Euler angles"),
        (lambda: euler_from_rotation_vector(NAN3), "rotation vector"),
        (lambda: quaternion_from_dcm(BAD_MATRIX), r"matrix: element \(0, 0\) is nan"),
        (lambda: euler_from_dcm(2.0 * np.eye(3)), "C C' leaves I by 3"),
        (lambda: quaternion_from_dcm(np.diag([1.0, 1.0, -1.0])), "determinant is negative"),
        (lambda: orthonormal(np.diag([1.0, 1.0, 0.0])), "has no rotation near it"),
        (lambda: orthonormal(-np.eye(3)), "turns right hands into left ones"),
        (lambda: dcm_from_quaternion(np.zeros(4)), "norm 0"),
        (lambda: euler_from_quaternion(np.zeros((2, 4))), "is there an attitude yet"),
        (lambda: slerp(np.zeros(4), [1, 0, 0, 0], 0.5), "norm 0"),
        (lambda: normalised([1.0, 0.0, 0.0]), r"shape \(3,\) where \(..., 4\) is needed"),
        (lambda: quaternion_from_dcm(np.eye(4)), r"shape \(4, 4\) where \(..., 3, 3\) is needed"),
    ],
)
def test_what_is_no_rotation_is_refused(call, say):
    with pytest.raises(HilError, match=say):
        call()
