"""Alignment of records of increments: recursive is batch, the covariance is the scatter, refusals say why."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from nav.alignment.analytic import FORMS, AlignmentRefused
from nav.alignment.recursive import RestAlignment, align_at_rest
from nav.alignment.rest import Sensors
from nav.earth import normal_gravity
from nav.increments import ImuIncrements
from nav.rotation import attitude_error

EARTH_RATE = 7.292115e-5
DEG = math.radians(1.0)
G = 9.80665
LAT = 50.0 * DEG
ATTITUDE = Rotation.from_euler("ZYX", [37, 4, -3], degrees=True)
HEAD = Sensors(
    angle_random_walk=0.002 * DEG / 60,
    velocity_random_walk=5e-6 * G,
    gyro_bias=0.01 * DEG / 3600,
    accelerometer_bias=10e-6 * G,
)
"""The grade of a DTG head: 0.002 deg/sqrt(h), 5 ug/sqrt(Hz), 0.01 deg/h, 10 ug."""


def record(seconds, sensors, seed, hz=10.0, lat=LAT):
    """Increments of a head at rest, with the biases drawn and white noise."""
    random = np.random.default_rng(seed)
    n, h = round(seconds * hz), 1 / hz
    imu = ImuIncrements.empty(n)
    imu.step[:], imu.time[:], imu.sequence[:] = h, h * np.arange(1, n + 1), np.arange(n)
    rate = [EARTH_RATE * math.cos(lat), 0.0, -EARTH_RATE * math.sin(lat)]
    force = [0.0, 0.0, -normal_gravity(math.sin(lat), 0.0)]
    for out, truth, bias, walk in (
        (imu.dtheta, rate, sensors.gyro_bias, sensors.angle_random_walk),
        (imu.dvel, force, sensors.accelerometer_bias, sensors.velocity_random_walk),
    ):
        mean = ATTITUDE.inv().apply(truth) + bias * random.standard_normal(3)
        out[:] = h * mean + math.sqrt(h) * walk * random.standard_normal((n, 3))
    return imu


def error(result):
    return attitude_error(result.q_nb, ATTITUDE.as_quat(scalar_first=True))


@pytest.mark.parametrize("form", FORMS)
@given(seed=st.integers(0, 2**32 - 1), cuts=st.lists(st.integers(1, 199), max_size=6))
def test_recursive_is_batch(form, seed, cuts):
    imu = record(20.0, HEAD, seed)
    whole = align_at_rest(imu, LAT, HEAD, FORMS[form])
    edges = [0, *sorted(set(cuts)), 200]
    recursive = RestAlignment(LAT, HEAD, FORMS[form])
    for start, stop in pairwise(edges):
        recursive.add(imu.rows(start, stop))
    np.testing.assert_array_equal(recursive.result().q_nb, whole.q_nb)
    np.testing.assert_array_equal(recursive.result().covariance, whole.covariance)


def test_sample_by_sample_is_the_alignment_of_the_plain_means_at_any_time():
    imu = record(20.0, HEAD, 1)
    recursive = RestAlignment(LAT, HEAD)
    for k in range(200):
        recursive.add(imu.rows(k, k + 1))
        done = (k + 1) // 5 * 5  # samples in complete blocks
        if done:
            up = imu.dvel[:done].sum(0) / -np.linalg.norm(imu.dvel[:done].sum(0))
            east = np.cross(up, imu.dtheta[:done].sum(0))
            east /= np.linalg.norm(east)
            c_nb = np.array([np.cross(east, up), east, up])
            plain = Rotation.from_matrix(c_nb).as_quat(scalar_first=True)
            assert np.linalg.norm(attitude_error(recursive.result().q_nb, plain)) < 1e-12


def test_covariance_shrinks_with_time_down_to_the_biases():
    imu = record(400.0, HEAD, 2)
    noise_only = Sensors(HEAD.angle_random_walk, HEAD.velocity_random_walk)
    sigmas = [align_at_rest(imu.rows(0, n), LAT, noise_only).covariance for n in (250, 1000, 4000)]
    np.testing.assert_allclose(sigmas[0], 4.0 * sigmas[1], rtol=1e-5)
    np.testing.assert_allclose(sigmas[1], 4.0 * sigmas[2], rtol=1e-5)
    whole = align_at_rest(imu, LAT, HEAD).covariance
    limits = [HEAD.accelerometer_bias / G, HEAD.gyro_bias / (EARTH_RATE * math.cos(LAT))]
    rest_of_it = np.diag(whole - sigmas[2])
    assert math.sqrt(rest_of_it[0]) == pytest.approx(limits[0], rel=1e-3)
    assert math.sqrt(rest_of_it[2]) == pytest.approx(math.hypot(limits[1], math.tan(LAT) * limits[0]), rel=1e-3)


@pytest.mark.parametrize(
    "sensors", [Sensors(HEAD.angle_random_walk, HEAD.velocity_random_walk), HEAD], ids=["noise", "noise-and-biases"]
)
@pytest.mark.parametrize("form", ["angles", "cosines"])
def test_covariance_is_the_scatter_of_many_alignments(sensors, form):
    """300 draws: each axis and the whole (normalised error squared) within what chi-square leaves to chance."""
    draws = 300
    results = [align_at_rest(record(30.0, sensors, seed), LAT, sensors, FORMS[form]) for seed in range(draws)]
    errors = np.array([error(result) for result in results])
    covariances = np.array([result.covariance for result in results])
    for axis in range(3):
        squares = np.sum(errors[:, axis] ** 2 / covariances[:, axis, axis])
        assert chi2.ppf(1e-4, draws) < squares < chi2.ppf(1 - 1e-4, draws)
    whole = np.einsum("ki,kij,kj->", errors, np.linalg.inv(covariances), errors)
    assert chi2.ppf(1e-4, 3 * draws) < whole < chi2.ppf(1 - 1e-4, 3 * draws)
    correlation = np.corrcoef(errors.T)[0, 2]
    expected = covariances[0, 0, 2] / math.sqrt(covariances[0, 0, 0] * covariances[0, 2, 2])
    assert abs(math.atanh(correlation) - math.atanh(expected)) < 4.0 / math.sqrt(draws - 3)


def test_noise_that_is_not_stated_is_read_from_the_blocks():
    noise = Sensors(HEAD.angle_random_walk, HEAD.velocity_random_walk)
    imu = record(300.0, noise, 3)
    stated, seen = align_at_rest(imu, LAT, noise), align_at_rest(imu, LAT)
    np.testing.assert_array_equal(stated.q_nb, seen.q_nb)
    # The worst of three scatters of 600 blocks
    assert 1.0 / 1.2 < seen.sigma_heading / stated.sigma_heading < 1.2


def test_motion_in_a_record_is_refused_and_restarts_the_recursion():
    imu = record(20.0, HEAD, 4)
    imu.dtheta[80:85] += 0.02 * 0.1
    with pytest.raises(AlignmentRefused, match=r"the vehicle moved during the averaging, last before 8\.500 s: cut"):
        align_at_rest(imu, LAT, HEAD)
    recursive = RestAlignment(LAT, HEAD)
    recursive.add(imu.rows(0, 85))
    with pytest.raises(AlignmentRefused, match=r"0 blocks of 0.5 s since the motion at 8.500 s; stand still for 0.5 s"):
        recursive.result()
    recursive.add(imu.rows(85, 200))
    np.testing.assert_array_equal(recursive.result().q_nb, align_at_rest(imu.rows(85, 200), LAT, HEAD).q_nb)


def test_a_body_that_sways_is_not_at_rest():
    """0.001 deg at 0.4 Hz: far below the motion limits, and it would bend north by degrees."""
    imu = record(60.0, HEAD, 5)
    phase = 2 * math.pi * 0.4 * np.concatenate([[0.0], imu.time])
    imu.dtheta[:, 2] += 0.001 * DEG * np.diff(np.sin(phase))
    with pytest.raises(AlignmentRefused, match=r"this is not rest: the rate scatters \d+\.\d times as much"):
        align_at_rest(imu, LAT, HEAD)


def test_too_short_says_how_long_it_would_take():
    with pytest.raises(
        AlignmentRefused, match=r"too short: 3 blocks of 0.5 s; stand still for 2 s, or state the noise"
    ):
        align_at_rest(record(1.9, HEAD, 6), LAT)
    with pytest.raises(AlignmentRefused, match=r"too short: 0 blocks of 0.5 s; stand still for 0.5 s$"):
        align_at_rest(record(0.4, HEAD, 6), LAT, HEAD)
    asked = 0.1 * DEG
    with pytest.raises(AlignmentRefused, match=r"averaging is too short: .* average \d+ s instead of 5 s") as refusal:
        align_at_rest(record(5.0, HEAD, 6), LAT, HEAD, asked=asked)
    time = float(str(refusal.value).split("average ")[1].split(" s")[0])
    assert align_at_rest(record(time + 1.0, HEAD, 6), LAT, HEAD, asked=asked).sigma_heading < asked


def test_a_mems_board_cannot_gyrocompass():
    """0.3 deg/sqrt(h) hides the Earth rate for half a minute, the bias of 10 deg/h for good."""
    mems = Sensors(0.3 * DEG / 60, 120e-6 * G)
    with pytest.raises(AlignmentRefused, match=r"average longer \(\d+ s\) or give navigation.start.heading_deg"):
        align_at_rest(record(10.0, mems, 7), LAT, mems)
    biased = Sensors(mems.angle_random_walk, mems.velocity_random_walk, gyro_bias=10 * DEG / 3600)
    with pytest.raises(AlignmentRefused, match=r"gyro bias is 10 deg/h, which no averaging takes off; give navigation"):
        align_at_rest(record(600.0, mems, 7), LAT, biased)


@pytest.mark.parametrize("name", ["time", "step", "dtheta", "dvel"])
def test_an_increment_that_is_not_a_number_is_refused_before_it_spoils_the_sums(name):
    imu = record(5.0, HEAD, 8)
    recursive = RestAlignment(LAT, HEAD)
    recursive.add(imu)
    before = recursive.result()
    broken = record(5.0, HEAD, 9)
    getattr(broken, name)[17] = math.nan
    with pytest.raises(AlignmentRefused, match="increment 17 is not a number: mend the driver or the file"):
        recursive.add(broken)
    np.testing.assert_array_equal(recursive.result().q_nb, before.q_nb)


def test_gravity_may_drift_the_upright_axis():
    """A drift about the vertical bends no heading; stated, it does not refuse the latitude either."""
    imu, drift = record(600.0, HEAD, 1), 0.1 * DEG / 3600
    imu.dtheta[:] += imu.step[:, None] * ATTITUDE.inv().apply([0.0, 0.0, drift])
    with pytest.raises(AlignmentRefused, match="upward part of the rate"):
        align_at_rest(imu, LAT, HEAD)
    found = align_at_rest(imu, LAT, replace(HEAD, upright_drift=drift))
    assert abs(error(found)[2]) < 3.0 * found.sigma_heading
    assert found.sigma_heading == align_at_rest(record(600.0, HEAD, 1), LAT, HEAD).sigma_heading
