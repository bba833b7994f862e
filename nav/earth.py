"""The Earth: WGS-84 ellipsoid, its rotation and its normal gravity.

Frames and units as in :mod:`nav`. Every function here is a compiled kernel on scalars, so that the same arithmetic
serves the simulated world and the navigation.
"""

import math

from nav.kernel import inline_kernel

A = 6378137.0
"""Semi-major axis, m."""
F = 1.0 / 298.257223563
"""Flattening."""
B = A * (1.0 - F)
"""Semi-minor axis, m."""
E2 = F * (2.0 - F)
"""First eccentricity squared."""
GM = 3.986004418e14
"""Gravitational constant of the Earth, m^3/s^2."""
RATE = 7.292115e-5
"""Rotation rate, rad/s."""
J2 = 1.08262982e-3
"""Second zonal harmonic."""
GE = 9.7803253359
"""Normal gravity at the equator, m/s^2."""
GP = 9.8321849378
"""Normal gravity at the pole, m/s^2."""
STANDARD_GRAVITY = 9.80665
"""What sensors and their data sheets call 1 g, m/s^2."""

_K = B * GP / (A * GE) - 1.0
_M = RATE * RATE * A * A * B / GM


@inline_kernel
def curvature_radii(sin_lat: float) -> tuple[float, float]:
    """Radii of curvature of the ellipsoid: (meridian, prime vertical), m.

    Parameters
    ----------
    sin_lat : float
        Sine of the geodetic latitude.
    """
    w2 = 1.0 - E2 * sin_lat * sin_lat
    prime = A / math.sqrt(w2)
    return prime * (1.0 - E2) / w2, prime


@inline_kernel
def normal_gravity(sin_lat: float, height: float) -> float:
    """Normal gravity (centrifugal part included), m/s^2, downward along the ellipsoid normal.

    Somigliana's formula on the ellipsoid with the second-order series in height (`docs/mathematics.md`, Earth).

    Parameters
    ----------
    sin_lat : float
        Sine of the geodetic latitude.
    height : float
        Height above the ellipsoid, m.
    """
    s2 = sin_lat * sin_lat
    g0 = GE * (1.0 + _K * s2) / math.sqrt(1.0 - E2 * s2)
    return g0 * (1.0 - 2.0 / A * (1.0 + F + _M - 2.0 * F * s2) * height + 3.0 * height * height / (A * A))


@inline_kernel
def normal_gravity_gradient(sin_lat: float, cos_lat: float, height: float) -> tuple[float, float]:
    """Derivatives of :func:`normal_gravity` by latitude, m/s^2/rad, and by height, 1/s^2.

    Parameters
    ----------
    sin_lat, cos_lat : float
        Of the geodetic latitude.
    height : float
        Height above the ellipsoid, m.
    """
    s2 = sin_lat * sin_lat
    w2 = 1.0 - E2 * s2
    g0 = GE * (1.0 + _K * s2) / math.sqrt(w2)
    slope = 2.0 / A * (1.0 + F + _M - 2.0 * F * s2)
    factor = 1.0 - slope * height + 3.0 * height * height / (A * A)
    by_s2 = g0 * factor * (_K / (1.0 + _K * s2) + 0.5 * E2 / w2) + g0 * 4.0 * F / A * height
    return 2.0 * sin_lat * cos_lat * by_s2, g0 * (6.0 * height / (A * A) - slope)
