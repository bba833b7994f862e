"""Steady gains of the tracking correction: their closed forms, the Riccati equation, and that none are better."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, solve_discrete_are

from nav.errors import HilError
from nav.filter.tracking_gains import Gains, Noise, steady

G, A = 9.80665, 6378137.0
TACTICAL = Noise(1.5e-5, 7e-6, 5e-4, 1e-2, (1.5, 2.5), (0.05, 0.08), 1.3e-3, 1.3e-3, 0.2)
SURE = 1e-12
"""A sigma of nothing."""
spans = st.floats(-1.0, 1.0)


@settings(max_examples=40)
@given(spans, spans, spans)
def test_the_azimuth_has_its_closed_form(a, b, c):
    """K^3 r T = 2 d^2 + q K."""
    drift, white, sigma = 5e-6 * 10**a, 1e-5 * 10**b, 1e-3 * 10**c
    noise = replace(TACTICAL, gyro_drift=drift, gyro_white=white, heading=sigma, period=0.05)
    gain = steady(noise).azimuth / noise.period
    unit = sigma**2 * noise.period
    roots = np.roots([unit, 0.0, -(white**2), -2.0 * drift**2])
    expected = max(root.real for root in roots if abs(root.imag) < 1e-9 * abs(root))
    if expected * noise.period < 0.02:  # continuous time
        assert gain == pytest.approx(expected, rel=1.5 * expected * noise.period + 1e-3)


def test_without_drift_and_bias_they_are_those_of_the_riccati_equation():
    noise = replace(TACTICAL, gyro_drift=SURE, accelerometer_bias=SURE)
    found, t = steady(noise), noise.period
    phi = expm(t * np.array([[0.0, 1.0, 0.0], [0.0, 0.0, G], [0.0, -1.0 / A, 0.0]]))
    q = t * np.diag([0.0, noise.accelerometer_white**2, noise.gyro_white**2])
    r = np.diag([noise.place[0] ** 2, noise.velocity[0] ** 2, noise.tilt**2])
    p = solve_discrete_are(phi.T, np.eye(3), q, r)
    gain = p @ np.linalg.inv(p + r)
    # Fix, then tilt: the tilt that is compared has been corrected by the fix.
    first, second = found.level_fix, found.level_tilt
    both = np.column_stack([first - np.outer(second, first[2]), second])
    np.testing.assert_allclose(both, gain, rtol=1e-3, atol=1e-9)


def _spread(level_fix, level_tilt, noise, seed):
    """Rms of place, velocity, tilt of a level axis under the gains, over many runs with drift and bias of their own."""
    rng, runs, t = np.random.default_rng(seed), 400, noise.period
    bias, drift = noise.accelerometer_bias * rng.standard_normal(runs), noise.gyro_drift * rng.standard_normal(runs)
    p, v, phi = np.zeros((3, runs))
    squares = np.zeros(3)
    for k in range(2000):
        force = G * phi + bias + noise.accelerometer_white / math.sqrt(t) * rng.standard_normal(runs)
        p, v = p + v * t + 0.5 * force * t * t, v + force * t
        phi = phi + (drift - v / A) * t + noise.gyro_white * math.sqrt(t) * rng.standard_normal(runs)
        seen = [p + noise.place[0] * rng.standard_normal(runs), v + noise.velocity[0] * rng.standard_normal(runs)]
        p, v, phi = np.stack([p, v, phi]) - level_fix @ seen
        p, v, phi = np.stack([p, v, phi]) - np.outer(level_tilt, phi + noise.tilt * rng.standard_normal(runs))
        if k >= 1000:
            squares += [np.mean(p**2), np.mean(v**2), np.mean(phi**2)]
    return np.sqrt(squares / 1000)


@pytest.mark.parametrize("constant", [5.0, 10.0, 20.0, 40.0])
def test_no_fixed_gains_are_better(constant):
    """The same draws under both: every part errs less with the steady gains."""
    found, fixed = steady(TACTICAL), Gains(constant, constant, constant, constant)
    best = _spread(found.level_fix, found.level_tilt, TACTICAL, 3)
    other = _spread(fixed.fix(TACTICAL.period)[0], fixed.attitude(TACTICAL.period)[0], TACTICAL, 3)
    assert (best < 1.02 * other).all()
    assert (best < 0.9 * other).any()


def test_refusals():
    with pytest.raises(HilError, match="finite and positive"):
        replace(TACTICAL, tilt=math.nan)
    with pytest.raises(HilError, match="finite and positive"):
        replace(TACTICAL, period=0.0)
