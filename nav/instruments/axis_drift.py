"""How far the gyro axes of a head drift where it stands, and what their best combination leaves of it in the body.

Gravity drifts a DTG by its part across the spin axis. Of the two y axes of a level head, that of the gyro whose rotor stands
upright feels none of it and the other one all of it: their mean is worse than the better one alone. Weights of
1 / variance are best.
"""

import numpy as np

from nav.earth import STANDARD_GRAVITY as _G
from nav.increments import FloatArray
from nav.instruments.grades import Grade
from nav.instruments.redundancy import layout

_SPIN = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
"""Spin axes of the gyros of g1x, g1y, g2y, g2z, in head axes."""


def axis_variances(grade: Grade, c_bh: FloatArray, *, bias_removed: bool = False, factor: float = 1.0) -> FloatArray:
    """Variances of the constant drifts of the four axes of a head in a level vehicle, (rad/s)^2.

    Parameters
    ----------
    grade : Grade
        Of the gyros: bias, flicker, drift by gravity along both input axes.
    c_bh : (3, 3) float
        Mounting: takes head axes to body axes.
    bias_removed : bool
        As in `Grade.draw`.
    factor : float
        Turn-on errors, times those of the grade.
    """
    bias = grade.gyro_bias_removed if bias_removed else grade.gyro_bias
    along_spin = _SPIN @ c_bh[2]
    by_gravity = (grade.gyro_g * _G) ** 2 * (1.0 - along_spin**2)
    variances: FloatArray = factor**2 * (bias**2 + by_gravity) + grade.gyro_flicker**2
    return variances


def body_drift(variances: FloatArray, c_bh: FloatArray, skew: float) -> FloatArray:
    """Standard deviations (3,) of the drift about the body axes once the axes are combined by these variances, rad/s.

    Parameters
    ----------
    variances : (4,) float
        Of the axes, (rad/s)^2; positive.
    c_bh : (3, 3) float
        Mounting.
    skew : float
        How far each gyro is turned about its spin axis, rad.
    """
    h = layout(skew)
    covariance = c_bh @ np.linalg.inv(h.T @ (h / variances[:, None])) @ c_bh.T
    drift: FloatArray = np.sqrt(np.diag(covariance))
    return drift
