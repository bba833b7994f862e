"""Four antennas: exact phases give the exact attitude, errors are those of the geometry, bad satellites are found."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from nav.filter.gnss_attitude import FALSE_ALARM, AttitudeRefused, attitude, start_from_epoch
from nav.frames import level_in_earth
from nav.rotation import attitude_error
from nav.strapdown import MECHANIZATIONS, Strapdown

LAT, LON = 0.87, 0.6
WAVE, SIGMA = 0.1903, 5e-3
SPACE = np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.0]])
PLANE = np.array([[2.0, 0.0, 0.1], [0.0, 2.0, 0.1], [0.0, -2.0, 0.1], [0.0, 0.0, 0.1]])
TRUE = Rotation.from_quat(level_in_earth(LAT, LON), scalar_first=True) * Rotation.from_euler("ZYX", [0.7, 0.1, -0.2])


def sky(count, seed=1):
    random = np.random.default_rng(seed)
    azimuth, up = 2 * np.pi * (np.arange(count) + 0.4 * random.random(count)) / count, random.uniform(0.3, 1.4, count)
    level = np.stack([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), -np.sin(up)], axis=1)
    return Rotation.from_quat(level_in_earth(LAT, LON), scalar_first=True).apply(level)


def phases(directions, antennas, random=None, true=TRUE):
    noise = SIGMA * random.standard_normal((len(directions), 4)) if random else np.zeros((len(directions), 4))
    ranges = directions @ true.apply(antennas).T + noise
    return 2.0 * math.pi / WAVE * (ranges[:, :3] - ranges[:, 3:])


def error(found):
    return (Rotation.from_quat(found.q_eb, scalar_first=True) * TRUE.inv()).as_rotvec()


@pytest.mark.parametrize("antennas", [SPACE, PLANE], ids=["space", "plane"])
@given(q=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1), count=st.integers(3, 12))
def test_exact_phases_give_the_exact_attitude(antennas, q, count):
    true = Rotation.from_quat(q, scalar_first=True)
    found = attitude(sky(count), phases(sky(count), antennas, true=true), antennas, WAVE, SIGMA)
    assert (Rotation.from_quat(found.q_eb, scalar_first=True) * true.inv()).magnitude() < 1e-12
    assert found.excluded == ()


@pytest.mark.parametrize("antennas", [SPACE, PLANE], ids=["space", "plane"])
def test_a_thousand_epochs_err_as_the_geometry_says(antennas):
    random, u, count = np.random.default_rng(5), sky(8), 1000
    found = [attitude(u, phases(u, antennas, random), antennas, WAVE, SIGMA) for _ in range(count)]
    errors = np.array([error(one) for one in found])
    covariance = found[0].covariance
    distances = np.einsum("ki,ij,kj->k", errors, np.linalg.inv(covariance), errors)
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 3 * count) / count
    assert low < distances.mean() < high
    assert np.abs(errors.mean(axis=0) / np.sqrt(np.diag(covariance) / count)).max() < 4.0


def test_three_equal_baselines_have_their_closed_form():
    """Satellites all round: U'U = 2 I. R^-1 = (I - 1 1'/4) / sigma^2 makes H = (5 I + 1 1') / sigma^2, but for signs, of
    orthogonal baselines of 2 m; then P = H^-1 / 2.
    """
    u = np.concatenate([np.eye(3), -np.eye(3)])
    found = attitude(u, phases(u, SPACE, true=Rotation.identity()), SPACE, WAVE, SIGMA)
    by_hand = 0.5 * np.linalg.inv(5.0 * np.eye(3) + np.ones((3, 3)))
    np.testing.assert_allclose(np.abs(found.covariance), SIGMA**2 * np.abs(by_hand), rtol=1e-9)
    # Twice the length, half the error; four times as many satellites, half again.
    longer = attitude(u, phases(u, 2.0 * SPACE, true=Rotation.identity()), 2.0 * SPACE, WAVE, SIGMA)
    many = attitude(np.tile(u, (4, 1)), np.tile(phases(u, SPACE, true=Rotation.identity()), (4, 1)), SPACE, WAVE, SIGMA)
    np.testing.assert_allclose(4.0 * longer.covariance, found.covariance, rtol=1e-9)
    np.testing.assert_allclose(4.0 * many.covariance, found.covariance, rtol=1e-9)


@given(bad=st.integers(0, 8), antenna=st.integers(0, 2), cycles=st.sampled_from([-2, -1, 1, 2]))
def test_a_slipped_cycle_is_found_and_left_out(bad, antenna, cycles):
    u = sky(9)
    slipped = phases(u, SPACE, np.random.default_rng(bad))
    slipped[bad, antenna] += 2.0 * math.pi * cycles
    found = attitude(u, slipped, SPACE, WAVE, SIGMA)
    assert found.excluded == (bad,)
    rest = np.arange(9) != bad
    without = attitude(u[rest], slipped[rest], SPACE, WAVE, SIGMA)
    np.testing.assert_allclose(found.q_eb, without.q_eb, atol=1e-14)
    np.testing.assert_allclose(found.covariance, without.covariance, rtol=1e-9)


def test_healthy_satellites_are_kept():
    random, u = np.random.default_rng(11), sky(7)
    alarms = sum(bool(attitude(u, phases(u, SPACE, random), SPACE, WAVE, SIGMA).excluded) for _ in range(2000))
    assert alarms <= chi2.isf(1e-6, 2) + 2000 * FALSE_ALARM


U = sky(6)


@pytest.mark.parametrize(
    ("directions", "antennas", "why"),
    [
        (U[:2], SPACE, "2 satellites are left"),
        (U * 1.01, SPACE, "no unit vector"),
        (np.array([[math.cos(a), math.sin(a), 0.0] for a in range(6)]), SPACE, "near a plane"),
        (U, SPACE * [1.0, 0.0, 0.0], "on a line"),
        (U * np.nan, SPACE, "not a number"),
    ],
)
def test_degenerate_geometry_is_refused(directions, antennas, why):
    with pytest.raises(AttitudeRefused, match=why):
        attitude(directions, phases(directions, antennas), antennas, WAVE, SIGMA)


def test_one_bad_satellite_of_four_cannot_be_named():
    slipped = phases(sky(4), SPACE)
    slipped[2, 1] += 2.0 * math.pi
    with pytest.raises(AttitudeRefused, match="of 4 satellites one is bad"):
        attitude(sky(4), slipped, SPACE, WAVE, SIGMA)


@pytest.mark.parametrize("mechanization", [name for name in MECHANIZATIONS if name != "inertial-source"])
def test_one_epoch_starts_the_navigator(mechanization):
    found = attitude(U, phases(U, SPACE), SPACE, WAVE, SIGMA)
    core, vel_n = Strapdown("two-sample", mechanization), np.array([100.0, -20.0, 3.0])
    start_from_epoch(core, LAT, LON, 500.0, vel_n, found, azimuth=0.4)
    q_nb = Rotation.from_euler("ZYX", [0.7, 0.1, -0.2]).as_quat(scalar_first=True)
    assert np.abs(attitude_error(core.solution[6:], q_nb)).max() < 1e-12
    np.testing.assert_allclose(core.solution[:6], [LAT, LON, 500.0, *vel_n])


def test_the_row_carries_attitude_and_sigmas_in_the_level():
    found = attitude(U, phases(U, SPACE), SPACE, WAVE, SIGMA)
    row = found.row(12.5, LAT, LON)
    _, covariance = found.level(LAT, LON)
    np.testing.assert_allclose(row["sigma"][:3] ** 2, np.diag(covariance))
    assert np.trace(covariance) == pytest.approx(np.trace(found.covariance))
    assert row["time"] == 12.5
