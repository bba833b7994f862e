"""Four axes for three rates: least squares, parity, and the tests that name a failed axis in time and cry no wolf."""

import math
from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nav.instruments.redundancy import (
    AXES,
    GYRO_AXES,
    Fault,
    Limits,
    combination,
    examine,
    fresh_memory,
    layout,
    parity_vector,
)

STEP = 1e-3
ARW = math.radians(0.002) / 60.0
"""0.002 deg/sqrt(h), rad/sqrt(s)."""
VRW = 5e-6 * 9.80665
LIMITS = Limits(ARW, VRW, 5e-5, 2.5e-5, 2.0, 200.0)
SKEW = math.radians(45.0)


def head(skew, seconds, seed=1, roll=0.3):
    """Increments of a shaking, turning, healthy head: times, steps, gyros (n, 4), accelerometers (n, 3)."""
    rng = np.random.default_rng(seed)
    n = round(seconds / STEP)
    time = STEP * np.arange(1, n + 1)
    rate = np.stack(
        [0.3 * np.sin(6.0 * time), 0.1 * np.sin(0.2 * time) + 0.02 * np.sin(300.0 * time), 0.1 + 0 * time], 1
    )
    force = np.stack([2.0 * np.sin(3.0 * time), 0.5 * np.sin(200.0 * time), -9.8 + np.sin(time)], axis=1)
    scale = 1.0 + 5e-5 * rng.standard_normal(4)
    gyro = STEP * (rate @ layout(skew).T) * scale + ARW * math.sqrt(STEP) * rng.standard_normal((n, 4))
    return time, np.full(n, STEP), gyro, STEP * force + VRW * math.sqrt(STEP) * rng.standard_normal((n, 3))


def examined(skew, data, limits=LIMITS):
    """(time, axis, fault) of every change, and the faults at the end."""
    time, step, gyro, accelerometer = data
    memory, faults, parity = fresh_memory(), np.zeros(7, np.int64), parity_vector(layout(skew))
    residual, found, at = np.zeros(len(time)), [], 0
    values = astuple(limits)
    while at < len(time):
        before = faults.copy()
        rest = time[at:], step[at:], gyro[at:], gyro[at:], accelerometer[at:]
        at += examine(memory, faults, *rest, parity, values, skew == 0.0, residual[at:])
        found += [(time[at - 1], AXES[k], Fault(int(faults[k]))) for k in np.flatnonzero(faults != before)]
    return found, faults


@given(st.floats(-math.pi, math.pi), st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.integers(0, 2**32 - 1))
def test_least_squares_takes_the_motion_out_and_back(skew, rate, seed):
    h, weights = layout(skew), np.random.default_rng(seed).uniform(0.1, 10.0, 4)
    inverse, parity = combination(h, weights), parity_vector(h)
    assert inverse is not None
    np.testing.assert_allclose(inverse @ h, np.eye(3), atol=1e-12)
    assert abs(parity @ h @ rate) < 1e-12
    assert np.linalg.norm(parity) == pytest.approx(1.0)


def test_the_pair_is_averaged_by_its_variances():
    inverse = combination(layout(0.0), np.array([1.0, 4.0, 1.0, 1.0]))
    np.testing.assert_allclose(inverse, [[1, 0, 0, 0], [0, 0.8, 0.2, 0], [0, 0, 0, 1]], atol=1e-15)


@pytest.mark.parametrize("lost", range(4))
def test_what_a_lost_axis_costs(lost):
    """Orthogonal: one of the y pair may go, x and z may not. Skewed: any one may go."""
    weights = np.ones(4)
    weights[lost] = 0.0
    assert (combination(layout(0.0), weights) is not None) == (GYRO_AXES[lost] in ("g1y", "g2y"))
    inverse = combination(layout(SKEW), weights)
    np.testing.assert_allclose(inverse @ layout(SKEW), np.eye(3), atol=1e-12)
    assert not inverse[:, lost].any()


@pytest.mark.parametrize("skew", [0.0, SKEW])
def test_a_healthy_head_is_left_alone(skew):
    found, faults = examined(skew, head(skew, 120.0))
    assert found == []
    assert not faults.any()


@pytest.mark.parametrize("skew", [0.0, SKEW])
@pytest.mark.parametrize("axis", range(4))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_jump_above_twenty_sigma_is_found_in_fifty_milliseconds(skew, axis, sign):
    """By parity: on the pair where the gyros stand orthogonally, on any axis where they stand skewed."""
    time, _, gyro, _ = data = head(skew, 3.0, roll=0.0)
    jump = 20.5 * ARW / math.sqrt(0.05) / abs(parity_vector(layout(skew))[axis]) if skew or axis in (1, 2) else 1e-4
    gyro[time > 2.0123, axis] += sign * jump * STEP
    found, _ = examined(skew, data)
    if skew == 0.0 and axis in (0, 3):
        assert found == []  # nobody else measures this rate
        return
    assert found
    assert 2.0123 < found[0][0] <= 2.0123 + 0.05
    assert GYRO_AXES[axis] in [name for _, name, _ in found]
    assert all(fault == Fault.PARITY for _, _, fault in found)


