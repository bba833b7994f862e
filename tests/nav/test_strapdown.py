"""Every mechanization against the same analytic flights, against each other, and where they differ: poles and azimuth."""

import copy
import gc
import math
import pickle
import weakref
from itertools import pairwise

import numpy as np
import pymap3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hil.scenario import MotionConfig, load
from hil.world.motion import Motion
from hil.world.pole import PoleFlight
from nav import step as kernels
from nav.earth import GM, J2, RATE, A, curvature_radii, normal_gravity
from nav.errors import HilError
from nav.gravitation import J2_FIELD, NORMAL, gravitation_cartesian, gravitation_local, near_latitude
from nav.increments import ImuIncrements
from nav.mechanization.geographic import MAX_LAT
from nav.navigator import Navigator, Settings
from nav.rotation import attitude_error
from nav.step import DONE, NOT_FINITE, POLE
from nav.strapdown import MECHANIZATIONS, Strapdown

EXACT = ("geographic", "wander", "earth", "inertial")
FLIGHT = load("flight").motion.model_copy(update={"rest_s": 0.0, "ramp_s": 0.0})
AGILE = MotionConfig.model_validate(
    FLIGHT.model_dump()
    | {
        "roll": {
            "sines": [{"amplitude": 30, "period_s": 35}, {"amplitude": 2, "period_s": 1.0, "phase_deg": 20}],
        },
        "pitch": {"sines": [{"amplitude": 1, "period_s": 1.3, "phase_deg": 50}]},
        "heading": {"sines": [{"amplitude": 1.5, "period_s": 2.0, "phase_deg": 110}]},
    }
)
"""The flight with banking to and fro and with vibration of 0.5 to 1 Hz."""
MOTIONS = {"flight": Motion(FLIGHT), "agile": Motion(AGILE)}
ATTITUDES = ("two-sample", "high-order:4", "high-order:6", "picard3", "four-sample", "coning:3", "high-order-stream:5")


def increments(motion, duration, step, start=0.0):
    n = round(duration / step)
    dtheta, dvel = np.empty((n, 3)), np.empty((n, 3))
    motion.increments(round(start / step), n, step, dtheta, dvel)
    return np.full(n, step), dtheta, dvel


def begin(core, row, turn=0.0):
    core.start(row["lat"], row["lon"] + turn, row["height"], row["vel_n"], row["q_nb"])


def advance(core, step, dtheta, dvel):
    n = len(step)
    out = np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.full((n, 4), np.nan)
    done = core.advance(step, np.ascontiguousarray(dtheta), np.ascontiguousarray(dvel), np.zeros(3), *out)
    return done, *out


def fly(motion, core, duration, step):
    """Positions (n, 3), velocities, attitudes at the ends of the steps."""
    begin(core, motion.truth([0.0])[0])
    done, *out = advance(core, *increments(motion, duration, step))
    assert done == len(out[0])
    return out


def cartesian(position):
    return np.stack(pymap3d.geodetic2ecef(*np.asarray(position).T, deg=False), axis=-1)


def way_off(motion, position, step):
    """Distances from the truth, m."""
    truth = motion.truth(step * np.arange(1, len(position) + 1))
    right = cartesian(np.stack([truth["lat"], truth["lon"], truth["height"]], axis=1))
    return np.linalg.norm(cartesian(position) - right, axis=1)


# Flights


@pytest.mark.parametrize("mechanization", EXACT)
@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize(
    ("attitude", "limit"),
    [("two-sample", {"flight": 1e-6, "agile": 2e-3}), ("high-order:4", dict.fromkeys(MOTIONS, 5e-7))],
)
def test_flights_in_every_mechanization(mechanization, name, attitude, limit):
    """250 s at 100 Hz. Required: 1e-2 m with two samples, 1e-5 m with four."""
    motion = MOTIONS[name]
    position, velocity, q_nb = fly(motion, Strapdown(attitude, mechanization, whole_record=True), 250.0, 0.01)
    truth = motion.truth(0.01 * np.arange(1, 25_001))
    assert way_off(motion, position, 0.01).max() < limit[name]
    assert np.abs(velocity - truth["vel_n"]).max() < limit[name] / 10.0
    assert np.abs(attitude_error(q_nb[-1], truth["q_nb"][-1])).max() < limit[name] / 100.0


@pytest.mark.parametrize("name", MOTIONS)
def test_mechanizations_agree(name):
    solutions = [fly(MOTIONS[name], Strapdown("high-order:6", m, whole_record=True), 250.0, 0.01) for m in EXACT]
    places = [cartesian(position) for position, *_ in solutions]
    for place, (_, velocity, q_nb) in zip(places, solutions, strict=True):
        assert np.abs(place - places[0]).max() < 1e-7
        assert np.abs(velocity - solutions[0][1]).max() < 1e-9
        assert np.abs(attitude_error(q_nb[-1], solutions[0][2][-1])).max() < 1e-13


@pytest.mark.parametrize("attitude", ATTITUDES)
def test_attitude_methods_in_flight(attitude):
    """From second order on every method keeps the flight: its attitude alone differs."""
    position, *_ = fly(MOTIONS["flight"], Strapdown(attitude), 100.0, 0.01)
    assert way_off(MOTIONS["flight"], position, 0.01).max() < 1e-6


