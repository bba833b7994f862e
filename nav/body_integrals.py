"""What one step did to the body, seen from the body axes at its start: rotation, velocity and position integrals.

Whatever the mechanization, inertial sensors enter it only through

    dq = rotation of the body over the step,   dv = int C f dt,   ds = int int C f dt dt

with C from the body axes at t to those at the step's start. This module computes them from a stream of increments, one
row for each sample, with no knowledge of the Earth. Two orders:

two-sample
    Rate and force linear over this step and the one before (coning, sculling, scrolling to second order).
high order, N samples
    Polynomials of degree N - 1 through the last N increments; the rotation by the sixth-order Magnus expansion at three
    Gauss nodes (Blanes, Casas & Ros 2000), the velocity and position integrals by the same nodes with the rotation at
    each from the Magnus series. Until N samples are there, the degree is what there is.

Steps may be unequal. A step of zero gives no rotation and no velocity.
"""

import math

import numpy as np

from nav.increments import FloatArray
from nav.kernel import inline_kernel, kernel
from nav.turn import change_by_turn, cross, turn_of

MAX_WINDOW = 8
"""Most samples in a polynomial."""
_SEEN, _READY, _WINDOW = 0, 1, 2
_WEIGHTS = _WINDOW + 7 * MAX_WINDOW
_STEPS = _WEIGHTS + MAX_WINDOW * MAX_WINDOW
_TABLE = _STEPS + MAX_WINDOW
_COEFFICIENT = _TABLE + 2 * MAX_WINDOW * MAX_WINDOW
MEMORY = _COEFFICIENT + 6 * MAX_WINDOW
"""Floats that the stream remembers: samples seen, window for which the weights hold, increments, weights; and room to work."""

_ROOT15 = math.sqrt(15.0)
_NODE = (0.5 - 0.1 * _ROOT15, 0.5, 0.5 + 0.1 * _ROOT15)
_MASS = (5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0)


@kernel
def _fit_weights(steps: FloatArray, place: int, weights: FloatArray, room: FloatArray) -> None:
    """Weights that take m increments to the coefficients of their polynomial over the step number `place`.

    The integrand is sum_j a_j s^j, s from 0 to 1 over that step, per unit of s; a_j = sum_i weights[j, i] increment_i,
    oldest first. `room` has 2 m^2 floats to work in.
    """
    m = len(steps)
    table = room[: 2 * m * m].reshape((m, 2 * m))
    table[:] = 0.0
    left = 0.0
    for i in range(place):
        left -= steps[i] / steps[place]
    for i in range(m):
        right = left + steps[i] / steps[place]
        p, q = left, right
        for j in range(m):
            table[i, j] = (q - p) / (j + 1.0)
            p *= left
            q *= right
        table[i, m + i] = 1.0
        left = right
    for k in range(m):  # Gauss-Jordan with row pivoting
        pivot = k
        for i in range(k + 1, m):
            if abs(table[i, k]) > abs(table[pivot, k]):
                pivot = i
        for j in range(2 * m):
            table[k, j], table[pivot, j] = table[pivot, j], table[k, j]
        scale = 1.0 / table[k, k]
        for j in range(2 * m):
            table[k, j] *= scale
        for i in range(m):
            if i != k and table[i, k] != 0.0:
                factor = table[i, k]
                for j in range(2 * m):
                    table[i, j] -= factor * table[k, j]
    for j in range(m):
        for i in range(m):
            weights[j, i] = table[j, m + i]


