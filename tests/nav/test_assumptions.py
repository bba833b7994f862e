"""What is known without another sensor: a MEMS board on a desk, in a hand, on its side; and what flies is not at rest."""

import math
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hil.geometry import attitude_difference, position_error
from hil.scenario import Channel, MotionConfig, Sine, load
from hil.study.aiding import gnss_rows
from hil.world.motion import Motion
from nav.aiding import Kind, aiding_rows
from nav.earth import RATE, normal_gravity
from nav.errors import HilError
from nav.filter.aided import Settings as FilterSettings
from nav.filter.assumptions import Assumptions, Bounds
from nav.filter.states import GYRO_SCALE, tuning
from nav.filter.stillness import Stillness
from nav.increments import ImuIncrements
from nav.instruments.accelerometer_errors import Accelerometers
from nav.instruments.grades import GRADES
from nav.instruments.gyro_errors import Gyros
from nav.navigator import Aiding, Navigator, Settings
from nav.rotation import attitude_error, euler_from_quaternion
from nav.state import Mode

MEMS, HZ = GRADES["mems"], 50
LAT, LON, HEIGHT = math.radians(50.0), math.radians(36.25), 150.0
BIAS_TILT = MEMS.accelerometer_bias / 9.80665
"""Tilt that one sigma of an accelerometer's bias makes, rad: 0.29 deg."""
DESK = Motion(MotionConfig(heading=Channel(offset=35), pitch=Channel(offset=2), roll=Channel(offset=-1)))
BOUNDS = Bounds(0.3, 1.0, 10.0)


def sensed(dtheta, dvel, seed, bias_removed=False):
    """What a MEMS board makes of true increments (n, 3)."""
    n, rng = len(dtheta), np.random.default_rng(seed)
    gyros, accelerometers = MEMS.draw(rng, bias_removed=bias_removed)
    imu = ImuIncrements.empty(n)
    imu.sequence[:] = np.arange(n)
    imu.time[:], imu.step[:] = (imu.sequence + 1) / HZ, 1.0 / HZ
    imu.dtheta[:] = Gyros(gyros, 1.0 / HZ, rng).sense(dtheta, dvel)
    imu.dvel[:] = Accelerometers(accelerometers, 1.0 / HZ, rng).sense(dvel)
    return imu


def board(motion, seconds, seed, bias_removed=False):
    dtheta, dvel = np.empty((2, round(seconds * HZ), 3))
    motion.increments(0, len(dtheta), 1.0 / HZ, dtheta, dvel)
    return sensed(dtheta, dvel, seed, bias_removed)


FINE, COARSE = (0.02, 50, 5), (0.1, 10, 1)
"""Intervals of the filter, s, blocks in the detector's window and in a stride; the coarse ones are five times as fast."""


def navigator(heading, rest=True, bounds=BOUNDS, smooth=5.0, pace=FINE, wheels=None):
    """As the bridge sets it up for a MEMS board that is levelled with its heading given."""
    predict_s, blocks, stride = pace
    noise = MEMS.gyro_white, MEMS.accelerometer_white
    stillness = Stillness(*noise, block_s=predict_s, blocks=blocks, stride=stride)
    assumptions = Assumptions(stillness, rest, smooth, bounds, wheels)
    sigma = np.array([5.0, 5.0, 5.0, 0.05, 0.05, 0.05, 10 * BIAS_TILT, 10 * BIAS_TILT, math.radians(0.2)])
    aiding = Aiding(tuning(MEMS, bias_removed=True), FilterSettings(predict_s), sigma, assumptions)
    start = {"lat": LAT, "lon": LON, "height": HEIGHT, "alignment": "level", "align_s": 10.0, "heading": heading}
    return Navigator(Settings(**start, position_trusted=False, aiding=aiding))


def flown(found, imu, truth, every=10):
    """Errors, sigmas (n, 9) and the times of every `every`-th sample of `truth` (times) -> TRUTH once navigating."""
    times, errors, sigmas, tilts = [], [], [], []
    for k in range(0, len(imu), every):
        row = found.process(imu.rows(k, min(k + every, len(imu))))[-1]
        if row["mode"] < Mode.NAVIGATE:
            continue
        true = truth(np.array([row["time"]]))
        place = position_error(*(np.array([row[name]]) for name in ("lat", "lon", "height")), true)[0]
        times.append(row["time"])
        angles = attitude_error(row["q_nb"], true["q_nb"][0])
        errors.append([*place, *(row["vel_n"] - true["vel_n"][0]), *angles])
        tilts.append([part[0] for part in attitude_difference(row["q_nb"][None], true["q_nb"])[1:]])
        sigmas.append(row["sigma"].copy())
    return np.array(times), np.array(errors), np.array(sigmas), np.array(tilts)


