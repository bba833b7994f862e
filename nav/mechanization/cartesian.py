"""Mechanizations in Earth-centred axes: `inertial` (source 000) and `earth` (turning with the Earth).

One step for both, in axes that stand still among the stars for its length: the body integrals and the gravitation at
mid-step give the inertial displacement; for `earth` the Earth's turn is then taken off place, velocity and attitude
exactly. Nothing is singular anywhere. Place and attitude are summed with their rounding carried along.

`inertial-source` is the method as source 000 prints it: gravitation and rotation of the force taken at the start of the
step, trapezoid for the place, Picard 3 for the attitude; first order.
"""

import math

import numpy as np

from nav.earth import E2, RATE, A, curvature_radii
from nav.frames import level_in_earth
from nav.gravitation import gravitation_cartesian, near_latitude
from nav.increments import FloatArray
from nav.kernel import inline_kernel, kernel
from nav.rotation import product, rotated
from nav.turn import cross, turn_of

STATE = 29
"""r (3) | v (3) | q (4) | rounding left of r (3) and q (4) | gravitation at the last mid-step (3), its step | sine, cosine
of the latitude | time since the axes of i and e coincided, what rounding left of it | the increment before (3), its step."""
_LOW_R, _LOW_Q, _G, _G_STEP, _LAT, _TIME, _PREVIOUS = 10, 13, 17, 20, 21, 23, 25
PREVIOUS_PART = slice(_PREVIOUS, STATE)
"""The increment before, where the attitude needs it."""


def start(lat: float, lon: float, height: float, vel_n: FloatArray, q_nb: FloatArray, turn_rate: float) -> FloatArray:
    """State vector of the inertial (`turn_rate` = 0) or Earth-fixed (`turn_rate` = RATE) mechanization.

    Parameters as in :func:`nav.mechanization.geographic.start`. The inertial axes are those of e now; for others, shift the
    longitude by the turn since.
    """
    state = np.zeros(STATE)
    sin_lat, cos_lat, sin_lon, cos_lon = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    _, prime = curvature_radii(sin_lat)
    p = (prime + height) * cos_lat
    state[0:3] = p * cos_lon, p * sin_lon, (prime * (1.0 - E2) + height) * sin_lat
    q_en = level_in_earth(lat, lon)
    state[3:6] = rotated(q_en, vel_n)
    if turn_rate == 0.0:
        state[3:6] += RATE * np.array([-state[1], state[0], 0.0])
    state[6:10] = product(q_en, q_nb)
    state[_LAT], state[_LAT + 1] = sin_lat, cos_lat
    return state


@inline_kernel
def _answer(
    turn: float,
    x: float,
    y: float,
    z: float,
    vx: float,
    vy: float,
    vz: float,
    a: float,
    b: float,
    c: float,
    d: float,
    sin_lat: float,
    cos_lat: float,
    k: int,
    position: FloatArray,
    velocity: FloatArray,
    attitude: FloatArray,
) -> None:
    """Write the level solution of a state in axes that are ahead of e by `-turn` about z."""
    p = math.sqrt(x * x + y * y)
    lon = math.atan2(y, x) - turn
    lon -= 2.0 * math.pi * math.floor(lon / (2.0 * math.pi) + 0.5)
    lat = math.atan2(sin_lat, cos_lat)
    position[k, 0], position[k, 1] = lat, lon
    position[k, 2] = p * cos_lat + z * sin_lat - A * math.sqrt(1.0 - E2 * sin_lat * sin_lat)
    cos_lon, sin_lon = (x / p, y / p) if p > 0.0 else (1.0, 0.0)
    out, velocity[k, 1] = vx * cos_lon + vy * sin_lon, vy * cos_lon - vx * sin_lon
    velocity[k, 0], velocity[k, 2] = vz * cos_lat - out * sin_lat, -vz * sin_lat - out * cos_lat
    # q_nb = conj(q_en) q_eb with the longitude of these axes.
    half_lon, half_lat = 0.5 * math.atan2(y, x), -0.5 * (lat + 0.5 * math.pi)
    cl, sl, cb, sb = math.cos(half_lon), math.sin(half_lon), math.cos(half_lat), math.sin(half_lat)
    e, f, g, h = cl * cb, sl * sb, -cl * sb, -sl * cb
    attitude[k, 0] = e * a - f * b - g * c - h * d
    attitude[k, 1] = e * b + f * a + g * d - h * c
    attitude[k, 2] = e * c - f * d + g * a + h * b
    attitude[k, 3] = e * d + f * c - g * b + h * a


