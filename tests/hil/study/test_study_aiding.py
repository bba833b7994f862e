"""The study of aided navigation, with few runs; in full where it is slow."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from hil.study import study_names
from hil.study.aiding import LIMITS_DEG, OWN, fly, run
from hil.study.aiding_runs import growth, nees_bounds
from hil.study.report import write


@pytest.mark.study
def test_every_limit_is_kept():
    assert [row for row in run().rows if not row.ok] == []


@pytest.mark.parametrize("runs", [20, 50, 100])
def test_bounds_are_those_of_chi_square(runs):
    expected = chi2.ppf([0.025, 0.975], 3 * runs) / runs
    assert nees_bounds(runs) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("name", LIMITS_DEG)
def test_a_short_campaign_is_consistent(name):
    """Few runs: the mean NEES after 30 s within four sigma of its spread over runs that stay as they are."""
    runs = fly(name, 8, 60.0, "own", settings=OWN)
    nees = runs.nees[:, runs.time > 30.0].mean(axis=(0, 1))
    assert (np.abs(nees - 3.0) < 4.0 * math.sqrt(6.0 / 8.0)).all()
    nis = runs.nis.mean(axis=(0, 1)) / 3.0
    assert nis == pytest.approx([1.0, 1.0], abs=4.0 * math.sqrt(2.0 / 3.0 / (8 * 300)))


def test_the_filter_is_not_too_sure_of_whole_instruments():
    """Flicker as it is, and drift by force that has no state."""
    runs = fly("mems", 16, 60.0, "full", settings=OWN)
    nees = runs.nees[:, runs.time > 30.0].mean(axis=(0, 1))
    assert (nees < nees_bounds(16)[1]).all()


def test_draws_are_apart_for_each_grade_and_kind():
    flown = [fly(name, 2, 1.0, kind) for name in LIMITS_DEG for kind in ("own", "full")]
    errors = np.array([runs.errors[:, 0, :3] for runs in flown]).reshape(-1, 3)
    assert len(np.unique(errors.round(2), axis=0)) == len(errors)


def test_gain_of_a_mean():
    """The good head hardly moves between fixes: after a second and 5 of them the height is the mean of 6."""
    assert fly("dtg", 2, 1.0, "own").gain[:, 0, 0] == pytest.approx(1.0 / 6.0, rel=0.02)


def test_an_outage_grows_as_it_is_said():
    runs = fly("mems", 8, 60.0, "full", (30.0, 60.0))
    rms, sigma = growth(runs)
    assert sigma[-1] > 5.0 * sigma[28]
    assert 0.4 < rms[-1] / sigma[-1] < 1.8


def test_rows_and_figures(tmp_path):
    found = run(seeds=2, settled=2.0, outage=(4.0, 6.0))
    ids = [row.id for row in found.rows]
    assert len(set(ids)) == len(ids)
    assert {f"{name}-tilt" for name in LIMITS_DEG} <= set(ids)
    assert len(write(found, tmp_path)) == 2 + len(found.plots)
    assert "aiding" in study_names()
