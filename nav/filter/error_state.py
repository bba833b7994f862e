"""Error-state Kalman filter with a factored covariance, P = U D U^T: U unit upper triangular, D diagonal and not negative.

However long it runs and however the numbers are scaled, P stays symmetric and positive semidefinite, because only its factors
are kept, and these go forward without a difference of large numbers:

    predict   weighted Gram-Schmidt of [Phi U | G] with the weights [D | Q] (Thornton 1976)
    update    one scalar after another, each divided by its sigma (Bierman 1977)

The transition is that of :mod:`nav.error_dynamics` over the mean rate and force of an interval. White noise enters through
the increments, random walks in their own states. After an update the estimated errors are taken off the navigator at once
and the filter's errors are zero again. What is then left of the attitude's error is measured from the new attitude; with the
estimate e, d phi' = (I - [e x] / 2) d phi. This Jacobian is multiplied to the next transition.

Columns of U are kept as rows of `u`, so that every inner loop runs along memory. No kernel allocates.
"""

import math

import numpy as np

from nav.error_dynamics import fill_dynamics, fill_input, fill_transition
from nav.filter.states import LEVEL, STATES, Tuning, places
from nav.increments import FloatArray, IntArray
from nav.kernel import kernel
from nav.turn import matrix_from_quaternion, multiply, quaternion_of

MEASURED = 3
"""Most components of a measurement that is judged at once."""


@kernel
def _factored_sum(u: FloatArray, d: FloatArray, w: FloatArray, weight: FloatArray) -> None:
    """Fill U D U^T = W diag(weight) W^T; the rows of `w` (n, m) are used up."""
    n, m = w.shape
    for j in range(n - 1, -1, -1):
        total = 0.0
        for k in range(m):
            total += weight[k] * w[j, k] * w[j, k]
        d[j] = total
        u[j, j] = 1.0
        for i in range(j):
            product = 0.0
            if total > 0.0:
                for k in range(m):
                    product += weight[k] * w[i, k] * w[j, k]
                product /= total
                for k in range(m):
                    w[i, k] -= product * w[j, k]
            u[j, i] = product


@kernel
def _fill_interval(
    used: IntArray,
    before: FloatArray,
    after: FloatArray,
    sums: FloatArray,
    turn: FloatArray,
    nine: FloatArray,
    gain: FloatArray,
    phi: FloatArray,
) -> None:
    """Nine rows of the transition, `phi` (9, n), and the input `gain` (9, 6); `nine` (3, 9, 9) is room to work in."""
    step = sums[0]
    c, f, transition = nine[2, :3, :3], nine[0], nine[1]
    q, vel, force = nine[2, 3, :4], nine[2, 4, :3], nine[2, 5, :3]
    q[0], q[1], q[2], q[3] = quaternion_of(-0.5 * sums[1], -0.5 * sums[2], -0.5 * sums[3])
    multiply(after[6:10], q, q)
    matrix_from_quaternion(q, c)
    for i in range(3):
        vel[i] = 0.5 * (before[3 + i] + after[3 + i])
        force[i] = sums[4 + i] / step
    fill_dynamics(0.5 * (before[0] + after[0]), 0.5 * (before[2] + after[2]), vel, c, force, f)
    fill_transition(f, step, transition)
    fill_input(f, c, step, gain)
    for j in range(len(used)):
        state = used[j]
        axis = state % 3
        for i in range(9):
            if state < 9:
                phi[i, j] = transition[i, state]
            elif state < 12:
                phi[i, j] = step * gain[i, axis]
            elif state < 15:
                phi[i, j] = step * gain[i, 3 + axis]
            elif state < 18:
                phi[i, j] = sums[1 + axis] * gain[i, axis]
            elif state < 21:
                phi[i, j] = sums[4 + axis] * gain[i, 3 + axis]
            elif state < 24:
                phi[i, j] = sums[4 + axis] * gain[i, axis]
            elif state < 29:
                phi[i, j] = 0.0
            else:
                gyro, other = (state - 29) // 2, (state - 29) % 2
                phi[i, j] = sums[1 + (gyro + 1 + other) % 3] * gain[i, gyro]
    # The reset before: columns of the attitude times I - [turn x] / 2.
    tx, ty, tz = 0.5 * turn[0], 0.5 * turn[1], 0.5 * turn[2]
    for i in range(9):
        a, b, e = phi[i, 6], phi[i, 7], phi[i, 8]
        phi[i, 6], phi[i, 7], phi[i, 8] = a - b * tz + e * ty, b + a * tz - e * tx, e - a * ty + b * tx


