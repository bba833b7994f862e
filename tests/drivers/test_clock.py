"""The map of device time to host time against simulated transports."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.clock import ClockMap

START = 1_700_000_000_000_000_000


@given(st.floats(0, 4000), st.integers(0, 2**32 - 1))
def test_the_fastest_transport_is_the_map(first, seed):
    random = np.random.default_rng(seed)
    clock, device = ClockMap(), first + np.arange(3000) * 1e-3
    delays = 50e-6 + random.exponential(300e-6, 3000)
    ages = [clock.update(t, START + round((t - first + delay) * 1e9)) for t, delay in zip(device, delays, strict=True)]
    assert min(ages) >= 0.0
    best = delays[-500:].min()
    assert ages[-1] == pytest.approx(delays[-1] - best, abs=120e-6)
    mapped = clock.host_ns(float(device[-1]))
    true = START + round((device[-1] - first) * 1e9)
    assert -1000 <= mapped - true <= 1e9 * (best + 120e-6)


@pytest.mark.parametrize("drift", [-150e-6, 0.0, 150e-6])
def test_a_drifting_device_is_followed(drift):
    random = np.random.default_rng(5)
    clock = ClockMap()
    for k in range(60_000):
        host = k * 1e-2
        age = clock.update(host * (1.0 + drift), START + round((host + random.exponential(100e-6)) * 1e9))
    assert 0.0 <= age < 2e-3  # ten minutes, 90 ms of drift
    assert abs(clock.host_ns(host * (1.0 + drift)) - START - host * 1e9) < 1e6


def test_a_stall_shows_as_age_and_does_not_move_the_map():
    clock = ClockMap()
    for k in range(100):
        clock.update(k * 1e-3, START + k * 1_000_000)
    assert clock.update(0.100, START + 600_000_000) == pytest.approx(0.5, abs=1e-6)
    assert clock.host_ns(0.101) == pytest.approx(START + 101_000_000, abs=1000)


def test_reset_forgets():
    clock = ClockMap()
    assert clock.update(1000.0, START) == 0.0
    clock.reset()
    assert clock.update(0.5, START + 10**12) == 0.0
    assert clock.host_ns(1.5) == START + 10**12 + 10**9
