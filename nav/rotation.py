"""Rotations of whole arrays: quaternions (..., 4), direction cosines (..., 3, 3), rotation vectors and angles (..., 3).

Conventions as in :mod:`nav`: ``q_ab`` is Hamilton, scalar first, and takes vectors from b to a, as ``C_ab`` does; a
rotation vector is axis times angle, rad; Euler angles are heading, pitch, roll, rad. Every function broadcasts over the
leading axes, takes empty arrays, and returns new ones. What is done sample by sample is in :mod:`nav.turn`.

Where a quaternion stands for a rotation it need not be of unit norm: it is normalised first. A matrix must be a rotation to
`DEFECT`; :func:`orthonormal` mends a worse one. Every function raises `HilError` for a value that is not finite, a
quaternion whose norm is not a positive number, a matrix that is not a rotation, and a wrong shape.
"""

import numpy as np
from numpy.typing import ArrayLike

from nav.errors import HilError
from nav.increments import FloatArray
from nav.kernel import kernel
from nav.turn import euler_of

DEFECT = 1e-6
"""Largest element of C C' - I that is taken for rounding."""


def product(p: ArrayLike, q: ArrayLike) -> FloatArray:
    """Hamilton's product p q; ``q_ac = q_ab q_bc``. Norms multiply."""
    p, q = _array(p, "quaternion", 4), _array(q, "quaternion", 4)
    (a, b, c, d), (w, x, y, z) = np.moveaxis(p, -1, 0), np.moveaxis(q, -1, 0)
    return np.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=-1,
    )


def conjugate(q: ArrayLike) -> FloatArray:
    """The same rotation the other way: ``q_ba`` of ``q_ab``."""
    q = _array(q, "quaternion", 4)
    return np.concatenate([q[..., :1], -q[..., 1:]], axis=-1)


def normalised(q: ArrayLike) -> FloatArray:
    """`q` of unit norm."""
    q = _array(q, "quaternion", 4)
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if not ((norm > 0.0) & (norm < np.inf)).all():
        raise HilError("a quaternion of norm 0 (or beyond the numbers) is no rotation: is there an attitude yet?")
    unit: FloatArray = q / norm
    return unit


def orthonormal(c: ArrayLike) -> FloatArray:
    """The rotation matrix that is nearest to `c` (least squares of the elements)."""
    c = _array(c, "matrix", 3, 3)
    if not (np.linalg.det(c) > 0.0).all():
        raise HilError("a matrix that is singular or turns right hands into left ones has no rotation near it")
    left, _, right = np.linalg.svd(c)
    nearest: FloatArray = left @ right
    return nearest


def rotated(q: ArrayLike, v: ArrayLike) -> FloatArray:
    """C(q) v: with ``q_ab`` the vectors in a of those given in b, (..., 3)."""
    v = _array(v, "vector", 3)
    q = normalised(q)
    twice = 2.0 * np.cross(q[..., 1:], v)
    turned: FloatArray = v + q[..., :1] * twice + np.cross(q[..., 1:], twice)
    return turned


def relative(q_na: ArrayLike, q_nb: ArrayLike) -> FloatArray:
    """q_ab of two attitudes in the same frame: conj(q_na) q_nb."""
    return product(conjugate(q_na), q_nb)


def attitude_error(q: ArrayLike, q_true: ArrayLike) -> FloatArray:
    """Rotation vector (..., 3) in n that takes the true attitude to `q` (both q_nb), rad, by the short way."""
    return rotation_vector_from_quaternion(product(q, conjugate(q_true)))


def slerp(q_a: ArrayLike, q_b: ArrayLike, part: ArrayLike) -> FloatArray:
    """The attitude at `part` (...) of the short way from `q_a` (0) to `q_b` (1), at a constant rate."""
    way = rotation_vector_from_quaternion(relative(q_a, q_b))
    return product(normalised(q_a), quaternion_from_rotation_vector(np.asarray(part, float)[..., None] * way))


def quaternion_from_rotation_vector(phi: ArrayLike) -> FloatArray:
    """Unit quaternion of a rotation vector of any length."""
    phi = _array(phi, "rotation vector", 3)
    angle = np.linalg.norm(phi, axis=-1, keepdims=True)
    there = angle > 0.0
    half_sinc = np.where(there, np.sin(0.5 * angle) / np.where(there, angle, 1.0), 0.5)
    return np.concatenate([np.cos(0.5 * angle), half_sinc * phi], axis=-1)


def rotation_vector_from_quaternion(q: ArrayLike) -> FloatArray:
    """Rotation vector of length pi at most. Of the two at a half turn, that along the vector part."""
    q = normalised(q)
    norm = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    there = norm > 0.0
    scale = np.where(there, 2.0 * np.arctan2(norm, np.abs(q[..., :1])) / np.where(there, norm, 1.0), 2.0)
    phi: FloatArray = np.where(q[..., :1] < 0.0, -scale, scale) * q[..., 1:]
    return phi