@inline_kernel
def _integrate_polynomial(
    coefficient: FloatArray, m: int, t: float, k: int, dq: FloatArray, dv: FloatArray, ds: FloatArray
) -> None:
    """Integrals of one step of `t` s from the polynomials of rate and force over it, into row `k`."""
    # Rate and force at the nodes; the angle up to each node.
    a1x = a1y = a1z = a2x = a2y = a2z = a3x = a3y = a3z = 0.0
    dvx = dvy = dvz = dsx = dsy = dsz = 0.0
    for node in range(3):
        s = _NODE[node]
        wx = wy = wz = fx = fy = fz = gx = gy = gz = 0.0
        for j in range(m - 1, -1, -1):
            wx, wy, wz = wx * s + coefficient[6 * j], wy * s + coefficient[6 * j + 1], wz * s + coefficient[6 * j + 2]
            fx, fy, fz = (
                fx * s + coefficient[6 * j + 3],
                fy * s + coefficient[6 * j + 4],
                fz * s + coefficient[6 * j + 5],
            )
            g = 1.0 / (j + 1.0)
            gx, gy, gz = (
                gx * s + g * coefficient[6 * j],
                gy * s + g * coefficient[6 * j + 1],
                gz * s + g * coefficient[6 * j + 2],
            )
        # Angle to the node: alpha + (1/2) int alpha x w, the latter by the polynomial's first three coefficients.
        hx, hy, hz = s * gx, s * gy, s * gz
        if m > 1:
            kx, ky, kz = cross(
                coefficient[0],
                coefficient[1],
                coefficient[2],
                coefficient[6],
                coefficient[7],
                coefficient[8],
            )
            g = s * s * s / 12.0
            hx, hy, hz = hx + g * kx, hy + g * ky, hz + g * kz
        if m > 2:
            kx, ky, kz = cross(
                coefficient[0],
                coefficient[1],
                coefficient[2],
                coefficient[12],
                coefficient[13],
                coefficient[14],
            )
            g = s * s * s * s / 12.0
            hx, hy, hz = hx + g * kx, hy + g * ky, hz + g * kz
        px, py, pz = change_by_turn(hx, hy, hz, fx, fy, fz)
        px, py, pz = px + fx, py + fy, pz + fz
        mass = _MASS[node]
        dvx, dvy, dvz = dvx + mass * px, dvy + mass * py, dvz + mass * pz
        mass *= 1.0 - s
        dsx, dsy, dsz = dsx + mass * px, dsy + mass * py, dsz + mass * pz
        if node == 0:
            a2x, a2y, a2z = -wx, -wy, -wz
            a3x, a3y, a3z = wx, wy, wz
        elif node == 1:
            a1x, a1y, a1z = wx, wy, wz
            a3x, a3y, a3z = a3x - 2.0 * wx, a3y - 2.0 * wy, a3z - 2.0 * wz
        else:
            a2x, a2y, a2z = a2x + wx, a2y + wy, a2z + wz
            a3x, a3y, a3z = a3x + wx, a3y + wy, a3z + wz
    g = _ROOT15 / 3.0
    a2x, a2y, a2z = g * a2x, g * a2y, g * a2z
    g = 10.0 / 3.0
    a3x, a3y, a3z = g * a3x, g * a3y, g * a3z
    # Sixth-order Magnus; the body turns on the right, so each commutator has the other sign.
    c1x, c1y, c1z = cross(a2x, a2y, a2z, a1x, a1y, a1z)
    c2x, c2y, c2z = cross(a1x, a1y, a1z, 2.0 * a3x + c1x, 2.0 * a3y + c1y, 2.0 * a3z + c1z)
    g = 1.0 / 60.0
    kx, ky, kz = cross(
        a2x + g * c2x,
        a2y + g * c2y,
        a2z + g * c2z,
        c1x - 20.0 * a1x - a3x,
        c1y - 20.0 * a1y - a3y,
        c1z - 20.0 * a1z - a3z,
    )
    g = 1.0 / 240.0
    dq[k, 0], dq[k, 1], dq[k, 2], dq[k, 3] = turn_of(
        a1x + a3x / 12.0 + g * kx, a1y + a3y / 12.0 + g * ky, a1z + a3z / 12.0 + g * kz
    )
    dv[k, 0], dv[k, 1], dv[k, 2] = dvx, dvy, dvz
    ds[k, 0], ds[k, 1], ds[k, 2] = t * dsx, t * dsy, t * dsz


