"""EGM96 undulation: the 5-minute grid, published values, poles, date line, smoothness."""

import csv
import math
import timeit
from importlib.resources import files

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.geoid import undulation


def test_agrees_with_the_five_minute_grid() -> None:
    with (files("fixtures") / "geoid" / "egm96-5-sample.csv").open() as file:
        rows = [[float(value) for value in row.values()] for row in csv.DictReader(file)]
    errors = np.array([undulation(math.radians(lat), math.radians(lon)) - n for lat, lon, n in rows])
    assert len(errors) > 300
    assert np.abs(errors[:300]).max() < 0.03
    assert np.abs(errors).max() < 0.045  # the picked rows hold the worst nodes of the Earth
    assert np.sqrt(np.mean(errors[:300] ** 2)) < 0.006


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg", "undulation_m"),
    [
        # Test points that NGA publishes with its EGM96 interpolation program (OUTINTPT.DAT).
        (38.6281550, 269.7791550, -31.628),
        (-14.6212170, 305.0211140, -2.969),
        (46.8743190, 102.4487290, -43.575),
        (-23.6174460, 133.8747120, 15.871),
        (38.6254730, 359.9995000, 50.066),
        (-0.4667440, 0.0023000, 17.329),
    ],
)
def test_published_points(lat_deg: float, lon_deg: float, undulation_m: float) -> None:
    assert undulation(math.radians(lat_deg), math.radians(lon_deg)) == pytest.approx(undulation_m, abs=0.03)


def test_a_pole_is_one_point() -> None:
    for lat, undulation_m in ((-math.pi / 2, -29.53), (math.pi / 2, 13.61)):
        values = [undulation(lat, lon) for lon in np.linspace(-math.pi, math.pi, 50)]
        assert np.ptp(values) < 1e-6
        assert values[0] == pytest.approx(undulation_m, abs=0.005)


@given(st.floats(-math.pi / 2, math.pi / 2), st.floats(-math.pi, math.pi))
def test_continuous_and_periodic(lat: float, lon: float) -> None:
    here = undulation(lat, lon)
    assert -107.5 < here < 86.5
    assert undulation(lat, lon + 2 * math.pi) == pytest.approx(here, abs=1e-6)
    assert undulation(lat, lon + 1e-8) == pytest.approx(here, abs=1e-4)
    assert undulation(lat + 1e-8, lon) == pytest.approx(here, abs=1e-4)


@pytest.mark.parametrize("lat_deg", [-89.99, -60.0, 0.0, 33.3, 89.99])
def test_no_step_at_the_date_line(lat_deg: float) -> None:
    lat = math.radians(lat_deg)
    east, west = undulation(lat, math.pi - 1e-12), undulation(lat, -math.pi + 1e-12)
    assert east == pytest.approx(west, abs=1e-6)


def test_smooth_over_a_pole() -> None:
    before = undulation(math.radians(89.999999), 0.3)
    after = undulation(math.radians(89.999999), 0.3 + math.pi)
    assert before == pytest.approx(after, abs=1e-3)


def test_fast_enough_for_every_message() -> None:
    undulation(0.8, 0.6)
    assert timeit.timeit(lambda: undulation(0.8, 0.6), number=2000) / 2000 < 200e-6