@kernel
def _predict(
    used: IntArray,
    white: FloatArray,
    by_rate: FloatArray,
    by_force: FloatArray,
    walk: FloatArray,
    before: FloatArray,
    after: FloatArray,
    sums: FloatArray,
    turn: FloatArray,
    nine: FloatArray,
    gain: FloatArray,
    phi: FloatArray,
    u: FloatArray,
    d: FloatArray,
    w: FloatArray,
    weight: FloatArray,
) -> None:
    n, step = len(used), sums[0]
    if step <= 0.0:
        return
    _fill_interval(used, before, after, sums, turn, nine, gain, phi)
    turn[:] = 0.0
    w[:] = 0.0
    for k in range(n):
        weight[k] = d[k]
        for i in range(9):
            total = 0.0
            for m in range(k + 1):
                total += phi[i, m] * u[k, m]
            w[i, k] = total
        for i in range(9, k + 1):
            w[i, k] = u[k, i]
    for j in range(6):
        density = white[j] * white[j]
        if j < 3:
            for i in range(3):
                rate, force = sums[1 + i] / step, sums[4 + i] / step
                if i == 2:
                    force += LEVEL
                density += by_rate[j, i] * rate * rate + by_force[j, i] * force * force
        weight[n + j] = density * step
        for i in range(9):
            w[i, n + j] = gain[i, j]
    column = n + 6
    for k in range(9, n):
        drive = walk[used[k]]
        if drive > 0.0:
            w[k, column] = drive
            weight[column] = step
            column += 1
    _factored_sum(u, d, w[:, :column], weight[:column])


@kernel
def _examine(
    u: FloatArray,
    d: FloatArray,
    used: IntArray,
    m: int,
    h: FloatArray,
    residual: FloatArray,
    variance: FloatArray,
    s: FloatArray,
    work: FloatArray,
) -> float:
    """Fill S = H P H^T of the first `m` rows; residual^T (S + R)^-1 residual."""
    n = len(used)
    for a in range(m):
        for k in range(n):
            total = 0.0
            for i in range(k + 1):
                total += u[k, i] * h[a, used[i]]
            work[a, k] = total
    for a in range(m):
        for b in range(a + 1):
            total = 0.0
            for k in range(n):
                total += work[a, k] * work[b, k] * d[k]
            s[a, b] = s[b, a] = total
    # Cholesky of S + R beside the forward substitution; the factors lie in `work`, which is done with.
    nis = 0.0
    for a in range(m):
        for b in range(a + 1):
            total = s[a, b]
            if a == b:
                total += variance[a]
            for k in range(b):
                total -= work[a, k] * work[b, k]
            work[a, b] = math.sqrt(total) if a == b else total / work[b, b]
        total = residual[a]
        for k in range(a):
            total -= work[a, k] * work[k, n]
        work[a, n] = total / work[a, a]
        nis += work[a, n] * work[a, n]
    return nis


@kernel
def _absorb(
    u: FloatArray,
    d: FloatArray,
    used: IntArray,
    m: int,
    h: FloatArray,
    residual: FloatArray,
    variance: FloatArray,
    x: FloatArray,
    work: FloatArray,
) -> None:
    """Take the first `m` scalars; `x` (STATES,) out: the estimated errors."""
    n = len(used)
    f, gain = work[0], work[1]
    x[:] = 0.0
    for a in range(m):
        weight = 1.0 / math.sqrt(variance[a])
        innovation = weight * residual[a]
        for k in range(n):
            innovation -= weight * h[a, used[k]] * x[used[k]]
            total = 0.0
            for i in range(k + 1):
                total += u[k, i] * h[a, used[i]]
            f[k] = weight * total
        before = 1.0
        for k in range(n):
            carried = d[k] * f[k]
            after = before + f[k] * carried
            d[k] *= before / after
            slope = -f[k] / before
            for i in range(k):
                old = u[k, i]
                u[k, i] = old + slope * gain[i]
                gain[i] += carried * old
            gain[k] = carried
            before = after
        for k in range(n):
            x[used[k]] += gain[k] / before * innovation