def watched(found):
    """All rows that a navigator gives itself, gathered as it goes."""
    rows, make = [], found._assumed.rows

    def gather(aided):
        made = make(aided)
        rows.extend(made)
        return made

    found._assumed.rows = gather
    return rows


def rest_rows(rows):
    """Times of zero velocities and zero rates at rest."""
    return [float(row["time"]) for row in rows if row["source"] == -1 and row["kind"] in (6, 7)]


def on_the_desk(seconds, seeds, pace):
    """Tilt and heading errors (seeds, n), and the worst of place, height and velocity, of boards on a desk."""
    heading = float(euler_from_quaternion(DESK.truth([0.0])["q_nb"])[0, 0])
    found = []
    for seed in seeds:
        one = navigator(heading, pace=pace)
        times, errors, sigmas, angles = flown(one, board(DESK, seconds, seed), DESK.truth, every=HZ)
        assert one.mode == Mode.NAVIGATE
        settled = times > 12.0
        found.append((errors[settled], sigmas[settled], angles[settled]))
    return found


def check_desk(found):
    for errors, sigmas, angles in found:
        assert (np.abs(errors[:, 6:8]) < 3.0 * BIAS_TILT).all()
        assert angles[:, 0].max() < 3.0 * BIAS_TILT
        assert (np.abs(errors[:, 8]) < 3.0 * sigmas[:, 8]).all()
        assert np.linalg.norm(errors[:, :3], axis=1).max() < 0.5  # the bounds would allow 10 m
        assert np.abs(errors[:, 3:6]).max() < 0.05
        assert (sigmas[:, :3] < 1.5 * BOUNDS.place).all()


def test_a_board_on_a_desk():
    check_desk(on_the_desk(60.0, range(2), FINE))


@pytest.mark.study
def test_ten_boards_on_a_desk_for_an_hour():
    found = on_the_desk(3600.0, range(10), COARSE)
    check_desk(found)
    last = np.array([errors[-1] / sigmas[-1] for errors, sigmas, _ in found])
    assert 0.5 < math.sqrt((last[:, 6:8] ** 2).mean()) < 1.6
    assert math.sqrt((last[:, 8] ** 2).mean()) < 1.6