@pytest.mark.parametrize("mechanization", EXACT)
@pytest.mark.parametrize(("attitude", "limit"), [("two-sample", 1e-4), ("high-order:4", 1e-6), ("high-order:6", 1e-6)])
def test_samples_as_they_come_from_rest(mechanization, attitude, limit):
    """Without samples to come the polynomial is as good, once it has its samples: here it gets them at rest."""
    motion = Motion(AGILE.model_copy(update={"rest_s": 2.0, "ramp_s": 10.0}))
    position, *_ = fly(motion, Strapdown(attitude, mechanization), 100.0, 0.01)
    assert way_off(motion, position, 0.01).max() < limit


@pytest.mark.parametrize("mechanization", EXACT)
@pytest.mark.parametrize(("attitude", "order"), [("two-sample", 2.8), ("high-order:4", 5.5)])
def test_order_in_the_step(mechanization, attitude, order):
    motion = MOTIONS["agile"]
    errors = [
        way_off(motion, fly(motion, Strapdown(attitude, mechanization, whole_record=True), 96.0, step)[0], step).max()
        for step in (0.02, 0.04, 0.08)
    ]
    assert (np.log2(np.divide(errors[1:], errors[:-1])) > order).all(), errors


def test_the_source_is_of_first_order():
    motion, steps = MOTIONS["flight"], (0.001, 0.002, 0.005, 0.01)
    errors = [
        way_off(motion, fly(motion, Strapdown(mechanization="inertial-source"), 50.0, step)[0], step).max()
        for step in steps
    ]
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("mechanization", EXACT)
def test_steps_of_a_second(mechanization):
    motion = MOTIONS["flight"]
    for attitude, limit in (("two-sample", 0.3), ("high-order:4", 5e-3)):
        position, *_ = fly(motion, Strapdown(attitude, mechanization, whole_record=True), 200.0, 1.0)
        assert way_off(motion, position, 1.0).max() < limit


@settings(max_examples=6)
@given(
    st.integers(0, 2**32 - 1), st.sampled_from(EXACT), st.sampled_from(["two-sample", "high-order:4"]), st.booleans()
)
def test_unequal_steps(seed, mechanization, attitude, whole):
    """Steps of 5, 10 and 15 ms in any order are at worst about as wrong as steps of 15 ms."""
    motion = MOTIONS["flight"]
    step, dtheta, dvel = increments(motion, 60.0, 0.005)
    edges = np.concatenate([[0], np.cumsum(np.random.default_rng(seed).integers(1, 4, len(step)))])
    edges = np.unique(np.append(edges[edges < len(step)], len(step)))
    core = Strapdown(attitude, mechanization, whole_record=whole)
    begin(core, motion.truth([0.0])[0])
    joined = (np.add.reduceat(x, edges[:-1]) for x in (step, dtheta, dvel))
    done, position, *_ = advance(core, *joined)
    assert done == len(edges) - 1
    jittered = way_off(motion, position[-1:], 60.0)[0]
    regular = fly(motion, Strapdown(attitude, mechanization, whole_record=whole), 60.0, 0.015)[0]
    assert jittered < 2.0 * way_off(motion, regular, 0.015)[-1] + 1e-7


@settings(max_examples=25)
@given(
    st.sampled_from(MECHANIZATIONS),
    st.sampled_from(ATTITUDES),
    st.sampled_from(["normal", "j2"]),
    st.lists(st.integers(0, 60), max_size=8),
    st.integers(0, 2**32 - 1),
)
def test_how_a_stream_is_split_does_not_matter(mechanization, attitude, gravity, cuts, seed):
    """Same bits, with steps of zero among them and more samples than the core had room for."""
    attitude = "two-sample" if mechanization == "inertial-source" else attitude
    step, dtheta, dvel = increments(MOTIONS["agile"], 3.0, 0.01)
    nothing = np.random.default_rng(seed).integers(0, 300, 10)
    step[nothing], dtheta[nothing], dvel[nothing] = 0.0, 0.0, 0.0
    whole, split = (Strapdown(attitude, mechanization, gravity) for _ in range(2))
    for core in whole, split:
        begin(core, MOTIONS["agile"].truth([0.0])[0])
    _, *expected = advance(whole, step, dtheta, dvel)
    edges = np.concatenate([[0], np.cumsum(cuts), [300]]).clip(max=300).astype(int)
    parts = [advance(split, step[i:j], dtheta[i:j], dvel[i:j]) for i, j in pairwise(edges)]
    for k in range(3):
        np.testing.assert_array_equal(np.concatenate([part[k + 1] for part in parts]), expected[k])
    np.testing.assert_array_equal(whole.solution, split.solution)
    assert whole.azimuth == split.azimuth


