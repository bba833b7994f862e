"""Poisson's equation C' = C [w x] for the direction-cosine matrix C_ib, by the fourth-order Runge-Kutta method.

Source: 001, eq. 2. Needs the body rate at the start, the middle and the end of a step. The matrix is made orthonormal
after every step. Towards a frame that turns itself, C_nb, turn the result from the left by that frame's own rotation.
"""

import math

from nav.attitude.quaternion import Quaternion
from nav.increments import FloatArray
from nav.kernel import inline_kernel


@inline_kernel
def _cross(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> tuple[float, float, float]:
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@inline_kernel
def poisson_step(c: FloatArray, rates: FloatArray, step: float) -> None:
    """One Runge-Kutta step of C_ib, and orthonormalisation.

    Each row r of C obeys r' = r x w.

    Parameters
    ----------
    c : (3, 3) float
        C_ib at the start; replaced by that at the end.
    rates : (3, 3) float
        w_ib_b at the start, in the middle, at the end of the step, rad/s.
    step : float
        s.
    """
    ax, ay, az = rates[0, 0], rates[0, 1], rates[0, 2]
    mx, my, mz = rates[1, 0], rates[1, 1], rates[1, 2]
    ex, ey, ez = rates[2, 0], rates[2, 1], rates[2, 2]
    half, sixth = 0.5 * step, step / 6.0
    for i in range(3):
        x, y, z = c[i, 0], c[i, 1], c[i, 2]
        k1x, k1y, k1z = _cross(x, y, z, ax, ay, az)
        k2x, k2y, k2z = _cross(x + half * k1x, y + half * k1y, z + half * k1z, mx, my, mz)
        k3x, k3y, k3z = _cross(x + half * k2x, y + half * k2y, z + half * k2z, mx, my, mz)
        k4x, k4y, k4z = _cross(x + step * k3x, y + step * k3y, z + step * k3z, ex, ey, ez)
        c[i, 0] = x + sixth * (k1x + 2.0 * (k2x + k3x) + k4x)
        c[i, 1] = y + sixth * (k1y + 2.0 * (k2y + k3y) + k4y)
        c[i, 2] = z + sixth * (k1z + 2.0 * (k2z + k3z) + k4z)
    orthonormalise(c)


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
