"""Gravitation of the Earth in the meridian plane: one field for every mechanization.

`normal`: the normal gravity of :mod:`nav.earth` less the centrifugal acceleration. `j2`: GM and J2. Both without the
centrifugal part, for equations in frames that do not turn with the Earth.
"""

import math

from nav.earth import E2, GM, J2, RATE, A, normal_gravity
from nav.errors import HilError
from nav.kernel import inline_kernel

NORMAL, J2_FIELD = 0, 1
"""Codes of the fields for kernels."""
_CODES = {"normal": NORMAL, "j2": J2_FIELD}


def field_code(name: str) -> int:
    """Code of the field `name`.

    Raises
    ------
    HilError
        Unknown name.
    """
    if name not in _CODES:
        raise HilError(f"unknown gravity {name!r}; there is: {', '.join(_CODES)}")
    return _CODES[name]


@inline_kernel
def gravitation_local(
    field: int, sin_lat: float, cos_lat: float, height: float, axis_distance: float
) -> tuple[float, float]:
    """Gravitation towards north and down, m/s^2, in the level axes at a position.

    Parameters
    ----------
    field : int
        `NORMAL` or `J2_FIELD`.
    sin_lat, cos_lat : float
        Of the geodetic latitude.
    height : float
        Above the ellipsoid, m.
    axis_distance : float
        From the Earth's axis, m.
    """
    if field == NORMAL:
        outward = RATE * RATE * axis_distance
        return outward * sin_lat, normal_gravity(sin_lat, height) + outward * cos_lat
    prime = A / math.sqrt(1.0 - E2 * sin_lat * sin_lat)
    z = (prime * (1.0 - E2) + height) * sin_lat
    r2 = axis_distance * axis_distance + z * z
    r = math.sqrt(r2)
    base = -GM / (r2 * r)
    k = 1.5 * J2 * A * A / r2
    zz = 5.0 * z * z / r2
    out = base * axis_distance * (1.0 + k * (1.0 - zz))
    up = base * z * (1.0 + k * (3.0 - zz))
    return cos_lat * up - sin_lat * out, -(sin_lat * up + cos_lat * out)