@pytest.mark.parametrize("mechanization", MECHANIZATIONS)
@pytest.mark.parametrize("attitude", ["two-sample", "high-order:4", "high-order:8", "coning:3"])
def test_one_sample_a_call_is_the_batch(mechanization, attitude):
    """Same bits, started in motion and with steps of zero; what is not a number changes nothing."""
    attitude = "two-sample" if mechanization == "inertial-source" else attitude
    step, dtheta, dvel = increments(MOTIONS["agile"], 1.0, 0.01)
    step[[0, 5, 50]], dtheta[[0, 5, 50]], dvel[[0, 5, 50]] = 0.0, 0.0, 0.0
    batch, single = Strapdown(attitude, mechanization), Strapdown(attitude, mechanization)
    for core in batch, single:
        begin(core, MOTIONS["agile"].truth([0.0])[0])
    _, *out = advance(batch, step, dtheta, dvel)
    for k, row in enumerate(np.column_stack([step, dtheta, dvel]).tolist()):
        assert single.push(*row) == DONE
        np.testing.assert_array_equal(single.solution, np.concatenate([part[k] for part in out]))
        for bad in math.nan, math.inf:
            row[k % 7] = bad
            assert single.push(*row) == NOT_FINITE
    assert single.azimuth == batch.azimuth


@pytest.mark.parametrize("mechanization", EXACT)
@pytest.mark.parametrize(("attitude", "limit"), [("high-order:4", 2e-6), ("high-order:8", 2e-8)])
def test_a_stream_that_starts_in_motion(mechanization, attitude, limit):
    """The first samples, taken with what there was, are taken again when the polynomial has all it needs."""
    core, motion = Strapdown(attitude, mechanization), MOTIONS["agile"]
    position, _, q_nb = fly(motion, core, 20.0, 0.01)
    assert way_off(motion, position, 0.01)[-1] < limit
    assert np.abs(attitude_error(q_nb[-1], motion.truth([20.0])[0]["q_nb"])).max() < limit / 100.0


@pytest.mark.parametrize("old", EXACT)
@pytest.mark.parametrize("new", EXACT)
def test_hand_over_in_flight(old, new):
    """From any mechanization to any other, and nobody can tell afterwards."""
    motion = MOTIONS["agile"]
    step, dtheta, dvel = increments(motion, 40.0, 0.01)
    stay, change = Strapdown("high-order:4", old), Strapdown("high-order:4", old)
    ends = []
    for core in stay, change:
        begin(core, motion.truth([0.0])[0])
        advance(core, step[:2000], dtheta[:2000], dvel[:2000])
        if core is change:
            core.hand_over(new)
        ends.append([part[-1] for part in advance(core, step[2000:], dtheta[2000:], dvel[2000:])[1:]])
    assert change.mechanization == new
    assert np.abs(cartesian(ends[0][0]) - cartesian(ends[1][0])).max() < 1e-7
    assert np.abs(ends[0][1] - ends[1][1]).max() < 1e-8
    assert np.abs(attitude_error(ends[0][2], ends[1][2])).max() < 1e-12
    with pytest.raises(HilError, match="no hand-over from"):
        stay.hand_over("inertial-source")


def test_what_is_not_a_number_is_refused_by_the_core_itself():
    step, dtheta, dvel = increments(MOTIONS["flight"], 1.0, 0.01)
    dvel[37, 1] = math.nan
    core = Strapdown()
    begin(core, MOTIONS["flight"].truth([0.0])[0])
    with pytest.raises(HilError, match="increment 37 of the batch is not a number"):
        advance(core, step, dtheta, dvel)


@pytest.mark.parametrize("mechanization", MECHANIZATIONS)
@pytest.mark.parametrize("attitude", ["two-sample", "high-order:4", "coning:3"])
@pytest.mark.parametrize("whole", [False, True])
def test_steps_of_zero_change_nothing(mechanization, attitude, whole):
    attitude = "two-sample" if mechanization == "inertial-source" else attitude
    step, dtheta, dvel = increments(MOTIONS["agile"], 2.0, 0.01)
    plain, padded, idle = (Strapdown(attitude, mechanization, whole_record=whole) for _ in range(3))
    for core in plain, padded, idle:
        begin(core, MOTIONS["agile"].truth([0.0])[0])
    _, *expected = advance(plain, step, dtheta, dvel)
    longer = np.stack([np.zeros(200), step], axis=1).ravel()
    _, *got = advance(padded, longer, dtheta.repeat(2, 0), dvel.repeat(2, 0))
    for one, other in zip(expected, got, strict=True):
        np.testing.assert_array_equal(one, other[1::2])
    before = idle.solution.copy()
    advance(idle, np.zeros(5), dtheta[:5], dvel[:5])
    height = 2  # comes from Earth-centred coordinates: their rounding
    assert idle.solution[height] == pytest.approx(before[height], abs=4e-9)
    np.testing.assert_allclose(np.delete(idle.solution, height), np.delete(before, height), rtol=1e-14, atol=1e-12)


# Symmetries


@pytest.mark.parametrize("mechanization", MECHANIZATIONS)
@pytest.mark.parametrize("turn", [-3.0, 1.0, 2.2])
def test_longitude_is_a_symmetry(mechanization, turn):
    row = MOTIONS["agile"].truth([0.0])[0]
    one, other = Strapdown(mechanization=mechanization), Strapdown(mechanization=mechanization)
    begin(one, row)
    begin(other, row, turn)
    data = increments(MOTIONS["agile"], 10.0, 0.01)
    _, one_place, one_velocity, one_q = advance(one, *data)
    _, place, velocity, q_nb = advance(other, *data)
    assert (np.abs(place[:, 1]) <= math.pi).all()
    assert np.abs(np.sin(place[:, 1] - one_place[:, 1] - turn)).max() < 1e-14
    assert np.abs(place[:, [0, 2]] - one_place[:, [0, 2]]).max() < 1e-8
    assert np.abs(velocity - one_velocity).max() < 1e-10
    assert np.abs(attitude_error(q_nb[-1], one_q[-1])).max() < 1e-13


