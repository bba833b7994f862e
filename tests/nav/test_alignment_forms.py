"""The source's three forms of analytic alignment, and the covariance of what they find."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nav.alignment import rest
from nav.alignment.analytic import FORMS, AlignmentRefused, gyrocompass, level
from nav.alignment.rest import Sensors
from nav.earth import normal_gravity
from nav.errors import HilError
from nav.rotation import attitude_error

EARTH_RATE = 7.292115e-5
DEG_H = math.radians(1 / 3600)
latitudes = st.floats(-80, 80).map(math.radians)
attitudes = st.tuples(st.floats(0, 360), st.floats(-89, 89), st.floats(-180, 180)).map(
    lambda angles: Rotation.from_euler("ZYX", angles, degrees=True)
)


def at_rest(attitude, lat):
    """Specific force and rate in body axes of something that stands on the Earth."""
    f = attitude.inv().apply([0.0, 0.0, -normal_gravity(math.sin(lat), 0.0)])
    w = attitude.inv().apply([EARTH_RATE * math.cos(lat), 0.0, -EARTH_RATE * math.sin(lat)])
    return f, w


def averaged(f, w, sigma_f=0.0, sigma_w=0.0):
    return rest.Means(60.0, w, f, sigma_w, sigma_f, 120)


def error(result, attitude):
    return attitude_error(result.q_nb, attitude.as_quat(scalar_first=True))


@pytest.mark.parametrize("form", ["angles", "cosines"])
@given(attitude=attitudes, lat=latitudes)
def test_angles_and_cosines_are_exact(form, attitude, lat):
    f, w = at_rest(attitude, lat)
    np.testing.assert_allclose(FORMS[form](f, w, lat), attitude.as_matrix(), atol=3e-15 / math.cos(lat))
    found = gyrocompass(averaged(f, w), lat, form=FORMS[form])
    assert np.linalg.norm(error(found, attitude)) < 5e-15 / math.cos(lat)


@given(attitudes, latitudes, st.tuples(*[st.floats(-0.1, 0.1)] * 3), st.tuples(*[st.floats(-0.01, 0.01)] * 3))
def test_angles_and_cosines_agree_on_any_data(attitude, lat, rate_error, force_error):
    """Also where the rate is not the Earth's and the rows of the cosines are not orthonormal: the vertical stays."""
    f, w = at_rest(attitude, lat)
    mean = averaged(f + 9.8 * np.array(force_error), w + math.cos(lat) * EARTH_RATE * np.array(rate_error))
    by_angles, by_cosines = (gyrocompass(mean, lat, form=FORMS[name]).q_nb for name in ("angles", "cosines"))
    assert np.linalg.norm(attitude_error(by_angles, by_cosines)) < 1e-13


@given(st.floats(0, 360), st.floats(0, 360), st.floats(-3.5, -1.1), latitudes)
def test_the_small_angle_form_is_wrong_by_its_own_orders(heading, azimuth, exponent, lat):
    """Rows by the square of the tilt, the attitude by its cube: t - atan(sin t), as the closed form says."""
    tilt = 10.0**exponent
    axis = [math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth)), 0.0]
    attitude = Rotation.from_rotvec(tilt * np.array(axis)) * Rotation.from_euler("z", heading, degrees=True)
    f, w = at_rest(attitude, lat)
    rows = FORMS["small-angles"](f, w, lat) - attitude.as_matrix()
    long = 1.0 - math.cos(tilt)  # of the vertical row and, through it, of the others
    lean = math.tan(abs(lat))
    noise = 1e-14 / math.cos(lat) ** 2
    assert np.linalg.norm(rows[2]) == pytest.approx(long, abs=noise)
    assert np.linalg.norm(rows[0]) == pytest.approx(lean * long, abs=noise)
    assert np.linalg.norm(rows[1]) == pytest.approx(long, rel=2 * tilt * (1 + lean), abs=noise)
    left = error(gyrocompass(averaged(f, w), lat, form=FORMS["small-angles"]), attitude)
    cube = tilt - math.atan(math.sin(tilt))
    assert cube == pytest.approx(0.5 * tilt**3, rel=2 * tilt**2, abs=1e-16)
    # Towards the level: the found tilt is the smaller one. Heading turns with the part of it about north.
    np.testing.assert_allclose(left[:2], -cube * np.array(axis[:2]), atol=noise + 2 * cube**2 * (1 + lean))
    assert left[2] == pytest.approx(cube * axis[0] * math.tan(lat), abs=noise + 2 * cube**2 * (1 + lean) ** 2)


