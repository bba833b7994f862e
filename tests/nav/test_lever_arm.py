"""The lever arm against geodesy in Earth-fixed axes and against rigid-body kinematics."""

import math

import numpy as np
import pymap3d
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nav.lever_arm import shift


def shifted(lat, lon, height, q, w, arm, vel=(0.0, 0.0, 0.0)):
    position = [np.array([value]) for value in (lat, lon, height)]
    velocity = np.array([vel], float)
    shift(*position, velocity, np.array([q]), np.array([w], float), np.array(arm, float))
    return *(float(value[0]) for value in position), velocity[0]


arms = st.tuples(*[st.floats(-20, 20)] * 3)
turns = st.tuples(*[st.floats(-3, 3)] * 3)


@given(st.floats(-1.5, 1.5), st.floats(-3.14, 3.14), turns, arms)
def test_the_place_is_where_geodesy_says(lat, lon, vector, arm):
    attitude = Rotation.from_rotvec(vector)
    q = attitude.as_quat(scalar_first=True)
    got = shifted(lat, lon, 300.0, q, (0, 0, 0), arm)
    expected = pymap3d.ned2geodetic(*attitude.apply(arm), lat, lon, 300.0, deg=False)
    there = np.array(pymap3d.geodetic2ecef(*got[:3], deg=False))
    meant = np.array(pymap3d.geodetic2ecef(*expected, deg=False))
    # Left out: the curvature over the arm, arm^2 / radius, larger near the pole
    assert np.linalg.norm(there - meant) < 2e-9 + 1200 / 6.3e6 * (1.0 + abs(math.tan(lat)))


@given(turns, turns, arms)
def test_there_and_back_and_the_velocity_of_a_rigid_body(vector, w, arm):
    attitude = Rotation.from_rotvec(vector)
    q = attitude.as_quat(scalar_first=True)
    lat, lon, height, vel = shifted(0.8, 0.6, 100.0, q, w, arm, (50.0, -3.0, 1.0))
    np.testing.assert_allclose(vel - [50.0, -3.0, 1.0], attitude.apply(np.cross(w, arm)), atol=1e-12)
    lat, lon, height, vel = shifted(lat, lon, height, q, w, [-x for x in arm], vel)
    np.testing.assert_allclose([(lat - 0.8) * 6.4e6, (lon - 0.6) * 6.4e6, height - 100.0], 0.0, atol=5e-4)
    np.testing.assert_allclose(vel, [50.0, -3.0, 1.0], atol=1e-12)


def test_longitude_stays_in_its_range_across_the_date_line():
    east = math.nextafter(math.pi, 0.0)
    _, lon, _, _ = shifted(0.5, east, 0.0, [1.0, 0, 0, 0], (0, 0, 0), (0, 5.0, 0))
    assert -math.pi <= lon < -3.14
    _, lon, _, _ = shifted(0.5, -east, 0.0, [1.0, 0, 0, 0], (0, 0, 0), (0, -5.0, 0))
    assert 3.14 < lon <= math.pi
