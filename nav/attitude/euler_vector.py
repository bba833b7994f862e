"""Bortz's equation for the Euler (rotation) vector of the whole attitude, by the fourth-order Runge-Kutta method.

phi' = w + (1/2) phi x w + (1/th^2) (1 - (th/2) cot(th/2)) phi x (phi x w), th = |phi| (source 001, eq. 3). The equation
is singular at th = 2 pi; the vector is folded to the other way round, phi (1 - 2 pi / th), when th passes pi, and so
never comes near. Needs the body rate at the start, the middle and the end of a step.
"""

import math

from nav.increments import FloatArray
from nav.kernel import inline_kernel


@inline_kernel
def bortz_coefficient(angle2: float) -> float:
    """(1 - (th/2) cot(th/2)) / th^2 for th = sqrt(angle2), by its series where that is exact to the last digit."""
    if angle2 < 0.05:
        return 1.0 / 12.0 + angle2 * (
            1.0 / 720.0 + angle2 * (1.0 / 30240.0 + angle2 * (1.0 / 1209600.0 + angle2 * (1.0 / 47900160.0)))
        )
    half = 0.5 * math.sqrt(angle2)
    return (1.0 - half / math.tan(half)) / angle2


@inline_kernel
def _bortz(px: float, py: float, pz: float, wx: float, wy: float, wz: float) -> tuple[float, float, float]:
    cx, cy, cz = py * wz - pz * wy, pz * wx - px * wz, px * wy - py * wx
    k = bortz_coefficient(px * px + py * py + pz * pz)
    return (
        wx + 0.5 * cx + k * (py * cz - pz * cy),
        wy + 0.5 * cy + k * (pz * cx - px * cz),
        wz + 0.5 * cz + k * (px * cy - py * cx),
    )


@inline_kernel
def euler_vector_step(phi: FloatArray, rates: FloatArray, step: float) -> None:
    """One Runge-Kutta step of the Euler vector, and the fold.

    Parameters
    ----------
    phi : (3,) float
        Euler vector of C_ib at the start, rad, of length pi at most; replaced by that at the end.
    rates : (3, 3) float
        w_ib_b at the start, in the middle, at the end of the step, rad/s.
    step : float
        s.
    """
    ax, ay, az = rates[0, 0], rates[0, 1], rates[0, 2]
    mx, my, mz = rates[1, 0], rates[1, 1], rates[1, 2]
    ex, ey, ez = rates[2, 0], rates[2, 1], rates[2, 2]
    half, sixth = 0.5 * step, step / 6.0
    x, y, z = phi[0], phi[1], phi[2]
    k1x, k1y, k1z = _bortz(x, y, z, ax, ay, az)
    k2x, k2y, k2z = _bortz(x + half * k1x, y + half * k1y, z + half * k1z, mx, my, mz)
    k3x, k3y, k3z = _bortz(x + half * k2x, y + half * k2y, z + half * k2z, mx, my, mz)
    k4x, k4y, k4z = _bortz(x + step * k3x, y + step * k3y, z + step * k3z, ex, ey, ez)
    x += sixth * (k1x + 2.0 * (k2x + k3x) + k4x)
    y += sixth * (k1y + 2.0 * (k2y + k3y) + k4y)
    z += sixth * (k1z + 2.0 * (k2z + k3z) + k4z)
    angle = math.sqrt(x * x + y * y + z * z)
    fold = 1.0 - 2.0 * math.pi / angle if angle > math.pi else 1.0
    phi[0], phi[1], phi[2] = fold * x, fold * y, fold * z