def smooth_step(t, start, stop):
    s = np.clip((t - start) / (stop - start), 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


TAKEN, LAID = 20.0, 24.0


def in_hand(t):
    return smooth_step(t, TAKEN, TAKEN + 0.5) * (1.0 - smooth_step(t, LAID - 0.5, LAID))


def attitude_in_hand(t):
    """Turned by 90 degrees in heading and laid on its side, trembling meanwhile."""
    turn, tremble = smooth_step(t, TAKEN + 1.0, LAID - 1.0), 0.03 * in_hand(t) * np.sin(6.0 * math.pi * t)
    angles = [0.6 + 0.5 * math.pi * turn + tremble, 0.03 + 0.5 * tremble, -0.02 + 0.5 * math.pi * turn + tremble]
    return Rotation.from_euler("ZYX", np.transpose(angles))


def path_in_hand(t):
    """North, east, down of the start, m."""
    lift = smooth_step(t, TAKEN, TAKEN + 1.0) * (1.0 - smooth_step(t, LAID - 1.0, LAID))
    return np.stack([0.2 * smooth_step(t, TAKEN, LAID), 0.3 * smooth_step(t, TAKEN, LAID), -0.3 * lift], axis=1)


def carried(attitude, path, seconds, seed, fine=4):
    """Increments of a board moved by hand: derivatives of the attitude and the path by differences."""
    h, small = 1.0 / (HZ * fine), 1e-3
    t = h * (np.arange(round(seconds * HZ * fine)) + 0.5)
    earth = np.array([RATE * math.cos(LAT), 0.0, -RATE * math.sin(LAT)])
    c_bn = attitude(t).inv()
    rate = (attitude(t - small).inv() * attitude(t + small)).as_rotvec() / (2.0 * small) + c_bn.apply(earth)
    speed = (path(t + small) - path(t - small)) / (2.0 * small)
    pushed = (path(t + small) - 2.0 * path(t) + path(t - small)) / small**2 + 2.0 * np.cross(earth, speed)
    force = c_bn.apply(pushed - [0.0, 0.0, normal_gravity(math.sin(LAT), HEIGHT)])
    return sensed(*(h * part.reshape(-1, fine, 3).sum(axis=1) for part in (rate, force)), seed)


@pytest.mark.parametrize("seed", range(3))
def test_picked_up_turned_and_laid_on_its_side(seed):
    """The tilt is right again within seconds: other axes lie level now, and their biases are the limit."""
    found = navigator(0.6)
    imu = carried(attitude_in_hand, path_in_hand, 32.0, seed)
    rows = watched(found)
    tilts = {}
    for k in range(0, len(imu), 5):
        row = found.process(imu.rows(k, k + 5))[-1]
        if row["mode"] < Mode.NAVIGATE:
            continue
        true = attitude_in_hand(row["time"][None]).as_quat(scalar_first=True)
        tilts[round(float(row["time"]), 2)] = attitude_difference(row["q_nb"][None], true)[1][0]
    times = np.array(rest_rows(rows))
    assert (times < TAKEN + 0.3).any()
    assert not ((times > TAKEN + 0.4) & (times < LAID)).any()
    assert times[times > LAID].min() < LAID + 1.5
    assert max(tilt for time, tilt in tilts.items() if 12.0 < time < TAKEN) < 3.0 * BIAS_TILT
    assert max(tilt for time, tilt in tilts.items() if time > LAID + 2.0) < 3.0 * BIAS_TILT
    assert row["sigma"][6:8].max() < 1.2 * math.hypot(BIAS_TILT, MEMS.accelerometer_scale)


def swaying(t):
    on = smooth_step(t, 15.0, 18.0)
    angles = [0.6 + 0.5 * on * np.sin(0.7 * t), 0.15 * on * np.sin(1.9 * t), 0.2 * on * np.sin(1.3 * t)]
    return Rotation.from_euler("ZYX", np.transpose(angles))


def walking(t):
    on = smooth_step(t, 15.0, 18.0)
    return np.stack([4.0 * on * np.sin(0.2 * t), 4.0 * on * np.sin(0.13 * t), 0.03 * on * np.sin(9.0 * t)], axis=1)


def test_carried_about_the_vertical_and_the_bounds_hold():
    """A minute and a half in motion without any other aiding: gravity holds the tilt, the bounds the rest."""
    tilts = {}
    for bounds in (BOUNDS, None):
        found = navigator(0.6, bounds=bounds)
        imu = carried(swaying, walking, 110.0, 2)
        tilts[bounds], rows = [], watched(found)
        for k in range(0, len(imu), HZ):
            row = found.process(imu.rows(k, k + HZ))[-1]
            if row["mode"] < Mode.NAVIGATE:
                continue
            true = swaying(row["time"][None]).as_quat(scalar_first=True)
            tilts[bounds].append(attitude_difference(row["q_nb"][None], true)[1][0])
        assert max(rest_rows(rows)) < 16.5
        gone = math.hypot((row["lat"] - LAT) * 6.37e6, (row["lon"] - LON) * 6.37e6 * math.cos(LAT))
        if bounds is None:
            assert gone > 30.0
        else:
            assert gone < 3.0 * BOUNDS.place
            assert np.abs(row["vel_n"]).max() < 3.0 * BOUNDS.speed
            assert (row["sigma"][:3] < 2.0 * BOUNDS.place).all()
    assert max(tilts[BOUNDS]) < math.radians(2.0)


def test_gravity_counts_less_in_a_manoeuvre():
    """The row's sigma in cruise is that of the acceleration; turning, jerking and pulling widen it."""

    def sigmas(attitude, path):
        found = navigator(0.6, rest=False)
        rows = watched(found)
        found.process(carried(attitude, path, 30.0, 1))
        return np.array(
            [[row["time"], row["sigma"][0]] for row in rows if row["kind"] == Kind.GRAVITY and row["time"] > 20.0]
        )

    calm = sigmas(lambda t: swaying(0.0 * t), lambda t: np.zeros((len(t), 3)))
    white = BOUNDS.acceleration * math.sqrt(2.0 * BOUNDS.speed / BOUNDS.acceleration / 0.1)
    np.testing.assert_allclose(calm[:, 1], white, rtol=0.1)

    def spinning(t):
        return Rotation.from_euler("Z", (0.6 + 2.0 * (t - 12.0) * (t > 12.0))[:, None])

    def heaving(t):
        return np.stack([0.1 * smooth_step(t, 12, 13) * np.sin(8.0 * t), 0 * t, 0 * t], axis=1)

    for moved in (sigmas(spinning, lambda t: np.zeros((len(t), 3))), sigmas(lambda t: swaying(0.0 * t), heaving)):
        assert np.median(moved[:, 1]) > 5.0 * white


def test_a_jet_is_not_at_rest():
    """It looks still for much of the flight. With its velocity known nothing is taken for rest from the take-off on."""
    motion, seconds = Motion(load("flight").motion), 110.0  # stands for 60 s
    imu, times = board(motion, seconds, 1), 0.2 * np.arange(1, 550)
    fixes = gnss_rows(motion.truth(times), np.random.default_rng(9))
    found = navigator(float(euler_from_quaternion(motion.truth([0.0])["q_nb"])[0, 0]), bounds=None)
    rows, still = watched(found), []
    for k in range(0, len(imu), HZ // 5):
        found.process(imu.rows(k, k + HZ // 5))
        if found.mode == Mode.NAVIGATE and k // 10 < len(fixes):
            found.aid(fixes[k // 10 : k // 10 + 1])
        still.append(found._assumed.detector.still)
    assert len(rest_rows(rows)) > 400
    assert max(rest_rows(rows)) < 70.0
    assert np.mean(still[5 * 70 :]) > 0.1


@pytest.mark.parametrize(("smooth", "fires"), [(5.0, False), (1e4, True)])
def test_lost_in_a_straight_flight_it_is_still_not_at_rest(smooth, fires):
    """No fix for minutes, the velocity unknown by more than itself: only what the vehicle cannot do smoothly is rest."""
    motion = Motion(MotionConfig(north=Channel(rate=30.0)))
    found = navigator(0.0, bounds=None, smooth=smooth)
    true = motion.truth([0.0])[0]
    imu = board(motion, 150.0, 3, bias_removed=True)
    found.begin(*(true[name] for name in ("lat", "lon", "height", "vel_n", "q_nb")), 0.0)
    rows = watched(found)
    found.process(imu)
    assert bool(rest_rows(rows)) is fires


def test_noise_is_not_learnt_as_a_scale_factor():
    """At rest only the Earth's rate shows a scale factor: nothing of it can be known after half a minute."""
    found = navigator(0.6)
    found.process(board(DESK, 40.0, 4))
    assert np.abs(found._aided.estimates[GYRO_SCALE]).max() < 0.1 * MEMS.gyro_scale


HAND = carried(attitude_in_hand, path_in_hand, 27.0, 1)


@cache
def whole():
    return navigator(0.6).process(HAND).tobytes()


@settings(max_examples=4)
@given(st.lists(st.integers(1, len(HAND)), max_size=30))
def test_batches_change_no_bit(cuts):
    split = navigator(0.6)
    edges = [0, *sorted(cuts), len(HAND)]
    parts = [split.process(HAND.rows(a, b)).copy() for a, b in pairwise(edges)]
    assert np.concatenate(parts).tobytes() == whole()


def test_wheels_hold_a_car_on_its_road_while_fixes_fail():
    """East of a road to the north, a minute after the last fix: the tilt and the gyros carry away what has no wheels."""
    road = Motion(MotionConfig(rest_s=12, ramp_s=8, north=Channel(rate=15, sines=(Sine(amplitude=20, period_s=17),))))
    fixes = road.truth(np.arange(60.0, 350.0) / 5.0)
    off = {}
    for wheels in (None, 0.05):
        errors = []
        for seed in range(4):
            found, imu = navigator(0.0, bounds=None, wheels=wheels, pace=COARSE), board(road, 130.0, seed)
            rows = gnss_rows(fixes, np.random.default_rng(seed))
            found.process(imu.rows(0, 11 * HZ))
            found.aid(rows)
            last = found.process(imu.rows(11 * HZ, len(imu)))[-1]
            errors.append(
                position_error(*(np.array([last[name]]) for name in ("lat", "lon", "height")), road.truth([130.0]))[0]
            )
            assert (np.abs(errors[-1]) < 4.0 * last["sigma"][:3]).all()
        off[wheels] = np.sqrt(np.mean(np.square(errors), axis=0))
    print(off)
    assert off[0.05][1] < 0.3 * off[None][1]


def test_a_measurement_of_the_first_moment_leaves_the_captured_bias():
    """It takes the filter back to its start, where the bias of the alignment must be known."""
    found, imu = navigator(0.6, rest=False, bounds=None), board(DESK, 11.0, 0)
    found.process(imu.rows(0, 10 * HZ + 2))
    captured = found.gyro_bias.copy()
    assert np.abs(captured).max() > 1e-3
    found.aid(aiding_rows([10.01], Kind.HEADING, [0.6], [0.1]))
    found.process(imu.rows(10 * HZ + 2, len(imu)))
    np.testing.assert_allclose(found.gyro_bias, captured, atol=1e-6)


@pytest.mark.parametrize("wrong", [(0.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, math.inf)])
def test_bounds_that_bound_nothing_are_refused(wrong):
    with pytest.raises(HilError):
        Bounds(*wrong)
