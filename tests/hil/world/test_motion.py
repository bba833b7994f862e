"""The motion against physics: inertial kinematics by finite differences, closed forms, quadrature, built-in scenarios."""

import math
from itertools import pairwise

import numpy as np
import pymap3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hil.scenario import Channel, Cone, MotionConfig, Sine, built_in_names, load
from hil.world.motion import TRUTH, Motion
from nav import earth
from nav.errors import HilError

ARM = (1.3, -0.4, 0.7)
SLOPE = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
CURVE = np.array([-1 / 560, 8 / 315, -1 / 5, 8 / 5, -205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560])
"""First and second derivative by central differences of the eighth order."""


def sines(*terms):
    return tuple(Sine(amplitude=a, period_s=p, phase_deg=f) for a, p, f in terms)


EVERYTHING = MotionConfig(
    latitude_deg=-41.0,
    longitude_deg=170.0,
    rest_s=10.0,
    ramp_s=20.0,
    attitude="coordinated",
    north=Channel(rate=80.0, sines=sines((200, 30, 20))),
    east=Channel(rate=-30.0, sines=sines((150, 40, 50))),
    up=Channel(offset=20, rate=3.0, sines=sines((30, 25, -70))),
    heading=Channel(offset=4, sines=sines((3, 8, 0))),
    pitch=Channel(offset=5, rate=0.1, sines=sines((2, 7, 10), (1, 9, 0))),
    roll=Channel(sines=sines((5, 6, 90))),
    cone=Cone(half_angle_deg=8.0, frequency_hz=-0.3),
)
TUMBLING = MotionConfig(
    latitude_deg=80.0,
    height_m=8000.0,
    north=Channel(rate=300.0),
    east=Channel(rate=200.0, sines=sines((500, 60, 0))),
    up=Channel(rate=-20.0),
    heading=Channel(offset=200, rate=30.0),
    pitch=Channel(sines=sines((80, 20, 0))),
    roll=Channel(rate=-40.0),
)
FAST_CONE = MotionConfig(rest_s=0.5, ramp_s=1.5, cone=Cone(half_angle_deg=10.0, frequency_hz=10.0))


def inertial(truth):
    """Position in i (m), matrices n to i and b to i, from positions and quaternions alone."""
    position = np.column_stack(pymap3d.geodetic2ecef(truth["lat"], truth["lon"], truth["height"], deg=False))
    (s, c), (sl, cl) = ((np.sin(x), np.cos(x)) for x in (truth["lat"], truth["lon"]))
    north, east = np.stack([-s * cl, -s * sl, c], -1), np.stack([-sl, cl, 0 * c], -1)
    n_to_e = Rotation.from_matrix(np.stack([north, east, np.cross(north, east)], -1))
    turn = Rotation.from_rotvec(np.outer(truth["time"], [0, 0, earth.RATE]))
    n_to_i = turn * n_to_e
    return turn.apply(position), n_to_i, n_to_i * Rotation.from_quat(truth["q_nb"], scalar_first=True)


def observed(motion, time, arm=(0.0, 0.0, 0.0), h_position=0.4, h_attitude=0.02):
    """Velocity, body rate and specific force at one time by differencing positions and attitudes in i."""
    centre = motion.truth(time)
    place, n_to_i, b_to_i = inertial(centre)
    offsets = np.arange(-4, 5)
    earth_rate = np.array([0.0, 0.0, earth.RATE])

    path, _, attitudes = inertial(motion.truth(time + h_position * offsets))
    displaced = path - place + attitudes.apply(arm)
    velocity_i = SLOPE @ (path - place) / h_position - np.cross(earth_rate, place[0])
    gravity_n = [0.0, 0.0, earth.normal_gravity(math.sin(centre["lat"][0]), centre["height"][0])]
    # Gravity is gravitation plus the centrifugal acceleration of the Earth's rotation
    gravitation = n_to_i.apply(gravity_n)[0] + np.cross(earth_rate, np.cross(earth_rate, place[0]))
    force = b_to_i.inv().apply(CURVE @ displaced / h_position**2 - gravitation)[0]

    _, _, attitudes = inertial(motion.truth(time + h_attitude * offsets))
    rotation = (b_to_i.inv() * attitudes).as_matrix()
    skew = np.tensordot(SLOPE, rotation, 1) / h_attitude
    return n_to_i.inv().apply(velocity_i)[0], np.array([skew[2, 1], skew[0, 2], skew[1, 0]]), force