@kernel
def advance(
    state: FloatArray,
    field: int,
    turn_rate: float,
    step: FloatArray,
    dq: FloatArray,
    dv: FloatArray,
    ds: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    attitude: FloatArray,
) -> int:
    """As :func:`nav.mechanization.geographic.advance`; `turn_rate` is 0 for inertial axes, RATE for Earth-fixed ones."""
    rx, ry, rz = state[0], state[1], state[2]
    vx, vy, vz = state[3], state[4], state[5]
    a, b, c, d = state[6], state[7], state[8], state[9]
    lx, ly, lz = state[_LOW_R], state[_LOW_R + 1], state[_LOW_R + 2]
    a_low, b_low, c_low, d_low = state[_LOW_Q], state[_LOW_Q + 1], state[_LOW_Q + 2], state[_LOW_Q + 3]
    gx, gy, gz, g_step = state[_G], state[_G + 1], state[_G + 2], state[_G_STEP]
    sin_lat, cos_lat, time, time_low = state[_LAT], state[_LAT + 1], state[_TIME], state[_TIME + 1]
    ahead = RATE - turn_rate
    for k in range(step.shape[0]):
        t = step[k]
        if t > 0.0:
            x, y, z = dv[k, 0], dv[k, 1], dv[k, 2]
            px, py, pz = cross(b, c, d, x, y, z)
            px, py, pz = 2.0 * px, 2.0 * py, 2.0 * pz
            qx, qy, qz = cross(b, c, d, px, py, pz)
            ux, uy, uz = x + a * px + qx, y + a * py + qy, z + a * pz + qz
            x, y, z = ds[k, 0], ds[k, 1], ds[k, 2]
            px, py, pz = cross(b, c, d, x, y, z)
            px, py, pz = 2.0 * px, 2.0 * py, 2.0 * pz
            qx, qy, qz = cross(b, c, d, px, py, pz)
            sx, sy, sz = x + a * px + qx, y + a * py + qy, z + a * pz + qz

            wx, wy = vx - turn_rate * ry, vy + turn_rate * rx  # inertial velocity, z as it is
            t2 = t * t
            if g_step <= 0.0:
                gx, gy, gz = gravitation_cartesian(field, rx, ry, rz, sin_lat, cos_lat)
                g_step = -t
            mx = rx + 0.5 * t * wx + 0.25 * sx + 0.125 * t2 * gx
            my = ry + 0.5 * t * wy + 0.25 * sy + 0.125 * t2 * gy
            mz = rz + 0.5 * t * vz + 0.25 * sz + 0.125 * t2 * gz
            sin_lat, cos_lat = near_latitude(math.sqrt(mx * mx + my * my), mz, sin_lat, cos_lat)
            hx, hy, hz = gravitation_cartesian(field, mx, my, mz, sin_lat, cos_lat)
            # Slope of gravitation from the last mid-step (from the start, the first time); t^3/12 of it is missing.
            slope = t2 / 6.0 * (t / (t + g_step) if g_step > 0.0 else 1.0)
            dx = wx * t + sx + 0.5 * t2 * hx - slope * (hx - gx)
            dy = wy * t + sy + 0.5 * t2 * hy - slope * (hy - gy)
            dz = vz * t + sz + 0.5 * t2 * hz - slope * (hz - gz)
            ux, uy, uz = ux + t * hx, uy + t * hy, uz + t * hz
            gx, gy, gz, g_step = hx, hy, hz, t

            w, x, y, z = dq[k, 0], dq[k, 1], dq[k, 2], dq[k, 3]
            e = a * w - b * x - c * y - d * z
            f = a * x + b * w + c * z - d * y
            g = a * y - b * z + c * w + d * x
            h = a * z + b * y - c * x + d * w
            lack = 0.5 - 0.5 * (a * a + b * b + c * c + d * d)
            a_low += e + lack * a
            b_low += f + lack * b
            c_low += g + lack * c
            d_low += h + lack * d
            if turn_rate != 0.0:
                turn = turn_rate * t
                sw, cw = turn - turn * turn * turn / 6.0, 0.5 * turn * turn
                # Off the place: rotation by -turn about z of r + d; off the velocity likewise, less the Earth's own.
                kx, ky = rx + dx, ry + dy
                ox, oy = sw * ky - cw * kx, -sw * kx - cw * ky
                dx, dy = dx + ox, dy + oy
                kx, ky = wx + ux, wy + uy
                ux += sw * ky - cw * kx + turn_rate * dy
                uy += -sw * kx - cw * ky - turn_rate * dx
                gx, gy = gx + turn * gy, gy - turn * gx
                w, _, _, z = turn_of(0.0, 0.0, -turn)
                px, py, pz, qx = a + e, b + f, c + g, d + h
                a_low += w * px - z * qx
                b_low += w * py - z * pz
                c_low += w * pz + z * py
                d_low += w * qx + z * px
            vx, vy, vz = vx + ux, vy + uy, vz + uz
            lx, ly, lz = lx + dx, ly + dy, lz + dz
            low = rx + lx
            lx -= low - rx
            rx = low
            low = ry + ly
            ly -= low - ry
            ry = low
            low = rz + lz
            lz -= low - rz
            rz = low
            low = a + a_low
            a_low -= low - a
            a = low
            low = b + b_low
            b_low -= low - b
            b = low
            low = c + c_low
            c_low -= low - c
            c = low
            low = d + d_low
            d_low -= low - d
            d = low
            time_low += t
            low = time + time_low
            time_low -= low - time
            time = low
            sin_lat, cos_lat = near_latitude(math.sqrt(rx * rx + ry * ry), rz, sin_lat, cos_lat)
        _answer(
            ahead * time,
            rx,
            ry,
            rz,
            vx + ahead * ry,
            vy - ahead * rx,
            vz,
            a,
            b,
            c,
            d,
            sin_lat,
            cos_lat,
            k,
            position,
            velocity,
            attitude,
        )
    state[0], state[1], state[2] = rx, ry, rz
    state[3], state[4], state[5] = vx, vy, vz
    state[6], state[7], state[8], state[9] = a, b, c, d
    state[_LOW_R], state[_LOW_R + 1], state[_LOW_R + 2] = lx, ly, lz
    state[_LOW_Q], state[_LOW_Q + 1], state[_LOW_Q + 2], state[_LOW_Q + 3] = a_low, b_low, c_low, d_low
    state[_G], state[_G + 1], state[_G + 2], state[_G_STEP] = gx, gy, gz, g_step
    state[_LAT], state[_LAT + 1], state[_TIME], state[_TIME + 1] = sin_lat, cos_lat, time, time_low
    return len(step)


