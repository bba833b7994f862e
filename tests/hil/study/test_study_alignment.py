"""The study of the alignments, with few runs over a short time."""

import math

import numpy as np
import pytest

from hil.study import study_names
from hil.study.alignment import run
from hil.study.alignment.fine import moored
from hil.study.alignment.flying import epochs, flown
from hil.study.alignment.records import FIX_S, fixes, ideal, sensed
from hil.study.alignment.standing import Answers
from hil.study.navigation.flights import flight
from nav.instruments.grades import GRADES


@pytest.mark.study
def test_every_limit_is_kept():
    assert [row for row in run().rows if not row.ok] == []


def test_rows_and_figures():
    found = run(seeds=2, duration=60.0, flights=2, flight_s=20.0, tracked=1, tracked_s=10.0, refined_s=80.0)
    ids = [row.id for row in found.rows]
    assert len(set(ids)) == len(ids)
    assert {
        "sway-dtg-goal",
        "rest-mems-answers",
        "sway-mems-answers",
        "flight-dtg-heading",
        "track-20-mems-tilt",
        "fine-flight-tactical-heading",
    } <= set(ids)
    rows = {row.id: row for row in found.rows}
    assert rows["rest-mems-answers"].ok
    assert "gyro bias" in rows["rest-mems-answers"].what
    assert {plot.id for plot in found.plots} == {
        *("rest", "sway", "flight", "fine"),
        *("track-dtg", "track-tactical", "track-mems"),
    }
    assert "alignment" in study_names()


def test_the_filter_goes_on_where_the_coarse_alignment_ends():
    """A minute of sway shows degrees; the filter comes to tenths, and errs within its sigma."""
    found = moored("dtg", 1, 300.0)
    heading, sigma = np.abs(found.errors[0, :, 1]), found.sigmas[0, :, 1]
    assert sigma[-1] < 0.0025 < sigma[6]
    assert heading[-1] < 3.0 * sigma[-1]


def test_epochs_err_as_their_geometry_says():
    errors, covariances = epochs(300)
    distance = np.einsum("ki,kij,kj->k", errors, np.linalg.inv(covariances), errors).mean() / 3.0
    assert distance == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / 900.0))


def test_fixes_scatter_as_they_say():
    truth = flight("smooth").truth(FIX_S * np.arange(2000))
    rows = fixes(truth, np.random.default_rng(1))
    assert np.std(rows["value"][:, 3:] - truth["vel_n"]) == pytest.approx(rows["sigma"][0, 3], rel=0.05)
    assert np.std(rows["value"][:, 2] - truth["height"]) == pytest.approx(rows["sigma"][0, 2], rel=0.07)


def test_tracking_holds_what_free_inertial_loses():
    motion = flight("smooth")
    imu = sensed(ideal(motion, 60.0), GRADES["mems"], 1)
    truth = motion.truth(FIX_S * np.arange(round(60.0 / FIX_S) + 1))
    free, tracked = (flown(imu, truth, 1, constant).errors[-1] for constant in (None, 10.0))
    assert (np.abs(tracked) < 0.5 * np.abs(free)).all()


def test_time_to_a_heading_is_when_it_stays_there():
    time = np.arange(10.0, 60.0, 10.0)
    heading = np.radians([0.5, 0.05, 0.2, 0.05, 0.05])
    found = Answers(time, np.zeros((1, 5, 2)), np.zeros((1, 5, 2)), ("",))
    assert found.reached(np.stack([heading, heading], axis=1)) == 40.0
    assert found.reached(np.full((5, 2), np.nan)) == math.inf