def test_the_axis_that_changed_is_named_where_the_other_stood_still():
    rng = np.random.default_rng(3)
    time, step = STEP * np.arange(1, 3001), np.full(3000, STEP)
    gyro = ARW * math.sqrt(STEP) * rng.standard_normal((3000, 4))
    accelerometer = VRW * math.sqrt(STEP) * rng.standard_normal((3000, 3))
    gyro[2000:, 2] += 1e-4 * STEP
    found, faults = examined(0.0, (time, step, gyro, accelerometer))
    assert [name for _, name, _ in found] == ["g2y"]
    assert faults.tolist() == [0, 0, Fault.PARITY, 0, 0, 0, 0]


@pytest.mark.parametrize("axis", range(7))
@pytest.mark.parametrize("kind", [Fault.STUCK, Fault.NOISE])
def test_own_signal_tests_find_it_in_two_hundred_milliseconds(axis, kind):
    time, _, gyro, accelerometer = data = head(0.0, 3.0)
    signal, column = (gyro, axis) if axis < 4 else (accelerometer, axis - 4)
    bad = time > 2.0
    if kind == Fault.STUCK:
        signal[bad, column] = signal[np.argmax(bad), column]
    else:
        noise = (ARW if axis < 4 else VRW) * math.sqrt(STEP)
        signal[bad, column] += 100.0 * noise * np.random.default_rng(axis).standard_normal(bad.sum())
    found, _ = examined(0.0, data)
    when = [t for t, name, fault in found if name == AXES[axis] and fault & kind]
    assert when
    assert 2.0 < when[0] <= 2.2
    assert {name for _, name, fault in found if fault & (Fault.STUCK | Fault.NOISE)} == {AXES[axis]}


def test_a_slow_head_is_not_noisy_before_the_sixth_difference_is_there():
    """At 100 Hz the first block of the noise test ends with its fifth sample."""
    n, step = 200, 0.01
    rng = np.random.default_rng(8)
    gyro = ARW * math.sqrt(step) * rng.standard_normal((n, 4))
    accelerometer = VRW * math.sqrt(step) * rng.standard_normal((n, 3))
    found, faults = examined(0.0, (step * np.arange(1, n + 1), np.full(n, step), gyro, accelerometer))
    assert found == []
    assert not faults.any()


def test_saturation_comes_and_goes():
    time, _, gyro, _ = data = head(0.0, 2.0)
    gyro[(time > 1.0) & (time < 1.1), 3] = 2.1 * STEP
    limits = Limits(0.0, 0.0, 0.0, 0.0, 2.0, 200.0)
    found, faults = examined(0.0, data, limits)
    assert [(round(t, 3), name, fault) for t, name, fault in found] == [
        (1.001, "g2z", Fault.SATURATED),
        (1.1, "g2z", Fault.GOOD),
    ]
    assert not faults.any()


@pytest.mark.parametrize("skew", [0.0, SKEW])
def test_gaps_and_steps_of_zero_raise_no_alarm(skew):
    time, step, gyro, accelerometer = head(skew, 5.0)
    time[2000:] += 0.3
    time[4000:] += 7.0
    accelerometer[2000:] += 5.0 * STEP
    gyro[4000:] += STEP * 0.5 * layout(skew)[:, 1]
    still = [np.insert(array, [3000] * 100, value, 0) for array, value in ((time, time[2999]), (step, 0.0))]
    found, _ = examined(skew, (*still, *(np.insert(array, [3000] * 100, 0.0, 0) for array in (gyro, accelerometer))))
    assert found == []


@pytest.mark.parametrize("skew", [0.0, SKEW])
def test_biases_of_the_grade_are_no_fault(skew):
    """Turn-on biases far above the noise, as of a MEMS head: a fault unless they are stated; five sigmas of them are one."""
    time, step, gyro, accelerometer = head(skew, 1.0)
    sigma = math.radians(0.2)
    apart = sigma * step[:, None] * parity_vector(layout(skew))
    stated = replace(LIMITS, gyro_bias=sigma)
    assert examined(skew, (time, step, gyro + 3.0 * apart, accelerometer))[0]
    assert not examined(skew, (time, step, gyro + 3.0 * apart, accelerometer), stated)[0]
    assert examined(skew, (time, step, gyro + 5.0 * apart, accelerometer), stated)[0]


@given(st.lists(st.integers(1, 700), max_size=8))
def test_how_a_stream_is_split_does_not_matter(cuts):
    time, step, gyro, accelerometer = head(0.0, 2.0, 9)
    gyro[1200:, 1] += 1e-3 * STEP
    gyro[1500:, 0] = 0.0
    whole = examined(0.0, (time, step, gyro, accelerometer))
    memory, faults, parity = fresh_memory(), np.zeros(7, np.int64), parity_vector(layout(0.0))
    values, residual, found = astuple(LIMITS), np.zeros(len(time)), []
    edges = [0, *np.cumsum(cuts).clip(max=len(time)).tolist(), len(time)]
    at = 0
    for stop in edges[1:]:
        while at < stop:
            before, part = faults.copy(), slice(at, stop)
            rows = time[part], step[part], gyro[part], gyro[part], accelerometer[part]
            at += examine(memory, faults, *rows, parity, values, True, residual[part])
            found += [(time[at - 1], AXES[k], Fault(int(faults[k]))) for k in np.flatnonzero(faults != before)]
    assert found == whole[0]
