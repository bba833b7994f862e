"""Gravitation of the Earth in the meridian plane: one field for every mechanization.

`normal`: the normal gravity of :mod:`nav.earth` less the centrifugal acceleration. `j2`: GM and J2. Both without the
centrifugal part, for equations in frames that do not turn with the Earth.

The height series of `normal` leaves out about 4 g (h/a)^3: 1.5e-4 m/s^2 at 100 km, 0.1 at 1000 km; take `j2` there.
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


@inline_kernel
def near_latitude(axis_distance: float, z: float, sin_lat: float, cos_lat: float) -> tuple[float, float]:
    """Sine and cosine of the geodetic latitude of (axis distance, z), from those of a place within some kilometres.

    One Newton step on ``p sin B - z cos B = e^2 N sin B cos B``; a way of 10 m leaves less than 1e-14 rad, one of 1 km 1e-10 rad.
    """
    w2 = 1.0 - E2 * sin_lat * sin_lat
    prime = A / math.sqrt(w2)
    sc = sin_lat * cos_lat
    wrong = axis_distance * sin_lat - z * cos_lat - E2 * prime * sc
    slope = axis_distance * cos_lat + z * sin_lat - E2 * prime * (1.0 - 2.0 * sin_lat * sin_lat + E2 * sc * sc / w2)
    angle = -wrong / slope
    s = sin_lat + angle * (cos_lat - 0.5 * angle * sin_lat)
    c = cos_lat - angle * (sin_lat + 0.5 * angle * cos_lat)
    scale = 1.5 - 0.5 * (s * s + c * c)
    return s * scale, c * scale


@inline_kernel
def height_above(axis_distance: float, z: float, sin_lat: float, cos_lat: float) -> float:
    """Height above the ellipsoid, m, of a place whose geodetic latitude is known."""
    return axis_distance * cos_lat + z * sin_lat - A * math.sqrt(1.0 - E2 * sin_lat * sin_lat)


@inline_kernel
def gravitation_cartesian(
    field: int, x: float, y: float, z: float, sin_lat: float, cos_lat: float
) -> tuple[float, float, float]:
    """Gravitation in Earth-centred axes (any turn about the Earth's axis), m/s^2, at a place with known latitude."""
    p = math.sqrt(x * x + y * y)
    north, down = gravitation_local(field, sin_lat, cos_lat, height_above(p, z, sin_lat, cos_lat), p)
    out = -sin_lat * north - cos_lat * down
    scale = out / p if p > 0.0 else 0.0
    return scale * x, scale * y, cos_lat * north - sin_lat * down
