"""The study of the grades' drift, with few runs over a short time."""

import math

import numpy as np
import pytest

from hil.study import study_names
from hil.study.drift import drift, run
from hil.study.report import write
from nav.instruments.grades import GRADES


@pytest.mark.slow
def test_every_limit_is_kept():
    assert [row for row in run().rows if not row.ok] == []


@pytest.mark.parametrize("name", GRADES)
def test_runs_spread_as_the_covariance_says(name):
    seeds = 24
    free, held = drift(GRADES[name], 60.0, seeds)
    for found in (free, held):
        assert found.errors.shape == (seeds, 60, 3)
        assert found.rms(2)[-1] == pytest.approx(found.sigma(2)[-1], rel=4.0 / math.sqrt(2.0 * seeds))
        assert (np.diff(found.sigma(2)) > 0.0).all()
    assert free.consistency() == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / (3.0 * seeds)))


def test_a_held_height_errs_by_a_second_at_most():
    free, held = drift(GRADES["tactical"], 30.0, 8)
    assert np.abs(held.errors[:, :, 2]).max() < 0.1 * np.abs(free.errors[:, -1, 2]).max()
    np.testing.assert_allclose(held.errors[:, :, :2], free.errors[:, :, :2], atol=0.01)


def test_rows_and_figures(tmp_path):
    found = run(seeds=3, duration=20.0)
    ids = [row.id for row in found.rows]
    assert len(set(ids)) == len(ids)
    assert all(" " not in key for key in ids)
    parts = [row.ours for row in found.rows if row.id.startswith("budget-vertical-")]
    sigma = {row.id: row.reference for row in found.rows}
    whole = sigma["dtg-3d-end"] ** 2 - sigma["dtg-horizontal-end"] ** 2
    assert math.fsum(part**2 for part in parts) == pytest.approx(whole, rel=1e-9)
    for path in write(found, tmp_path):
        if path.name in ("drift-north.svg", "drift-down.svg"):
            assert "1 sigma" in path.read_text()
    assert "drift" in study_names()
