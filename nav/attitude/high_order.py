"""Rotation over a few samples to the order of the polynomial through them, unequal steps included.

m increments fix the polynomial of degree m - 1 whose integral over each step is the increment of that step (Newton's
divided differences of the accumulated angle). Under that rate the quaternion equation ``q' = q w / 2`` is solved by its
Taylor series about the middle of the wanted span, continued until what is left out is below one unit in the last
place. The rotation is therefore that of functional iteration on Chebyshev polynomials of the same rate (Wu, "RodFIter:
Attitude reconstruction from inertial measurement by functional iteration", IEEE Trans. AES 54, 2018; QuatFIter, 2019)
once the iteration has converged; only the error of the polynomial itself remains.

Time is measured by ``tau``, -1 at the start of the span and 1 at its end.
"""

import math

import numpy as np

from nav.increments import FloatArray
from nav.kernel import inline_kernel
from nav.turn import Quaternion

MAX_SAMPLES = 10
"""Most samples in a polynomial: beyond it, equally spaced samples amplify their noise more than they add order."""

MAX_TERMS = 96
"""Most terms of the series. Smooth motion takes ten to twenty; only a rate that the polynomial hardly resolves takes all,
and then what is left out is below the error of the polynomial."""

_NODES = 0
_NEWTON = _NODES + MAX_SAMPLES + 1
_RATE = _NEWTON + 3 * MAX_SAMPLES
_BOUND = _RATE + 3 * (MAX_SAMPLES + 1)
_TERM_BOUND = _BOUND + MAX_SAMPLES
_SERIES = _TERM_BOUND + MAX_TERMS
WORK = _SERIES + 4 * MAX_TERMS
"""Length of the work array: tau of the ends of the steps | Newton's differences | half the rate by powers of tau, bounds
on it | bounds on the terms of the series, the terms."""

_ROUNDING = 1e-17
"""Terms of the series below this are dropped: the attitude itself is 1."""


def work_array() -> FloatArray:
    """A work array for the kernels of this module."""
    return np.zeros(WORK)


@inline_kernel
def fit_rate(dtheta: FloatArray, step: FloatArray, begin: int, end: int, first: int, work: FloatArray) -> None:
    """Fit the rate polynomial of a window.

    Parameters
    ----------
    dtheta : (n, 3) float
        Increments, rad.
    step : (n,) float
        Their steps, s.
    begin, end : int
        The window: rows `begin` to `end` - 1, m of them, 1 to `MAX_SAMPLES`, of positive steps, equal or not.
    first : int
        The span is that of the rows `first` to `end` - 1: tau is -1 at the start of step `first`, 1 at the end.
    work : (WORK,) float
        Out: the polynomial, for `node`, `rate_at`, `attitude_series`.
    """
    length = 0.0
    for i in range(first, end):
        length += step[i]
    m = end - begin
    _divide_differences(dtheta, step, begin, m, 2.0 / length, work)
    _expand(m, work)
    for j in range(m):
        p = _RATE + 3 * j
        for c in range(3):
            work[p + c] = 0.5 * (j + 1) * work[p + 3 + c]
    largest = 0.0
    for j in range(m - 1, -1, -1):
        p = _RATE + 3 * j
        x, y, z = work[p], work[p + 1], work[p + 2]
        largest = max(largest, math.sqrt(x * x + y * y + z * z))
        work[_BOUND + j] = largest


@inline_kernel
def _divide_differences(
    dtheta: FloatArray, step: FloatArray, begin: int, m: int, scale: float, work: FloatArray
) -> None:
    """Newton's form of the accumulated angle; its value at the first node does not matter."""
    work[_NODES + m] = 1.0
    for i in range(m - 1, -1, -1):
        duration = scale * step[begin + i]
        work[_NODES + i] = work[_NODES + i + 1] - duration
        inverse = 1.0 / duration
        for c in range(3):
            work[_NEWTON + 3 * i + c] = dtheta[begin + i, c] * inverse
    for k in range(2, m + 1):
        for i in range(m - 1, k - 2, -1):
            inverse = 1.0 / (work[_NODES + i + 1] - work[_NODES + i + 1 - k])
            f = _NEWTON + 3 * i
            for c in range(3):
                work[f + c] = (work[f + c] - work[f - 3 + c]) * inverse


@inline_kernel
def _expand(m: int, work: FloatArray) -> None:
    """From Newton's form to powers of tau, by Horner's scheme."""
    for c in range(3):
        work[_RATE + c] = work[_NEWTON + 3 * (m - 1) + c]
    for i in range(m - 1, -1, -1):
        tau = work[_NODES + i]
        top = _RATE + 3 * (m - 1 - i)
        for c in range(3):
            work[top + 3 + c] = work[top + c]
        for p in range(top, _RATE, -3):
            for c in range(3):
                work[p + c] = work[p - 3 + c] - tau * work[p + c]
        for c in range(3):
            below = work[_NEWTON + 3 * (i - 1) + c] if i > 0 else 0.0
            work[_RATE + c] = below - tau * work[_RATE + c]


