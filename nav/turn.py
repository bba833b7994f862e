"""Small rotations and quaternions inside loops: kernels on scalars, tuples and small arrays that allocate nothing.

Conventions as in :mod:`nav`: quaternions are Hamilton, scalar first. Quaternions that come in are of unit norm. A kernel
with an `out` argument writes there; `out` may not be one of the inputs unless it says so. Whole arrays, with checks:
:mod:`nav.rotation`.
"""

import math

from nav.increments import FloatArray
from nav.kernel import inline_kernel, kernel

Quaternion = tuple[float, float, float, float]
LOCK = 1e-12
"""Gimbal lock: half of the distance of pitch from +-90 deg, rad, below which heading takes the whole turn."""


@inline_kernel
def cross(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> tuple[float, float, float]:
    """Cross product a x b."""
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@inline_kernel
def half_sinc(angle2: float) -> float:
    """sin(a/2)/a for a = sqrt(angle2), by its series where that is exact to the last digit."""
    if angle2 < 1e-3:
        return 0.5 - angle2 * (1.0 / 48.0 - angle2 * (1.0 / 3840.0 - angle2 * (1.0 / 645120.0)))
    angle = math.sqrt(angle2)
    return math.sin(0.5 * angle) / angle


@inline_kernel
def quaternion_of(x: float, y: float, z: float) -> Quaternion:
    """Unit quaternion of the rotation vector (x, y, z), rad."""
    angle2 = x * x + y * y + z * z
    s = half_sinc(angle2)
    w = 1.0 - 0.5 * angle2 * (0.25 - angle2 / 192.0 + angle2 * angle2 / 23040.0)
    if angle2 >= 1e-3:
        w = math.cos(0.5 * math.sqrt(angle2))
    return w, s * x, s * y, s * z


@inline_kernel
def turn_of(x: float, y: float, z: float) -> Quaternion:
    """Unit quaternion of a rotation vector (rad) less the identity: scalar part minus one, vector part.

    Without the one, small rotations lose nothing to rounding.
    """
    a2 = x * x + y * y + z * z
    s = half_sinc(a2)
    if a2 < 1e-3:
        w = -a2 * (0.125 - a2 * (1.0 / 384.0 - a2 * (1.0 / 46080.0)))
    else:
        w = math.sin(0.25 * math.sqrt(a2))
        w = -2.0 * w * w
    return w, s * x, s * y, s * z


@inline_kernel
def change_by_turn(x: float, y: float, z: float, vx: float, vy: float, vz: float) -> tuple[float, float, float]:
    """What the rotation vector (x, y, z) changes of the vector v: exp([phi x]) v - v."""
    a2 = x * x + y * y + z * z
    if a2 < 1e-3:
        s = 1.0 - a2 * (1.0 / 6.0 - a2 * (1.0 / 120.0 - a2 * (1.0 / 5040.0)))
        c = 0.5 - a2 * (1.0 / 24.0 - a2 * (1.0 / 720.0 - a2 * (1.0 / 40320.0)))
    else:
        a = math.sqrt(a2)
        s = math.sin(a) / a
        c = (1.0 - math.cos(a)) / a2
    tx, ty, tz = cross(x, y, z, vx, vy, vz)
    ux, uy, uz = cross(x, y, z, tx, ty, tz)
    return s * tx + c * ux, s * ty + c * uy, s * tz + c * uz


@inline_kernel
def euler_of(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Heading [0, 2 pi), pitch, roll (-pi, pi] of a quaternion q_nb, rad.

    The half sum and the half difference of heading and roll are angles of the quaternion's parts, and the lengths of these
    parts are the sine and cosine of half the distance of pitch from -90 deg: nothing loses digits near the vertical. At
    `LOCK` heading takes the whole turn and roll is 0.
    """
    plus, minus = math.atan2(x + z, w - y), math.atan2(z - x, w + y)
    below, above = math.hypot(w + y, z - x), math.hypot(w - y, x + z)
    pitch = math.atan2(2.0 * (w * y - x * z), below * above)
    heading, roll = plus + minus, plus - minus
    if above < LOCK:
        heading, roll = 2.0 * minus, 0.0
    elif below < LOCK:
        heading, roll = 2.0 * plus, 0.0
    roll -= 2.0 * math.pi * math.ceil(roll / (2.0 * math.pi) - 0.5)
    heading %= 2.0 * math.pi
    return heading if heading < 2.0 * math.pi else 0.0, pitch, roll  # that of a tiny negative angle rounds up


@kernel
def turns_between(before: FloatArray, after: FloatArray, out: FloatArray) -> None:
    """conj(before) after of each row (n, 4), less the identity as `turn_of`.

    The scalar part comes from the vector part, so that nothing is lost to rounding.
    """
    for k in range(before.shape[0]):
        a, b, c, d = before[k, 0], before[k, 1], before[k, 2], before[k, 3]
        e, f, g, h = after[k, 0], after[k, 1], after[k, 2], after[k, 3]
        x = a * f - b * e - c * h + d * g
        y = a * g + b * h - c * e - d * f
        z = a * h - b * g + c * f - d * e
        sign = math.copysign(1.0, a * e + b * f + c * g + d * h)
        s2 = x * x + y * y + z * z
        out[k, 0] = -s2 / (1.0 + math.sqrt(max(0.0, 1.0 - s2)))
        out[k, 1], out[k, 2], out[k, 3] = sign * x, sign * y, sign * z


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
def vector_from_quaternion(q: FloatArray, phi: FloatArray) -> None:
    """Rotation vector of the unit quaternion `q`, rad, of length pi at most."""
    n = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    w = abs(q[0])
    s = 2.0 * math.atan2(n, w) / n if n > 0.0 else 2.0
    if q[0] < 0.0:
        s = -s
    phi[0], phi[1], phi[2] = s * q[1], s * q[2], s * q[3]


@inline_kernel
def orthonormalise(c: FloatArray) -> None:
    """C <- (3/2) C - (1/2) C C' C: the next orthonormal matrix, to the square of the defect."""
    dxx = c[0, 0] * c[0, 0] + c[0, 1] * c[0, 1] + c[0, 2] * c[0, 2]
    dyy = c[1, 0] * c[1, 0] + c[1, 1] * c[1, 1] + c[1, 2] * c[1, 2]
    dzz = c[2, 0] * c[2, 0] + c[2, 1] * c[2, 1] + c[2, 2] * c[2, 2]
    dxy = c[0, 0] * c[1, 0] + c[0, 1] * c[1, 1] + c[0, 2] * c[1, 2]
    dxz = c[0, 0] * c[2, 0] + c[0, 1] * c[2, 1] + c[0, 2] * c[2, 2]
    dyz = c[1, 0] * c[2, 0] + c[1, 1] * c[2, 1] + c[1, 2] * c[2, 2]
    for j in range(3):
        x, y, z = c[0, j], c[1, j], c[2, j]
        c[0, j] = x + 0.5 * ((1.0 - dxx) * x - dxy * y - dxz * z)
        c[1, j] = y + 0.5 * ((1.0 - dyy) * y - dxy * x - dyz * z)
        c[2, j] = z + 0.5 * ((1.0 - dzz) * z - dxz * x - dyz * y)


@inline_kernel
def matrix_from_quaternion(q: FloatArray, c: FloatArray) -> None:
    """C (3, 3) of the unit quaternion `q` (4,), without allocation."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    c[0, 0], c[0, 1], c[0, 2] = w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    c[1, 0], c[1, 1], c[1, 2] = 2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)
    c[2, 0], c[2, 1], c[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z


@inline_kernel
def quaternion_from_matrix(c: FloatArray) -> Quaternion:
    """Unit quaternion of `c` (Shepperd's method), without allocation."""
    xx, yy, zz = c[0, 0], c[1, 1], c[2, 2]
    w, x, y, z = 1.0 + xx + yy + zz, c[2, 1] - c[1, 2], c[0, 2] - c[2, 0], c[1, 0] - c[0, 1]
    if w < 1.0:  # then a component of the vector part is at least 1/2
        if xx >= yy and xx >= zz:
            w, x, y, z = x, 1.0 + xx - yy - zz, c[1, 0] + c[0, 1], c[0, 2] + c[2, 0]
        elif yy >= zz:
            w, x, y, z = y, c[1, 0] + c[0, 1], 1.0 + yy - xx - zz, c[2, 1] + c[1, 2]
        else:
            w, x, y, z = z, c[0, 2] + c[2, 0], c[2, 1] + c[1, 2], 1.0 + zz - xx - yy
    s = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * s, x * s, y * s, z * s
