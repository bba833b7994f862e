"""Quaternion of one step by Picard's method to the third order, with the increment of the step before.

Source: Uspensky & Bagmut 2009, eqs. 13 and 14. Global error of the third order in the step.
"""

import math

from nav.increments import FloatArray
from nav.kernel import inline_kernel
from nav.turn import Quaternion


@inline_kernel
def previous_increment_coefficient(before: float, now: float) -> float:
    """k of the rotation vector ``d + k d0 x d`` over a step of `now` s after one of `before` s.

    T^2 / (6 T0 (T + T0)): exact to the second order in the angle where the rate is linear over both steps; 1/12 where
    they are equal.
    """
    return now * now / (6.0 * before * (now + before))


@inline_kernel
def picard3_turn(dtheta: FloatArray, step: FloatArray, end: int, source: bool) -> Quaternion:
    """Rotation over the last step before row `end`, from its increment d and the one before, d0.

    l0 = 1 - |d|^2/8, l = d/2 - d |d|^2/48 + (k/2) d0 x d, normalised; k of `previous_increment_coefficient`.

    Parameters
    ----------
    dtheta : (n, 3) float
        Increments, rad.
    step : (n,) float
        Their steps, s, positive.
    end : int
        Rows `end` - 2 and `end` - 1 are read.
    source : bool
        The cross product of the source, -(1/24) d x d*, d* = d0 T / T0: the same for equal steps, of the second order
        only for unequal ones.

    Returns
    -------
    (4,) tuple of float
        Unit quaternion.
    """
    i, j = end - 2, end - 1
    cross = step[j] / (24.0 * step[i]) if source else 0.5 * previous_increment_coefficient(step[i], step[j])
    px, py, pz = dtheta[i, 0], dtheta[i, 1], dtheta[i, 2]
    x, y, z = dtheta[j, 0], dtheta[j, 1], dtheta[j, 2]
    square = x * x + y * y + z * z
    along = 0.5 - square / 48.0
    w = 1.0 - 0.125 * square
    a = along * x + cross * (py * z - pz * y)
    b = along * y + cross * (pz * x - px * z)
    c = along * z + cross * (px * y - py * x)
    s = 1.0 / math.sqrt(w * w + a * a + b * b + c * c)
    return w * s, a * s, b * s, c * s
