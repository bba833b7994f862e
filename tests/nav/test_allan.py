"""Allan deviation: the peer's, the closed forms', and the coefficients that were put in."""

import math

import allantools
import numpy as np
import pytest

from nav.errors import HilError
from nav.instruments.allan import allan
from nav.instruments.noise import Noise, NoiseModel

PERIOD = 0.01


def noise(model, n, seed=0):
    return Noise(model, PERIOD, 1, np.random.default_rng(seed)).increments(n)[:, 0]


def test_the_deviation_is_that_of_the_peer():
    values = np.random.default_rng(1).normal(0.0, 2.0, 20_000).cumsum() * 1e-3
    found = allan(values * PERIOD, PERIOD)
    tau, deviation, *_ = allantools.oadev(values, 1.0 / PERIOD, "freq", found.tau)
    np.testing.assert_allclose(found.tau, tau)
    np.testing.assert_allclose(found.deviation, deviation, rtol=1e-9)
    assert found.tau[-1] == pytest.approx(20_000 // 9 * PERIOD, rel=0.12)


@pytest.mark.parametrize(
    ("name", "size"), [("white", 3e-3), ("flicker", 2e-3), ("walk", 5e-4), ("rounding", 1e-4), ("ramp", 1e-4)]
)
def test_a_coefficient_alone_is_found_and_no_other(name, size):
    n = 200_000
    if name == "rounding":
        angle = np.random.default_rng(2).uniform(-0.5, 0.5, n + 1) * math.sqrt(12.0) * size
        increments = np.diff(angle)
    elif name == "ramp":
        increments = size * (np.arange(n) + 0.5) * PERIOD * PERIOD
    else:
        increments = noise(NoiseModel(**{name: size}), n)
    found = allan(increments, PERIOD)
    assert getattr(found, name) == pytest.approx(size, rel=0.12)
    curve = found.curve(found.tau)
    share = np.median(np.abs(np.log(curve / found.deviation)))
    assert share < 0.1


def test_all_of_a_sensor_together():
    model = NoiseModel(white=1e-3, flicker=8e-4, walk=5e-5)
    found = allan(noise(model, 2_000_000, 3), PERIOD)
    assert found.white == pytest.approx(model.white, rel=0.02)
    assert found.flicker == pytest.approx(model.flicker, rel=0.25)
    assert found.rounding < 0.02 * model.white


def test_a_record_that_stands_still_shows_nothing():
    found = allan(np.full(1000, 3.0), PERIOD)
    assert (found.rounding, found.white, found.flicker, found.walk, found.ramp) == (0.0,) * 5


@pytest.mark.parametrize("wrong", [np.zeros(10), np.full(100, math.nan)])
def test_what_tells_nothing_is_refused(wrong):
    with pytest.raises(HilError, match="Allan"):
        allan(wrong, PERIOD)
