"""The one loop that runs every attitude method: a window of samples, the attitude, and what a method keeps besides.

A method turns the attitude by a block of `block` samples at a time, with a window of `window` samples of which the
block is the last part. Methods with ``block == window`` wait for whole blocks. Methods with ``block == 1`` step at every
sample from past increments; their first `window` samples are one block of the polynomial through them, so that the
start costs no order. Between two block ends the attitude is that of the polynomial through the newest `window`
samples: made known by what has come so far in `STREAM` mode, and by the whole block in `EVERY_ROW` mode. The attitude
at block ends is the same to the last bit in all modes and however the samples are split over calls.
"""

import math

import numpy as np

from nav.attitude.coning import coning_stream_turn, coning_turn, coning_uncompressed_turn
from nav.attitude.euler_vector import euler_vector_step
from nav.attitude.four_sample import four_sample_turn
from nav.attitude.high_order import MAX_SAMPLES, WORK, fit_rate, node, rate_at, turns
from nav.attitude.picard import picard3_turn
from nav.attitude.poisson import poisson_step
from nav.increments import FloatArray
from nav.kernel import inline_kernel, kernel
from nav.turn import Quaternion, matrix_from_quaternion, quaternion_from_matrix, quaternion_of, vector_from_quaternion

HIGH_ORDER, PICARD3, PICARD3_SOURCE, FOUR_SAMPLE, FOUR_SAMPLE_SERIES = 0, 1, 2, 3, 4
CONING, CONING_UNCOMPRESSED, CONING_STREAM, POISSON, EULER_VECTOR = 5, 6, 7, 8, 9
"""Kinds of methods."""

STREAM, EVERY_ROW, BLOCK_ENDS = 0, 1, 2
"""Rows between block ends: from the samples so far; from the whole block; none, `out` holds block ends only."""

RATE_SAMPLES = 4
"""Samples of the polynomial that gives the Runge-Kutta methods their rates: a cubic, of their own order."""

_FILLED, _SINCE, _STARTED = 0, 1, 2
_ATTITUDE, _EXTRA, _RATES = 4, 8, 17
_STEPS = 26
_ANGLES = _STEPS + 2 * MAX_SAMPLES
_ROWS = _ANGLES + 6 * MAX_SAMPLES
_WORK = _ROWS + 4 * MAX_SAMPLES
STATE = _WORK + WORK
"""Samples in the window, since the last block end, started | attitude | matrix or vector | scratch, window, scratch."""


def initial_state(kind: int, q0: FloatArray) -> FloatArray:
    """State (`STATE`,) of a method at the unit attitude `q0` (4,) with no samples yet."""
    state = np.zeros(STATE)
    state[_ATTITUDE : _ATTITUDE + 4] = q0
    if kind == POISSON:
        matrix_from_quaternion(state[_ATTITUDE : _ATTITUDE + 4], state[_EXTRA : _EXTRA + 9].reshape(3, 3))
    elif kind == EULER_VECTOR:
        vector_from_quaternion(state[_ATTITUDE : _ATTITUDE + 4], state[_EXTRA : _EXTRA + 3])
    return state


@inline_kernel
def _runge_kutta(kind: int, matrix: FloatArray, vector: FloatArray, rates: FloatArray, step: float) -> Quaternion:
    """One step of a Runge-Kutta method, and the attitude at its end."""
    if kind == POISSON:
        poisson_step(matrix, rates, step)
        return quaternion_from_matrix(matrix)
    euler_vector_step(vector, rates, step)
    return quaternion_of(vector[0], vector[1], vector[2])


@inline_kernel
def _store(q: Quaternion, near: FloatArray, out: FloatArray, row: int) -> None:
    """out[row] = q, of the sign that is closer to the quaternion `near` (4,)."""
    w, x, y, z = q
    s = 1.0
    if near[0] * w + near[1] * x + near[2] * y + near[3] * z < 0.0:
        s = -1.0
    out[row, 0], out[row, 1], out[row, 2], out[row, 3] = s * w, s * x, s * y, s * z


@inline_kernel
def _fitted_steps(
    kind: int,
    samples: int,
    matrix: FloatArray,
    vector: FloatArray,
    rates: FloatArray,
    near: FloatArray,
    work: FloatArray,
    rows: FloatArray,
) -> None:
    """Runge-Kutta steps over the samples of a window, by its rate polynomial; the attitudes into `rows`."""
    for i in range(samples):
        left, right = node(i, work), node(i + 1, work)
        rates[0, 0], rates[0, 1], rates[0, 2] = rate_at(samples, left, work)
        rates[1, 0], rates[1, 1], rates[1, 2] = rate_at(samples, 0.5 * (left + right), work)
        rates[2, 0], rates[2, 1], rates[2, 2] = rate_at(samples, right, work)
        _store(_runge_kutta(kind, matrix, vector, rates, right - left), near, rows, i)