@pytest.mark.parametrize("mechanization", EXACT)
@pytest.mark.parametrize("gravity", ["normal", "j2"])
def test_time_runs_backwards(mechanization, gravity):
    """Flown back from the end with the inertial velocity turned round: the start again, twice the Earth's turn westward."""
    row = MOTIONS["agile"].truth([0.0])[0]
    core = Strapdown("high-order:4", mechanization, gravity, whole_record=True)
    begin(core, row)
    step, dtheta, dvel = increments(MOTIONS["agile"], 60.0, 0.01)
    advance(core, step, dtheta, dvel)
    lat, lon, height, vel_n, q_nb = *core.solution[:3], core.solution[3:6].copy(), core.solution[6:].copy()
    core.start(lat, lon, height, turned_round(vel_n, lat, height), q_nb)
    advance(core, step, -dtheta[::-1], dvel[::-1])
    lat, lon, height = core.solution[:3]
    assert math.remainder(lon + 2.0 * RATE * 60.0 - row["lon"], 2.0 * math.pi) == pytest.approx(0.0, abs=3e-15)
    assert lat == pytest.approx(row["lat"], abs=3e-15)
    assert height == pytest.approx(row["height"], abs=2e-8)
    assert np.abs(turned_round(core.solution[3:6], lat, height) - row["vel_n"]).max() < 1e-9
    assert np.abs(attitude_error(core.solution[6:], row["q_nb"])).max() < 1e-13


def turned_round(vel_n, lat, height):
    _, prime = curvature_radii(math.sin(lat))
    return -vel_n - [0.0, 2.0 * RATE * (prime + height) * math.cos(lat), 0.0]


# Rest

REST = math.radians(60.0), 0.6, 120.0
REST_ATTITUDE = Rotation.from_euler("ZYX", [37, 5, 3], degrees=True)


def rest_increments(n, step):
    lat, _, height = REST
    rate = REST_ATTITUDE.inv().apply([RATE * math.cos(lat), 0.0, -RATE * math.sin(lat)])
    force = REST_ATTITUDE.inv().apply([0.0, 0.0, -normal_gravity(math.sin(lat), height)])
    return np.full(n, step), np.tile(rate * step, (n, 1)), np.tile(force * step, (n, 1))


def moved(position):
    """Horizontal way from the place of rest, m."""
    lat, lon, height = REST
    meridian, prime = curvature_radii(math.sin(lat))
    position = np.atleast_2d(position)
    east = np.sin(position[:, 1] - lon) * (prime + height) * math.cos(lat)
    return np.hypot((position[:, 0] - lat) * (meridian + height), east)


@pytest.mark.parametrize("mechanization", EXACT)
@pytest.mark.parametrize("attitude", ["two-sample", "high-order:4"])
def test_an_hour_at_rest(mechanization, attitude):
    core = Strapdown(attitude, mechanization)
    core.start(*REST, np.zeros(3), REST_ATTITUDE.as_quat(scalar_first=True))
    done, position, velocity, q_nb = advance(core, *rest_increments(72_000, 0.05))
    assert done == 72_000
    assert moved(position).max() < 1e-4
    # The vertical channel grows 45 000-fold in an hour: exp(t sqrt(2 g / R)) / 2
    assert np.abs(position[:, 2] - REST[2]).max() < 0.05
    assert np.abs(velocity[:, :2]).max() < 1e-7
    assert np.abs(attitude_error(q_nb[-1], REST_ATTITUDE.as_quat(scalar_first=True))).max() < 3e-12


@pytest.mark.slow
@pytest.mark.parametrize("mechanization", EXACT)
def test_a_day_at_rest_with_the_height_held(mechanization):
    core = Strapdown(mechanization=mechanization)
    core.start(*REST, np.zeros(3), REST_ATTITUDE.as_quat(scalar_first=True))
    data, worst = rest_increments(10, 0.1), 0.0
    for _ in range(86_400):
        advance(core, *data)
        lat, lon, _, north, east, _, *q_nb = core.solution
        worst = max(worst, float(moved(core.solution[:3])[0]))
        core.start(lat, lon, REST[2], np.array([north, east, 0.0]), np.array(q_nb))
    assert worst < 1e-4
    assert np.abs(attitude_error(core.solution[6:], REST_ATTITUDE.as_quat(scalar_first=True))).max() < 1e-10


# The pole

POLE_STEP, POLE_STEPS = 0.01, 6000


def over_the_pole(core, *, south=False):
    """A minute over the pole, reached at the end of a step; what `advance` answers, and the truth."""
    motion = PoleFlight(crossing_s=0.5 * POLE_STEP * POLE_STEPS, south=south)
    begin(core, motion.truth([0.0])[0])
    answer = advance(core, *increments(motion, POLE_STEP * POLE_STEPS, POLE_STEP))
    return *answer, motion.truth(POLE_STEP * np.arange(1, POLE_STEPS + 1))


