"""The study of navigation on error-free increments."""

import math

import numpy as np
import pytest

from hil.study import study_names
from hil.study.navigation import run
from hil.study.navigation.azimuth import strip_paths, wander_azimuth
from hil.study.navigation.exactness import frame_cores
from hil.study.navigation.flights import flight, fly
from hil.study.navigation.pole import over_the_pole
from hil.study.navigation.source import gravity_lag
from nav.errors import HilError
from nav.nonholonomy import solid_angle
from nav.strapdown import MECHANIZATIONS, Strapdown


@pytest.mark.slow
def test_every_limit_is_kept():
    result = run()
    assert [row for row in result.rows if not row.ok] == []
    assert len({row.id for row in result.rows}) == len(result.rows)
    assert all(" " not in row.id for row in result.rows)


def test_azimuth_rows():
    rows, _ = wander_azimuth()
    assert [row for row in rows if not row.ok] == []
    assert {row.published for row in rows if row.id.startswith("strip")} == {2.117}


def test_over_the_pole_every_frame_closes_on_the_truth():
    rows, _ = over_the_pole()
    assert [row for row in rows if not row.ok] == []
    ours = {row.id: row.ours for row in rows}
    assert 6300.0 < ours.pop("pole-hand-over") < 6500.0  # 1e-3 of the radius of curvature
    assert {key.split("-")[1] for key in ours} == {"geographic", "wander", "inertial", "earth"}
    for frame in ("geographic", "wander", "inertial", "earth"):
        assert ours[f"pole-{frame}-high-order:4"] < 1e-2 * ours[f"pole-{frame}-two-sample"] < 1e-4


def test_agile_flight_is_agile():
    """Speed near 230 m/s, bank to 30 degrees and the shaking on top."""
    truth = flight("agile").truth(np.arange(0.0, 70.0, 0.05))
    speed = np.linalg.norm(truth["vel_n"], axis=1)
    assert 225.0 < speed.min() < speed.max() < 240.0
    w, x, y, z = truth["q_nb"].T
    roll = np.degrees(np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))
    assert 29.0 < roll.max() < 34.0
    assert -34.0 < roll.min() < -29.0


def test_mechanizations_agree_with_the_truth_on_a_short_flight():
    time, errors = fly(flight("agile"), 0.01, frame_cores(), 30.0)
    assert tuple(errors) == MECHANIZATIONS
    assert time[-1] == pytest.approx(30.0)
    assert len(time) == 60
    for name, error in errors.items():
        assert error.max() < (0.1 if name == "inertial-source" else 1e-7)


def test_the_lag_of_gravity_explains_the_first_order_of_the_source():
    time, error = fly(flight("smooth"), 0.01, {"": Strapdown(mechanization="inertial-source")}, 300.0)
    lag_time, lag = gravity_lag(flight("smooth"), 300.0)
    predicted = 0.01 * np.interp(time, lag_time, lag)
    late = time > 60.0
    np.testing.assert_allclose(error[""][late], predicted[late], rtol=0.05)


def test_strip_is_run_clockwise_on_its_left():
    planned, other = strip_paths(1e6, 1e4, 2001)
    loop = np.concatenate([other, planned[::-1]])
    assert solid_angle(*loop.T) == pytest.approx(1e10 / 6371e3**2, rel=1e-5)
    assert math.degrees(planned[0, 0]) == pytest.approx(30.0)


def test_registered():
    assert "navigation" in study_names()
    with pytest.raises(HilError, match="unknown mechanization"):
        Strapdown(mechanization="flat")
