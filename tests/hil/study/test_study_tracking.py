"""The study of the tracking correction, with few runs over a short time."""

import math

import numpy as np
import pytest

from hil.study import study_names
from hil.study.report import write
from hil.study.tracking import WAYS, navigate, run
from hil.study.tracking.flights import WANDER_M, fly, motion, noise
from hil.study.tracking.peer import feedback
from hil.study.tracking.ways import filtered
from nav.filter.states import tuning
from nav.filter.tracking_gains import steady
from nav.instruments.grades import GRADES


@pytest.mark.study
def test_every_limit_is_kept():
    assert [row for row in run().rows if not row.ok] == []


@pytest.fixture(scope="module")
def flight():
    return fly("turns", GRADES["mems"], 1, 40.0, (30.0, 40.0), wandering=False)


def test_every_way_holds_what_it_is_given_and_loses_it_in_silence(flight):
    for way in WAYS:
        errors = flight.errors(navigate(flight, GRADES["mems"], way))
        time = flight.truth["time"][1:]
        heard = errors[(time > 10.0) & (time <= 30.0), 3]
        assert np.sqrt(np.mean(heard**2)) < 60.0
        assert errors[-1, 3] > 2.0 * np.sqrt(np.mean(errors[(time > 29.0) & (time <= 30.0), 3] ** 2))


def test_the_order_of_the_ways_by_position(flight):
    late = slice(100, 150)
    rms = {way: np.mean(flight.errors(navigate(flight, GRADES["mems"], way))[late, 3] ** 2) for way in WAYS}
    assert rms["filter-antennas"] < rms["track-10"] < rms["track-20"] < rms["track-40"]
    assert rms["track-steady"] < rms["track-10"]


def test_better_gyros_want_slower_gains():
    gains = []
    for grade in GRADES.values():
        one = fly("straight", grade, 0, 2.0, None, wandering=False)
        gains.append(steady(noise(grade, one)).azimuth)
    assert gains == sorted(gains)
    assert gains[2] > 5.0 * gains[0]


def test_straight_is_straight_and_the_slow_error_is_slow():
    assert np.abs(motion("straight").truth(np.arange(60.0))["w_ib_b"]).max() < 2e-4
    one = fly("straight", GRADES["dtg"], 2, 300.0, None, wandering=True)
    height = one.fixes["value"][:, 2] - one.truth["height"]
    smooth = np.convolve(height, np.ones(50) / 50, "valid")
    assert 0.2 * WANDER_M < np.sqrt(np.mean(smooth**2)) < 3.0 * WANDER_M
    assert np.sqrt(np.mean(np.diff(smooth[::25]) ** 2)) < 0.5 * WANDER_M


def test_the_peer_navigates_as_ours_does():
    pytest.importorskip("pandas")
    pytest.importorskip("pyins.filters")
    one, belief = fly("turns", GRADES["tactical"], 3, 10.0, None, wandering=False), tuning(GRADES["tactical"])
    ours, theirs = filtered(one, belief, antennas=False), feedback(one, belief)
    assert abs(np.diff([one.errors(solved)[-1, 0] for solved in (ours, theirs)])[0]) < math.radians(0.01)
    np.testing.assert_allclose(ours[-1, 3:6], theirs[-1, 3:6], atol=0.02)


def test_rows_and_figures(tmp_path):
    found = run(seeds=1, settled=1.0, outage=(2.0, 4.0), peer_s=2.0)
    ids = [row.id for row in found.rows]
    assert len(set(ids)) == len(ids)
    assert {f"time-{way}" for way in WAYS} <= set(ids)
    assert {f"mems-turns-wander-{way}-tilt" for way in WAYS} <= set(ids)
    assert len(write(found, tmp_path)) == 2 + len(found.plots)
    assert "tracking" in study_names()
