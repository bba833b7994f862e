"""Every attitude method through the one interface: order, block ends and rows between, streams, refusals."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nav.attitude import NAMES, method
from nav.attitude.euler_vector import bortz_coefficient, euler_vector_step
from nav.attitude.poisson import poisson_step
from nav.attitude.signals import Precession, Swinging
from nav.errors import HilError
from nav.rotation import attitude_error
from nav.turn import orthonormalise

EVERY = (
    "poisson-rk4",
    "euler-vector-rk4",
    "picard3",
    "picard3-source",
    "four-sample",
    "four-sample-series",
    *(f"{family}:{n}" for family in ("coning", "coning-uncompressed", "coning-stream") for n in range(1, 6)),
    *(f"{family}:{n}" for family in ("high-order", "high-order-stream") for n in (1, 2, 3, 4, 6, 10)),
)
MOTION = Swinging()


PATTERN = np.array([0.1, 1.0, -0.8, 0.5, -0.6])


def edges(count, duration, unequal=0.0):
    steps = 1.0 + unequal * np.resize(PATTERN, count)
    times = np.concatenate([[0.0], np.cumsum(steps)])
    return times * (duration / times[-1])


def solve(name, times, signal=MOTION):
    return method(name).integrate(signal.attitude(0.0), np.diff(times), signal.increments(times))


def error(q, times, signal=MOTION):
    return np.linalg.norm(attitude_error(q, signal.attitude(times[1:])), axis=1)


def slope(largest_error, counts):
    return np.polyfit(-np.log(counts), np.log([largest_error(n) for n in counts]), 1)[0]


def order(name, counts, variation):
    chosen = method(name)

    def largest(n):
        times = edges(n, 3.0, variation)
        q = chosen.block_ends(MOTION.attitude(0.0), np.diff(times), MOTION.increments(times))
        return error(q, times[:: chosen.block]).max()

    return slope(largest, np.array(counts))


@pytest.mark.parametrize(
    ("name", "equal", "unequal"),
    [
        ("poisson-rk4", 4, 4),
        ("euler-vector-rk4", 4, 4),
        ("picard3", 3, 3),
        ("picard3-source", 3, 2),
        ("four-sample", 4, 2),
        ("four-sample-series", 4, 2),
        ("coning:1", 2, 2),
        ("coning:2", 4, 3),
        ("coning:3", 3, 2),
        ("coning:4", 3, 2),
        ("coning:5", 3, 2),
        ("coning-uncompressed:2", 4, 3),
        ("coning-uncompressed:3", 4, 2),
        ("coning-uncompressed:4", 4, 2),
        ("coning-uncompressed:5", 4, 2),
        ("coning-stream:1", 2, 2),
        ("coning-stream:2", 3, 3),
        ("coning-stream:3", 3, 2),
        ("coning-stream:4", 3, 2),
        ("coning-stream:5", 3, 2),
        ("high-order:1", 2, 2),
        ("high-order:2", 4, 3),
        ("high-order:3", 4, 4),
        ("high-order:4", 6, 5),
        ("high-order:5", 6, 6),
        ("high-order:6", 8, 7),
        ("high-order-stream:2", 3, 3),
        ("high-order-stream:3", 4, 4),
        ("high-order-stream:4", 5, 5),
        ("high-order-stream:5", 6, 6),
    ],
)
def test_order_of_the_attitude_error(name, equal, unequal):
    counts = [720, 1440] if equal < 5 else [240, 480] if equal < 8 else [120, 240]
    assert order(name, counts, 0.0) == pytest.approx(equal, abs=0.25)
    # What asymmetry costs shows in short steps only: until then the slope lies between the two orders.
    assert unequal - 0.25 < order(name, counts, 0.4) < equal + 0.5


@pytest.mark.parametrize("name", ["picard3-source", "four-sample", "coning-uncompressed:3", "coning-stream:3"])
def test_methods_for_equal_steps_lose_their_order_in_unequal_ones(name):
    assert order(name, [2880, 5760], 0.4) == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("name", ["poisson-rk4", "euler-vector-rk4"])
@pytest.mark.parametrize("variation", [0.0, 0.4])
def test_order_with_sampled_rates(name, variation):
    def largest(n):
        t = edges(n, 3.0, variation)
        return error(method(name).integrate_rates(MOTION.attitude(0.0), np.diff(t), MOTION.rate(t)), t).max()

    assert slope(largest, [480, 960]) == pytest.approx(4, abs=0.2)


@pytest.mark.parametrize("name", EVERY)
def test_a_constant_rate_is_exact_or_to_the_order_of_the_series(name):
    rate, n = np.array([0.3, -0.5, 0.2]), 60
    q0 = MOTION.attitude(0.0)
    steps = np.full(n, 0.01)
    q = method(name).integrate(q0, steps, np.outer(steps, rate))
    expected = Rotation.from_quat(q0, scalar_first=True) * Rotation.from_rotvec(np.outer(np.cumsum(steps), rate))
    turned = (expected.inv() * Rotation.from_quat(q, scalar_first=True)).magnitude().max()
    series = name.startswith(("poisson", "euler", "picard")) or name == "four-sample-series"
    assert turned < (1e-9 if series else 1e-14)
    assert np.linalg.norm(q, axis=1) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("name", EVERY)
@settings(max_examples=15)
@given(cuts=st.lists(st.integers(0, 47), max_size=8), gaps=st.lists(st.integers(0, 46), max_size=3))
def test_a_stream_is_the_same_however_it_is_split(name, cuts, gaps):
    times = edges(47, 0.5, 0.3)
    steps, dtheta = np.diff(times), MOTION.increments(times)
    steps[gaps] = 0.0
    chosen, q0 = method(name), MOTION.attitude(0.0)
    whole, parts = np.empty((47, 4)), np.empty((47, 4))
    chosen.stream(q0).push(steps, dtheta, whole)
    stream = chosen.stream(q0)
    places = sorted({0, 47, *cuts})
    for a, b in pairwise(places):
        stream.push(steps[a:b], dtheta[a:b], parts[a:b])
    assert np.array_equal(whole, parts)

    batch = chosen.integrate(q0, steps, dtheta)
    sample = np.cumsum(steps > 0.0)
    at_end = (sample % chosen.block == 0) & (sample >= chosen.window)
    assert np.array_equal(batch[at_end], whole[at_end])
    assert np.array_equal(batch[-1], whole[-1])
    still = np.flatnonzero(steps == 0.0)
    for k in still[still > 0]:
        assert np.array_equal(batch[k], batch[k - 1])
        assert np.array_equal(whole[k], whole[k - 1])


@pytest.mark.parametrize("name", [n for n in EVERY if method(n).block > 1])
def test_block_ends_are_rows_and_rows_between_are_as_good(name):
    times = edges(121, 1.0)
    chosen = method(name)
    rows = solve(name, times)
    ends = chosen.block_ends(MOTION.attitude(0.0), np.diff(times), MOTION.increments(times))
    assert np.array_equal(ends, rows[chosen.block - 1 :: chosen.block])
    off = error(rows, times)
    tail = 121 // chosen.block * chosen.block
    assert off[:tail].max() <= 1.5 * off[chosen.block - 1 : tail : chosen.block].max() + 1e-8
    assert off[tail:].max(initial=0.0) < 1e-2 if chosen.window == 2 else 1e-5


@pytest.mark.parametrize("name", ["poisson-rk4", "euler-vector-rk4", "high-order:4", "high-order-stream:4"])
def test_provisional_rows_of_a_stream_are_good(name):
    times = edges(240, 1.0)
    out = np.empty((240, 4))
    method(name).stream(MOTION.attitude(0.0)).push(np.diff(times), MOTION.increments(times), out)
    assert error(out, times)[4:].max() < 1e-8


def test_a_few_samples_or_none():
    times = edges(3, 0.01)
    for name in EVERY:
        assert method(name).integrate(MOTION.attitude(0.0), np.zeros(0), np.zeros((0, 3))).shape == (0, 4)
        assert error(solve(name, times), times).max() < 1e-3
    for count in (1, 2, 3):
        t = edges(count, 1e-3 * count)
        q = method("poisson-rk4").integrate_rates(MOTION.attitude(0.0), np.diff(t), MOTION.rate(t))
        assert error(q, t).max() < 1e-7


def test_euler_vector_is_folded_and_passes_the_whole_turn():
    spin = Precession(0.0, 2.0 * math.pi, 0.3)
    times = edges(2000, 5.0)
    assert error(solve("euler-vector-rk4", times, spin), times, spin).max() < 1e-8
    phi, rates = np.array([0.0, 0.0, math.pi - 1e-3]), np.tile([0.0, 0.0, 2.0], (3, 1))
    euler_vector_step(phi, rates, 1e-3)
    assert phi == pytest.approx([0.0, 0.0, -math.pi + 1e-3], abs=1e-14)


def test_bortz_coefficient_is_smooth_where_its_series_ends():
    below, above = bortz_coefficient(np.nextafter(0.05, 0.0)), bortz_coefficient(0.05)
    assert below == pytest.approx(above, rel=2e-14)
    assert bortz_coefficient(math.pi**2) == pytest.approx(1.0 / math.pi**2, rel=1e-15)


def test_poisson_keeps_the_matrix_orthonormal():
    c = np.eye(3)
    for k in range(200):
        poisson_step(c, MOTION.rate([0.05 * k, 0.05 * k + 0.025, 0.05 * k + 0.05]), 0.05)
    assert c @ c.T == pytest.approx(np.eye(3), abs=1e-9)
    skewed = Rotation.from_rotvec([0.3, 0.2, 0.9]).as_matrix() + 1e-6 * np.arange(9.0).reshape(3, 3)
    orthonormalise(skewed)
    assert skewed @ skewed.T == pytest.approx(np.eye(3), abs=1e-9)


def test_the_sign_of_the_rows_does_not_jump():
    times = edges(4000, 10.0)
    for name in ("poisson-rk4", "euler-vector-rk4", "high-order"):
        q = solve(name, times, Precession(3.0, 5.0, 0.8))
        assert (np.einsum("ij,ij->i", q[1:], q[:-1]) > 0.9).all()


def test_names():
    assert method("two-sample").name == "coning-stream:2"
    assert method("high-order").name == "high-order:4"
    assert method("high-order-stream").block == 1
    assert method("poisson-rk4").needs == "rates"
    assert {method(name).name for name in EVERY} == set(EVERY)
    with pytest.raises(HilError) as refused:
        method("euler")
    assert all(name in str(refused.value) for name in NAMES)
    for wrong in ("coning", "coning:6", "coning:0", "high-order:x", "high-order:11", "coning:-1"):
        with pytest.raises(HilError, match="N from 1 to"):
            method(wrong)


def test_wrong_calls_are_refused():
    q0 = np.array([1.0, 0.0, 0.0, 0.0])
    with pytest.raises(HilError, match=r"dtheta: shape \(4, 3\) where \(3, 3\)"):
        method("picard3").integrate(q0, np.ones(3), np.ones((4, 3)))
    with pytest.raises(HilError, match="takes increments"):
        method("picard3").integrate_rates(q0, np.ones(3), np.ones((4, 3)))
    with pytest.raises(HilError, match=r"rate: shape \(3, 3\) where \(4, 3\)"):
        method("poisson-rk4").integrate_rates(q0, np.ones(3), np.ones((3, 3)))
    for step in 0.0, math.inf:
        with pytest.raises(HilError, match="positive"):
            method("poisson-rk4").integrate_rates(q0, np.full(3, step), np.ones((4, 3)))
    with pytest.raises(HilError, match="rate: row 2 is not a number"):
        method("poisson-rk4").integrate_rates(
            q0, np.ones(3), np.array([[0, 0, 0], [0, 0, 0], [0, math.nan, 0], [0, 0, 0]])
        )
    with pytest.raises(HilError, match="no rotation"):
        method("picard3").stream(np.zeros(4))


@pytest.mark.parametrize("name", EVERY)
def test_no_stream_reads_or_writes_beyond_its_arrays_or_takes_what_is_no_number(name):
    times = 0.01 * np.arange(31)
    step, dtheta = np.diff(times), MOTION.increments(times)
    chosen, room = method(name), np.zeros((30, 4))
    stream, wrong = chosen.stream(MOTION.attitude(0.0)), dtheta.copy()
    wrong[7, 2] = math.nan
    for arrays, say in (
        ((step, dtheta[:3], room), r"got \(30,\), \(3, 3\)"),
        ((step, np.ascontiguousarray(dtheta[:, :2]), room), r"got \(30,\), \(30, 2\)"),
        ((step, dtheta, room[:3]), r"and \(3, 4\)"),
        ((step, wrong, room), "sample 7 is not a number"),
    ):
        with pytest.raises(HilError, match=say):
            stream.push(*arrays)
    with pytest.raises(HilError, match="sample 7 is not a number"):
        chosen.integrate(MOTION.attitude(0.0), step, wrong)
    stream.push(step, dtheta, room)  # and nothing has changed
    again = np.empty((30, 4))
    chosen.stream(3.0 * MOTION.attitude(0.0)).push(step, dtheta, again)
    np.testing.assert_allclose(room, again, atol=1e-15)
    with pytest.raises(HilError, match="too large"):
        stream.push(step, np.full((30, 3), 1e200), room)