def test_the_orders_of_the_small_angle_form():
    """Halving the tilt leaves a quarter of the rows' error and an eighth of the attitude's."""
    lat, rows, attitudes_left = math.radians(50.0), [], []
    for tilt in (0.08, 0.04, 0.02, 0.01):
        attitude = Rotation.from_euler("ZYX", [0.6, 0.6 * tilt, -0.8 * tilt])
        f, w = at_rest(attitude, lat)
        rows.append(np.abs(FORMS["small-angles"](f, w, lat) - attitude.as_matrix()).max())
        found = gyrocompass(averaged(f, w), lat, form=FORMS["small-angles"])
        attitudes_left.append(np.linalg.norm(error(found, attitude)))
    np.testing.assert_allclose(np.log2(np.divide(rows[:-1], rows[1:])), 2.0, atol=0.02)
    np.testing.assert_allclose(np.log2(np.divide(attitudes_left[:-1], attitudes_left[1:])), 3.0, atol=0.02)


@pytest.mark.parametrize(("pitch", "roll", "tilt"), [(8, 0, "8.0"), (-4, 5, "6.4"), (0, 180, "180.0")])
def test_the_small_angle_form_refuses_a_body_that_is_not_near_level(pitch, roll, tilt):
    f, w = at_rest(Rotation.from_euler("ZYX", [30, pitch, roll], degrees=True), 0.9)
    with pytest.raises(AlignmentRefused, match=f"tilted by {tilt} deg: use the form angles or cosines"):
        gyrocompass(averaged(f, w), 0.9, form=FORMS["small-angles"])


def jacobians(align, attitude, f, w):
    """Central differences of the attitude error over the specific force and the rate, (3, 3) each."""
    columns = []
    for size, which in ((1e-5, 0), (1e-5 * EARTH_RATE, 1)):
        for axis in np.eye(3):
            pair = []
            for sign in (1.0, -1.0):
                data = [f, w]
                data[which] = data[which] + sign * size * axis
                pair.append(error(align(averaged(*data)), attitude))
            columns.append((pair[0] - pair[1]) / (2 * size))
    return np.array(columns[:3]).T, np.array(columns[3:]).T


@given(attitudes, latitudes)
def test_covariance_is_that_of_the_numerical_derivatives(attitude, lat):
    f, w = at_rest(attitude, lat)
    sigma_f, sigma_w = 1e-4, 0.1 * DEG_H * math.cos(lat)
    by_force, by_rate = jacobians(lambda mean: gyrocompass(mean, lat), attitude, f, w)
    expected = sigma_f**2 * by_force @ by_force.T + sigma_w**2 * by_rate @ by_rate.T
    stated = Sensors(gyro_bias=0.6 * sigma_w, accelerometer_bias=0.6 * sigma_f)
    found = gyrocompass(averaged(f, w, 0.8 * sigma_f, 0.8 * sigma_w), lat, stated)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found.covariance / scale, expected / scale, atol=1e-6)
    assert found.sigma_heading == pytest.approx(math.sqrt(expected[2, 2]), rel=1e-6)
    assert found.sigma_tilt == pytest.approx(sigma_f / np.linalg.norm(f), rel=1e-6)


@given(st.floats(0, 6.28), st.floats(-1.4, 1.4), st.floats(-3.1, 3.1), latitudes)
def test_covariance_of_the_level_alignment_is_that_of_the_numerical_derivatives(heading, pitch, roll, lat):
    attitude = Rotation.from_euler("ZYX", [heading, pitch, roll])
    f, w = at_rest(attitude, lat)
    sigma_f, sigma_heading = 1e-4, 1e-3
    by_force, _ = jacobians(lambda mean: level(mean, lat, heading), attitude, f, w)
    turned = error(level(averaged(f, w), lat, heading + 1e-6), attitude) / 1e-6
    expected = sigma_f**2 * by_force @ by_force.T + sigma_heading**2 * np.outer(turned, turned)
    found = level(averaged(f, w, 0.8 * sigma_f), lat, heading, sigma_heading, Sensors(accelerometer_bias=0.6 * sigma_f))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found.covariance / scale, expected / scale, atol=1e-6)


@pytest.mark.parametrize("wrong", [{"time_s": 0.0}, {"time_s": -1.0}, {"time_s": math.nan}])
def test_no_time_is_no_average(wrong):
    mean = dataclasses.replace(averaged(*at_rest(Rotation.identity(), 0.9)), **wrong)
    for align in (lambda: gyrocompass(mean, 0.9), lambda: level(mean, 0.9, 0.0)):
        with pytest.raises(AlignmentRefused):
            align()


@pytest.mark.parametrize("asked", [math.nan, -1.0])
def test_a_heading_of_no_accuracy_is_never_good_enough(asked):
    mean = averaged(*at_rest(Rotation.identity(), 0.9), sigma_w=1e-7)
    with pytest.raises(AlignmentRefused, match="no averaging is long enough"):
        gyrocompass(mean, 0.9, asked=asked)


@pytest.mark.parametrize("value", [math.nan, -1e-6, math.inf])
def test_a_sensor_has_finite_deviations(value):
    with pytest.raises(HilError, match="0 or more"):
        Sensors(gyro_bias=value)