@kernel
def advance_source(
    state: FloatArray,
    field: int,
    step: FloatArray,
    dtheta: FloatArray,
    dvel: FloatArray,
    gyro_bias: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    attitude: FloatArray,
) -> int:
    """Inertial mechanization as source 000 prints it (Uspensky & Bagmut 2009, eqs. 13-17); first order in the step.

    ``dV = C (dv + dth x dv / 2) + g(R) T``, ``R += (V + V') T / 2``, attitude by Picard 3 with the source's scaling of the
    previous increment. `state` as of `start` with turn rate 0; `dtheta` and `dvel` are raw increments, `gyro_bias` (3,) is
    taken off the rate.
    """
    rx, ry, rz = state[0], state[1], state[2]
    vx, vy, vz = state[3], state[4], state[5]
    a, b, c, d = state[6], state[7], state[8], state[9]
    sin_lat, cos_lat, time = state[_LAT], state[_LAT + 1], state[_TIME]
    previous = state[_PREVIOUS : _PREVIOUS + 4]
    for k in range(step.shape[0]):
        t = step[k]
        if t > 0.0:
            x, y, z = dtheta[k, 0] - gyro_bias[0] * t, dtheta[k, 1] - gyro_bias[1] * t, dtheta[k, 2] - gyro_bias[2] * t
            ux, uy, uz = cross(x, y, z, dvel[k, 0], dvel[k, 1], dvel[k, 2])
            ux, uy, uz = dvel[k, 0] + 0.5 * ux, dvel[k, 1] + 0.5 * uy, dvel[k, 2] + 0.5 * uz
            px, py, pz = cross(b, c, d, ux, uy, uz)
            px, py, pz = 2.0 * px, 2.0 * py, 2.0 * pz
            qx, qy, qz = cross(b, c, d, px, py, pz)
            gx, gy, gz = gravitation_cartesian(field, rx, ry, rz, sin_lat, cos_lat)
            nx, ny, nz = (
                vx + ux + a * px + qx + gx * t,
                vy + uy + a * py + qy + gy * t,
                vz + uz + a * pz + qz + gz * t,
            )
            rx, ry, rz = rx + 0.5 * t * (vx + nx), ry + 0.5 * t * (vy + ny), rz + 0.5 * t * (vz + nz)
            vx, vy, vz = nx, ny, nz
            scale = t / previous[3] if previous[3] > 0.0 else 0.0
            px, py, pz = cross(x, y, z, scale * previous[0], scale * previous[1], scale * previous[2])
            th2 = x * x + y * y + z * z
            g = 0.5 - th2 / 48.0
            previous[0], previous[1], previous[2], previous[3] = x, y, z, t
            w, x, y, z = 1.0 - th2 / 8.0, g * x - px / 24.0, g * y - py / 24.0, g * z - pz / 24.0
            a, b, c, d = (
                a * w - b * x - c * y - d * z,
                a * x + b * w + c * z - d * y,
                a * y - b * z + c * w + d * x,
                a * z + b * y - c * x + d * w,
            )
            g = 1.0 / math.sqrt(a * a + b * b + c * c + d * d)
            a, b, c, d = g * a, g * b, g * c, g * d
            time += t
            sin_lat, cos_lat = near_latitude(math.sqrt(rx * rx + ry * ry), rz, sin_lat, cos_lat)
        _answer(
            RATE * time,
            rx,
            ry,
            rz,
            vx + RATE * ry,
            vy - RATE * rx,
            vz,
            a,
            b,
            c,
            d,
            sin_lat,
            cos_lat,
            k,
            position,
            velocity,
            attitude,
        )
    state[0], state[1], state[2] = rx, ry, rz
    state[3], state[4], state[5] = vx, vy, vz
    state[6], state[7], state[8], state[9] = a, b, c, d
    state[_LAT], state[_LAT + 1], state[_TIME] = sin_lat, cos_lat, time
    return len(step)