@inline_kernel
def node(i: int, work: FloatArray) -> float:
    """Tau at the start of step `i` of the window of `fit_rate`; i = m is its end."""
    tau: float = work[_NODES + i]
    return tau


@inline_kernel
def rate_at(samples: int, tau: float, work: FloatArray) -> tuple[float, float, float]:
    """Rate at `tau` of the polynomial of `fit_rate` through `samples` increments, rad per unit of tau."""
    x = y = z = 0.0
    for p in range(_RATE + 3 * (samples - 1), _RATE - 1, -3):
        x = x * tau + work[p]
        y = y * tau + work[p + 1]
        z = z * tau + work[p + 2]
    return 2.0 * x, 2.0 * y, 2.0 * z


@inline_kernel
def attitude_series(samples: int, work: FloatArray) -> int:
    """Taylor series about tau = 0 of the quaternion that is 1 there, for the rate of `fit_rate`.

    (k + 1) c_(k+1) = sum over j of c_(k-j) v_j, v_j half the rate's coefficients. The same recursion with the norms of
    the v_j, made to fall with j, bounds all terms from the first that is dropped.

    Returns
    -------
    int
        Number of terms; they are in `work`, for `attitude_at`.
    """
    s = _SERIES
    work[s] = 1.0
    work[s + 1] = work[s + 2] = work[s + 3] = 0.0
    work[_TERM_BOUND] = 1.0
    terms = 1
    while terms < MAX_TERMS:
        inverse = 1.0 / terms
        count = min(terms, samples)
        bound = 0.0
        for j in range(count):
            bound += work[_BOUND + j] * work[_TERM_BOUND + terms - 1 - j]
        bound *= inverse
        if bound < _ROUNDING:
            break
        work[_TERM_BOUND + terms] = bound
        w = x = y = z = 0.0
        for j in range(count):
            v, c = _RATE + 3 * j, s + 4 * (terms - 1 - j)
            vx, vy, vz = work[v], work[v + 1], work[v + 2]
            cw, cx, cy, cz = work[c], work[c + 1], work[c + 2], work[c + 3]
            w -= cx * vx + cy * vy + cz * vz
            x += cw * vx + cy * vz - cz * vy
            y += cw * vy + cz * vx - cx * vz
            z += cw * vz + cx * vy - cy * vx
        c = s + 4 * terms
        work[c], work[c + 1], work[c + 2], work[c + 3] = w * inverse, x * inverse, y * inverse, z * inverse
        terms += 1
    return terms


@inline_kernel
def attitude_at(terms: int, tau: float, work: FloatArray) -> Quaternion:
    """Quaternion from the attitude at tau = 0 to that at `tau`, by the series of `attitude_series`."""
    w = x = y = z = 0.0
    for c in range(_SERIES + 4 * (terms - 1), _SERIES - 1, -4):
        w = w * tau + work[c]
        x = x * tau + work[c + 1]
        y = y * tau + work[c + 2]
        z = z * tau + work[c + 3]
    return w, x, y, z


@inline_kernel
def turns(
    dtheta: FloatArray,
    step: FloatArray,
    begin: int,
    end: int,
    first: int,
    rows: bool,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """Rotations from the start of step `first` to the end of each later step, by the polynomial through the window.

    Parameters
    ----------
    dtheta : (n, 3) float
        Increments, rad.
    step : (n,) float
        Their steps, s.
    begin, end : int
        The window: rows `begin` to `end` - 1, at most `MAX_SAMPLES`, of positive steps, equal or not.
    first : int
        First row that is integrated; the rows before it only support the polynomial.
    rows : bool
        False: only the last row of `out` is filled.
    work : (WORK,) float
        Scratch.
    out : (at least end - first, 4) float
        Out: quaternions, of unit norm to rounding.
    """
    fit_rate(dtheta, step, begin, end, first, work)
    terms = attitude_series(end - begin, work)
    last = end - first - 1
    sw, sx, sy, sz = attitude_at(terms, -1.0, work)
    for i in range(0 if rows else last, last + 1):
        w, x, y, z = attitude_at(terms, work[_NODES + first - begin + i + 1], work)
        # conj(start) (w, x, y, z)
        out[i, 0] = sw * w + sx * x + sy * y + sz * z
        out[i, 1] = sw * x - sx * w - sy * z + sz * y
        out[i, 2] = sw * y + sx * z - sy * w - sz * x
        out[i, 3] = sw * z - sx * y + sy * x - sz * w
