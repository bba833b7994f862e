"""The Earth against closed forms, geographiclib and the values published with WGS-84 (NGA.STND.0036)."""

import math

import numpy as np
import pymap3d
import pytest
from geographiclib.geodesic import Geodesic
from hypothesis import given
from hypothesis import strategies as st

from nav import earth

latitudes = st.floats(-89.9, 89.9)


@given(latitudes)
def test_radii_turn_metres_into_angles(lat_deg):
    meridian, prime = earth.curvature_radii(math.sin(math.radians(lat_deg)))
    half = 0.005  # deg: the geodesic along the meridian, symmetric about the point
    arc = Geodesic.WGS84.Inverse(lat_deg - half, 0, lat_deg + half, 0)["s12"]
    assert meridian == pytest.approx(arc / math.radians(2 * half), rel=2e-8)
    x, y, _ = pymap3d.geodetic2ecef(lat_deg, 77.0, 0.0)
    assert prime * math.cos(math.radians(lat_deg)) == pytest.approx(math.hypot(x, y), rel=1e-12)


def test_radii_at_the_ends():
    a, b = 6378137.0, 6356752.314245
    assert earth.curvature_radii(0.0) == pytest.approx((b * b / a, a), rel=1e-12)
    assert earth.curvature_radii(1.0) == pytest.approx((a * a / b, a * a / b), rel=1e-12)


@pytest.mark.parametrize(
    ("lat_deg", "published"),
    [(0, 9.7803253359), (45, 9.806197769), (90, 9.8321849378)],  # NGA.STND.0036, table 3.6; 45 deg: Moritz, GRS-80 form
)
def test_published_gravity(lat_deg, published):
    assert earth.normal_gravity(math.sin(math.radians(lat_deg)), 0.0) == pytest.approx(published, abs=5e-9)


def test_gravity_is_even_and_falls_with_height():
    s = math.sin(math.radians(50))
    assert earth.normal_gravity(s, 0.0) == earth.normal_gravity(-s, 0.0)
    free_air = (earth.normal_gravity(s, 1.0) - earth.normal_gravity(s, 0.0)) / 1.0
    assert free_air == pytest.approx(-0.3086e-5, rel=2e-3)  # the classical 0.3086 mGal/m


@given(latitudes, st.floats(-400, 20000))
def test_gravity_aloft_is_that_of_the_rotating_ellipsoid(lat_deg, height):
    """Exact normal gravity above the ellipsoid: the gradient of the closed potential in ellipsoidal coordinates."""
    lat = math.radians(lat_deg)
    x, _, z = pymap3d.geodetic2ecef(lat_deg, 0.0, height)
    size = float(np.hypot(*exact_gravity(x, z)))
    # The series is second order in height; its remainder at 20 km is the fourth power of h / a and the flattening's square
    assert earth.normal_gravity(math.sin(lat), height) == pytest.approx(size, abs=2e-6 * (1 + (height / 1e4) ** 2))


def exact_gravity(x, z):
    """Heiskanen and Moritz 1967, section 2-7: gamma from the potential U(u, beta), by central differences of 20 m."""
    a, f, gm, w = 6378137.0, 1 / 298.257223563, 3.986004418e14, 7.292115e-5
    b = a * (1 - f)
    e = math.sqrt(a * a - b * b)

    def q(u):
        t = e / u  # 0.5 * ((1 + 3 / t^2) atan t - 3 / t), by its series: the closed form cancels
        return sum((-1) ** (k + 1) * 2 * k * t ** (2 * k + 1) / ((2 * k + 1) * (2 * k + 3)) for k in range(1, 12))

    def potential(x, z):
        r2 = x * x + z * z - e * e
        u = math.sqrt(0.5 * r2 * (1 + math.sqrt(1 + 4 * e * e * z * z / r2**2)))
        sin_beta = z / u
        disturbing = 0.5 * w * w * a * a * q(u) / q(b) * (sin_beta**2 - 1 / 3)
        # The leading GM / r is differentiated analytically below
        return gm / e * atan_rest(e / u) + gm / u - gm / math.hypot(x, z) + disturbing + 0.5 * w * w * x * x

    def atan_rest(t):  # atan t - t
        return sum((-1) ** k * t ** (2 * k + 1) / (2 * k + 1) for k in range(1, 16))

    h, r = 20.0, math.hypot(x, z)
    slope = [
        (potential(x + h, z) - potential(x - h, z)) / (2 * h),
        (potential(x, z + h) - potential(x, z - h)) / (2 * h),
    ]
    return slope[0] - gm * x / r**3, slope[1] - gm * z / r**3


@given(st.floats(-90, 90), st.floats(-400, 20000))
def test_gradient_of_gravity(lat_deg, height):
    lat, h = math.radians(lat_deg), 1e-3

    def gravity(change, rise):
        return earth.normal_gravity(math.sin(lat + change), height + rise)

    by_lat, by_height = earth.normal_gravity_gradient(math.sin(lat), math.cos(lat), height)
    assert by_lat == pytest.approx((gravity(h, 0.0) - gravity(-h, 0.0)) / (2 * h), abs=2e-7)
    assert by_height == pytest.approx((gravity(0.0, 50.0) - gravity(0.0, -50.0)) / 100.0, rel=1e-8)
