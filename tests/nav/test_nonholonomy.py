"""The wander azimuth along paths: parallels, closed paths, Babich's figures, geodesics, the wander mechanization."""

import math

import numpy as np
import pytest
from geographiclib.geodesic import Geodesic
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.scenario import load
from hil.world.motion import Motion
from nav.errors import HilError
from nav.nonholonomy import azimuth_change, constant_gyro_heading, family, solid_angle
from nav.strapdown import Strapdown

angle = st.floats(-math.pi, math.pi)


def test_along_a_parallel_and_a_meridian():
    lon = np.linspace(3.0, 3.5, 20001)  # over the date line
    lat = np.full_like(lon, 0.9)
    reduced = np.remainder(lon + math.pi, 2 * math.pi) - math.pi
    np.testing.assert_allclose(azimuth_change(lat, reduced), math.sin(0.9) * (lon - 3.0), atol=1e-9)
    assert azimuth_change(np.array([0.1, 1.2]), np.array([2.0, 2.0]))[-1] == 0.0


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_around_a_closed_path_it_is_the_solid_angle(seed):
    """A polygon about a place: A around it and the solid angle are two computations of the same."""
    rng = np.random.default_rng(seed)
    lat0, lon0 = rng.uniform(-1.2, 1.2), rng.uniform(-3.0, 3.0)
    lat = lat0 + rng.uniform(-0.2, 0.2, 7)
    lon = lon0 + rng.uniform(-0.3, 0.3, 7)
    around = azimuth_change(np.append(lat, lat[0]), np.append(lon, lon[0]))[-1]
    assert around == pytest.approx(solid_angle(lat, lon), abs=1e-13)


def test_an_octant_run_clockwise():
    lat, lon = np.array([0.0, math.pi / 2, 0.0]), np.array([0.0, 0.0, math.pi / 2])
    assert solid_angle(lat, lon) == pytest.approx(math.pi / 2)  # to the pole, down to the east, back west: clockwise
    assert solid_angle(lat[::-1], lon[::-1]) == pytest.approx(-math.pi / 2)


@settings(max_examples=20, deadline=None)
@given(st.floats(-1.0, 1.0), angle, angle)
def test_constant_gyroscopic_heading_is_a_geodesic(lat, lon, heading):
    path = constant_gyro_heading(lat, lon, heading, 2e6, 2000)
    if np.abs(path[:, 0]).max() > 1.4:
        return
    end = Geodesic.WGS84.Direct(math.degrees(lat), math.degrees(lon), math.degrees(heading), 2e6)
    assert path[-1, 0] == pytest.approx(math.radians(end["lat2"]), abs=1e-10)
    assert math.remainder(path[-1, 1] - math.radians(end["lon2"]), 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    assert math.remainder(heading + path[-1, 2] - math.radians(end["azi2"]), 2 * math.pi) == pytest.approx(0, abs=1e-9)


@given(angle, angle, angle)
def test_the_family_keeps_heading_and_velocity_in_n(azimuth, heading, constant):
    vel = np.array([3.0, -7.0, 0.5])
    other_azimuth, other_heading, other_vel = family(azimuth, heading, vel, constant)

    def north_east(a, v):
        return -v[0] * math.sin(a) + v[1] * math.cos(a), v[0] * math.cos(a) + v[1] * math.sin(a)

    assert other_azimuth + other_heading == pytest.approx(azimuth + heading)
    assert north_east(other_azimuth, other_vel) == pytest.approx(north_east(azimuth, vel), abs=1e-12)
    assert other_vel[2] == vel[2]


def test_the_mechanization_follows_its_path_and_knows_the_family():
    """A of the wander mechanization is the integral along its path, and another start of A stays the constant apart."""
    motion = Motion(load("flight").motion)
    n, step = 6000, 0.02
    dtheta, dvel = np.empty((n, 3)), np.empty((n, 3))
    motion.increments(7500, n, step, dtheta, dvel)
    truth = motion.truth([150.0])[0]
    place = truth["lat"], truth["lon"], truth["height"], truth["vel_n"], truth["q_nb"]
    runs = []
    for constant in (0.0, 2.0):
        strapdown = Strapdown(mechanization="wander")
        strapdown.start(*place, constant)
        out = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
        strapdown.advance(np.full(n, step), dtheta, dvel, np.zeros(3), *out)
        runs.append((strapdown.azimuth, out[0]))
    (azimuth, position), (other, other_position) = runs
    path = np.vstack([[place[0], place[1], place[2]], position])
    assert abs(azimuth) > 1e-5
    assert azimuth == pytest.approx(azimuth_change(path[:, 0], path[:, 1])[-1], abs=1e-11)
    assert other - azimuth == pytest.approx(2.0, abs=1e-12)
    assert np.abs(other_position - position).max() < 1e-6


@pytest.mark.parametrize("what", [azimuth_change, solid_angle])
@pytest.mark.parametrize(
    ("lat", "lon", "say"),
    [([], [], "no points"), ([0.1, math.nan], [0.0, 1.0], "not a number"), ([0.1, 0.2], [0.0], "lon: shape")],
)
def test_what_is_no_path_is_refused(what, lat, lon, say):
    with pytest.raises(HilError, match=say):
        what(lat, lon)


@pytest.mark.parametrize(
    ("start", "say"),
    [
        ((0.9, 0.0, 0.0, 1e7, 1000), "meets a pole"),
        ((math.nan, 0.0, 0.0, 1e3, 2), "nan"),
        ((0.9, 0.0, 0.0, 1e3, 0), "0 steps"),
    ],
)
def test_a_geodesic_that_cannot_be_followed_is_refused(start, say):
    with pytest.raises(HilError, match=say):
        constant_gyro_heading(*start)
