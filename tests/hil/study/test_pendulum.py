"""The study of pendulum accelerometers."""

import math

import numpy as np
import pytest

from hil.study import study_names
from hil.study.pendulum import (
    SKEW,
    errors,
    lever_block,
    rolling_turn,
    run,
    scattered_block,
    turn,
    vibration,
    vibropendulous,
)


@pytest.fixture(scope="module")
def result():
    return run()


def test_every_limit_is_kept(result):
    assert [row for row in result.rows if not row.ok] == []
    assert len({row.id for row in result.rows}) == len(result.rows)
    assert all(" " not in row.id for row in result.rows)


@pytest.mark.parametrize(("id", "published"), [("turn", 7.5), ("vibration-300", 5.4), ("vibration-50hz", 5.9)])
def test_published_figures(result, id, published):
    rows = {row.id: row for row in result.rows}
    assert rows[f"{id}-raw"].published == published
    assert rows[f"{id}-raw"].ours == pytest.approx(published, rel=0.01)
    assert rows[f"{id}-compensated"].ours < 0.1


def test_raw_error_grows_as_the_square_of_time():
    time, raw, _ = errors(lever_block(), turn, 1000, dynamics=False)
    after = time > 0.5
    np.testing.assert_allclose(np.abs(raw[after, 0]), 0.15 * 0.01 * time[after] ** 2 / 2.0, rtol=0.01)


def test_rolling_turn_rates_are_those_of_its_attitude():
    """Zero turn about the body's velocity but roll; the vertical rate is g tan(bank) / V."""
    time = np.linspace(-0.5, 4.0, 4501)
    force, rate = rolling_turn(time)
    bank = np.cumsum(rate[:, 0]) * (time[1] - time[0])
    np.testing.assert_allclose(rate[:, 1] * np.cos(bank), rate[:, 2] * np.sin(bank), atol=2e-4)
    np.testing.assert_allclose(np.hypot(rate[:, 1], rate[:, 2]), 9.81 / 100.0 * np.tan(bank), atol=2e-4)
    assert bank[-1] == pytest.approx(math.pi / 4.0, abs=1e-3)
    assert np.abs(force[:, :2]).max() == 0.0


def test_deflections_leave_what_the_closed_form_says():
    block, pulsation = scattered_block(), 2.0 * math.pi * 80.0
    clean = errors(block, vibration(pulsation), 4000, dynamics=True)[2][-1]
    np.testing.assert_allclose(clean, vibropendulous(block, pulsation, SKEW), rtol=0.05, atol=2e-5)


def test_registered():
    assert "pendulum" in study_names()
