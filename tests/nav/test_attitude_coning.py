"""The coning family: its coefficients derived anew, and its order on pure coning."""

import math

import numpy as np
import pytest
from numpy.polynomial import polynomial as P

from nav.attitude.coning import BLOCK, STREAM, coning_stream_turn, coning_turn, coning_uncompressed_turn
from nav.attitude.four_sample import four_sample_turn
from nav.attitude.picard import previous_increment_coefficient
from nav.attitude.signals import Coning
from nav.rotation import attitude_error


def sine_series(factor, terms):
    """Coefficients of sin(factor x) at x, x^3, x^5, ..."""
    return np.array([(-1) ** k * factor ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(terms)])


@pytest.mark.parametrize(("table", "block"), [(BLOCK, True), (STREAM, False)])
@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_coefficients_cancel_the_coning_error_to_the_highest_order(table, block, n):
    # Rate a (cos Wt, sin Wt): with x = W h, the cross product of increments p steps apart is (a/W)^2 (2 - 2 cos x) sin px,
    # and half of the double integral over a span of m steps is (a/W)^2 (mx - sin mx) / 2.
    span, terms = (n if block else 1), n
    wanted = -0.5 * sine_series(span, terms + 1)[1:]  # x^3, x^5, ...
    chord = np.array([2.0 * (-1) ** k / math.factorial(2 * k + 2) for k in range(terms)])  # 2 - 2 cos x: x^2, x^4, ...
    columns = np.column_stack([P.polymul(chord, sine_series(p, terms))[:terms] for p in range(1, n)])
    found, *_ = np.linalg.lstsq(columns[: n - 1], wanted[: n - 1], rcond=None)
    assert table[n] == pytest.approx(found, rel=1e-9)
    assert abs(columns[n - 1] @ found - wanted[n - 1]) > 1e-6  # and no higher


def linear_rate(times):
    a, b = np.array([0.4, -0.3, 0.2]), np.array([-0.7, 0.9, 1.1])
    angle = np.outer(times, a) + 0.5 * np.outer(np.square(times), b)
    return np.diff(angle, axis=0), a, b


@pytest.mark.parametrize("steps", [(1e-3, 1e-3), (1e-3, 2.3e-3), (3e-3, 1e-3)])
def test_two_samples_are_exact_for_a_linear_rate_and_unequal_steps(steps):
    times = np.cumsum([0.0, *steps])
    dtheta, a, b = linear_rate(times)
    whole = dtheta.sum(axis=0) + np.cross(a, b) * times[2] ** 3 / 12.0
    q = coning_turn(dtheta, np.array(steps), 0, 2, np.array(BLOCK[2]))
    assert 2.0 * np.array(q[1:]) == pytest.approx(whole * (1 - whole @ whole / 24), abs=1e-13)
    start = a + b * times[1]
    last = dtheta[1] + np.cross(start, b) * steps[1] ** 3 / 12.0
    q = coning_stream_turn(dtheta, np.array(steps), 0, 2, np.array(STREAM[2]))
    assert 2.0 * np.array(q[1:]) == pytest.approx(last * (1 - last @ last / 24), abs=1e-13)
    k = previous_increment_coefficient(*steps)
    assert k * np.cross(dtheta[0], dtheta[1]) == pytest.approx(np.cross(start, b) * steps[1] ** 3 / 12.0, rel=1e-9)


def drift(turn, coefficient, samples, advance, phase):
    """Drift along the cone's axis over one block or step, over that of the cone itself; `phase` rad a sample."""
    signal = Coning(1e-3, 1.0)
    times = np.arange(samples + 1) * phase / (2.0 * math.pi)
    q = np.array(turn(signal.increments(times), np.diff(times), 0, samples, coefficient))
    start, end = signal.attitude(times[[samples - advance, samples]])
    true = np.array([start @ end, *(start[0] * end[1:] - end[0] * start[1:] - np.cross(start[1:], end[1:]))])
    return abs(attitude_error(q, true)[0]) / 1e-6


@pytest.mark.parametrize("n", [1, 2, 3, 4])
@pytest.mark.parametrize(
    ("table", "turn"), [(BLOCK, coning_turn), (BLOCK, coning_uncompressed_turn), (STREAM, coning_stream_turn)]
)
def test_drift_on_pure_coning_falls_with_the_order_2n_plus_1(n, table, turn):
    advance = n if table is BLOCK else 1
    phases = (0.5, 0.25) if n < 4 else (0.8, 0.4)  # radians a sample that leave the drift well above rounding
    large, small = (drift(turn, np.array(table[n], dtype=float), n, advance, phase) for phase in phases)
    assert math.log2(large / small) == pytest.approx(2 * n + 1, abs=0.4)


def test_four_sample_coefficients_are_those_of_coning_by_distance():
    # (S1+S2)x(S3+S4) has the distances 1, 2, 2, 3 and S1xS2 + S3xS4 twice 1: the first two orders of the coning error vanish.
    sums = np.array([22 / 45 + 2 * 32 / 45, 2 * 22 / 45, 22 / 45])
    chord = np.array([2.0 * (-1) ** k / math.factorial(2 * k + 2) for k in range(3)])
    columns = np.column_stack([P.polymul(chord, sine_series(p, 3))[:3] for p in (1, 2, 3)])
    wanted = -0.5 * sine_series(4, 4)[1:]
    assert (columns @ sums)[:2] == pytest.approx(wanted[:2], rel=1e-12)
    q = four_sample_turn(np.tile([0.1, 0.0, 0.0], (4, 1)), 0, False)
    assert q == pytest.approx((math.cos(0.2), math.sin(0.2), 0.0, 0.0), abs=1e-15)
