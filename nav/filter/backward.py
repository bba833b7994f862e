"""The way back of the smoother, interval by interval: kernels of :mod:`nav.filter.smoother`, whose letters are used here.

The rows of `u` are the columns of U, as in :mod:`nav.filter.error_state`. Inner loops run along memory.
"""

from nav.increments import FloatArray, IntArray
from nav.kernel import kernel

ROUNDING = 1e-14
"""Of the filter's variance: a smoothed one is no smaller."""


@kernel
def fill_gain(u: FloatArray, d: FloatArray, row: FloatArray, innovation: float, out: FloatArray) -> None:
    """h, P h / s, s, innovation of a row of the record."""
    n = len(d)
    s = row[n + 1]
    out[n : 2 * n] = 0.0
    for k in range(n):
        f = 0.0
        for i in range(k + 1):
            f += u[k, i] * row[i]
        s += d[k] * f * f
        for i in range(k + 1):
            out[n + i] += u[k, i] * d[k] * f
    for i in range(n):
        out[i] = row[i]
        out[n + i] /= s
    out[2 * n], out[2 * n + 1] = s, innovation


@kernel
def go_back(
    phi: FloatArray,
    u: FloatArray,
    d: FloatArray,
    scalars: FloatArray,
    first: IntArray,
    back: FloatArray,
    curvature: FloatArray,
    work: FloatArray,
    x: FloatArray,
    spread: FloatArray,
    covariance: FloatArray,
) -> None:
    """Smooth the epochs of `x` (e, m), `spread` (e, m), `covariance` (e, 9, 9); `back` and `curvature` (l, L) go on.

    Parameters
    ----------
    phi, u, d : (e, 9, m), (e, m, m), (e, m) float
        Of the interval that ends in each epoch; the factors after its measurements.
    scalars : (r, 2 m + 2) float
        h, k, s, nu of each scalar.
    first : (e + 1,) int
        Those of epoch i are `first[i]` to `first[i + 1]`.
    back, curvature, work : (m,), (m, m), (3, m, m) float
        l and L behind the last epoch, out: before the interval of the first; room to work in.
    x, spread, covariance
        Out: errors left, their variances, the covariance of the first nine.
    """
    p, w = work[0], work[1, 0]
    for k in range(len(x) - 1, -1, -1):
        _fill_smoothed(u[k], d[k], back, curvature, p, w, x[k], spread[k], covariance[k])
        for i in range(first[k + 1] - 1, first[k] - 1, -1):
            _through_measurement(scalars[i], back, curvature, w)
        _through_interval(phi[k], back, curvature, w, work[2])


@kernel
def _fill_smoothed(
    u: FloatArray,
    d: FloatArray,
    back: FloatArray,
    curvature: FloatArray,
    p: FloatArray,
    w: FloatArray,
    x: FloatArray,
    spread: FloatArray,
    covariance: FloatArray,
) -> None:
    m = len(back)
    p[:] = 0.0
    for k in range(m):
        for i in range(k + 1):
            for j in range(k + 1):
                p[i, j] += d[k] * u[k, i] * u[k, j]
    for i in range(m):
        total = 0.0
        w[:] = 0.0
        for k in range(m):
            total += p[i, k] * back[k]
            for j in range(m):
                w[j] += p[i, k] * curvature[k, j]
        x[i] = -total
        total = 0.0
        for j in range(m):
            total += w[j] * p[i, j]
        spread[i] = max(p[i, i] - total, ROUNDING * p[i, i])
        if i < 9:
            for j in range(9):
                total = 0.0
                for k in range(m):
                    total += w[k] * p[j, k]
                covariance[i, j] = p[i, j] - total


@kernel
def _through_measurement(scalar: FloatArray, back: FloatArray, curvature: FloatArray, w: FloatArray) -> None:
    """L = A^T L A + h h^T / s, A = I - k h, one factor after the other.

    Expanded it would lose in rounding what the first fix leaves of a large doubt.
    """
    m = len(back)
    h, gain, s, innovation = scalar[:m], scalar[m : 2 * m], scalar[2 * m], scalar[2 * m + 1]
    along = 0.0
    for i in range(m):
        along += gain[i] * back[i]
        total = 0.0
        for j in range(m):
            total += curvature[i, j] * gain[j]
        for j in range(m):
            curvature[i, j] -= total * h[j]
    w[:] = 0.0
    for i in range(m):
        for j in range(m):
            w[j] += gain[i] * curvature[i, j]
    for i in range(m):
        back[i] -= h[i] * (along + innovation / s)
        for j in range(m):
            curvature[i, j] += h[i] * (h[j] / s - w[j])


@kernel
def _through_interval(
    phi: FloatArray, back: FloatArray, curvature: FloatArray, w: FloatArray, product: FloatArray
) -> None:
    """Phi is `phi` (9, m) above the rows of a unit matrix."""
    m = len(back)
    w[:] = back
    product[:] = curvature
    back[:9], product[:, :9] = 0.0, 0.0
    for i in range(9):
        for j in range(m):
            back[j] += phi[i, j] * w[i]
    for r in range(m):
        for i in range(9):
            for j in range(m):
                product[r, j] += curvature[r, i] * phi[i, j]
    curvature[:] = product
    curvature[:9] = 0.0
    for i in range(9):
        for r in range(m):
            for j in range(m):
                curvature[r, j] += phi[i, r] * product[i, j]
    for i in range(m):
        for j in range(i):
            curvature[i, j] = curvature[j, i] = 0.5 * (curvature[i, j] + curvature[j, i])
