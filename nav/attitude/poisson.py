"""Poisson's equation C' = C [w x] for the direction-cosine matrix C_ib, by the fourth-order Runge-Kutta method.

Source: 001, eq. 2. Needs the body rate at the start, the middle and the end of a step. The matrix is made orthonormal
after every step. Towards a frame that turns itself, C_nb, turn the result from the left by that frame's own rotation.
"""

from nav.increments import FloatArray
from nav.kernel import inline_kernel
from nav.turn import cross, orthonormalise


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
        k1x, k1y, k1z = cross(x, y, z, ax, ay, az)
        k2x, k2y, k2z = cross(x + half * k1x, y + half * k1y, z + half * k1z, mx, my, mz)
        k3x, k3y, k3z = cross(x + half * k2x, y + half * k2y, z + half * k2z, mx, my, mz)
        k4x, k4y, k4z = cross(x + step * k3x, y + step * k3y, z + step * k3z, ex, ey, ez)
        c[i, 0] = x + sixth * (k1x + 2.0 * (k2x + k3x) + k4x)
        c[i, 1] = y + sixth * (k1y + 2.0 * (k2y + k3y) + k4y)
        c[i, 2] = z + sixth * (k1z + 2.0 * (k2z + k3z) + k4z)
    orthonormalise(c)