@pytest.mark.parametrize("south", [False, True])
@pytest.mark.parametrize("mechanization", EXACT)
@pytest.mark.parametrize("attitude", ["two-sample", "high-order:4"])
def test_over_the_pole(mechanization, attitude, south):
    core = Strapdown(attitude, mechanization, whole_record=True)
    done, position, velocity, q_nb, truth = over_the_pole(core, south=south)
    assert (done < POLE_STEPS) == (mechanization == "geographic")
    assert np.isfinite(position).all()
    assert np.isfinite(velocity).all()
    assert np.isfinite(q_nb).all()
    right = cartesian(np.stack([truth["lat"], truth["lon"], truth["height"]], axis=1))
    limit = 3e-5 if attitude == "two-sample" else 2e-8
    assert np.linalg.norm(cartesian(position) - right, axis=1).max() < limit
    # Beyond the pole the same course is the other way; close by, north turns too fast to be compared.
    far = np.cos(truth["lat"]) > 1e-5
    assert np.abs(velocity - truth["vel_n"])[far][:, [0, 2]].max() < limit / 10.0
    assert np.abs(velocity[far, 1]).max() < max(limit, 1e-6)
    assert np.abs(attitude_error(q_nb[-1], truth["q_nb"][-1])).max() < max(limit / 100.0, 1e-8)


def test_the_flight_over_the_pole_is_newtons():
    """Specific force: second derivative of the place in inertial axes less gravitation; rate: that of the attitude."""
    motion, h = PoleFlight(crossing_s=50.0), 1e-2
    for time in (3.0, 49.0, 52.0, 90.0):
        rows = motion.truth(time + h * np.arange(-2, 3))
        turn = Rotation.from_rotvec([[0.0, 0.0, RATE * t] for t in rows["time"]])
        place = turn.apply(cartesian(np.stack([rows["lat"], rows["lon"], rows["height"]], axis=1)))
        level = Rotation.from_euler("ZY", np.stack([rows["lon"], -rows["lat"] - 0.5 * math.pi], axis=1))
        c_ib = turn * level * Rotation.from_quat(rows["q_nb"], scalar_first=True)
        acceleration = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) @ place / (12.0 * h * h)
        s, c = math.sin(rows["lat"][2]), math.cos(rows["lat"][2])
        g = gravitation_cartesian(NORMAL, *place[2], s, c)
        np.testing.assert_allclose(c_ib[2].inv().apply(acceleration - g), rows["f_b"][2], atol=2e-4)
        rate = (c_ib[1].inv() * c_ib[3]).as_rotvec() / (2.0 * h)
        np.testing.assert_allclose(rate, rows["w_ib_b"][2], atol=1e-4)


def test_geographic_hands_over_before_the_pole():
    """In a batch, one by one, and in the navigator: the same flight, and it is said."""
    motion = PoleFlight(crossing_s=0.5 * POLE_STEP * POLE_STEPS)
    step, dtheta, dvel = increments(motion, POLE_STEP * POLE_STEPS, POLE_STEP)
    (row,) = motion.truth([0.0])
    start = row["lat"], row["lon"], row["height"], row["vel_n"], row["q_nb"]
    batch, single = Strapdown(), Strapdown()
    for core in batch, single:
        core.start(*start)
    done, *out = advance(batch, step, dtheta, dvel)
    assert abs(out[0][done - 1, 0]) > MAX_LAT >= abs(out[0][done - 2, 0])
    assert batch.mechanization == "wander"
    answers = []
    for sample in np.hstack([dtheta, dvel]).tolist():
        answers.append(single.push(POLE_STEP, *sample))
        if answers[-1] == POLE:
            single.hand_over("wander")
            assert single.push(POLE_STEP, *sample) == DONE
    assert answers == done * [DONE] + [POLE] + (POLE_STEPS - done - 1) * [DONE]
    np.testing.assert_array_equal(single.solution, batch.solution)
    navigator = Navigator(Settings())
    navigator.begin(*start, 0.0)
    rows = navigator.process(record(dtheta, dvel, POLE_STEP))
    np.testing.assert_array_equal(rows["q_nb"], out[2])
    event = navigator.events()[-1]
    assert event.time == pytest.approx(POLE_STEP * (done + 1))
    assert event.text == "the geographic mechanization is singular at the pole: wander goes on"


def record(dtheta, dvel, step):
    imu = ImuIncrements.empty(len(dtheta))
    imu.time[:], imu.step[:] = step * np.arange(1, len(dtheta) + 1), step
    imu.dtheta[:], imu.dvel[:], imu.sequence[:] = dtheta, dvel, np.arange(len(dtheta))
    return imu


# Wander azimuth


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_azimuth_changes_by_the_solid_angle(sense):
    """Ishlinsky on a circle of 20 km: the change is its area over R^2, positive clockwise; exactly, the integral of sin B dL."""
    config = MotionConfig.model_validate(
        {
            "latitude_deg": 55.0,
            "attitude": "coordinated",
            "north": {"sines": [{"amplitude": 20_000, "period_s": 600, "phase_deg": 90}]},
            "east": {"sines": [{"amplitude": sense * 20_000, "period_s": 600}]},
        }
    )
    motion = Motion(config)
    core = Strapdown("high-order:4", "wander", whole_record=True)
    fly(motion, core, 600.0, 0.02)
    truth = motion.truth(np.linspace(0.0, 600.0, 6001))
    # Trapezoid of a periodic integrand: L' from the velocity
    _, prime = np.array([curvature_radii(math.sin(lat)) for lat in truth["lat"]]).T
    rate = truth["vel_n"][:, 1] * np.tan(truth["lat"]) / (prime + truth["height"])
    assert core.azimuth == pytest.approx(0.1 * rate[:-1].sum(), abs=1e-12)
    meridian, prime = curvature_radii(math.sin(math.radians(55.0)))
    assert core.azimuth == pytest.approx(sense * math.pi * 20_000**2 / (meridian * prime), rel=2e-3)