def reference(motion, first, step, marks=(), arm=(0.0, 0.0, 0.0)):
    """Increments of one step by a much finer rule over the truth, split at `marks`."""
    nodes, weights = np.polynomial.legendre.leggauss(16)
    start, stop = first * step, (first + 1) * step
    inside = [mark - start for mark in marks if start < mark < stop]
    edges = np.unique([*np.linspace(0.0, step, 5), *inside])  # from the start: a late time is too coarse to subtract
    half = np.diff(edges)[:, None] / 2
    times = start + (edges[:-1, None] + half * (nodes + 1)).ravel()
    weights = (half * weights).ravel()
    truth = motion.truth(times)
    w = truth["w_ib_b"]
    force = truth["f_b"] + np.cross(w, np.cross(w, arm))
    ends = motion.truth([start, stop])["w_ib_b"]
    return weights @ w, weights @ force + np.cross(ends[1] - ends[0], arm)


def increments(motion, first, count, step):
    dtheta, dvel = np.empty((count, 3)), np.empty((count, 3))
    motion.increments(first, count, step, dtheta, dvel)
    return dtheta, dvel


@pytest.mark.parametrize("config", [EVERYTHING, TUMBLING], ids=["everything", "tumbling"])
@pytest.mark.parametrize("time", [5.0, 14.0, 20.0, 27.3, 41.0, 123.4])
def test_rate_and_force_are_those_of_the_inertial_path(config, time):
    motion = Motion(config)
    truth = motion.truth(time)[0]
    velocity, rate, force = observed(motion, time, h_position=0.2)
    assert truth["vel_n"] == pytest.approx(velocity, abs=1e-7)
    assert truth["w_ib_b"] == pytest.approx(rate, abs=1e-11)
    assert truth["f_b"] == pytest.approx(force, abs=1e-6)


def test_lever_arm_feels_the_path_of_its_own_point():
    motion, step = Motion(EVERYTHING, ARM), 0.05
    nodes, weights = np.polynomial.legendre.leggauss(4)
    for first in (360, 900, 2000):
        _, dvel = increments(motion, first, 1, step)
        forces = [observed(motion, (first + 0.5 + 0.5 * x) * step, ARM, h_position=0.1)[2] for x in nodes]
        assert dvel[0] / step == pytest.approx(0.5 * weights @ forces, abs=2e-6)


def test_rest_feels_gravity_and_the_earth():
    motion = Motion(MotionConfig(latitude_deg=30.0, height_m=0.0))
    truth = motion.truth([0.0, 1000.0])
    gravity = 9.780327 * (1 + 0.0053024 * 0.25 - 5.8e-6 * 0.75)  # the 1980 formula, at 30 degrees
    day = 86164.0989  # sidereal, s
    assert truth["f_b"] == pytest.approx(np.tile([0, 0, -gravity], (2, 1)), abs=5e-6)
    rate = 2 * math.pi / day
    assert truth["w_ib_b"][1] == pytest.approx([rate * math.cos(math.pi / 6), 0, -rate / 2], abs=1e-11)
    assert not truth["vel_n"].any()
    dtheta, dvel = increments(motion, 10**6, 3, 1e-3)
    assert dtheta == pytest.approx(np.tile(truth["w_ib_b"][0] * 1e-3, (3, 1)), rel=1e-14)
    assert dvel == pytest.approx(np.tile(truth["f_b"][0] * 1e-3, (3, 1)), rel=1e-14)


def test_euler_angles_at_rest():
    scenario = load("rest")
    q = Motion(scenario.motion).truth(0.0)["q_nb"]
    angles = Rotation.from_quat(q, scalar_first=True).as_euler("ZYX", degrees=True)
    assert angles[0] == pytest.approx([37, 5, 3], abs=1e-12)


def test_the_motion_waits_and_then_runs_with_the_clock():
    truth = Motion(EVERYTHING).truth(np.array([0.0, 10.0, 30.0, 31.0, 40.0]))
    assert not truth["vel_n"][:2].any()
    assert truth["lat"][0] == truth["lat"][1]
    free = MotionConfig(**EVERYTHING.model_dump() | {"rest_s": 0.0, "ramp_s": 0.0})
    unramped = Motion(free).truth(np.array([10.0, 11.0, 20.0]))  # half of the ramp is lost
    for name in ("lat", "lon", "height", "vel_n", "q_nb", "w_ib_b", "f_b"):
        assert truth[name][2:] == pytest.approx(unramped[name], abs=1e-12, rel=1e-12), name


