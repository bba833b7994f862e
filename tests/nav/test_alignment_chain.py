"""The alignment chain in the navigator: every way ends at the truth, however samples and measurements came in."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.scenario import Channel, MotionConfig, Sine, load
from hil.world.motion import Motion
from nav.aiding import AIDING, Kind, aiding, aiding_rows
from nav.alignment.held import turn_between
from nav.alignment.rest import Sensors
from nav.earth import curvature_radii
from nav.errors import HilError
from nav.filter.aided import Settings as FilterSettings
from nav.filter.states import tuning
from nav.increments import ImuIncrements
from nav.instruments.grades import GRADES
from nav.lever_arm import shift
from nav.navigator import Aiding, Navigator, Settings
from nav.rotation import attitude_error, euler_from_quaternion, product
from nav.state import Health, Mode

DEG = math.radians(1.0)
DEG_H = DEG / 3600.0
LAT, HEIGHT, STEP = 50.0 * DEG, 20.0, 0.02


def swing(amplitude, period, phase=0.0, offset=0.0):
    return Channel(offset=offset, sines=(Sine(amplitude=amplitude, period_s=period, phase_deg=phase),))


SHIP = Motion(
    MotionConfig(
        latitude_deg=50.0,
        height_m=HEIGHT,
        heading=swing(1.5, 9.7, 0.0, 217.0),
        roll=swing(5.0, 8.3, 100.0),
        up=swing(0.3, 7.3, 20.0),
        north=swing(0.2, 9.1),
    )
)
STANDING = Motion(MotionConfig(latitude_deg=50.0, height_m=HEIGHT, heading=Channel(offset=140.0)))
FLIGHT = Motion(load("airstart").motion)
ANTENNA = (1.0, 0.2, -1.5)


def record(motion, seconds, bias=0.0):
    n = round(seconds / STEP)
    imu = ImuIncrements.empty(n)
    imu.sequence[:] = np.arange(n)
    imu.step[:], imu.time[:] = STEP, STEP * (imu.sequence + 1)
    motion.increments(0, n, STEP, imu.dtheta, imu.dvel)
    imu.dtheta[:] += bias * STEP
    return imu


def without(imu, first, last):
    kept = (imu.time <= first) | (imu.time > last)
    return ImuIncrements(*(getattr(imu, name)[kept] for name in ImuIncrements.__dataclass_fields__))


def true_fixes(motion, times, arm=(0.0, 0.0, 0.0)):
    truth = motion.truth(times)
    parts = [np.ascontiguousarray(truth[name]) for name in ("lat", "lon", "height", "vel_n", "q_nb", "w_ib_b")]
    shift(*parts, np.array(arm))
    return aiding_rows(times, Kind.GNSS, np.column_stack(parts[:4]), [1.0, 1.0, 1.0, 0.1, 0.1, 0.1])


def fed(navigator, imu, rows=(), late=0.0, cuts=()):
    """Hand over samples and rows, each row `late` s after its time; all solutions."""
    arrivals = [int(np.searchsorted(imu.time, row["time"] + late)) for row in rows]
    out = []
    for first, last in pairwise(sorted({0, *arrivals, *(cut for cut in cuts if cut < len(imu)), len(imu)})):
        for row, arrival in zip(rows, arrivals, strict=True):
            if arrival == first:
                navigator.aid(np.array([row], AIDING))
        out.append(navigator.process(imu.rows(first, last)).copy())
    return np.concatenate(out)


def errors(motion, row):
    """Position, m, velocity, m/s, attitude, rad, each north, east, down."""
    truth = motion.truth([row["time"]])[0]
    meridian, prime = curvature_radii(math.sin(truth["lat"]))
    place = [
        (row["lat"] - truth["lat"]) * meridian,
        (row["lon"] - truth["lon"]) * prime * math.cos(truth["lat"]),
        truth["height"] - row["height"],
    ]
    return np.array(place), row["vel_n"] - truth["vel_n"], attitude_error(row["q_nb"], truth["q_nb"])


def first_solution(rows):
    return rows[np.argmax(rows["mode"] >= Mode.NAVIGATE)]


def texts(navigator):
    return " | ".join(event.text for event in navigator.events())


SWAYING = Settings(lat=LAT, lon=36.25 * DEG, height=HEIGHT, alignment="swaying", align_s=300.0)
MOVING = Settings(alignment="moving", align_s=60.0, antenna=ANTENNA)
TRANSFER = Settings(alignment="transfer", antenna=ANTENNA)


def test_at_a_mooring_attitude_and_velocity_are_those_of_the_ship():
    """Heave and sway of 0.2 m/s are no error of the velocity, only of the place."""
    navigator = Navigator(SWAYING)
    rows = fed(navigator, record(SHIP, 310.0))
    assert (rows["mode"] >= Mode.NAVIGATE).sum() == round(10.0 / STEP) + 1
    place, velocity, attitude = errors(SHIP, first_solution(rows))
    assert np.abs(attitude[:2]).max() < 1e-3 * DEG
    assert abs(attitude[2]) < 0.02 * DEG
    assert np.linalg.norm(SHIP.truth([300.0])["vel_n"]) > 0.1
    assert np.abs(velocity).max() < 0.02
    assert np.abs(place).max() < 0.5
    assert "heading known to" in texts(navigator)


def test_a_given_heading_is_not_needed_where_sway_shows_the_north():
    """What a bias leaves is the classical limit: east bias / (U cos B). The mean heading is 217 deg."""
    bias = np.array([0.01, -0.02, 0.0]) * DEG_H
    rows = fed(Navigator(SWAYING), record(SHIP, 300.0, bias))
    clean = fed(Navigator(SWAYING), record(SHIP, 300.0))
    turned = attitude_error(rows["q_nb"][-1], clean["q_nb"][-1])[2]
    east = bias[0] * math.sin(217 * DEG) + bias[1] * math.cos(217 * DEG)
    assert turned == pytest.approx(-east / (7.292115e-5 * math.cos(LAT)), rel=0.02)


@pytest.mark.parametrize("late", [0.0, 0.35])
def test_in_flight_the_start_is_that_of_the_sensor(late):
    """The antenna is 1.8 m away in a body that rolls; fixes lie between samples and come late."""
    fixes = true_fixes(FLIGHT, np.arange(0.113, 60.1, 0.2), ANTENNA)
    rows = fed(Navigator(MOVING), record(FLIGHT, 61.0), fixes, late)
    start = first_solution(rows)
    assert start["time"] == pytest.approx(60.0)
    place, velocity, attitude = errors(FLIGHT, start)
    assert np.abs(attitude).max() < 0.005 * DEG
    assert np.abs(place).max() < 0.05
    assert np.abs(velocity).max() < 0.01
    untold = first_solution(fed(Navigator(Settings(alignment="moving", align_s=60.0)), record(FLIGHT, 61.0), fixes))
    assert np.linalg.norm(errors(FLIGHT, untold)[0]) > 1.0


def test_fixes_without_velocity_do():
    fixes = true_fixes(FLIGHT, np.arange(0.2, 60.1, 0.2))
    fixes["sigma"][:, 3:] = np.inf
    rows = fed(Navigator(Settings(alignment="moving", align_s=60.0)), record(FLIGHT, 60.5), fixes, 0.2)
    _, velocity, attitude = errors(FLIGHT, first_solution(rows))
    assert np.abs(velocity).max() < 0.05
    assert np.abs(attitude).max() < 0.02 * DEG


@pytest.mark.parametrize(("attitude_at", "fix_at"), [(3.0, 3.0), (3.013, 3.3), (3.313, 3.0), (4.5, 3.1)])
def test_transfer_begins_at_once_with_the_other_navigators_solution(attitude_at, fix_at):
    row = aiding(attitude_at, Kind.ATTITUDE, tuple(FLIGHT.truth([attitude_at])["q_nb"][0]), (1e-3,) * 3)
    fix = true_fixes(FLIGHT, [fix_at], ANTENNA)[0]
    both = sorted([row, fix], key=lambda one: one["time"])
    rows = fed(Navigator(TRANSFER), record(FLIGHT, 6.0), both, late=0.1)
    start = first_solution(rows)
    assert 0.1 - 1e-9 <= start["time"] - max(attitude_at, fix_at) < 0.1 + STEP
    place, velocity, attitude = errors(FLIGHT, start)
    # Between the two times the level turns with the vehicle's way, 161 m/s over the Earth's radius.
    assert np.abs(attitude).max() < 0.001 * DEG + 161.0 / 6.36e6 * abs(attitude_at - fix_at) * 1.2
    assert np.abs(place).max() < 0.01
    assert np.abs(velocity).max() < 0.01


def test_what_another_navigator_said_too_long_ago_begins_nothing():
    row = aiding(1.0, Kind.ATTITUDE, tuple(FLIGHT.truth([1.0])["q_nb"][0]), (1e-3,) * 3)
    rows = fed(Navigator(TRANSFER), record(FLIGHT, 8.0), [row, true_fixes(FLIGHT, [4.0])[0]])
    assert set(rows["mode"]) == {Mode.ALIGN}


@settings(max_examples=20)
@given(st.floats(0.0, 3.9), st.floats(0.0, 3.9))
def test_turns_between_two_instants_are_those_of_the_body(before, after):
    imu = record(SHIP, 4.0)
    turned = product(SHIP.truth([before])["q_nb"][0], turn_between(imu, before, after))
    assert np.abs(attitude_error(turned, SHIP.truth([after])["q_nb"][0])).max() < 5e-4 + 1.1e-4 * abs(after - before)


FILTER = Aiding(tuning(GRADES["tactical"]), FilterSettings(), np.full(9, 1e-3))


def test_a_heading_source_gives_the_level_its_heading():
    """By the mean of its rows, and across north; without one the alignment waits and says for what."""
    settings = Settings(lat=LAT, height=HEIGHT, alignment="level", align_s=4.0, aiding=FILTER)
    still = Motion(MotionConfig(latitude_deg=50.0, height_m=HEIGHT, heading=Channel(offset=0.0)))
    readings = [aiding(t, Kind.HEADING, (x * DEG % (2 * math.pi),), (DEG,)) for t, x in ((1.0, 0.5), (2.0, -0.3))]
    rows = fed(Navigator(settings), record(still, 4.0), readings)
    assert rows["mode"][-1] == Mode.NAVIGATE
    assert euler_from_quaternion(rows["q_nb"][-1])[0] == pytest.approx(0.1 * DEG)
    alone = Navigator(settings)
    rows = fed(alone, record(still, 6.0))
    assert set(rows["mode"]) == {Mode.ALIGN}
    assert rows["health"][-1] & Health.RATE_TOO_SMALL
    assert "no heading source has sent" in texts(alone)


@pytest.mark.parametrize("way", ["gyrocompass", "swaying"])
def test_sensors_that_cannot_find_north_are_refused_with_what_they_would_find(way):
    """1 deg/h over U cos B is 5.9 deg at latitude 50."""
    with pytest.raises(HilError, match=r"north to 5\.9 deg only .*heading_deg.*GNSS.*transfer"):
        Navigator(Settings(lat=LAT, alignment=way, sensors=Sensors(gyro_bias=DEG_H)))
    with pytest.raises(HilError, match="north not at all"):
        Navigator(Settings(lat=LAT, alignment=way, sensors=Sensors(gyro_bias=0.2 * DEG)))
    Navigator(Settings(lat=LAT, alignment=way, sensors=Sensors(gyro_bias=0.01 * DEG_H)))
    Navigator(Settings(lat=LAT, alignment="moving", sensors=Sensors(gyro_bias=0.2 * DEG)))


def test_without_fixes_the_alignment_goes_on_until_there_are_some():
    navigator = Navigator(Settings(alignment="moving", align_s=20.0))
    imu, fixes = record(FLIGHT, 75.0), true_fixes(FLIGHT, np.arange(30.0, 75.0, 0.2))
    rows = fed(navigator, imu, fixes)
    assert (rows["health"][round(25.0 / STEP)] & Health.RATE_TOO_SMALL) != 0
    start = first_solution(rows)
    assert start["time"] == pytest.approx(40.0)
    assert start["health"] == Health.GOOD
    assert "no fix is newer than 2 s" in texts(navigator)


def test_a_ship_that_gets_under_way_is_told_so():
    away = Motion(MotionConfig(latitude_deg=50.0, height_m=HEIGHT, north=swing(400.0, 300.0)))
    navigator = Navigator(Settings(lat=LAT, height=HEIGHT, alignment="swaying", align_s=100.0))
    rows = fed(navigator, record(away, 110.0))
    assert set(rows["mode"]) == {Mode.ALIGN}
    assert rows["health"][-1] & Health.MOVING
    assert rows["progress"][-1] == pytest.approx(0.1)
    assert "does not fit the fixes" in texts(navigator)


@pytest.mark.parametrize("factor", [0.1, 9.81])
def test_wrong_units_are_not_taken_for_a_swaying_base(factor):
    imu = record(SHIP, 110.0)
    imu.dvel[:] *= factor
    navigator = Navigator(Settings(lat=LAT, height=HEIGHT, alignment="swaying", align_s=100.0))
    assert set(fed(navigator, imu)["mode"]) == {Mode.ALIGN}
    assert "units" in texts(navigator)


@pytest.mark.parametrize("length", [0.05, 1.0, 15.0])
def test_gaps(length):
    """A short gap is filled; what is bridged, and what is not, begins anew."""
    navigator = Navigator(SWAYING)
    rows = fed(navigator, without(record(SHIP, 420.0), 100.0, 100.0 + length))
    expected = 300.0 if length < 0.1 else 400.0 + length
    assert first_solution(rows)["time"] == pytest.approx(expected, abs=0.1)
    assert ("gap" in texts(navigator)) == (length > 0.1)
    assert np.abs(errors(SHIP, first_solution(rows))[2]).max() < 0.03 * DEG


def test_what_is_no_number_is_refused():
    navigator = Navigator(MOVING)
    navigator.process(record(FLIGHT, 1.0))
    bad = true_fixes(FLIGHT, [0.5])
    bad["value"][0, 4] = np.nan
    with pytest.raises(HilError, match="no number"):
        navigator.aid(bad)


AIDED = Settings(alignment="moving", align_s=4.0, antenna=ANTENNA, aiding=FILTER)
SHORT = Settings(lat=LAT, height=HEIGHT, alignment="swaying", align_s=30.0)


@settings(max_examples=4)
@given(cuts=st.lists(st.integers(1, 449), max_size=8), late=st.floats(0.0, 1.5), gap=st.floats(0.5, 4.0))
@pytest.mark.parametrize("choice", [MOVING, AIDED, TRANSFER])
def test_batches_do_not_matter_in_flight(choice, cuts, late, gap):
    settings_ = Settings(**{**{name: getattr(choice, name) for name in Settings.__slots__}, "align_s": 4.0})
    rows = list(true_fixes(FLIGHT, np.arange(0.113, 9.0, 0.2), ANTENNA))
    rows.append(aiding(5.7, Kind.ATTITUDE, tuple(FLIGHT.truth([5.7])["q_nb"][0]), (1e-3,) * 3))
    imu = without(record(FLIGHT, 9.0), gap, gap + 0.31)
    whole, split = Navigator(settings_), Navigator(settings_)
    expected = fed(whole, imu, rows, late)
    assert fed(split, imu, rows, late, cuts).tobytes() == expected.tobytes()
    assert split.events() == whole.events()


@settings(max_examples=3)
@given(cuts=st.lists(st.integers(1, 1700), max_size=8), gap=st.floats(1.0, 34.0), length=st.floats(0.02, 0.4))
def test_batches_do_not_matter_at_a_mooring(cuts, gap, length):
    imu = without(record(SHIP, 36.0), gap, gap + length)
    whole, split = Navigator(SHORT), Navigator(SHORT)
    assert fed(split, imu, (), 0.0, cuts).tobytes() == fed(whole, imu).tobytes()
    assert split.events() == whole.events()