@settings(max_examples=10)
@given(st.floats(-math.pi, math.pi))
def test_the_azimuth_at_the_start_does_not_matter(azimuth):
    """A and the gyroscopic heading depend on it, their sum and all that leaves the mechanization does not."""
    row = MOTIONS["agile"].truth([0.0])[0]
    one, other = Strapdown("high-order:4", "wander"), Strapdown("high-order:4", "wander")
    begin(one, row)
    other.start(row["lat"], row["lon"], row["height"], row["vel_n"], row["q_nb"], azimuth)
    data = increments(MOTIONS["agile"], 20.0, 0.01)
    _, one_place, one_velocity, one_q = advance(one, *data)
    _, place, velocity, q_nb = advance(other, *data)
    assert np.abs(cartesian(place) - cartesian(one_place)).max() < 2e-8
    assert np.abs(velocity - one_velocity).max() < 1e-9
    assert np.abs(attitude_error(q_nb[-1], one_q[-1])).max() < 1e-13
    assert math.remainder(other.azimuth - one.azimuth - azimuth, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-13)


def test_the_heading_is_corrected_through_the_azimuth_alone():
    """Babich: psi_r and the velocity in the platform are right, A is wrong; a correction of A mends heading and course."""
    row, motion, wrong = MOTIONS["agile"].truth([0.0])[0], MOTIONS["agile"], 0.01
    turn = Rotation.from_euler("z", wrong)
    q_nb = turn * Rotation.from_quat(row["q_nb"], scalar_first=True)
    core = Strapdown("high-order:4", "wander")
    core.start(row["lat"], row["lon"], row["height"], turn.apply(row["vel_n"]), q_nb.as_quat(scalar_first=True), wrong)
    data = increments(motion, 10.0, 0.01)
    _, _, velocity, q_nb = advance(core, *data)
    right = motion.truth([10.0])[0]
    assert attitude_error(q_nb[-1], right["q_nb"])[2] == pytest.approx(wrong, rel=1e-3)
    core.correct_azimuth(-wrong)
    # What is left came of ten seconds on the wrong course: its way over R, and Coriolis on the false velocity.
    assert np.abs(attitude_error(core.solution[6:10], right["q_nb"])).max() < 1e-5
    assert np.abs(core.solution[3:6] - right["vel_n"]).max() < 5e-3 < np.abs(velocity[-1] - right["vel_n"]).max()
    with pytest.raises(HilError, match="has no azimuth"):
        Strapdown().correct_azimuth(wrong)


# Gravitation


def j2_gradient(x, y, z):
    """Gradient of the potential by complex steps: no differences, no cancellation."""
    h = 1e-20

    def potential(x, y, z):
        r2 = x * x + y * y + z * z
        return GM / np.sqrt(r2) * (1.0 - J2 * A * A / r2 * (1.5 * z * z / r2 - 0.5))

    return np.array([potential(x + 1j * h, y, z), potential(x, y + 1j * h, z), potential(x, y, z + 1j * h)]).imag / h


PLACES = [(lat, lon, h) for lat in (-90, -37.5, 0, 1e-6, 45, 60, 89.9) for lon in (-120, 10) for h in (-100, 0, 20e3)]


def test_j2_is_the_gradient_of_its_potential():
    for lat, lon, height in PLACES:
        x, y, z = (float(v) for v in pymap3d.geodetic2ecef(lat, lon, height))
        s, c = math.sin(math.radians(lat)), math.cos(math.radians(lat))
        np.testing.assert_allclose(gravitation_cartesian(J2_FIELD, x, y, z, s, c), j2_gradient(x, y, z), atol=1e-13)
        north, down = gravitation_local(J2_FIELD, s, c, float(height), math.hypot(x, y))
        of_n = pymap3d.ecef2enuv(*j2_gradient(x, y, z), lat, lon)
        np.testing.assert_allclose([north, -down], [of_n[1], of_n[2]], atol=1e-13)


def test_normal_is_normal_gravity_without_the_centrifugal_part():
    for lat, lon, height in PLACES:
        x, y, z = (float(v) for v in pymap3d.geodetic2ecef(lat, lon, height))
        s, c = math.sin(math.radians(lat)), math.cos(math.radians(lat))
        g = np.array(gravitation_cartesian(NORMAL, x, y, z, s, c)) + RATE**2 * np.array([x, y, 0.0])
        east, north, up = pymap3d.ecef2enuv(*g, lat, lon)
        np.testing.assert_allclose([east, north, -up], [0.0, 0.0, normal_gravity(s, float(height))], atol=1e-14)