@kernel
def integrate_body(
    memory: FloatArray,
    window: int,
    step: FloatArray,
    dtheta: FloatArray,
    dvel: FloatArray,
    gyro_bias: FloatArray,
    dq: FloatArray,
    dv: FloatArray,
    ds: FloatArray,
) -> None:
    """Integrals of a batch of samples.

    Parameters
    ----------
    memory : (MEMORY,) float
        What the stream remembers; zeros at its start; updated in place.
    window : int
        Samples in the polynomial: 2 is the two-sample algorithm, 3..8 high order.
    step : (n,) float
        s.
    dtheta, dvel : (n, 3) float
        Increments, rad and m/s.
    gyro_bias : (3,) float
        Taken off the rate, rad/s.
    dq : (n, 4) float
        Out: quaternion from the body at the end of the step to the body at its start, less the identity (`turn_of`).
    dv, ds : (n, 3) float
        Out: velocity and position integrals in the body axes at the step's start, m/s and m.
    """
    bx, by, bz = gyro_bias[0], gyro_bias[1], gyro_bias[2]
    top = _WINDOW + 7 * (MAX_WINDOW - 1)
    for k in range(step.shape[0]):
        t = step[k]
        if t <= 0.0:
            dq[k, 0], dq[k, 1], dq[k, 2], dq[k, 3] = 0.0, 0.0, 0.0, 0.0
            for i in range(3):
                dv[k, i] = 0.0
                ds[k, i] = 0.0
            continue
        x, y, z = dtheta[k, 0] - bx * t, dtheta[k, 1] - by * t, dtheta[k, 2] - bz * t
        u, v, w = dvel[k, 0], dvel[k, 1], dvel[k, 2]
        if window > 2:
            _remember(memory, window, t, x, y, z, u, v, w)
            _integrate_newest(memory, k, dq, dv, ds)
            continue
        t0 = memory[top]
        px, py, pz = memory[top + 1], memory[top + 2], memory[top + 3]
        qx, qy, qz = memory[top + 4], memory[top + 5], memory[top + 6]
        memory[top] = t
        memory[top + 1], memory[top + 2], memory[top + 3] = x, y, z
        memory[top + 4], memory[top + 5], memory[top + 6] = u, v, w
        c = t * t / (6.0 * t0 * (t + t0)) if t0 > 0.0 else 0.0
        cx, cy, cz = cross(px, py, pz, x, y, z)
        dq[k, 0], dq[k, 1], dq[k, 2], dq[k, 3] = turn_of(x + c * cx, y + c * cy, z + c * cz)
        ax, ay, az = cross(x, y, z, u, v, w)
        sx, sy, sz = cross(px, py, pz, u, v, w)
        rx, ry, rz = cross(qx, qy, qz, x, y, z)
        ex, ey, ez = cross(x, y, z, ax, ay, az)
        dv[k, 0] = u + 0.5 * ax + c * (sx + rx) + ex / 6.0
        dv[k, 1] = v + 0.5 * ay + c * (sy + ry) + ey / 6.0
        dv[k, 2] = w + 0.5 * az + c * (sz + rz) + ez / 6.0
        r = t / t0 if t0 > 0.0 else 0.0
        b = r / (1.0 + r) / 6.0  # slope of the force: 2 (dv/t - dv0/t0) / (t + t0)
        ds[k, 0] = t * (0.5 * u - b * (u - r * qx) + ax / 6.0)
        ds[k, 1] = t * (0.5 * v - b * (v - r * qy) + ay / 6.0)
        ds[k, 2] = t * (0.5 * w - b * (w - r * qz) + az / 6.0)


@inline_kernel
def _remember(
    memory: FloatArray, window: int, t: float, x: float, y: float, z: float, u: float, v: float, w: float
) -> None:
    """Put a sample into the window; the weights are stale where its steps are not those of the window before."""
    seen = min(int(memory[_SEEN]) + 1, window)
    memory[_SEEN] = seen
    top = _WINDOW + 7 * (MAX_WINDOW - 1)
    changed = memory[top] != t
    for i in range(MAX_WINDOW - seen, MAX_WINDOW - 1):
        here = _WINDOW + 7 * i
        changed = changed or memory[here] != memory[here + 7]
        for j in range(7):
            memory[here + j] = memory[here + 7 + j]
    memory[top] = t
    memory[top + 1], memory[top + 2], memory[top + 3] = x, y, z
    memory[top + 4], memory[top + 5], memory[top + 6] = u, v, w
    if changed:
        memory[_READY] = 0.0


