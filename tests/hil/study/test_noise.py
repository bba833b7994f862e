"""The study of noise: what the disturbances are, and what their closed forms say of its measure."""

import math

import numpy as np
import pytest

from drivers.can.dtg_head_emulator import ANGLE_LSB, VELOCITY_LSB
from hil.study import study_names
from hil.study.noise import GRADES, METHODS, Record, _least, _theory, amplification, motion, quantised, rms, run, white


@pytest.mark.slow
def test_every_limit_is_kept():
    result = run()
    assert [row for row in result.rows if not row.ok] == []
    assert len({row.id for row in result.rows}) == len(result.rows)


def test_closed_forms_at_rest():
    rows = _theory()
    assert len(rows) == 2 * len(GRADES) + 1
    assert [row for row in rows if not row.ok] == []


def test_white_noise_is_not_amplified():
    rows, ratios = amplification("agile", 100, "white")
    assert [row for row in rows if not row.ok] == []
    assert len(ratios) == len(METHODS) - 1
    assert 0.0 < max(abs(ratio - 1.0) for ratio in ratios.values()) < 1e-3


def test_rounding_leaves_a_residue_that_does_not_grow():
    record = Record(motion("agile"), 100, 20.0)
    ((dtheta, dvel),) = record.draws(quantised, 1)
    for rounded, exact, lsb in zip((dtheta, dvel), record.exact, (ANGLE_LSB, VELOCITY_LSB["fd"]), strict=True):
        np.testing.assert_array_equal(rounded / lsb, np.rint(rounded / lsb))
        off = np.abs(np.cumsum(rounded - exact, axis=0))
        assert 0.5 * lsb < off.max() <= lsb * (1.0 + 1e-4)


def test_white_noise_has_the_density_of_its_grade():
    record = Record(motion("rest"), 100, 40.0)
    ((dtheta, _),) = record.draws(white(GRADES[0]), 1)
    noise = dtheta - record.exact[0]
    assert rms(noise) / math.sqrt(3.0 * record.step) == pytest.approx(math.radians(0.002) / 60.0, rel=0.03)


def test_least_order_needs_both_errors_within_the_share():
    left = {2: (1.0, 1e-3), 4: (0.01, 1e-3), 6: (0.01, 1e-6)}
    assert _least("k", "w", left, GRADES[0], (1.0, 1e-4)).ours == 6
    assert _least("k", "w", left, GRADES[0], (100.0, 1.0)).ours == 2
    assert math.isnan(_least("k", "w", left, GRADES[0], (0.01, 1.0)).ours)


def test_registered():
    assert "noise" in study_names()
