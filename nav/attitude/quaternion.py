"""Quaternions as four numbers: what the kernels hand on without an array."""

import math

from nav.kernel import inline_kernel
from nav.rotation import half_sinc

Quaternion = tuple[float, float, float, float]


@inline_kernel
def quaternion_of(x: float, y: float, z: float) -> Quaternion:
    """Unit quaternion of the rotation vector (x, y, z), rad."""
    angle2 = x * x + y * y + z * z
    s = half_sinc(angle2)
    w = 1.0 - 0.5 * angle2 * (0.25 - angle2 / 192.0 + angle2 * angle2 / 23040.0)
    if angle2 >= 1e-3:
        w = math.cos(0.5 * math.sqrt(angle2))
    return w, s * x, s * y, s * z