@inline_kernel
def _integrate_newest(memory: FloatArray, k: int, dq: FloatArray, dv: FloatArray, ds: FloatArray) -> None:
    """Integrals of the newest step from the polynomials through the window, into row `k`."""
    m = int(memory[_SEEN])
    if memory[_READY] != m:
        steps = memory[_STEPS : _STEPS + m]
        for i in range(m):
            steps[i] = memory[_WINDOW + 7 * (MAX_WINDOW - m + i)]
        weights = memory[_WEIGHTS:_STEPS].reshape((MAX_WINDOW, MAX_WINDOW))
        _fit_weights(steps, m - 1, weights, memory[_TABLE:_COEFFICIENT])
        memory[_READY] = m
    coefficient = memory[_COEFFICIENT:MEMORY]
    for j in range(m):
        c0 = c1 = c2 = c3 = c4 = c5 = 0.0
        for i in range(m):
            weight = memory[_WEIGHTS + j * MAX_WINDOW + i]
            here = _WINDOW + 7 * (MAX_WINDOW - m + i)
            c0 += weight * memory[here + 1]
            c1 += weight * memory[here + 2]
            c2 += weight * memory[here + 3]
            c3 += weight * memory[here + 4]
            c4 += weight * memory[here + 5]
            c5 += weight * memory[here + 6]
        coefficient[6 * j], coefficient[6 * j + 1], coefficient[6 * j + 2] = c0, c1, c2
        coefficient[6 * j + 3], coefficient[6 * j + 4], coefficient[6 * j + 5] = c3, c4, c5
    _integrate_polynomial(coefficient, m, memory[_WINDOW + 7 * (MAX_WINDOW - 1)], k, dq, dv, ds)


@kernel
def integrate_blocks(
    window: int,
    step: FloatArray,
    dtheta: FloatArray,
    dvel: FloatArray,
    gyro_bias: FloatArray,
    dq: FloatArray,
    dv: FloatArray,
    ds: FloatArray,
) -> None:
    """Integrals of a whole record, block by block: one polynomial for the `window` samples of each block.

    More exact than the stream, because the polynomial reaches to both sides; for logs, and for real time that can wait for
    a block. The last block reaches back where samples are missing. Parameters as in `integrate_body`; steps must be
    positive and there must be `window` of them (else the polynomial has the degree that there is).
    """
    n = step.shape[0]
    m = min(window, n)
    coefficient = np.zeros(6 * MAX_WINDOW)
    weights = np.empty((MAX_WINDOW, MAX_WINDOW, MAX_WINDOW))
    fitted, room = np.zeros(MAX_WINDOW), np.empty(2 * m * m)
    for block in range(0, n, m):
        first = min(block, n - m)
        changed = False
        for i in range(m):
            changed = changed or fitted[i] != step[first + i]
            fitted[i] = step[first + i]
        if changed:
            for place in range(m):
                _fit_weights(fitted[:m], place, weights[place], room)
        for k in range(block, min(block + m, n)):
            place = k - first
            for j in range(m):
                c0 = c1 = c2 = c3 = c4 = c5 = 0.0
                for i in range(m):
                    weight = weights[place, j, i]
                    row = first + i
                    c0 += weight * (dtheta[row, 0] - gyro_bias[0] * step[row])
                    c1 += weight * (dtheta[row, 1] - gyro_bias[1] * step[row])
                    c2 += weight * (dtheta[row, 2] - gyro_bias[2] * step[row])
                    c3 += weight * dvel[row, 0]
                    c4 += weight * dvel[row, 1]
                    c5 += weight * dvel[row, 2]
                coefficient[6 * j], coefficient[6 * j + 1], coefficient[6 * j + 2] = c0, c1, c2
                coefficient[6 * j + 3], coefficient[6 * j + 4], coefficient[6 * j + 5] = c3, c4, c5
            _integrate_polynomial(coefficient, m, step[k], k, dq, dv, ds)
