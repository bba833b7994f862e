"""What an aided navigator says of itself in its rows, and what is told of the sources."""

import math
from itertools import pairwise

import numpy as np
import pytest

from hil.geometry import position_error
from hil.study.aiding import gnss_rows, record
from hil.study.navigation.flights import flight
from nav.chi_square import quantile
from nav.filter import watch
from nav.filter.aided import Settings as FilterSettings
from nav.filter.states import tuning
from nav.instruments.grades import GRADES
from nav.navigator import Aiding, Navigator, Settings
from nav.rotation import attitude_error
from nav.state import Health, Mode, Ratio

MOTION = flight("smooth")
SECONDS = 40.0
IMU = record(MOTION, SECONDS)
TIMES = np.arange(1, round(5 * SECONDS)) * 0.2 - 0.0031
TRUTH = MOTION.truth(IMU.time)
SIGMA = np.array([1.5, 1.5, 2.5, 0.05, 0.05, 0.08, 0.002, 0.002, 0.01])


def rows():
    return gnss_rows(MOTION.truth(TIMES), np.random.default_rng(4))


def navigator(aided=True, **settings):
    aiding = Aiding(tuning(GRADES["tactical"], bias_removed=True), FilterSettings(**settings), SIGMA)
    found = Navigator(Settings(aiding=aiding if aided else None))
    start = MOTION.truth([0.0])[0]
    position = start["lat"], start["lon"], start["height"]
    found.begin(*position, start["vel_n"], start["q_nb"], 0.0)
    found.events()
    return found


def fly(measurements, cuts=(), late=0.11, found=None):
    """All rows of NAV_STATE and all events; each measurement is given behind the sample at which it comes, `late` s."""
    found = found or navigator()
    places = np.searchsorted(IMU.time, measurements["time"] + late)
    states = []
    for a, b in pairwise(sorted({0, *cuts, *places.tolist(), len(IMU)})):
        come = measurements[places == a]
        if len(come):
            found.aid(come)
        states.append(found.process(IMU.rows(a, b)).copy())
    return np.concatenate(states), found.events()


def north(metres):
    return metres / 6.37e6


def test_rows_and_events_do_not_depend_on_batches():
    spoiled = rows()
    spoiled["value"][60:90, 0] += north(100.0)
    states, events = fly(spoiled)
    others, told = fly(spoiled, cuts=np.random.default_rng(1).integers(0, len(IMU), 900).tolist())
    assert (states == others).all()
    assert events == told
    assert events


def test_errors_are_as_large_as_the_sigmas_say():
    states, _ = fly(rows())
    settled = slice(1000, None)
    position = position_error(states["lat"], states["lon"], states["height"], TRUTH)[settled]
    velocity = (states["vel_n"] - TRUTH["vel_n"])[settled]
    attitude = attitude_error(states["q_nb"], TRUTH["q_nb"])[settled]
    sigma = states["sigma"][settled]
    normal = np.concatenate([position, velocity, attitude], axis=1) / sigma
    assert np.abs(normal).max() < 4.5
    assert 0.2 < math.sqrt((normal**2).mean()) < 1.5
    assert (sigma[:, 0] < 0.5 * SIGMA[0]).all()


def test_sigmas_begin_with_the_start_and_grow_without_measurements():
    states, _ = fly(rows()[:0])
    np.testing.assert_allclose(states["sigma"][0], SIGMA, rtol=1e-6)
    assert (np.diff(states["sigma"][:, :8], axis=0) >= 0.0).all()
    assert (states["sigma"][-1, :6] > 2.0 * SIGMA[:6]).all()
    assert not states["test_ratio"].any()


def test_without_aiding_nothing_is_claimed():
    states, _ = fly(rows(), found=navigator(aided=False))
    assert set(states["mode"]) == {Mode.NAVIGATE}
    assert np.isinf(states["sigma"]).all()
    assert not states["test_ratio"].any()