def test_how_far_the_fields_are_apart():
    """About 1.2e-4 m/s^2 at most, vertically as to the north, at 10 km."""
    difference = []
    for lat in np.radians(np.arange(-90, 91)):
        s, c = math.sin(lat), math.cos(lat)
        axis = (curvature_radii(s)[1] + 10e3) * c
        pairs = (gravitation_local(field, s, c, 10e3, axis) for field in (NORMAL, J2_FIELD))
        difference.append(np.subtract(*pairs))
    north, down = np.abs(difference).max(axis=0)
    assert 5e-5 < north < 1.3e-4
    assert 5e-5 < down < 1.3e-4


@pytest.mark.parametrize("mechanization", EXACT)
def test_the_wrong_field_shows_as_an_acceleration(mechanization):
    motion = MOTIONS["flight"]
    right, wrong = (
        fly(motion, Strapdown("two-sample", mechanization, field), 10.0, 0.01)[1][-1] for field in ("normal", "j2")
    )
    (row,) = motion.truth([0.0])
    s, c = math.sin(row["lat"]), math.cos(row["lat"])
    axis = (curvature_radii(s)[1] + row["height"]) * c
    normal, j2 = (gravitation_local(field, s, c, float(row["height"]), axis) for field in (NORMAL, J2_FIELD))
    assert wrong - right == pytest.approx(10.0 * np.array([j2[0] - normal[0], 0.0, j2[1] - normal[1]]), abs=2e-6)


@given(st.floats(-90, 90), st.floats(-1000, 1000), st.floats(-500, 2e4))
def test_near_latitude(lat, way, height):
    """One Newton step from a place within a kilometre leaves about e^2 of the way's square and half of its cube."""
    new = min(90.0, max(-90.0, lat + math.degrees(way / 6.4e6)))
    x, _, z = pymap3d.geodetic2ecef(new, 0.0, height)
    old = math.radians(lat)
    s, c = near_latitude(abs(float(x)), float(z), math.sin(old), math.cos(old))
    assert math.atan2(s, c) == pytest.approx(
        math.radians(new), abs=0.006 * (way / 6.4e6) ** 2 + abs(way / 6.4e6) ** 3 + 3e-16
    )
    assert math.hypot(s, c) == pytest.approx(1.0, abs=1e-15)


# Refusals


@pytest.mark.parametrize(
    ("choice", "say"),
    [
        ({"attitude": "high-order:9"}, "high-order:N takes N = 3..8"),
        ({"attitude": "high-order:x"}, "high-order:N takes N = 3..8"),
        ({"attitude": "three-sample"}, r"there is: two-sample, high-order\[:N\] \(N = 3\.\.8\), poisson-rk4, "),
        ({"attitude": "coning:6"}, "N from 1 to 5"),
        ({"mechanization": "polar"}, "there is: geographic, wander, earth, inertial, inertial-source"),
        ({"mechanization": "inertial-source", "attitude": "picard3"}, "has its own attitude: it takes no 'picard3'"),
        ({"gravity": "j4"}, "there is: normal, j2"),
    ],
)
def test_unknown_names_are_refused(choice, say):
    with pytest.raises(HilError, match=say):
        Strapdown(**choice)


@pytest.mark.parametrize("mechanization", MECHANIZATIONS)
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_a_number_never_enters(mechanization, value):
    navigator = Navigator(Settings(mechanization=mechanization))
    navigator.begin(*REST, np.zeros(3), REST_ATTITUDE.as_quat(scalar_first=True), 0.0)
    _, dtheta, dvel = rest_increments(10, 0.01)
    dvel[7, 2] = value
    with pytest.raises(HilError, match="increment 7 is not a number"):
        navigator.process(record(dtheta, dvel, 0.01))
    dvel[7, 2] = dvel[6, 2]
    assert np.isfinite(navigator.process(record(dtheta, dvel, 0.01))["vel_n"]).all()


# What a caller may hand over


def moving(attitude="two-sample", mechanization="geographic", whole=False, samples=12):
    """A core in flight, and the samples that it takes next."""
    core = Strapdown(attitude, mechanization, whole_record=whole)
    begin(core, MOTIONS["agile"].truth([0.0])[0])
    step, dtheta, dvel = increments(MOTIONS["agile"], 1.0, 0.01)
    for row in np.column_stack([step, dtheta, dvel])[:samples].tolist():
        core.push(*row)
    return core, (step[samples:], dtheta[samples:], dvel[samples:])


def test_a_kept_push_keeps_its_core():
    core, (step, dtheta, dvel) = moving()
    push, memory = core.push, weakref.ref(core.solution.base)
    del core
    gc.collect()
    assert memory() is not None, "push writes into freed memory"
    assert push(step[0], *dtheta[0], *dvel[0]) == DONE


@pytest.mark.parametrize("attitude", ["two-sample", "high-order:8", "coning:3"])
@pytest.mark.parametrize("samples", [0, 3, 12])
@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda core: pickle.loads(pickle.dumps(core))])
def test_a_copy_goes_on_alone(attitude, samples, copied):
    core, record = moving(attitude, samples=samples)
    twin, before = copied(core), core.solution.copy()
    rows = np.column_stack(record).tolist()
    for row in rows:
        assert twin.push(*row) == DONE
    np.testing.assert_array_equal(core.solution, before)
    for row in rows:
        core.push(*row)
    np.testing.assert_array_equal(core.solution, twin.solution)


