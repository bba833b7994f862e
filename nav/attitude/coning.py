"""The coning family: rotation vectors of 1 to 5 samples whose error on pure coning is of the highest order.

On pure coning the cross product of two increments depends on their distance alone, so one coefficient a distance makes
the error of the rotation vector of order 2 N + 1 in the coning phase of a step (Miller 1983; Ignagni 1990, 1996;
Savage 1998, part 1). On other motions the compressed forms of three samples and more are of the third order only;
Miller's uncompressed form, which spreads each coefficient over all pairs of its distance, keeps the fourth.

The coefficients hold for equal steps. With two samples the exact coefficient for unequal steps is used.
"""

import numpy as np

from nav.attitude.picard import previous_increment_coefficient
from nav.increments import FloatArray
from nav.kernel import inline_kernel
from nav.turn import Quaternion, quaternion_of

MAX_SAMPLES = 5

BLOCK: dict[int, tuple[float, ...]] = {
    1: (),
    2: (2 / 3,),
    3: (27 / 20, 9 / 20),
    4: (214 / 105, 92 / 105, 18 / 35),
    5: (1375 / 504, 325 / 252, 25 / 24, 125 / 252),
}
"""Rotation over a block of N equal steps: coefficients of d_(N-p) x d_N by the distance p = 1 .. N - 1."""

STREAM: dict[int, tuple[float, ...]] = {
    1: (),
    2: (1 / 12,),
    3: (7 / 60, -1 / 60),
    4: (113 / 840, -13 / 420, 1 / 280),
    5: (367 / 2520, -53 / 1260, 1 / 120, -1 / 1260),
}
"""Rotation over the last of N equal steps: coefficients of d_(N-p) x d_N by the distance p = 1 .. N - 1."""


def coefficients(table: dict[int, tuple[float, ...]], samples: int) -> FloatArray:
    """Coefficients by distance for the kernels of this module, (samples - 1,)."""
    return np.array(table[samples], dtype=np.float64)


@inline_kernel
def coning_turn(dtheta: FloatArray, step: FloatArray, begin: int, end: int, coefficient: FloatArray) -> Quaternion:
    """Rotation over a block, compressed: phi = sum d_i + (sum over p of k_p d_(N-p)) x d_N.

    Parameters
    ----------
    dtheta : (n, 3) float
        Increments, rad.
    step : (n,) float
        Their steps, s.
    begin, end : int
        The block: rows `begin` to `end` - 1, N of them, of positive steps, equal where N > 2.
    coefficient : (N - 1,) float
        k, of `BLOCK`.

    Returns
    -------
    (4,) tuple of float
        Unit quaternion.
    """
    last = end - 1
    x, y, z = dtheta[last, 0], dtheta[last, 1], dtheta[last, 2]
    ax = ay = az = 0.0
    cx, cy, cz = x, y, z
    for i in range(begin, last):
        k = coefficient[last - 1 - i]
        if end - begin == 2:
            k = _two_sample_coefficient(step[i], step[last])
        cx, cy, cz = cx + dtheta[i, 0], cy + dtheta[i, 1], cz + dtheta[i, 2]
        ax, ay, az = ax + k * dtheta[i, 0], ay + k * dtheta[i, 1], az + k * dtheta[i, 2]
    return quaternion_of(cx + ay * z - az * y, cy + az * x - ax * z, cz + ax * y - ay * x)


@inline_kernel
def coning_uncompressed_turn(
    dtheta: FloatArray, step: FloatArray, begin: int, end: int, coefficient: FloatArray
) -> Quaternion:
    """As `coning_turn`, uncompressed: phi = sum d_i + sum over i < j of k_(j-i) / (N - (j-i)) d_i x d_j."""
    n = end - begin
    cx = cy = cz = 0.0
    for j in range(begin, end):
        x, y, z = dtheta[j, 0], dtheta[j, 1], dtheta[j, 2]
        ax = ay = az = 0.0
        for i in range(begin, j):
            k = coefficient[j - i - 1] / (n - (j - i))
            if n == 2:
                k = _two_sample_coefficient(step[i], step[j])
            ax, ay, az = ax + k * dtheta[i, 0], ay + k * dtheta[i, 1], az + k * dtheta[i, 2]
        cx, cy, cz = cx + x + (ay * z - az * y), cy + y + (az * x - ax * z), cz + z + (ax * y - ay * x)
    return quaternion_of(cx, cy, cz)


@inline_kernel
def coning_stream_turn(
    dtheta: FloatArray, step: FloatArray, begin: int, end: int, coefficient: FloatArray
) -> Quaternion:
    """Rotation over the last step of the window from past increments: phi = d_N + (sum over p of k_p d_(N-p)) x d_N.

    Parameters and result as in `coning_turn`, with k of `STREAM`.
    """
    last = end - 1
    x, y, z = dtheta[last, 0], dtheta[last, 1], dtheta[last, 2]
    ax = ay = az = 0.0
    for i in range(begin, last):
        k = coefficient[last - 1 - i]
        if end - begin == 2:
            k = previous_increment_coefficient(step[i], step[last])
        ax, ay, az = ax + k * dtheta[i, 0], ay + k * dtheta[i, 1], az + k * dtheta[i, 2]
    return quaternion_of(x + ay * z - az * y, y + az * x - ax * z, z + ax * y - ay * x)


@inline_kernel
def _two_sample_coefficient(before: float, now: float) -> float:
    """k of d1 x d2 over a block of two steps of any length: exact where the rate is linear over the block."""
    return (before + now) ** 2 / (6.0 * before * now)
