"""The standard atmosphere against its published table and against hydrostatics."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nav.atmosphere import EARTH_RADIUS, standard_atmosphere

GAS = 287.05287


@pytest.mark.parametrize(
    ("altitude", "pressure", "temperature"),
    [
        (0.0, 101325.0, 288.150),
        (1000.0, 89876.3, 281.651),
        (5000.0, 54048.3, 255.676),
        (10000.0, 26499.9, 223.252),
        (15000.0, 12111.8, 216.650),
        (20000.0, 5529.30, 216.650),
        (30000.0, 1197.03, 226.509),
    ],
)
def test_published_table(altitude: float, pressure: float, temperature: float) -> None:
    """U.S. Standard Atmosphere 1976, table I (equal to ISO 2533 there), by geometric altitude."""
    p, t = standard_atmosphere(altitude)
    assert p == pytest.approx(pressure, rel=2e-5)
    assert t == pytest.approx(temperature, abs=2e-3)


@given(st.floats(-4000.0, 45000.0))
def test_air_carries_itself(altitude: float) -> None:
    """dp / dH = -p g / (R T) with the geopotential height H, across the layers too."""
    step = 1.0
    below, above = standard_atmosphere(altitude - step), standard_atmosphere(altitude + step)
    p, t = standard_atmosphere(altitude)
    geopotential = (EARTH_RADIUS / (EARTH_RADIUS + altitude)) ** 2
    gradient = (above[0] - below[0]) / (2.0 * step * geopotential)
    assert gradient == pytest.approx(-p * 9.80665 / (GAS * t), rel=1e-4)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_no_altitude_is_without_air(altitude: float) -> None:
    p, t = standard_atmosphere(altitude)
    assert 100.0 < p < 2e5
    assert 200.0 < t < 330.0
