"""The high-order method: its polynomial, its goals on coning, its gain on precession."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from nav.attitude import method
from nav.attitude.high_order import MAX_SAMPLES, fit_rate, node, rate_at, turns, work_array
from nav.attitude.signals import Coning, Precession, Swinging
from nav.rotation import attitude_error

TEN = math.radians(10.0)


@settings(max_examples=40)
@given(
    m=st.integers(1, MAX_SAMPLES),
    first=st.integers(0, MAX_SAMPLES - 1),
    lengths=st.lists(st.floats(0.7, 1.4), min_size=MAX_SAMPLES + 2, max_size=MAX_SAMPLES + 2),
    seed=st.integers(0, 1000),
)
def test_the_fit_returns_the_polynomial_whose_increments_it_was_given(m, first, lengths, seed):
    first = min(first, m - 1)
    steps = 0.01 * np.array(lengths)
    begin = 1
    end = begin + m
    ends = np.concatenate([[0.0], np.cumsum(steps[begin:end])])
    middle, half = 0.5 * (ends[first] + ends[m]), 0.5 * (ends[m] - ends[first])
    coefficients = np.random.default_rng(seed).uniform(-1.0, 1.0, (m, 3)) * (half / ends[-1]) ** np.arange(m)[:, None]
    rate = np.polynomial.Polynomial
    tau = (ends - middle) / half
    dtheta = np.full((len(steps), 3), np.nan)
    for c in range(3):
        dtheta[begin:end, c] = np.diff(rate(coefficients[:, c]).integ()(tau))
    work = work_array()
    fit_rate(dtheta, steps, begin, end, begin + first, work)
    assert [node(i, work) for i in range(m + 1)] == pytest.approx(tau, abs=1e-13)
    for x in np.linspace(-1.0, 1.0, 5):
        assert rate_at(m, x, work) == pytest.approx([rate(coefficients[:, c])(x) for c in range(3)], abs=1e-9)


def test_turns_solve_the_quaternion_equation_of_their_polynomial():
    dtheta = np.random.default_rng(3).uniform(-0.3, 0.3, (5, 3))
    steps = np.array([0.1, 0.13, 0.08, 0.11, 0.1])
    work, out = work_array(), np.empty((4, 4))
    turns(dtheta, steps, 0, 5, 1, True, work, out)

    def slope(tau, q):
        x, y, z = rate_at(5, tau, work)
        return 0.5 * np.array(
            [
                -q[1] * x - q[2] * y - q[3] * z,
                q[0] * x + q[2] * z - q[3] * y,
                q[0] * y + q[3] * x - q[1] * z,
                q[0] * z + q[1] * y - q[2] * x,
            ]
        )

    places = [node(i, work) for i in range(2, 6)]
    exact = solve_ivp(slope, (-1.0, 1.0), [1.0, 0, 0, 0], "DOP853", places, rtol=1e-13, atol=1e-14, max_step=0.01).y.T
    assert out == pytest.approx(exact, abs=1e-12)
    alone = np.empty((4, 4))
    turns(dtheta, steps, 0, 5, 1, False, work, alone)
    assert np.array_equal(alone[3], out[3])


@pytest.mark.parametrize("angle", [1e-8, 1e-3, 1.0, 6.0])
def test_a_constant_rate_is_exact_up_to_a_whole_turn_a_block(angle):
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    out = np.empty((4, 4))
    turns(np.tile(0.25 * angle * axis, (4, 1)), np.ones(4), 0, 4, 0, True, work_array(), out)
    for i in range(4):
        half = 0.125 * angle * (i + 1)
        assert out[i] == pytest.approx([math.cos(half), *(math.sin(half) * axis)], abs=1e-14)


@pytest.mark.parametrize(
    ("samples", "frequency", "rate_hz", "duration", "goal"),
    [
        (4, 10.0, 1000.0, 10.0, 2e-8),
        (6, 10.0, 1000.0, 10.0, 1e-10),
        (8, 10.0, 1000.0, 10.0, 1e-10),
        (4, 2.0, 400.0, 6.0, 1e-9),
        (8, 15.0, 800.0, 6.0, 1e-9),
    ],
)
def test_coning_of_ten_degrees(samples, frequency, rate_hz, duration, goal):
    signal = Coning(TEN, frequency)
    times = np.arange(round(duration * rate_hz) + 1) / rate_hz
    q = method(f"high-order:{samples}").integrate(signal.attitude(0.0), np.diff(times), signal.increments(times))
    assert np.linalg.norm(attitude_error(q, signal.attitude(times[1:])), axis=1).max() <= goal


def test_precession_is_at_least_a_hundred_times_better_than_four_sample():
    signal = Precession(2.0 * math.pi, 2.0 * math.pi, math.pi / 3.0)
    times = np.arange(81) / 160.0
    largest = {}
    for name in ("four-sample", "high-order"):
        q = method(name).integrate(signal.attitude(0.0), np.diff(times), signal.increments(times))
        largest[name] = np.linalg.norm(attitude_error(q, signal.attitude(times[1:])), axis=1)[3::4].max()
    assert largest["high-order"] * 100.0 <= largest["four-sample"]


def test_every_sample_more_than_halves_the_error():
    signal, times = Swinging(), np.arange(121) / 60.0
    largest = []
    for n in range(2, 9):
        q = method(f"high-order-stream:{n}").integrate(signal.attitude(0.0), np.diff(times), signal.increments(times))
        largest.append(np.abs(attitude_error(q, signal.attitude(times[1:]))).max())
    assert all(b < 0.5 * a for a, b in pairwise(largest))


@pytest.mark.parametrize("signal", [Coning(0.3, 2.0), Precession(3.0, -5.0, 1.1), Swinging()])
def test_signals_are_consistent(signal):
    """The rate is that of the attitude, and the increments integrate the rate."""
    times, h = np.linspace(0.1, 2.0, 7), 1e-3
    offsets = np.arange(-4, 5)
    weights = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
    q = signal.attitude(times)
    change = np.tensordot(weights, [signal.attitude(times + k * h) for k in offsets], 1) / h
    rate = 2.0 * (
        q[:, :1] * change[:, 1:] - change[:, :1] * q[:, 1:] - np.cross(q[:, 1:], change[:, 1:])
    )  # 2 conj(q) q'
    assert rate == pytest.approx(signal.rate(times), abs=1e-10)
    assert np.linalg.norm(q, axis=1) == pytest.approx(1.0, abs=1e-15)
    nodes, scale = np.polynomial.legendre.leggauss(40)
    edges = np.array([0.2, 0.25, 0.4])
    for k in range(2):
        middle, half = 0.5 * (edges[k] + edges[k + 1]), 0.5 * (edges[k + 1] - edges[k])
        assert signal.increments(edges)[k] == pytest.approx(
            half * scale @ signal.rate(middle + half * nodes), abs=1e-15
        )