def dcm_from_quaternion(q: ArrayLike) -> FloatArray:
    """C_ab of q_ab."""
    w, x, y, z = np.moveaxis(normalised(q), -1, 0)
    rows = [
        [w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_dcm(c: ArrayLike) -> FloatArray:
    """Unit quaternion q_ab of C_ab, scalar part not negative: the longest row of 4 q q' (Shepperd's method)."""
    c = _array(c, "matrix", 3, 3)
    defect = np.abs(c @ np.swapaxes(c, -1, -2) - np.eye(3))
    if not ((defect.max(axis=(-1, -2)) < DEFECT) & (np.linalg.det(c) > 0.0)).all():
        raise HilError(
            f"a matrix is not a rotation: C C' leaves I by {defect.max():.2g}, or its determinant is negative"
        )
    xx, yy, zz = c[..., 0, 0], c[..., 1, 1], c[..., 2, 2]
    wx, wy, wz = c[..., 2, 1] - c[..., 1, 2], c[..., 0, 2] - c[..., 2, 0], c[..., 1, 0] - c[..., 0, 1]
    xy, xz, yz = c[..., 1, 0] + c[..., 0, 1], c[..., 0, 2] + c[..., 2, 0], c[..., 2, 1] + c[..., 1, 2]
    rows = [
        [1.0 + xx + yy + zz, wx, wy, wz],
        [wx, 1.0 + xx - yy - zz, xy, xz],
        [wy, xy, 1.0 - xx + yy - zz, yz],
        [wz, xz, yz, 1.0 - xx - yy + zz],
    ]
    outer = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    longest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = normalised(np.take_along_axis(outer, longest[..., None, None], axis=-2)[..., 0, :])
    return np.where(q[..., :1] < 0.0, -q, q)


def quaternion_from_euler(heading: ArrayLike, pitch: ArrayLike, roll: ArrayLike) -> FloatArray:
    """q_nb of yaw-pitch-roll angles (...), rad, of any size."""
    angles = np.stack(np.broadcast_arrays(heading, pitch, roll), axis=-1)
    half = 0.5 * _array(angles, "Euler angles", 3)
    (ch, cp, cr), (sh, sp, sr) = np.moveaxis(np.cos(half), -1, 0), np.moveaxis(np.sin(half), -1, 0)
    return np.stack(
        [
            ch * cp * cr + sh * sp * sr,
            ch * cp * sr - sh * sp * cr,
            ch * sp * cr + sh * cp * sr,
            sh * cp * cr - ch * sp * sr,
        ],
        axis=-1,
    )


def euler_from_quaternion(q: ArrayLike) -> FloatArray:
    """(..., 3) heading [0, 2 pi), pitch, roll (-pi, pi] of q_nb, rad; see :func:`nav.turn.euler_of`."""
    unit = np.ascontiguousarray(normalised(q))
    angles = np.empty((*unit.shape[:-1], 3))
    _eulers(unit.reshape(-1, 4), angles.reshape(-1, 3))
    return angles


@kernel
def _eulers(q: FloatArray, angles: FloatArray) -> None:
    for k in range(q.shape[0]):
        angles[k, 0], angles[k, 1], angles[k, 2] = euler_of(q[k, 0], q[k, 1], q[k, 2], q[k, 3])


def dcm_from_rotation_vector(phi: ArrayLike) -> FloatArray:
    """C of a rotation vector."""
    return dcm_from_quaternion(quaternion_from_rotation_vector(phi))


def rotation_vector_from_dcm(c: ArrayLike) -> FloatArray:
    """Rotation vector of C, of length pi at most."""
    return rotation_vector_from_quaternion(quaternion_from_dcm(c))


def dcm_from_euler(heading: ArrayLike, pitch: ArrayLike, roll: ArrayLike) -> FloatArray:
    """C_nb of yaw-pitch-roll angles."""
    return dcm_from_quaternion(quaternion_from_euler(heading, pitch, roll))


def euler_from_dcm(c: ArrayLike) -> FloatArray:
    """Heading, pitch, roll of C_nb, ranges as of `euler_from_quaternion`."""
    return euler_from_quaternion(quaternion_from_dcm(c))


def rotation_vector_from_euler(heading: ArrayLike, pitch: ArrayLike, roll: ArrayLike) -> FloatArray:
    """Rotation vector of yaw-pitch-roll angles, of length pi at most."""
    return rotation_vector_from_quaternion(quaternion_from_euler(heading, pitch, roll))


def euler_from_rotation_vector(phi: ArrayLike) -> FloatArray:
    """Heading, pitch, roll of a rotation vector, ranges as of `euler_from_quaternion`."""
    return euler_from_quaternion(quaternion_from_rotation_vector(phi))


def _array(values: ArrayLike, what: str, *tail: int) -> FloatArray:
    array = np.asarray(values, float)
    if array.shape[-len(tail) :] != tail:
        raise HilError(f"{what}: shape {array.shape} where (..., {', '.join(map(str, tail))}) is needed")
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise HilError(f"{what}: element {where} is {array[where]}: mend what computed it")
    return array