@inline_kernel
def _turn(
    kind: int,
    dtheta: FloatArray,
    step: FloatArray,
    begin: int,
    end: int,
    table: FloatArray,
    rows: FloatArray,
    last: int,
) -> None:
    """Rotation over the block that ends the window, by the methods with a formula for it, into ``rows[last]``."""
    if kind in (PICARD3, PICARD3_SOURCE):
        w, x, y, z = picard3_turn(dtheta, step, end, kind == PICARD3_SOURCE)
    elif kind in (FOUR_SAMPLE, FOUR_SAMPLE_SERIES):
        w, x, y, z = four_sample_turn(dtheta, begin, kind == FOUR_SAMPLE_SERIES)
    elif kind == CONING:
        w, x, y, z = coning_turn(dtheta, step, begin, end, table)
    elif kind == CONING_UNCOMPRESSED:
        w, x, y, z = coning_uncompressed_turn(dtheta, step, begin, end, table)
    else:
        w, x, y, z = coning_stream_turn(dtheta, step, begin, end, table)
    rows[last, 0], rows[last, 1], rows[last, 2], rows[last, 3] = w, x, y, z


@kernel
def advance(
    kind: int,
    window: int,
    block: int,
    table: FloatArray,
    mode: int,
    state: FloatArray,
    step: FloatArray,
    dtheta: FloatArray,
    out: FloatArray,
) -> int:
    """Integrate increments.

    Parameters
    ----------
    kind, window, block : int
        The method.
    table : (window - 1,) float
        Coefficients of the coning family by distance; else not read.
    mode : int
        `STREAM`, `EVERY_ROW` or `BLOCK_ENDS`.
    state : (STATE,) float
        Of `initial_state`; advanced in place.
    step : (n,) float
        Steps, s; a step of zero or less repeats the row before and is no sample.
    dtheta : (n, 3) float
        Increments, rad.
    out : (n, 4) float
        Out: attitudes q_ib at the end of each step, or at block ends.

    Returns
    -------
    int
        Rows of `out` filled; -1 - k where sample k is not a number, -1 - n where a shape does not fit: then nothing has
        changed.
    """
    if dtheta.shape != (step.shape[0], 3) or out.shape[1] != 4 or (mode != BLOCK_ENDS and len(out) != len(step)):
        return -1 - len(step)
    for k in range(step.shape[0]):
        if not math.isfinite(step[k] + dtheta[k, 0] + dtheta[k, 1] + dtheta[k, 2]):
            return -1 - k
    steps = state[_STEPS:_ANGLES]
    angles = state[_ANGLES:_ROWS].reshape((2 * MAX_SAMPLES, 3))
    rows = state[_ROWS:_WORK].reshape((MAX_SAMPLES, 4))
    work = state[_WORK:STATE]
    q = state[_ATTITUDE : _ATTITUDE + 4]
    attitude = q.reshape((1, 4))
    vector, matrix = state[_EXTRA : _EXTRA + 3], state[_EXTRA : _EXTRA + 9].reshape((3, 3))
    rates = state[_RATES : _RATES + 9].reshape((3, 3))
    runge_kutta = kind in (POISSON, EULER_VECTOR)
    filled, since = int(state[_FILLED]), int(state[_SINCE])
    size = block if state[_STARTED] > 0.0 else window
    n, ends = step.shape[0], 0
    for k in range(n):
        if step[k] > 0.0:
            filled = _push(steps, angles, window, filled, step, dtheta, k)
            since += 1
        whole = since == size
        if since > 0 and (whole or mode == STREAM or (mode == EVERY_ROW and k == n - 1)):
            begin, last = max(0, filled - window), since - 1
            if whole and runge_kutta:
                fit_rate(angles, steps, begin, filled, begin, work)
                _fitted_steps(kind, window, matrix, vector, rates, q, work, rows)
            else:
                by_formula = whole and kind != HIGH_ORDER and size == block
                if not by_formula or (mode == EVERY_ROW and last > 0):
                    turns(angles, steps, begin, filled, filled - since, mode == EVERY_ROW, work, rows)
                if by_formula:
                    _turn(kind, angles, steps, begin, filled, table, rows, last)
                _compose(q, rows, 0 if mode == EVERY_ROW else last, since)
            if mode == EVERY_ROW:
                _write_back(rows, step, k, since, out)
            elif mode == STREAM or whole:
                _copy(rows, last, out, k if mode == STREAM else ends)
            if whole:
                _copy(rows, last, attitude, 0)
                ends, since, size = ends + 1, 0, block
        elif since == 0 and mode != BLOCK_ENDS:
            _copy(attitude, 0, out, k)
    state[_FILLED], state[_SINCE] = filled, since
    if size == block and ends > 0:
        state[_STARTED] = 1.0
    return ends if mode == BLOCK_ENDS else n


