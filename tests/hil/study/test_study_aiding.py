"""The study of aided navigation, with few runs; in full where it is slow."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from hil.study import study_names
from hil.study.aiding import LIMITS_DEG, fly, growth, nees_bounds, run
from hil.study.report import write


@pytest.mark.study
@pytest.mark.xfail(reason="not every bound of the consistency is kept yet: docs/accuracy.md, Aided navigation")
def test_every_limit_is_kept():
    assert [row for row in run().rows if not row.ok] == []


@pytest.mark.parametrize("runs", [20, 50, 100])
def test_bounds_are_those_of_chi_square(runs):
    expected = chi2.ppf([0.025, 0.975], 3 * runs) / runs
    assert nees_bounds(runs) == pytest.approx(expected, rel=1e-3)


def test_a_short_campaign_is_consistent():
    """Few runs: the mean NEES after 30 s within four sigma of its spread over runs that stay as they are."""
    runs = fly("tactical", 8, 60.0, "own")
    nees = runs.nees[:, runs.time > 30.0].mean(axis=(0, 1))
    assert (np.abs(nees - 3.0) < 4.0 * math.sqrt(6.0 / 8.0)).all()
    nis = np.concatenate(runs.nis).mean(axis=0) / 3.0
    assert nis == pytest.approx([1.0, 1.0], abs=4.0 * math.sqrt(2.0 / 3.0 / (8 * 300)))


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
