"""The size effect of a block of pendulums and its compensation at two rates (source 002/Babich, sec. 2).

In equilibrium a pendulum's output differs from the specific force at O along its xi by a quadratic form of the rate w and a
linear one of the angular acceleration e (eq. 1.7). In block axes each channel is a row of nine coefficients, m, for

    w_x^2, w_y^2, w_z^2, w_y w_z, w_z w_x, w_x w_y, e_x, e_y, e_z

so that pendulums of any orientation cost the same. Fast rate: on each step the rate is linear through this angle increment
and the one before, and the integral of the nine is taken exactly (eq. 2.11). The second integral takes the force as
linear likewise (eq. 2.13).
"""

from collections.abc import Sequence

import numpy as np

from nav.increments import FloatArray
from nav.instruments.pendulum import Pendulum
from nav.kernel import kernel

MEMORY = 4
"""Floats that the compensation remembers: the last step, s, and its angle increments, rad; zeros at its start."""

_PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (2, 0), (0, 1))


def size_coefficients(pendulums: Sequence[Pendulum]) -> FloatArray:
    """Rows of nine coefficients from the geometry, all terms of eq. 1.7 and those of eta0.

    Returns
    -------
    (p, 9) float
        m.
    """
    rows = np.empty((len(pendulums), 9))
    for row, pendulum in zip(rows, pendulums, strict=True):
        m, n, l, eta0 = pendulum.coefficients  # noqa: E741
        xi, eta, zeta = np.asarray(pendulum.axes)
        form = m * np.outer(xi, zeta) + n * (np.outer(eta, eta) + np.outer(zeta, zeta)) + eta0 * np.outer(xi, eta)
        row[:3] = np.diag(form)
        row[3:6] = [form[i, j] + form[j, i] for i, j in _PAIRS[3:]]
        row[6:] = l * eta - eta0 * zeta
    return rows


def size_terms(rate: FloatArray, acceleration: FloatArray) -> FloatArray:
    """The nine terms that the coefficients multiply.

    Parameters
    ----------
    rate, acceleration : (n, 3) float
        Rate and angular acceleration of the block, rad/s and rad/s^2.

    Returns
    -------
    (n, 9) float
        1/s^2.
    """
    products = [rate[:, i] * rate[:, j] for i, j in _PAIRS]
    return np.column_stack([*products, acceleration])


@kernel
def compensate(
    memory: FloatArray,
    coefficients: FloatArray,
    step: FloatArray,
    dtheta: FloatArray,
    dvel: FloatArray,
    out: FloatArray,
) -> None:
    """Take the size effect off a batch of velocity increments.

    With T0, a0 the step and angle increment before, the rate over a step is a / T + s (t - T / 2), s = 2 (a / T - a0 / T0)
    / (T + T0). The first sample has s = 0. A step of zero passes unchanged and is not remembered.

    Parameters
    ----------
    memory : (MEMORY,) float
        What the stream remembers; zeros at its start; updated in place.
    coefficients : (3, 9) float
        Of `size_coefficients`.
    step : (n,) float
        s, equal or not.
    dtheta, dvel : (n, 3) float
        Angle increments in block axes, rad, and velocity increments of the three pendulums, m/s.
    out : (n, 3) float
        Out: velocity increments at O, m/s; may be `dvel`.
    """
    t0, px, py, pz = memory[0], memory[1], memory[2], memory[3]
    for k in range(step.shape[0]):
        t = step[k]
        if t <= 0.0:
            for i in range(3):
                out[k, i] = dvel[k, i]
            continue
        x, y, z = dtheta[k, 0], dtheta[k, 1], dtheta[k, 2]
        mx, my, mz = x / t, y / t, z / t
        sx = sy = sz = 0.0
        if t0 > 0.0:
            g = 2.0 / (t + t0)
            sx, sy, sz = g * (mx - px / t0), g * (my - py / t0), g * (mz - pz / t0)
        t0, px, py, pz = t, x, y, z
        q = t * t * t / 12.0
        xx, yy, zz = mx * x + q * sx * sx, my * y + q * sy * sy, mz * z + q * sz * sz
        yz, zx, xy = my * z + q * sy * sz, mz * x + q * sz * sx, mx * y + q * sx * sy
        ex, ey, ez = t * sx, t * sy, t * sz
        for i in range(3):
            c = coefficients[i]
            quadratic = c[0] * xx + c[1] * yy + c[2] * zz + c[3] * yz + c[4] * zx + c[5] * xy
            out[k, i] = dvel[k, i] - (quadratic + c[6] * ex + c[7] * ey + c[8] * ez)
    memory[0], memory[1], memory[2], memory[3] = t0, px, py, pz


@kernel
def integrate_twice(
    memory: FloatArray, step: FloatArray, dvel: FloatArray, velocity: FloatArray, position: FloatArray
) -> None:
    """Velocity and position at the end of each step from velocity increments, without rotation.

    dS = v T + (T / 2) dv - (T^3 / 12) s with the slope s = 2 (dv / T - dv0 / T0) / (T + T0) of the force; for equal steps
    v T + (T / 12) (5 dv + dv0) (eq. 2.13). The first sample has s = 0.

    Parameters
    ----------
    memory : (10,) float
        What the stream remembers: the last step and its increments, velocity, position; zeros at its start.
    step : (n,) float
        s.
    dvel : (n, 3) float
        m/s.
    velocity, position : (n, 3) float
        Out: m/s and m.
    """
    for k in range(step.shape[0]):
        t, t0 = step[k], memory[0]
        for i in range(3):
            if t > 0.0:
                dv = dvel[k, i]
                slope = 2.0 * (dv / t - memory[1 + i] / t0) / (t + t0) if t0 > 0.0 else 0.0
                memory[7 + i] += t * (memory[4 + i] + 0.5 * dv - t * t / 12.0 * slope)
                memory[4 + i] += dv
                memory[1 + i] = dv
            velocity[k, i], position[k, i] = memory[4 + i], memory[7 + i]
        if t > 0.0:
            memory[0] = t
