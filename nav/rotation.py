"""Rotations: quaternions, direction cosines, rotation vectors, Euler angles, as kernels on small arrays.

Conventions as in :mod:`nav`: ``q_ab`` is Hamilton, scalar first, and takes vectors from b to a. Kernels write into an
`out` argument so that nothing is allocated per sample; `out` may not be one of the inputs unless it says so.
"""

import math

import numpy as np
from numpy.typing import NDArray

from nav.increments import FloatArray
from nav.kernel import inline_kernel, kernel


@inline_kernel
def multiply(p: FloatArray, q: FloatArray, out: FloatArray) -> None:
    """Quaternion product p q; `out` may be `p` or `q`."""
    w = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3]
    x = p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2]
    y = p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1]
    z = p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0]
    out[0], out[1], out[2], out[3] = w, x, y, z


@inline_kernel
def normalise(q: FloatArray) -> None:
    """Scale `q` to unit norm in place."""
    s = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for i in range(4):
        q[i] *= s


@inline_kernel
def half_sinc(angle2: float) -> float:
    """sin(a/2)/a for a = sqrt(angle2), by its series where that is exact to the last digit."""
    if angle2 < 1e-3:
        return 0.5 - angle2 * (1.0 / 48.0 - angle2 * (1.0 / 3840.0 - angle2 * (1.0 / 645120.0)))
    angle = math.sqrt(angle2)
    return math.sin(0.5 * angle) / angle


@inline_kernel
def from_rotation_vector(x: float, y: float, z: float, out: FloatArray) -> None:
    """Quaternion of the rotation vector (x, y, z), rad."""
    angle2 = x * x + y * y + z * z
    s = half_sinc(angle2)
    out[0] = 1.0 - 0.5 * angle2 * (0.25 - angle2 / 192.0 + angle2 * angle2 / 23040.0)
    if angle2 >= 1e-3:
        out[0] = math.cos(0.5 * math.sqrt(angle2))
    out[1], out[2], out[3] = s * x, s * y, s * z


@inline_kernel
def rotate(q: FloatArray, v: FloatArray, out: FloatArray) -> None:
    """C(q) v: with ``q_ab`` the vector in a of `v` given in b; `out` may be `v`."""
    tx = 2.0 * (q[2] * v[2] - q[3] * v[1])
    ty = 2.0 * (q[3] * v[0] - q[1] * v[2])
    tz = 2.0 * (q[1] * v[1] - q[2] * v[0])
    x = v[0] + q[0] * tx + q[2] * tz - q[3] * ty
    y = v[1] + q[0] * ty + q[3] * tx - q[1] * tz
    z = v[2] + q[0] * tz + q[1] * ty - q[2] * tx
    out[0], out[1], out[2] = x, y, z


@inline_kernel
def fill_dcm(q: FloatArray, out: FloatArray) -> None:
    """Write the direction-cosine matrix C_ab of the unit quaternion q_ab into `out` (3, 3)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    out[0, 0] = w * w + x * x - y * y - z * z
    out[1, 1] = w * w - x * x + y * y - z * z
    out[2, 2] = w * w - x * x - y * y + z * z
    out[0, 1] = 2.0 * (x * y - w * z)
    out[1, 0] = 2.0 * (x * y + w * z)
    out[0, 2] = 2.0 * (x * z + w * y)
    out[2, 0] = 2.0 * (x * z - w * y)
    out[1, 2] = 2.0 * (y * z - w * x)
    out[2, 1] = 2.0 * (y * z + w * x)


@kernel
def dcm_from_quaternion(q: FloatArray) -> FloatArray:
    """Direction-cosine matrix C_ab (3, 3) of the unit quaternion q_ab."""
    c = np.empty((3, 3))
    fill_dcm(q, c)
    return c


@kernel
def quaternion_from_dcm(c: FloatArray) -> FloatArray:
    """Unit quaternion q_ab of the direction-cosine matrix C_ab, scalar part not negative (Shepperd's method)."""
    trace = c[0, 0] + c[1, 1] + c[2, 2]
    best, i = trace, 3
    for k in range(3):
        if c[k, k] > best:
            best, i = c[k, k], k
    q = np.empty(4)
    if i == 3:
        q[0] = 1.0 + trace
        q[1] = c[2, 1] - c[1, 2]
        q[2] = c[0, 2] - c[2, 0]
        q[3] = c[1, 0] - c[0, 1]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0] = c[k, j] - c[j, k]
        q[1 + i] = 1.0 + 2.0 * c[i, i] - trace
        q[1 + j] = c[j, i] + c[i, j]
        q[1 + k] = c[k, i] + c[i, k]
    if q[0] < 0.0:
        q = -q
    normalise(q)
    return q


@kernel
def quaternion_from_euler(heading: float, pitch: float, roll: float) -> FloatArray:
    """q_nb of yaw-pitch-roll angles, rad."""
    ch, sh = math.cos(0.5 * heading), math.sin(0.5 * heading)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    q = np.empty(4)
    q[0] = ch * cp * cr + sh * sp * sr
    q[1] = ch * cp * sr - sh * sp * cr
    q[2] = ch * sp * cr + sh * cp * sr
    q[3] = sh * cp * cr - ch * sp * sr
    return q


@kernel
def euler_from_quaternion(q: FloatArray) -> tuple[float, float, float]:
    """(heading, pitch, roll) of q_nb, rad; heading in [0, 2 pi). At pitch +-90 deg heading takes the whole turn."""
    s = 2.0 * (q[0] * q[2] - q[3] * q[1])
    roll = math.atan2(2.0 * (q[0] * q[1] + q[2] * q[3]), 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]))
    heading = math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))
    if abs(s) > 1.0 - 1e-12:  # gimbal lock: only heading -+ roll is defined
        roll = 0.0
        heading = -2.0 * math.copysign(1.0, s) * math.atan2(q[1], q[0])
    pitch = math.asin(min(1.0, max(-1.0, s)))
    heading %= 2.0 * math.pi
    if heading >= 2.0 * math.pi:  # the remainder of a tiny negative angle rounds up to the whole turn
        heading = 0.0
    return heading, pitch, roll


@kernel
def euler_angles(q: FloatArray) -> FloatArray:
    """(n, 3) heading, pitch, roll of the quaternions q_nb (n, 4), rad."""
    out = np.empty((q.shape[0], 3))
    for k in range(q.shape[0]):
        out[k, 0], out[k, 1], out[k, 2] = euler_from_quaternion(q[k])
    return out


def attitude_error(q: FloatArray, q_true: FloatArray) -> FloatArray:
    """Rotation vector (..., 3) in n that takes the true attitude to `q`, rad, by the short way.

    Parameters
    ----------
    q, q_true : (..., 4) float
        Attitudes q_nb.
    """
    w, x, y, z = (q_true[..., i] for i in range(4))
    a, b, c, d = (q[..., i] for i in range(4))
    # q * conj(q_true)
    scalar = a * w + b * x + c * y + d * z
    vector = np.stack(
        [-a * x + b * w - c * z + d * y, -a * y + b * z + c * w - d * x, -a * z - b * y + c * x + d * w], axis=-1
    )
    norm = np.linalg.norm(vector, axis=-1)
    angle = 2.0 * np.arctan2(norm, np.abs(scalar))
    scale = np.where(norm > 0.0, angle / np.where(norm > 0.0, norm, 1.0), 2.0) * np.where(scalar < 0.0, -1.0, 1.0)
    error: NDArray[np.float64] = vector * scale[..., None]
    return error