@pytest.mark.parametrize(
    ("change", "say"),
    [
        ({"dtheta": lambda n: np.zeros((n - 1, 3))}, "dtheta: shape"),
        ({"dvel": lambda n: np.zeros((n, 2))}, "dvel: shape"),
        ({"dtheta": lambda n: np.zeros((3, n))}, "dtheta: shape"),
        ({"gyro_bias": lambda n: np.zeros(2)}, "gyro_bias: shape"),
        ({"gyro_bias": lambda n: np.full(3, math.nan)}, "the gyro bias is not a number"),
        ({"position": lambda n: np.zeros((n - 1, 3))}, "position: shape"),
        ({"velocity": lambda n: np.zeros((n, 3), np.float32)}, "velocity: float32"),
        ({"attitude": lambda n: np.zeros((n, 8))[:, ::2]}, "attitude: float64 where a contiguous"),
    ],
)
def test_no_kernel_reads_or_writes_beyond_its_arrays(change, say):
    core, (step, dtheta, dvel) = moving()
    n, before = len(step), core.solution.copy()
    right = {"step": step, "dtheta": dtheta, "dvel": dvel, "gyro_bias": np.zeros(3)}
    right |= {"position": np.zeros((n, 3)), "velocity": np.zeros((n, 3)), "attitude": np.zeros((n, 4))}
    with pytest.raises(HilError, match=say):
        core.advance(**right | {name: make(n) for name, make in change.items()})
    np.testing.assert_array_equal(core.solution, before)


def test_any_array_of_numbers_is_taken_without_compiling_anew():
    expected, record = moving()
    advance(expected, *record)
    versions = len(kernels.advance.signatures)
    for change in (
        np.ndarray.tolist,
        np.asfortranarray,
        lambda x: np.repeat(x, 2, axis=0)[::2],
        lambda x: np.frombuffer(x.tobytes()).reshape(x.shape),  # read-only
    ):
        core, (step, *rest) = moving()
        n = len(step)
        core.advance(*(change(x) for x in (step, *rest)), [0, 0, 0], *(np.empty((n, k)) for k in (3, 3, 4)))
        np.testing.assert_array_equal(core.solution, expected.solution)
    assert len(kernels.advance.signatures) == versions


@pytest.mark.parametrize("attitude", ["two-sample", "high-order:4", "coning:3"])
@pytest.mark.parametrize("whole", [False, True])
def test_a_refused_batch_leaves_no_trace(attitude, whole):
    core, (step, dtheta, dvel) = moving(attitude, samples=0 if whole else 12, whole=whole)
    clean = copy.copy(core)
    wrong = dvel.copy()
    wrong[20, 0] = math.inf
    with pytest.raises(HilError, match="increment 20 of the batch is not a number"):
        advance(core, step, dtheta, wrong)
    _, *got = advance(core, step, dtheta, dvel)
    _, *expected = advance(clean, step, dtheta, dvel)
    for one, other in zip(got, expected, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("attitude", ["two-sample", "high-order:4", "coning:3"])
def test_increments_too_large_to_be_any_are_told(attitude):
    core, (step, dtheta, dvel) = moving(attitude)
    with pytest.raises(HilError, match="too large"):
        advance(core, step, 1e200 + dtheta, dvel)
    core, (step, dtheta, dvel) = moving()
    assert core.push(step[0], 1e200, 0.0, 0.0, *dvel[0]) == NOT_FINITE


@pytest.mark.parametrize("attitude", ["two-sample", "high-order:4", "coning:3"])
@pytest.mark.parametrize("whole", [False, True])
def test_steps_below_zero_change_nothing(attitude, whole):
    cores = [moving(attitude, whole=whole, samples=0) for _ in range(2)]
    (plain, (step, dtheta, dvel)), (padded, _) = cores
    _, *expected = advance(plain, step, dtheta, dvel)
    longer = np.stack([-step, step], axis=1).ravel()
    _, *got = advance(padded, longer, dtheta.repeat(2, 0), dvel.repeat(2, 0))
    for one, other in zip(expected, got, strict=True):
        np.testing.assert_array_equal(one, other[1::2])


@pytest.mark.parametrize("mechanization", MECHANIZATIONS)
def test_a_start_is_a_place_and_a_rotation(mechanization):
    row, cores = MOTIONS["agile"].truth([0.0])[0], [Strapdown("two-sample", mechanization) for _ in range(2)]
    place, vel_n, q_nb = (row["lat"], row["lon"], row["height"]), row["vel_n"], row["q_nb"]
    for core, norm in zip(cores, (1.0, 2.0), strict=True):
        core.start(*place, vel_n, norm * q_nb)
        advance(core, *increments(MOTIONS["agile"], 1.0, 0.01))
    np.testing.assert_allclose(cores[1].solution, cores[0].solution, rtol=1e-12)
    before = core.solution.copy()
    for start, say in (
        ((math.nan, *place[1:], vel_n, q_nb), "not a number"),
        ((1.6, *place[1:], vel_n, q_nb), "beyond a pole"),
        ((*place, vel_n[:2], q_nb), "shape"),
        ((*place, vel_n, 0.0 * q_nb), "no rotation"),
        ((*place, vel_n, q_nb, math.inf), "not a number"),
    ):
        with pytest.raises(HilError, match=say):
            core.start(*start)
    np.testing.assert_array_equal(core.solution, before)


def test_a_whole_record_is_not_pushed():
    with pytest.raises(HilError, match="whole record"):
        moving("high-order:4", whole=True)