@inline_kernel
def _push(
    steps: FloatArray, angles: FloatArray, window: int, filled: int, step: FloatArray, dtheta: FloatArray, k: int
) -> int:
    """Append a sample to the window, which is moved to the front when twice its length is full; the new length."""
    if filled == 2 * window:
        for i in range(window):
            steps[i] = steps[window + i]
            for c in range(3):
                angles[i, c] = angles[window + i, c]
        filled = window
    steps[filled] = step[k]
    for c in range(3):
        angles[filled, c] = dtheta[k, c]
    return filled + 1


@inline_kernel
def _copy(rows: FloatArray, i: int, out: FloatArray, k: int) -> None:
    for c in range(4):
        out[k, c] = rows[i, c]


@inline_kernel
def _compose(q: FloatArray, rows: FloatArray, first: int, end: int) -> None:
    """rows[i] = q rows[i], to unit norm, for i from `first` to `end` - 1."""
    for i in range(first, end):
        a, b, c, d = rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3]
        w = q[0] * a - q[1] * b - q[2] * c - q[3] * d
        x = q[0] * b + q[1] * a + q[2] * d - q[3] * c
        y = q[0] * c - q[1] * d + q[2] * a + q[3] * b
        z = q[0] * d + q[1] * c - q[2] * b + q[3] * a
        s = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
        rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3] = s * w, s * x, s * y, s * z


@inline_kernel
def _write_back(rows: FloatArray, step: FloatArray, last: int, count: int, out: FloatArray) -> None:
    """Write `rows` of the `count` newest samples to the rows of `out` up to `last`, as far as those belong to this call."""
    sample = count - 1
    for k in range(last, -1, -1):
        if sample < 0:
            break
        for i in range(4):
            out[k, i] = rows[sample, i]
        if step[k] > 0.0:
            sample -= 1


@kernel
def advance_rates(kind: int, state: FloatArray, step: FloatArray, rate: FloatArray, out: FloatArray) -> None:
    """Integrate sampled rates by a Runge-Kutta method, one step a sample.

    The rate in the middle of a step is that of the cubic through the two samples on either side (at the ends of the
    record through the four that there are), which keeps the method's order.

    Parameters
    ----------
    kind : int
        `POISSON` or `EULER_VECTOR`.
    state : (STATE,) float
        Of `initial_state`; advanced in place.
    step : (n,) float
        Steps, s, all positive.
    rate : (n + 1, 3) float
        Body rates at the start and at the end of each step, rad/s.
    out : (n, 4) float
        Out: attitudes q_ib at the end of each step.
    """
    n = step.shape[0]
    vector, matrix = state[_EXTRA : _EXTRA + 3], state[_EXTRA : _EXTRA + 9].reshape((3, 3))
    rates = state[_RATES : _RATES + 9].reshape((3, 3))
    q = state[_ATTITUDE : _ATTITUDE + 4]
    points = min(4, n + 1)
    for k in range(n):
        first = min(max(k - 1, 0), n + 1 - points)
        middle = 0.5 * step[k]
        for c in range(3):
            rates[0, c], rates[1, c], rates[2, c] = rate[k, c], 0.0, rate[k + 1, c]
        for i in range(first, first + points):
            weight = 1.0
            at = _time_from(step, k, i)
            for j in range(first, first + points):
                if j != i:
                    other = _time_from(step, k, j)
                    weight *= (middle - other) / (at - other)
            for c in range(3):
                rates[1, c] += weight * rate[i, c]
        _store(_runge_kutta(kind, matrix, vector, rates, step[k]), q, out, k)
        for c in range(4):
            q[c] = out[k, c]


@inline_kernel
def _time_from(step: FloatArray, start: int, sample: int) -> float:
    """Time of rate `sample` from the start of step `start`, s."""
    time = 0.0
    for i in range(start, sample):
        time += step[i]
    for i in range(sample, start):
        time -= step[i]
    return time
