"""The detector of stillness against its theory: chi-square at rest, non-central in motion, and the same bits in any batches."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from nav.chi_square import quantile
from nav.errors import HilError
from nav.filter.stillness import Stillness, StillnessDetector
from nav.increments import ImuIncrements, Validity

STEP = 0.01
PLAIN = Stillness(9e-5, 1.2e-3, rate_tremor=0.0, force_tremor=0.0)
WINDOW_S = PLAIN.block_s * PLAIN.blocks
FREEDOM = 6 * (PLAIN.blocks - 1)


def samples(seconds, seed=0, motion=None, stillness=PLAIN):
    """A body whose increments have the stated white noise; `motion` (t) gives rate and force (n, 6) on top."""
    n, rng = round(seconds / STEP), np.random.default_rng(seed)
    imu = ImuIncrements.empty(n)
    imu.sequence[:] = np.arange(n)
    imu.time[:], imu.step[:] = STEP * (imu.sequence + 1), STEP
    imu.dtheta[:] = stillness.rate_white * math.sqrt(STEP) * rng.standard_normal((n, 3))
    imu.dvel[:] = stillness.force_white * math.sqrt(STEP) * rng.standard_normal((n, 3)) + [0.0, 0.0, -9.81 * STEP]
    if motion is not None:
        moved = STEP * motion(imu.time)
        imu.dtheta[:] += moved[:, :3]
        imu.dvel[:] += moved[:, 3:]
    return imu


def decisions(detector, imu):
    """(still, whole, fresh) at every decision."""
    found, at = [], 0
    while at < len(imu):
        at += detector.take(imu.rows(at, len(imu)))
        if detector.decided:
            found.append((detector.still, detector.whole, detector.fresh))
    return found


def test_the_quantile_is_that_of_chi_square():
    for freedom in (6, 54, FREEDOM):
        for probability in (0.9, 0.99, 1.0 - 1e-6):
            assert quantile(probability, freedom) == pytest.approx(stats.chi2.ppf(probability, freedom), rel=0.04)


def test_at_rest_both_statistics_are_chi_square():
    found = decisions(StillnessDetector(PLAIN), samples(2000.0))
    per_window = PLAIN.blocks // PLAIN.stride
    whole = [whole for _, whole, _ in found[per_window - 1 :: per_window]]  # windows that share no block
    fresh = [fresh for *_, fresh in found[per_window - 1 :: per_window]]
    assert stats.kstest(whole, stats.chi2(FREEDOM).cdf).pvalue > 0.01
    assert stats.kstest(fresh, stats.chi2(6).cdf).pvalue > 0.01


def test_false_alarms_are_as_rare_as_asked():
    """Of windows that share no block the share `enter` is taken for still; what is still stays so."""
    eager = replace(PLAIN, enter=0.9, leave=0.9999)
    per_window = PLAIN.blocks // PLAIN.stride
    entered = 0
    for seed in range(300):
        found = decisions(StillnessDetector(eager), samples(WINDOW_S, seed))
        assert len(found) == per_window
        entered += found[-1][0]
    assert abs(entered - 270) < 4.0 * math.sqrt(300 * 0.9 * 0.1)
    steady = decisions(StillnessDetector(PLAIN), samples(600.0, 1))[2 * per_window :]
    assert all(still for still, *_ in steady)


@pytest.mark.parametrize("amplitude", [1e-3, 1.3e-3])
def test_misses_are_as_the_non_central_chi_square_says(amplitude):
    """A rocking body, 3 Hz: what it moves by adds the sum of its squares over the variance."""
    per_window, found = PLAIN.blocks // PLAIN.stride, []

    def rocking(t):
        return np.outer(amplitude * np.sin(6.0 * math.pi * t), [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])

    found = [
        decisions(StillnessDetector(PLAIN), samples(WINDOW_S, seed, rocking))[per_window - 1][0] for seed in range(300)
    ]
    damped = amplitude * np.sinc(3.0 * PLAIN.block_s)  # of a block's mean
    shift = PLAIN.blocks * 0.5 * damped**2 / PLAIN.variance[0]
    expected = stats.ncx2.cdf(stats.chi2.ppf(PLAIN.enter, FREEDOM), FREEDOM, shift)
    assert 0.05 < expected < 0.95
    assert abs(np.mean(found) - expected) < 4.0 * math.sqrt(expected * (1.0 - expected) / 300)


def test_what_begins_to_move_is_seen_within_a_stride_and_rests_a_window_later():
    def pushed(t):
        on = (t > 3.0) & (t < 4.0)
        return on[:, None] * np.array([0.02, 0.0, 0.0, 0.0, 0.3, 0.0])

    found = decisions(StillnessDetector(PLAIN), samples(8.0, 3, pushed))
    still = np.array([one[0] for one in found])
    times = PLAIN.block_s * PLAIN.stride * np.arange(1, len(still) + 1)
    assert still[(times > WINDOW_S + 0.2) & (times < 3.05)].all()
    assert not still[(times > 3.05) & (times < 4.95)].any()
    assert still[times > 5.3].all()


def test_a_steady_turn_and_a_straight_flight_are_as_still_as_a_desk():
    """What the detector cannot know, and says of itself."""
    found = decisions(
        StillnessDetector(PLAIN), samples(10.0, 4, lambda t: np.tile([0, 0, 0.05, 0, 0.5, 0], (len(t), 1)))
    )
    assert all(still for still, *_ in found[12:])


def test_a_trembling_desk_is_still_where_the_tremor_is_stated():
    def tremor(t):
        return np.outer(np.sin(2.0 * math.pi * 7.0 * t), [1.4e-3, 7e-4, 0.0, 2e-2, 0.0, 1e-2])

    imu = samples(20.0, 5, tremor)
    assert not any(still for still, *_ in decisions(StillnessDetector(PLAIN), imu))
    stated = decisions(StillnessDetector(replace(PLAIN, rate_tremor=1e-3, force_tremor=0.015)), imu)
    assert all(still for still, *_ in stated[12:])


def test_coarse_steps_of_the_increments_are_noise_that_is_counted():
    """Increments rounded to whole steps, the remainder carried on."""
    imu, coarse = samples(60.0, 6), 2e-5
    imu.dtheta[:] = coarse * np.diff(np.rint(np.cumsum(imu.dtheta, axis=0) / coarse), axis=0, prepend=0.0)
    quiet = replace(PLAIN, rate_lsb=coarse)
    whole = [whole for _, whole, _ in decisions(StillnessDetector(quiet), imu)[10:]]
    assert 0.6 * FREEDOM < np.mean(whole) < 1.05 * FREEDOM
    unstated = [whole for _, whole, _ in decisions(StillnessDetector(PLAIN), imu)[10:]]
    assert np.mean(unstated) > 1.15 * FREEDOM


@pytest.mark.parametrize("flag", [Validity.BRIDGED, Validity.SENSOR])
def test_made_up_samples_are_no_rest(flag):
    imu = samples(6.0, 7)
    imu.validity[300] = flag
    still = np.array([one[0] for one in decisions(StillnessDetector(PLAIN), imu)])
    times = PLAIN.block_s * PLAIN.stride * np.arange(1, len(still) + 1)
    assert still[(times > 1.5) & (times < 3.05)].all()
    assert not still[(times > 3.05) & (times < 3.95)].any()
    assert still[times > 4.5].all()


@given(st.lists(st.integers(0, 600), max_size=10))
def test_batches_change_no_bit(cuts):
    imu = samples(6.0, 8, lambda t: np.outer(np.abs(t - 3.0) < 0.5, [0.01, 0, 0, 0, 0, 0]))
    imu.validity[450] = Validity.SENSOR
    split, found = StillnessDetector(PLAIN), []
    for first, last in pairwise([0, *sorted(cuts), len(imu)]):
        if last > first:
            found += decisions(split, imu.rows(first, last))
    whole = StillnessDetector(PLAIN)
    assert found == decisions(whole, imu)
    assert np.concatenate([split.mean, split.spread]).tobytes() == np.concatenate([whole.mean, whole.spread]).tobytes()


@pytest.mark.parametrize(
    "wrong",
    [
        {"rate_white": math.nan},
        {"force_tremor": -1.0},
        {"block_s": 0.0},
        {"stride": 50},
        {"enter": 0.4},
        {"leave": 0.9},
        {"rate_white": 0.0},
    ],
)
def test_what_decides_nothing_is_refused(wrong):
    with pytest.raises(HilError):
        replace(PLAIN, **wrong)