def test_a_coordinated_circle_banks_and_does_not_slip():
    speed, radius = 70.0, 900.0
    period = 2 * math.pi * radius / speed
    circle = MotionConfig(
        attitude="coordinated",
        north=Channel(sines=sines((radius, period, 0))),
        east=Channel(offset=radius, sines=sines((radius, period, -90))),
    )
    motion = Motion(circle)
    truth = motion.truth(np.linspace(0, period, 9))
    angles = Rotation.from_quat(truth["q_nb"], scalar_first=True).as_euler("ZYX", degrees=True)
    track = np.degrees(np.arctan2(truth["vel_n"][:, 1], truth["vel_n"][:, 0]))
    assert (angles[:, 0] - track + 180) % 360 - 180 == pytest.approx(0, abs=0.05)
    bank = math.degrees(math.atan(speed**2 / radius / 9.8110))
    assert angles[:, 2] == pytest.approx(bank, abs=0.01)  # right wing down in a right turn
    assert np.abs(truth["f_b"][:, 1]).max() < 0.02
    assert truth["f_b"][:, 2] == pytest.approx(-9.811 / math.cos(math.radians(bank)), abs=0.02)


def test_increments_of_a_roll_sum_to_the_roll():
    motion = Motion(load("harmonic_roll").motion)
    dtheta, _ = increments(motion, 0, 7000, 1e-3)
    north = earth.RATE * math.cos(math.radians(50))
    assert dtheta[:, 0].sum() == pytest.approx(math.radians(10) * math.sin(7.0) + 7.0 * north, abs=1e-13)


@pytest.mark.parametrize("arm", [(0.0, 0.0, 0.0), ARM])
@pytest.mark.parametrize(
    ("config", "step"),
    # Steps of whole powers of two: the reference takes plain times, which must not be rounded
    [
        (EVERYTHING, 2**-10),
        (EVERYTHING, 2**-3),
        (TUMBLING, 2**-7),
        (FAST_CONE, 2**-10),
        (FAST_CONE, 2**-7),
        (FAST_CONE, 2**-2),
    ],
)
def test_quadrature_is_exact_to_1e12(config, step, arm):
    motion = Motion(config, arm)
    marks = (config.rest_s, config.rest_s + config.ramp_s)
    late = marks[1] + np.array([0.7, 3.1, 20.0])
    times = [0.0, *marks, *(marks[0] + x * config.ramp_s for x in (0.2, 0.5, 0.8)), *late]
    steps = sorted({max(0, round(t / step) + k) for t in times for k in (-1, 0)})
    rates, forces, errors = [], [], []
    for k in steps:
        (dtheta,), (dvel,) = increments(motion, k, 1, step)
        angle, velocity = reference(motion, k, step, marks, arm)
        rates.append(np.linalg.norm(angle))
        forces.append(np.linalg.norm(velocity))
        errors.append((np.abs(dtheta - angle).max(), np.abs(dvel - velocity).max()))
    worst = np.max(errors, axis=0)
    assert worst[0] <= 1e-12 * max(rates)
    assert worst[1] <= 1e-12 * max(forces)


@pytest.mark.parametrize("offset", [0.0, 0.37e-3, 0.5e-3])
def test_a_step_across_the_end_of_a_steep_ramp_is_exact(offset):
    config = MotionConfig(rest_s=0.01 + offset, ramp_s=0.03, north=Channel(rate=1.0), roll=Channel(rate=50.0))
    motion = Motion(config)
    marks = (config.rest_s, config.rest_s + config.ramp_s)
    dtheta, dvel = increments(motion, 0, 50, 1e-3)
    expected = [reference(motion, k, 1e-3, marks) for k in range(50)]
    assert dtheta == pytest.approx(np.array([e[0] for e in expected]), abs=1e-12 * np.abs(dtheta).max())
    assert dvel == pytest.approx(np.array([e[1] for e in expected]), abs=1e-12 * np.abs(dvel).max())


@pytest.mark.parametrize("wait", [{}, {"rest_s": 0.3, "ramp_s": 0.7}], ids=["at once", "after a ramp"])
def test_a_late_step_is_as_exact_as_an_early_one(wait):
    motion = Motion(MotionConfig(cone=Cone(half_angle_deg=5.0, frequency_hz=10.0), **wait), ARM)
    step = (1.0 / 10.0) / 128
    early, late = increments(motion, 128 * 20, 128, step), increments(motion, 128 * 100_000, 128, step)
    assert late[0] == pytest.approx(early[0], abs=1e-13 * step)
    assert late[1] == pytest.approx(early[1], abs=1e-12 * step)


@settings(max_examples=30, deadline=None)
@given(cuts=st.lists(st.integers(1, 399), max_size=6), arm=st.booleans(), start=st.sampled_from([0, 950, 2950, 10**8]))
def test_splitting_changes_no_bit(cuts, arm, start):
    motion, step = Motion(EVERYTHING, ARM if arm else (0.0, 0.0, 0.0)), 0.01
    whole = increments(motion, start, 400, step)
    edges = sorted({0, 400, *cuts})
    parts = [increments(motion, start + a, b - a, step) for a, b in pairwise(edges)]
    for k in range(2):
        assert np.array_equal(whole[k], np.concatenate([part[k] for part in parts]))


