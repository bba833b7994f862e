"""Random processes: the Allan deviation, by an independent package, returns what was put in."""

import math

import allantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nav.errors import HilError
from nav.instruments.noise import Noise, NoiseModel

STEP, CHANNELS, COUNT = 0.01, 8, 150_000
TIMES = np.array([0.1, 0.5, 2.0, 8.0])


def deviation(model, count=COUNT, times=TIMES, seed=3):
    rate = Noise(model, STEP, CHANNELS, np.random.default_rng(seed)).increments(count) / STEP
    found = [allantools.oadev(column, rate=1 / STEP, data_type="freq", taus=times)[1] for column in rate.T]
    return np.sqrt(np.mean(np.square(found), axis=0))


@pytest.mark.parametrize(
    ("model", "expected", "tolerance"),
    [
        (NoiseModel(white=2e-3), 2e-3 / np.sqrt(TIMES), 0.04),
        (NoiseModel(flicker=5.0), np.full(4, 5.0 * math.sqrt(2 * math.log(2) / math.pi)), 0.05),
        (NoiseModel(walk=0.3), 0.3 * np.sqrt(TIMES / 3), 0.06),
        (NoiseModel(ramp=-0.02), 0.02 * TIMES / math.sqrt(2), 1e-9),
    ],
    ids=["white", "flicker", "walk", "ramp"],
)
def test_allan_deviation_is_what_was_put_in(model, expected, tolerance):
    np.testing.assert_allclose(deviation(model), expected, rtol=tolerance)


def test_processes_add_up():
    model = NoiseModel(white=1e-2, flicker=2e-2, walk=3e-2)
    expected = np.sqrt(1e-4 / TIMES + 4e-4 * 2 * math.log(2) / math.pi + 9e-4 * TIMES / 3)
    np.testing.assert_allclose(deviation(model), expected, rtol=0.06)


def test_flicker_is_stationary_from_the_first_sample():
    """No start-up: the spread over channels is the same early and late."""
    rate = Noise(NoiseModel(flicker=1.0), STEP, 4000, np.random.default_rng(1)).increments(400)
    assert rate[-1].std() == pytest.approx(rate[0].std(), rel=0.05)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 50), max_size=5).map(sorted))
def test_chunks_do_not_matter(splits):
    model = NoiseModel(white=1.0, flicker=0.3, walk=0.1, ramp=0.01)

    def stream(cuts):
        noise = Noise(model, STEP, 3, np.random.default_rng(7))
        return np.concatenate([noise.increments(b - a) for a, b in zip([0, *cuts], [*cuts, 50], strict=True)])

    np.testing.assert_array_equal(stream(splits), stream([]))


def test_seeds_and_channels_are_independent():
    one = Noise(NoiseModel(white=1.0), STEP, 2, np.random.default_rng(1)).increments(20_000)
    other = Noise(NoiseModel(white=1.0), STEP, 2, np.random.default_rng(2)).increments(20_000)
    correlation = np.corrcoef(np.hstack([one, other]).T) - np.eye(4)
    assert np.abs(correlation).max() < 0.04
    assert np.abs(Noise(NoiseModel(), STEP, 2, np.random.default_rng(1)).increments(10)).max() == 0.0


def test_wrong_coefficients_are_refused():
    with pytest.raises(HilError, match="flicker"):
        NoiseModel(flicker=-1.0)
    with pytest.raises(HilError, match="ramp"):
        NoiseModel(ramp=math.nan)
    with pytest.raises(HilError, match="step"):
        Noise(NoiseModel(), 0.0, 1, np.random.default_rng(1))
