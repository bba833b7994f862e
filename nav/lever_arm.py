"""From the place of the sensor to the navigated point of the vehicle and back."""

import math

import numpy as np

from nav.earth import curvature_radii
from nav.increments import FloatArray
from nav.kernel import kernel
from nav.turn import cross, rotate


@kernel
def shift(
    lat: FloatArray,
    lon: FloatArray,
    height: FloatArray,
    vel_n: FloatArray,
    q_nb: FloatArray,
    w_ib_b: FloatArray,
    arm_b: FloatArray,
) -> None:
    """Move positions and velocities (n rows, in place) by `arm_b`, m in body axes.

    The velocity changes by C_nb (w x r); the Earth's and the level's own rate (below 1e-4 rad/s) are left out of w_nb.
    """
    r, v = np.empty(3), np.empty(3)
    for k in range(lat.shape[0]):
        v[0], v[1], v[2] = cross(w_ib_b[k, 0], w_ib_b[k, 1], w_ib_b[k, 2], arm_b[0], arm_b[1], arm_b[2])
        rotate(q_nb[k], v, v)
        rotate(q_nb[k], arm_b, r)
        meridian, prime = curvature_radii(math.sin(lat[k]))
        lat[k] += r[0] / (meridian + height[k])
        lon[k] += r[1] / ((prime + height[k]) * math.cos(lat[k]))
        if lon[k] > math.pi:
            lon[k] -= 2.0 * math.pi
        elif lon[k] < -math.pi:
            lon[k] += 2.0 * math.pi
        height[k] -= r[2]
        for i in range(3):
            vel_n[k, i] += v[i]