def channels(amplitude, fastest_s):
    sine = st.builds(
        Sine,
        amplitude=st.floats(-amplitude, amplitude),
        period_s=st.floats(fastest_s, 200.0),
        phase_deg=st.floats(-180.0, 180.0),
    )
    return st.builds(
        Channel,
        offset=st.floats(-amplitude, amplitude),
        rate=st.floats(-1.0, 1.0),
        sines=st.lists(sine, max_size=2).map(tuple),
    )


@settings(max_examples=40, deadline=None)
@given(
    path=st.tuples(*[channels(300.0, 20.0)] * 3),
    angles=st.tuples(*[channels(30.0, 5.0)] * 3),
    latitude=st.floats(-85.0, 85.0),
    coordinated=st.booleans(),
    time=st.floats(5.0, 60.0),
)
def test_any_motion_obeys_the_inertial_path(path, angles, latitude, coordinated, time):
    north = path[0].model_copy(update={"rate": 250.0})  # faster than its sinusoids together
    config = MotionConfig(
        latitude_deg=latitude,
        attitude="coordinated" if coordinated else "free",
        **dict(zip(("north", "east", "up", "heading", "pitch", "roll"), (north, *path[1:], *angles), strict=True)),
    )
    motion = Motion(config)
    truth = motion.truth(time)[0]
    velocity, rate, force = observed(motion, time)
    assert truth["vel_n"] == pytest.approx(velocity, abs=1e-6)
    assert truth["w_ib_b"] == pytest.approx(rate, abs=1e-10)
    assert truth["f_b"] == pytest.approx(force, abs=1e-6)
    k = int(time / 0.01)
    (dtheta,), (dvel,) = increments(motion, k, 1, 0.01)
    angle, change = reference(motion, k, 0.01)
    assert dtheta == pytest.approx(angle, abs=1e-12 * np.linalg.norm(angle) + 1e-17)
    assert dvel == pytest.approx(change, abs=1e-12 * np.linalg.norm(change))


@pytest.mark.parametrize("name", built_in_names())
def test_built_in_scenarios_fly_plausibly(name):
    scenario = load(name)
    assert scenario.name == name
    assert scenario.description
    motion = Motion(scenario.motion, scenario.head.lever_arm_m)
    truth = motion.truth(np.arange(0.0, scenario.duration_s or 900.0, 0.5))
    assert truth.dtype == TRUTH
    load_factor = np.linalg.norm(truth["f_b"], axis=1) / 9.81
    assert 0.9 < load_factor.min() <= load_factor.max() < 1.6
    assert np.abs(truth["height"] - 5000).max() < 5500
    if scenario.motion.attitude == "coordinated":
        assert scenario.navigation.alignment == "moving" or scenario.navigation.align_s < scenario.motion.rest_s
        bank = Rotation.from_quat(truth["q_nb"], scalar_first=True).as_euler("ZYX", degrees=True)[:, 2]
        expected = {"aided": 45, "default": 20, "turns": 45, "flight": 30, "failing_head": 42, "airstart": 30}[name]
        assert [bank.min(), bank.max()] == pytest.approx([-expected, expected], abs=1.0)
        assert np.abs(truth["f_b"][:, 1]).max() < 0.4  # coordinated: hardly any side force


@pytest.mark.parametrize(
    "path",
    [
        {"north": Channel(sines=sines((100, 60, 7)))},
        {"north": Channel(rate=-1.0, sines=sines((10, 20 * math.pi, 11)))},
        {"north": Channel(offset=5.0)},
        {"north": Channel(rate=0.01), "up": Channel(rate=30.0)},
    ],
    ids=["oscillating", "stopping", "standing", "vertical"],
)
def test_a_path_without_heading_is_refused(path):
    with pytest.raises(HilError, match="stands still or is vertical"):
        Motion(MotionConfig(attitude="coordinated", **path))


def test_a_pole_is_refused():
    with pytest.raises(HilError, match="pole"):
        Motion(MotionConfig(latitude_deg=-90.0))
    polar = Motion(MotionConfig(latitude_deg=89.9, north=Channel(rate=250.0)))
    assert np.isfinite(polar.truth(40.0)["f_b"]).all()
    with pytest.raises(HilError, match=r"at 50\.000 s"):
        polar.truth([1.0, 50.0])


def test_wrong_calls_are_refused():
    motion = Motion(FAST_CONE)
    with pytest.raises(ValueError, match="3"):
        motion.increments(0, 4, 1e-3, np.empty((4, 3)), np.empty((3, 3)))
    with pytest.raises(HilError, match="sample faster"):
        increments(motion, 0, 1, 100.0)
