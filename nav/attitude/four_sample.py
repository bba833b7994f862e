"""The four-sample algorithm: four equal steps to one rotation vector.

Source: Fomichev 2011, sec. 1. The quaternion of the rotation vector is exact or the source's series (eq. 2), whose
error accumulates in fast turns.
"""

from nav.increments import FloatArray
from nav.kernel import inline_kernel
from nav.turn import Quaternion, quaternion_of


@inline_kernel
def four_sample_turn(s: FloatArray, begin: int, series: bool) -> Quaternion:
    """Rotation over four equal steps.

    phi = S1+S2+S3+S4 + (22/45)(S1+S2)x(S3+S4) + (32/45)(S1xS2 + S3xS4).

    Parameters
    ----------
    s : (n, 3) float
        Increments, rad.
    begin : int
        Rows `begin` to `begin` + 3 are read.
    series : bool
        The quaternion by the source's series, l0 = 1 - G/8 + G^2/384, l = phi (1/2 - G/48 + G^2/3840), G = phi.phi; it
        is of unit norm only to its own order.

    Returns
    -------
    (4,) tuple of float
        Quaternion.
    """
    i, j, k, m = begin, begin + 1, begin + 2, begin + 3
    ax, ay, az = s[i, 0] + s[j, 0], s[i, 1] + s[j, 1], s[i, 2] + s[j, 2]
    bx, by, bz = s[k, 0] + s[m, 0], s[k, 1] + s[m, 1], s[k, 2] + s[m, 2]
    nx = s[i, 1] * s[j, 2] - s[i, 2] * s[j, 1] + s[k, 1] * s[m, 2] - s[k, 2] * s[m, 1]
    ny = s[i, 2] * s[j, 0] - s[i, 0] * s[j, 2] + s[k, 2] * s[m, 0] - s[k, 0] * s[m, 2]
    nz = s[i, 0] * s[j, 1] - s[i, 1] * s[j, 0] + s[k, 0] * s[m, 1] - s[k, 1] * s[m, 0]
    far, near = 22.0 / 45.0, 32.0 / 45.0
    x = ax + bx + far * (ay * bz - az * by) + near * nx
    y = ay + by + far * (az * bx - ax * bz) + near * ny
    z = az + bz + far * (ax * by - ay * bx) + near * nz
    if series:
        g = x * x + y * y + z * z
        along = 0.5 - g / 48.0 + g * g / 3840.0
        return 1.0 - g / 8.0 + g * g / 384.0, along * x, along * y, along * z
    return quaternion_of(x, y, z)
