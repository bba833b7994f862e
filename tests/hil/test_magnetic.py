"""The Earth's field: the dipole by its potential, the World Magnetic Model by its published test values."""

import math

import numpy as np
import pytest

from hil.magnetic import DIPOLE, REFERENCE_RADIUS, magnetic_field
from nav.earth import E2, A


def ecef(lat, lon, height):
    prime = A / math.sqrt(1.0 - E2 * math.sin(lat) ** 2)
    level = (prime + height) * math.cos(lat)
    return np.array([level * math.cos(lon), level * math.sin(lon), (prime * (1 - E2) + height) * math.sin(lat)])


def potential(place):
    r = np.linalg.norm(place)
    return REFERENCE_RADIUS**3 / r**3 * float(np.dot(DIPOLE, place))


@pytest.mark.parametrize("lat_deg", [-89.0, -30.0, 0.0, 50.0, 90.0])
@pytest.mark.parametrize("lon_deg", [-170.0, 0.0, 36.0])
def test_dipole_is_the_gradient_of_its_potential(lat_deg, lon_deg):
    """B = -grad V along the geodetic north, east and down, V = a (a/r)^2 m . u."""
    lat, lon, height = math.radians(lat_deg), math.radians(lon_deg), 2000.0
    east = np.array([-math.sin(lon), math.cos(lon), 0.0])
    up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
    axes = np.array([np.cross(up, east), east, -up])
    here = ecef(lat, lon, height)
    expected = [-(potential(here + 50.0 * axis) - potential(here - 50.0 * axis)) / 100.0 for axis in axes]
    np.testing.assert_allclose(magnetic_field("dipole", lat, lon, height, 2025.0), expected, atol=1e-13)


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg", "north", "east", "down"),
    [
        (80, 0, 6521.6, 145.9, 54791.5),
        (0, 120, 39677.8, -109.6, -10580.2),
        (-80, 240, 6117.5, 15751.9, -52022.5),
    ],
)
def test_world_magnetic_model_gives_its_published_values(lat_deg, lon_deg, north, east, down):
    """Test values of the World Magnetic Model 2025 (NOAA NCEI, British Geological Survey), 2025.0, on the ellipsoid, nT."""
    pytest.importorskip("pygeomag", reason="the World Magnetic Model needs the extra 'magnetic'")
    field = magnetic_field("wmm", math.radians(lat_deg), math.radians(lon_deg), 0.0, 2025.0)
    np.testing.assert_allclose(1e9 * field, [north, east, down], atol=0.06)
