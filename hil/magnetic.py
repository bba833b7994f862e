"""The Earth's magnetic field: a centred dipole, or the World Magnetic Model through pygeomag (extra ``magnetic``)."""

import math
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from nav.earth import E2, curvature_radii
from nav.errors import HilError
from nav.increments import FloatArray

REFERENCE_RADIUS = 6371200.0
"""Of the coefficients, m."""
DIPOLE = (-1410.8e-9, 4545.4e-9, -29351.8e-9)
"""Terms g11, h11, g10 of the World Magnetic Model 2025: the dipole along the axes of e, T."""


def magnetic_field(model: Literal["dipole", "wmm"], lat: float, lon: float, height: float, year: float) -> FloatArray:
    """Flux density, north, east, down, T.

    The dipole is ``(a / r)^3 (3 (m . u) u - m)``, u the direction from the Earth's centre. It leaves the World Magnetic Model by
    some ten uT and fifteen degrees of declination: for trying things out, where world and navigator take the same one.

    Parameters
    ----------
    model : {"dipole", "wmm"}
        Which one.
    lat, lon, height : float
        Geodetic, rad and m above the ellipsoid.
    year : float
        Decimal, from 2025 to 2030; the dipole is that of 2025.

    Raises
    ------
    HilError
        ``wmm`` without pygeomag.
    """
    if model == "wmm":
        found = _world_magnetic_model().calculate(math.degrees(lat), math.degrees(lon), height * 1e-3, year)
        return 1e-9 * np.array([found.x, found.y, found.z])
    sin_lat, cos_lat, sin_lon, cos_lon = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    _, prime = curvature_radii(sin_lat)
    level = (prime + height) * cos_lat
    place = np.array([level * cos_lon, level * sin_lon, (prime * (1.0 - E2) + height) * sin_lat])
    r = float(np.linalg.norm(place))
    u, m = place / r, np.array(DIPOLE)
    field = (REFERENCE_RADIUS / r) ** 3 * (3.0 * float(m @ u) * u - m)
    c_ne = np.array(
        [
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [-sin_lon, cos_lon, 0.0],
            [-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat],
        ]
    )
    result: FloatArray = c_ne @ field
    return result


@lru_cache(maxsize=1)
def _world_magnetic_model() -> Any:
    try:
        from pygeomag import GeoMag
    except ImportError as error:
        raise HilError("the World Magnetic Model needs pygeomag: pip install 'dtg-hil[magnetic]'") from error
    return GeoMag(coefficients_file="wmm/WMM_2025.COF")
