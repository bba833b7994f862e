"""The tracking correction: exponential decay, the closed forms of its steady state, heading through A alone, over the pole."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hil.scenario import Channel, MotionConfig
from hil.world.motion import Motion
from hil.world.pole import PoleFlight
from nav.aiding import Kind, aiding
from nav.earth import curvature_radii, normal_gravity
from nav.errors import HilError
from nav.filter.tracking import Tracking
from nav.filter.tracking_gains import Gains
from nav.rotation import attitude_error
from nav.strapdown import Strapdown

DEG = math.radians(1.0)
STEP, FIX_S = 0.02, 0.2
REST = Motion(MotionConfig(latitude_deg=50.0, heading=Channel(offset=30.0)))


def rows(true):
    place = float(true["lat"]), float(true["lon"]), float(true["height"]), *true["vel_n"]
    time = float(true["time"])
    return aiding(time, Kind.GNSS, place, (1.0,) * 6), aiding(time, Kind.ATTITUDE, tuple(true["q_nb"]), (1e-3,) * 3)


def fly(motion, seconds, gains, start, gyro_error=(0.0, 0.0, 0.0), azimuth=0.3):
    """Attitude error in n, velocity error and position error (m) at the fixes; the core."""
    core = Strapdown("two-sample", "wander")
    core.start(start["lat"], start["lon"], start["height"], start["vel_n"], start["q_nb"], azimuth)
    tracking, n, per = Tracking(core, gains, 0.0), round(seconds / FIX_S), round(FIX_S / STEP)
    truth = motion.truth(FIX_S * np.arange(1, n + 1))
    dtheta, dvel, found = np.empty((per, 3)), np.empty((per, 3)), np.empty((n, 9))
    out = np.empty((per, 3)), np.empty((per, 3)), np.empty((per, 4))
    for k, true in enumerate(truth):
        motion.increments(k * per, per, STEP, dtheta, dvel)
        core.advance(np.full(per, STEP), dtheta, dvel, -np.asarray(gyro_error), *out)
        for row in rows(true):
            tracking.take(row)
        meridian, prime = curvature_radii(math.sin(true["lat"]))
        radii = meridian + true["height"], (prime + true["height"]) * math.cos(true["lat"]), -1.0
        found[k, :3] = attitude_error(core.solution[6:], true["q_nb"])
        found[k, 3:6] = core.solution[3:6] - true["vel_n"]
        found[k, 6:] = (core.solution[:3] - [true["lat"], true["lon"], true["height"]]) * radii
    return found, core


def start_with(motion, heading=0.0, place=0.0):
    true = motion.truth([0.0])[0].copy()
    turn = Rotation.from_euler("z", heading) * Rotation.from_quat(true["q_nb"], scalar_first=True)
    true["q_nb"] = turn.as_quat(scalar_first=True)
    true["lat"] += place
    return true


def test_a_wrong_heading_decays_with_its_constant():
    found, _ = fly(REST, 40.0, Gains(azimuth=10.0), start_with(REST, heading=0.01))
    time = FIX_S * np.arange(1, len(found) + 1)
    np.testing.assert_allclose(found[:, 2], 0.01 * np.exp(-time / 10.0), rtol=0.01)


def test_a_wrong_place_decays_with_its_constant():
    found, _ = fly(REST, 40.0, Gains(place=15.0), start_with(REST, place=1e-6))
    time = FIX_S * np.arange(1, len(found) + 1)
    np.testing.assert_allclose(found[:, 6], found[0, 6] * np.exp(-(time - FIX_S) / 15.0), rtol=0.01)


@pytest.mark.parametrize("constant", [10.0, 20.0])
def test_gyro_drift_leaves_its_steady_state(constant):
    """With 1/K = T for all: tilt = drift T, velocity = g tilt T, place = velocity T, azimuth = vertical drift T."""
    drift, share = np.array([1e-6, 0.0, 5e-6]), FIX_S / constant
    body = Rotation.from_euler("z", 30.0, degrees=True).inv().apply(drift)
    gains = Gains(constant, constant, constant, constant)
    found, _ = fly(REST, 14.0 * constant, gains, start_with(REST), gyro_error=body)
    tilt, heading = drift[[0, 2]] * constant
    g = normal_gravity(math.sin(50.0 * DEG), 150.0)
    assert found[-1, 0] == pytest.approx(tilt, rel=share)
    assert found[-1, 2] == pytest.approx(heading, rel=share)
    assert abs(found[-1, 4]) == pytest.approx(g * tilt * constant, rel=2.0 * share)
    assert abs(found[-1, 7]) == pytest.approx(g * tilt * constant**2, rel=4.0 * share)


def test_heading_goes_through_the_azimuth_alone():
    """The gyroscopic heading psi_r, heading less A, is what it is without any correction."""
    start = start_with(REST, heading=0.02)
    _, tracked = fly(REST, 20.0, Gains(), start)
    _, free = fly(REST, 20.0, Gains(*[math.inf] * 4), start)

    def gyro_heading(core):
        w, x, y, z = core.solution[6:]
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)) - core.azimuth

    assert tracked.azimuth - free.azimuth == pytest.approx(-0.02 * (1.0 - math.exp(-1.0)), rel=0.01)
    assert gyro_heading(tracked) == pytest.approx(gyro_heading(free), abs=1e-7)


def test_true_fixes_change_nothing_even_over_the_pole():
    motion = PoleFlight(crossing_s=10.0)
    found, _ = fly(motion, 20.0, Gains(), motion.truth([0.0])[0])
    found = found[
        np.abs(FIX_S * np.arange(1, len(found) + 1) - motion.crossing_s) > 1.0
    ]  # at the pole north is anywhere
    assert np.abs(found[:, 3:6]).max() < 1e-4
    assert np.abs(found[:, :3]).max() < 1e-6
    assert np.abs(found[:, [6, 8]]).max() < 1e-3  # the longitude is modulo a turn


@pytest.mark.parametrize("azimuth", [0.0, 1.0, -2.5])
def test_the_platform_azimuth_does_not_matter(azimuth):
    start = start_with(REST, heading=0.01, place=1e-6)
    found, _ = fly(REST, 10.0, Gains(), start, azimuth=azimuth)
    same, _ = fly(REST, 10.0, Gains(), start, azimuth=0.5)
    np.testing.assert_allclose(found, same, atol=1e-7)


def test_refusals():
    with pytest.raises(HilError, match="choose wander"):
        Tracking(Strapdown(), Gains(), 0.0)
    with pytest.raises(HilError, match="must be positive"):
        Gains(tilt=0.0)
    core = Strapdown("two-sample", "wander")
    tracking, (place, _) = Tracking(core, Gains(), 5.0), rows(REST.truth([6.0])[0])
    before = core.solution.copy()
    for field, value in (("time", 4.0), ("kind", Kind.BARO), ("value", np.nan)):
        bad = place.copy()
        bad[field] = value
        with pytest.raises(HilError, match="leave it"):
            tracking.take(bad)
    assert (core.solution == before).all()
