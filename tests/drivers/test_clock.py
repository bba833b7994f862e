"""The fit of a device's clock against simulated clocks and transports."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.clock import RESOLUTION_S, ClockFit
from hil.study.clock import TRANSPORTS, Delays, Fitted, bursts, exponential, fitted, moments

START = 1_700_000_000_000_000_000
FITTED_S = 10.0
"""From here on a fit is expected to be good."""


def steady(drift: float, delays: Delays, seconds: float = 120.0, seed: int = 7) -> Fitted:
    host = moments(seconds)
    return fitted(host, 1000.0 + host * (1.0 + drift), delays(np.random.default_rng(seed), len(host)))


@pytest.mark.parametrize("name", TRANSPORTS)
@pytest.mark.parametrize("drift", [-200e-6, 3e-6, 200e-6])
def test_the_clock_is_within_its_bound(name: str, drift: float) -> None:
    found = steady(drift, TRANSPORTS[name])
    assert found.outside() <= 0.01
    assert found.clock.steps == 0
    late = found.time > 40.0
    assert np.abs(found.drift[late] - drift).max() < 4e-6
    assert np.isfinite(found.bound[found.time > 1.5]).all()


def test_delays_that_reach_their_least_are_averaged_out() -> None:
    """The bound of a full window is far below the delays, and no wider than it need be."""
    found = steady(30e-6, exponential(300e-6))
    late = found.time > 40.0
    error, bound = np.abs(found.error[late]), found.bound[late]
    assert np.median(bound) < 300e-6 / 20
    assert np.median(error) > np.median(bound) / 200
    assert np.abs(found.drift[late] - 30e-6).max() < 0.5e-6


def test_the_error_falls_with_the_window() -> None:
    """Of points with a positive density at the line, the n-th part: four times as many cells, a quarter of the error at most."""
    errors = np.array([np.abs(steady(0.0, exponential(300e-6), 33.0, seed).error) for seed in range(30)])
    at_8_s, at_32_s = (np.median(errors[:, round(200 * t)]) for t in (8.0, 32.0))
    assert at_32_s < at_8_s / 2


def test_a_clock_without_noise_is_exact() -> None:
    drift = 123e-6
    found = steady(drift, lambda random, n: np.zeros(n), 20.0)
    late = found.time > FITTED_S
    assert np.abs(found.error[late]).max() < 10e-9
    assert found.drift[-1] == pytest.approx(drift, abs=1e-9)
    assert found.bound[-1] == pytest.approx(RESOLUTION_S, abs=20e-9)


def test_the_smallest_delay_is_not_seen() -> None:
    """It is in the offset, and the bound does not speak of it."""
    there, shifted = (
        steady(0.0, exponential(1e-4), 40.0),
        steady(0.0, lambda random, n: 5e-3 + random.exponential(1e-4, n), 40.0),
    )
    np.testing.assert_allclose(shifted.error - there.error, 5e-3, atol=1e-6)
    np.testing.assert_allclose(shifted.bound[400:], there.bound[400:], atol=1e-6)


def test_the_age_is_what_a_sample_is_late() -> None:
    found = steady(50e-6, bursts)
    assert found.age.min() >= 0.0
    late = found.time > 40.0
    delay = bursts(np.random.default_rng(7), len(found.time))
    assert np.abs(found.age - delay)[late].max() < 20e-6


@pytest.mark.parametrize("step", [-3600.0, -1.0, -2e-3, 2e-3, 1.0, 3600.0])
def test_a_step_is_counted_once_and_over_in_five_seconds(step: float) -> None:
    """Host less device: of the device's clock, or the same of the host's."""
    random, host = np.random.default_rng(3), np.arange(20_000) / 200.0
    device = host * (1.0 + 40e-6) - np.where(host > 50.0, step, 0.0)
    shift = np.where(host > 50.0, step, 0.0)
    found = fitted(host, host * (1.0 + 40e-6), random.exponential(1e-4, len(host)) + shift)  # arrivals step
    error = found.error - shift
    assert found.clock.steps == 1
    assert found.clock.step_s == pytest.approx(step, abs=5e-4)
    noticed = found.time[np.argmax(found.steps)]
    assert noticed - 50.0 < (0.3 if step < 0.0 else 4.6)
    after = found.time > noticed + 0.01
    known = after & np.isfinite(found.bound)
    assert np.mean(np.abs(error[known]) <= found.bound[known]) >= 0.99
    assert np.abs(found.drift[found.time > 75.0] - 40e-6).max() < 2e-6
    if step < 0.0:  # the same by the device's clock; one that goes back starts the fit anew instead
        assert fitted(host, device, random.exponential(1e-4, len(host))).clock.steps == 1


@pytest.mark.parametrize("change", [-200e-6, -20e-6, 20e-6, 200e-6])
def test_a_change_of_drift_is_followed_and_is_no_step(change: float) -> None:
    random, host = np.random.default_rng(3), np.arange(24_000) / 200.0
    device = host + np.maximum(host - 50.0, 0.0) * change
    found = fitted(host, device, random.exponential(1e-4, len(host)))
    assert found.clock.steps == 0
    assert np.abs(found.drift[found.time > 90.0] - change).max() < 1e-6
    beyond = np.abs(found.error) - found.bound
    assert np.max(beyond[found.time > 60.0]) <= 0.0
    assert np.max(beyond[found.time > FITTED_S]) < 1.3 * max(abs(change), 30e-6)  # what it moves in 1.3 s


def test_a_slow_change_of_drift_stays_within_the_bound() -> None:
    """A crystal that warms up: 0.01 ppm a second."""
    random, host = np.random.default_rng(3), np.arange(40_000) / 200.0
    found = fitted(host, host + 0.5e-8 * host**2, random.exponential(1e-4, len(host)))
    assert found.outside() < 0.01
    late = found.time > 40.0
    assert np.abs(found.drift - 1e-8 * found.time)[late].max() < 0.4e-6


def test_a_stall_widens_the_bound_and_does_not_move_the_line() -> None:
    host = np.arange(8000) / 200.0
    delay = np.random.default_rng(1).exponential(1e-4, len(host))
    stalled = (host >= 30.0) & (host < 33.0)
    delay[stalled] += 0.05
    found = fitted(host, host, delay)
    assert found.clock.steps == 0
    assert np.abs(found.error[found.time > FITTED_S]).max() < 20e-6
    assert found.bound[np.searchsorted(host, 32.0)] == pytest.approx(0.05, rel=0.1)
    assert found.bound[np.searchsorted(host, 34.0)] < 50e-6
    assert found.age[np.searchsorted(host, 31.0)] == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize("gap", [0.5, 20.0, 300.0])
def test_a_gap_is_crossed(gap: float) -> None:
    host = np.arange(12_000) / 200.0
    host[6000:] += gap
    found = fitted(host, host * (1.0 - 80e-6), np.random.default_rng(1).exponential(1e-4, len(host)))
    assert found.outside() <= 0.01
    assert found.clock.steps == 0
    assert found.drift[-1] == pytest.approx(-80e-6, abs=1e-6)


def test_a_device_that_starts_anew_is_fitted_anew() -> None:
    host, random = np.arange(8000) / 200.0, np.random.default_rng(1)
    found = fitted(host, np.where(host < 20.0, host + 500.0, host - 20.0), random.exponential(1e-4, len(host)))
    assert found.clock.steps == 0
    assert math.isinf(found.bound[4000])
    assert found.outside() <= 0.01
    clock = ClockFit()
    clock.update(1000.0, START)
    clock.reset()
    assert clock.update(2000.0, START + 10**12) == 0.0
    assert clock.host_ns(2001.5) == START + 10**12 + 1_500_000_000


@given(
    st.lists(
        st.tuples(st.floats(-5.0, 100.0), st.integers(-(10**11), 10**12))
        | st.tuples(st.just(0.01), st.just(10_000_000)),
        min_size=1,
        max_size=400,
    )
)
def test_whatever_comes_the_fit_says_numbers(moves: list[tuple[float, int]]) -> None:
    clock, device, arrival = ClockFit(), 0.0, START
    for elapsed, passed in moves:
        device, arrival = device + elapsed, arrival + passed
        age = clock.update(device, arrival)
        assert age >= 0.0
        assert math.isfinite(age)
        assert clock.bound_s >= 0.0
        assert math.isfinite(clock.drift)
        assert clock.host_ns(device) <= arrival + 1000, "a sample never comes before it was sent"