def test_a_jump_is_told_once_and_its_end_too():
    spoiled = rows()
    spoiled["value"][60:90, 0] += north(100.0)
    states, events = fly(spoiled)
    assert [event.text.partition(" is ")[2].partition(":")[0] for event in events] == ["rejected", "taken again"]
    assert float(events[0].text.partition(":")[2].removesuffix("sigma")) > 10.0
    assert [event.severity for event in events] == ["warning", "notice"]
    assert all(event.station for event in events)
    first, last = TIMES[60], TIMES[90]
    assert first <= events[0].time < first + 1.0
    assert last <= events[1].time < last + 5.0
    bad = (states["time"] > first + 0.5) & (states["time"] < last)
    assert (states["test_ratio"][bad, Ratio.POSITION] >= 1.0).all()
    assert (states["test_ratio"][bad, Ratio.VELOCITY] < 1.0).all()
    assert (states["test_ratio"][~bad & (states["time"] > last + 5.0), Ratio.POSITION] < 1.0).all()


def test_the_ratio_is_the_distance_over_that_of_the_gate():
    """The innovation of a jump of 100 m, over its expected sigma."""
    spoiled = rows()
    spoiled["value"][60:90, 0] += north(100.0)
    states, _ = fly(spoiled)
    at = np.searchsorted(states["time"], TIMES[64])
    expected = math.hypot(1.5, float(states["sigma"][at, 0]))
    ratio = 100.0 / expected / math.sqrt(quantile(0.999, 3))
    assert states["test_ratio"][at, Ratio.POSITION] == pytest.approx(ratio, rel=0.05)


def test_a_single_outlier_is_not_told():
    spoiled = rows()
    spoiled["value"][60, 0] += north(100.0)
    states, events = fly(spoiled)
    assert events == []
    assert states["test_ratio"][:, Ratio.POSITION].max() >= 1.0


def test_a_source_that_falls_silent_says_nothing_of_the_present():
    heard = rows()
    states, _ = fly(heard[heard["time"] < 20.0])
    assert states["test_ratio"][states["time"] < 25.0, Ratio.POSITION][100:].all()
    assert not states["test_ratio"][states["time"] > 25.3].any()


def test_a_noisy_source_is_named():
    spoiled = rows()
    part, rng = spoiled["time"] > 15.0, np.random.default_rng(6)
    spoiled["value"][part, 0] += north(7.0) * rng.standard_normal(part.sum())
    spoiled["value"][part, 1] += north(7.0) / 0.6 * rng.standard_normal(part.sum())
    spoiled["value"][part, 2] += 12.0 * rng.standard_normal(part.sum())
    _, events = fly(spoiled)
    assert "GNSS position 0 is noisier than it says" in [event.text for event in events]


def test_a_slow_drift_is_named():
    spoiled = rows()
    late = np.maximum(spoiled["time"] - 15.0, 0.0)
    spoiled["value"][:, 0] += north(0.3) * late
    _, events = fly(spoiled, found=navigator(restart_s=math.inf))
    assert "GNSS position 0 is rejected: it pulls one way" in [event.text for event in events]


def test_a_position_that_nobody_vouches_for_is_trusted_while_fixes_hold_it(monkeypatch):
    monkeypatch.setattr(watch, "SURE_M", 20.0)
    aiding = Aiding(tuning(GRADES["mems"], bias_removed=True), FilterSettings(), SIGMA)
    found = Navigator(Settings(aiding=aiding, position_trusted=False))
    start = MOTION.truth([0.0])[0]
    found.begin(start["lat"], start["lon"], start["height"], start["vel_n"], start["q_nb"], 0.0)
    fixes = rows()
    states, _ = fly(fixes[(fixes["time"] > 5.0) & (fixes["time"] < 8.0)], found=found)
    unaided = (states["health"] & Health.UNAIDED) != 0
    level = np.hypot(states["sigma"][:, 0], states["sigma"][:, 1])
    assert unaided[states["time"] < 5.0].all()
    assert not unaided[(states["time"] > 5.5) & (level < 19.0)].any()
    assert unaided[level > 22.0].all()
    assert level[-1] > 22.0, "the fixes have been over for long enough"