class ErrorState:
    """Covariance of the errors, and the estimates of one update; see the module.

    Parameters
    ----------
    tuning : Tuning
        Which states, and their noise.

    Attributes
    ----------
    used : (n,) int
        Places of the states among the full set.
    u, d : (n, n), (n,) float
        Factors; the columns of U are the rows of `u`.
    turn : (3,) float
        Attitude taken off the navigator since the last prediction, rad.
    transition : (9, n) float
        The navigator's rows of the last one, the reset before it included; the parameters stay as they are.
    """

    def __init__(self, tuning: Tuning) -> None:
        self.tuning = tuning
        self.used = places(tuning.blocks)
        n = len(self.used)
        self.u, self.d, self.turn = np.eye(n), np.zeros(n), np.zeros(3)
        self._x, self._s = np.zeros(STATES), np.zeros((MEASURED, MEASURED))
        self._nine, self._gain, self.transition = np.zeros((3, 9, 9)), np.zeros((9, 6)), np.eye(9, n)
        self._w, self._weight = np.zeros((n, 2 * n + 6)), np.zeros(2 * n + 6)
        self._work = np.zeros((MEASURED, n + 1))

    def start(self, sigma: FloatArray) -> None:
        """Begin with independent errors of the navigator, `sigma` (9,), and the parameters as the tuning says."""
        self.u[:] = np.eye(len(self.used))
        self.d[:9], self.d[9:] = np.square(sigma), self.tuning.sigma[self.used[9:]] ** 2
        self.turn[:] = 0.0

    def predict(self, before: FloatArray, after: FloatArray, sums: FloatArray) -> None:
        """Carry the covariance over an interval.

        Parameters
        ----------
        before, after : (10,) float
            The solution at its ends, as `nav.strapdown.Strapdown.solution`.
        sums : (7,) float
            Its length, s, and the sums of the corrected increments, rad and m/s. A length of zero changes nothing.
        """
        t = self.tuning
        how = self.used, t.white, t.by_rate, t.by_force, t.walk
        room = self._nine, self._gain, self.transition, self.u, self.d, self._w, self._weight
        _predict(*how, before, after, sums, self.turn, *room)

    def examine(
        self, h: FloatArray, residual: FloatArray, variance: FloatArray, count: int | None = None
    ) -> tuple[float, FloatArray]:
        """What the filter expects of a measurement.

        Parameters
        ----------
        h : (m, STATES) float
            Of residual = H x + noise, m at most `MEASURED`.
        residual, variance : (m,) float
            Computed less measured, and the variance of the noise, independent and not zero.
        count : int, optional
            Rows that count, if not all.

        Returns
        -------
        nis : float
            Residual^T S^-1 residual, S = H P H^T + R: chi-square of m degrees of freedom.
        spread : (MEASURED, MEASURED) float
            H P H^T in the first m rows and columns; valid until the next call.
        """
        m = len(residual) if count is None else count
        nis = _examine(self.u, self.d, self.used, m, h, residual, variance, self._s, self._work)
        return float(nis), self._s

    def absorb(self, h: FloatArray, residual: FloatArray, variance: FloatArray, count: int | None = None) -> FloatArray:
        """Take a measurement; parameters as of `examine`.

        Returns
        -------
        (STATES,) float
            The estimated errors, to be taken off the navigator and added to the parameters at once; valid until the next call.
        """
        m = len(residual) if count is None else count
        _absorb(self.u, self.d, self.used, m, h, residual, variance, self._x, self._work)
        self.turn += self._x[6:9]
        return self._x

    @property
    def covariance(self) -> FloatArray:
        """P (n, n) of the states in `used`."""
        p: FloatArray = (self.u.T * self.d) @ self.u
        return p

    @property
    def sigma(self) -> FloatArray:
        """(STATES,): one sigma of each state; 0 of one that is not used."""
        sigma = np.zeros(STATES)
        sigma[self.used] = np.sqrt(np.einsum("ki,k->i", self.u**2, self.d))
        return sigma
