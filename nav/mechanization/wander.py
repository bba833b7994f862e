"""Wander-azimuth mechanization (source 002, Babich): level axes w with Z up that do not turn about the vertical.

State: C_ew as a quaternion (it holds latitude, longitude and the azimuth A of the Y axis), height, velocity in w, attitude
q_wb. With k the Earth's axis in w (the third row of C_ew), everything that depends on the place is a polynomial of k:

    sin B = k_z,   rho = (u_z x V)/G - kappa (V . k)(k_y, -k_x),   kappa = N e^2 / (w^2 Q G),   w^2 = 1 - e^2 k_z^2

which is the source's F without its division by cos B: nothing is singular at a pole. The step is that of
:mod:`nav.mechanization.geographic`: inertial displacement in axes that stand still, the Earth's turn taken off, the level
carried along the chord by rho at mid-step, rho_z = 0.
"""

import math

import numpy as np

from nav.earth import E2, RATE, A
from nav.frames import level_in_earth
from nav.gravitation import gravitation_local
from nav.increments import FloatArray
from nav.kernel import inline_kernel, kernel
from nav.rotation import product, quaternion_from_rotation_vector
from nav.turn import change_by_turn, cross, turn_of

STATE = 20
"""q_ew (4) | height | vel_w (3) | q_wb (4) | what rounding left of q_ew (4), q_wb (4)."""


def start(
    lat: float, lon: float, height: float, vel_n: FloatArray, q_nb: FloatArray, azimuth: float = 0.0
) -> FloatArray:
    """State vector; `azimuth` is that of the Y axis, clockwise from north, rad. Others as in the geographic one."""
    q_nw = np.array([0.0, math.cos(0.25 * math.pi + 0.5 * azimuth), math.sin(0.25 * math.pi + 0.5 * azimuth), 0.0])
    q_wn = q_nw * np.array([1.0, -1.0, -1.0, -1.0])
    state = np.zeros(STATE)
    state[0:4] = product(level_in_earth(lat, lon), q_nw)
    state[4] = height
    s, c = math.sin(azimuth), math.cos(azimuth)
    state[5:8] = c * vel_n[1] - s * vel_n[0], s * vel_n[1] + c * vel_n[0], -vel_n[2]
    state[8:12] = product(q_wn, q_nb)
    return state


def correct(state: FloatArray, platform: FloatArray, tilt: FloatArray, vel_w: FloatArray, height: float) -> None:
    """Correct the state by small rotation vectors, rad, and differences, all in w axes.

    Parameters
    ----------
    state : (STATE,) float
        Changed in place.
    platform : (3,) float
        Turns w in e: the place by X and Y, the azimuth A by -Z. Velocity and attitude stay as they are in w.
    tilt : (3,) float
        Turns the body in w.
    vel_w, height : (3,) float and float
        Added to velocity, m/s, and height, m.
    """
    state[0:4] = product(state[0:4], quaternion_from_rotation_vector(platform))
    state[4] += height
    state[5:8] += vel_w
    state[8:12] = product(quaternion_from_rotation_vector(tilt), state[8:12])
    state[12:STATE] = 0.0


@inline_kernel
def _field(field: int, kx: float, ky: float, kz: float, height: float, prime: float) -> tuple[float, float, float]:
    """Gravitation in w axes."""
    c = math.sqrt(kx * kx + ky * ky)
    north, down = gravitation_local(field, kz, c, height, (prime + height) * c)
    scale = north / c if c > 1e-12 else 0.0
    return scale * kx, scale * ky, -down


@kernel
def advance(
    state: FloatArray,
    field: int,
    step: FloatArray,
    dq: FloatArray,
    dv: FloatArray,
    ds: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    attitude: FloatArray,
    azimuth: FloatArray,
) -> int:
    """As :func:`nav.mechanization.geographic.advance`; `azimuth` (n,) out: that of the Y axis, rad, in (-pi, pi]."""
    ea, eb, ec, ed = state[0], state[1], state[2], state[3]
    height, vx, vy, vz = state[4], state[5], state[6], state[7]
    a, b, c, d = state[8], state[9], state[10], state[11]
    ea_low, eb_low, ec_low, ed_low = state[12], state[13], state[14], state[15]
    a_low, b_low, c_low, d_low = state[16], state[17], state[18], state[19]
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

            kx, ky = 2.0 * (eb * ed - ea * ec), 2.0 * (ec * ed + ea * eb)
            kz = ea * ea - eb * eb - ec * ec + ed * ed
            w2 = 1.0 - E2 * kz * kz
            prime = A / math.sqrt(w2)
            big_g, big_q = prime + height, prime * (1.0 - E2) / w2 + height
            kappa = prime * E2 / (w2 * big_q * big_g)
            turn = RATE * t
            t2 = t * t
            ix, iy = vx + RATE * big_g * ky, vy - RATE * big_g * kx  # inertial velocity

            # Mid-step gravitation.
            gx0, gy0, gz0 = _field(field, kx, ky, kz, height, prime)
            arch = 0.125 * t2 * RATE * RATE * big_g * kz
            hx, hy = 0.5 * t * vx + 0.25 * sx + 0.125 * t2 * gx0, 0.5 * t * vy + 0.25 * sy + 0.125 * t2 * gy0
            cx, cy = RATE * (ky * vz - kz * vy), RATE * (kz * vx - kx * vz)  # k x v: half of Coriolis
            hx, hy = hx - 0.25 * t2 * cx - arch * kx, hy - 0.25 * t2 * cy - arch * ky
            dot = kappa * (hx * kx + hy * ky)
            rx, ry = -hy / big_g - dot * ky, hx / big_g + dot * kx
            mx, my, mz = change_by_turn(-rx, -ry, 0.0, kx, ky, kz)
            mx, my, mz = kx + mx, ky + my, kz + mz
            speed2 = (ix * ix + iy * iy) / big_g
            hm = height + 0.5 * t * vz + 0.25 * sz + 0.125 * t2 * (gz0 + speed2)
            prime_m = A / math.sqrt(1.0 - E2 * mz * mz)
            gx, gy, gz = _field(field, mx, my, mz, hm, prime_m)
            px, py, pz = change_by_turn(0.5 * turn * kx + rx, 0.5 * turn * ky + ry, 0.5 * turn * kz, gx, gy, gz)
            gx, gy, gz = gx + px, gy + py, gz + pz

            ux, uy, uz = ux + gx * t, uy + gy * t, uz + gz * t
            dx = ix * t + sx + t2 * (0.5 * gx - (gx - gx0) / 6.0)
            dy = iy * t + sy + t2 * (0.5 * gy - (gy - gy0) / 6.0)
            dz = vz * t + sz + t2 * (0.5 * gz - (gz - gz0) / 6.0)
            # The Earth's turn off the place.
            sw, cw = turn - turn * turn * turn / 6.0, 0.5 * turn * turn
            px, py, pz = cross(kx, ky, kz, dx, dy, dz)
            px, py = px + big_g * ky, py - big_g * kx
            qx, qy, qz = cross(kx, ky, kz, px, py, pz)
            dx, dy, dz = dx - sw * px + cw * qx, dy - sw * py + cw * qy, dz - sw * pz + cw * qz

            # The level along the chord: curvature at the middle.
            dot = kappa * (dx * kx + dy * ky)
            rx, ry = -dy / big_g - dot * ky, dx / big_g + dot * kx
            mx, my, mz = change_by_turn(-0.5 * rx, -0.5 * ry, 0.0, kx, ky, kz)
            mx, my, mz = kx + mx, ky + my, kz + mz
            px, py, rise = change_by_turn(-0.5 * rx, -0.5 * ry, 0.0, dx, dy, dz)
            px, py, rise = dx + px, dy + py, dz + rise
            w2 = 1.0 - E2 * mz * mz
            prime = A / math.sqrt(w2)
            hm = height + 0.5 * rise
            big_g, big_q = prime + hm, prime * (1.0 - E2) / w2 + hm
            dot = prime * E2 / (w2 * big_q * big_g) * (px * mx + py * my)
            rx, ry = -py / big_g - dot * my, px / big_g + dot * mx
            height += rise

            # Velocity: the Earth's turn, its own speed at the new place, then the new level.
            px, py, pz = change_by_turn(-turn * kx, -turn * ky, -turn * kz, ix + ux, iy + uy, vz + uz)
            qx, qy, qz = cross(kx, ky, kz, dx, dy, dz)
            ux, uy, uz = ux + px - RATE * qx, uy + py - RATE * qy, uz + pz - RATE * qz
            px, py, pz = change_by_turn(-rx, -ry, 0.0, vx + ux, vy + uy, vz + uz)
            vx, vy, vz = vx + (ux + px), vy + (uy + py), vz + (uz + pz)

            w, x, y, z = turn_of(rx, ry, 0.0)
            lack = 0.5 - 0.5 * (ea * ea + eb * eb + ec * ec + ed * ed)
            ea_low += ea * w - eb * x - ec * y + lack * ea
            eb_low += ea * x + eb * w - ed * y + lack * eb
            ec_low += ea * y + ec * w + ed * x + lack * ec
            ed_low += eb * y - ec * x + ed * w + lack * ed
            low = ea + ea_low
            ea_low -= low - ea
            ea = low
            low = eb + eb_low
            eb_low -= low - eb
            eb = low
            low = ec + ec_low
            ec_low -= low - ec
            ec = low
            low = ed + ed_low
            ed_low -= low - ed
            ed = low

            w, x, y, z = dq[k, 0], dq[k, 1], dq[k, 2], dq[k, 3]
            e = a * w - b * x - c * y - d * z
            f = a * x + b * w + c * z - d * y
            g = a * y - b * z + c * w + d * x
            h = a * z + b * y - c * x + d * w
            w, x, y, z = turn_of(-turn * mx - rx, -turn * my - ry, -turn * mz)
            px, py, pz, qx = a + e, b + f, c + g, d + h
            lack = 0.5 - 0.5 * (a * a + b * b + c * c + d * d)
            a_low += e + (w * px - x * py - y * pz - z * qx) + lack * a
            b_low += f + (w * py + x * px + y * qx - z * pz) + lack * b
            c_low += g + (w * pz - x * qx + y * px + z * py) + lack * c
            d_low += h + (w * qx + x * pz - y * py + z * px) + lack * d
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
        # Level solution: north is where the Earth's axis points in the level.
        kx, ky = 2.0 * (eb * ed - ea * ec), 2.0 * (ec * ed + ea * eb)
        kz = ea * ea - eb * eb - ec * ec + ed * ed
        cos_lat = math.sqrt(kx * kx + ky * ky)
        lat = math.atan2(kz, cos_lat)
        lon = math.atan2(2.0 * (ec * ed - ea * eb), 2.0 * (eb * ed + ea * ec))
        wander = math.atan2(-kx, ky)
        position[k, 0], position[k, 1], position[k, 2] = lat, lon, height
        azimuth[k] = wander
        s, w = (-kx / cos_lat, ky / cos_lat) if cos_lat > 0.0 else (0.0, 1.0)
        velocity[k, 0], velocity[k, 1], velocity[k, 2] = w * vy - s * vx, w * vx + s * vy, -vz
        x, y = math.cos(0.25 * math.pi + 0.5 * wander), math.sin(0.25 * math.pi + 0.5 * wander)
        attitude[k, 0] = -x * b - y * c
        attitude[k, 1] = x * a + y * d
        attitude[k, 2] = y * a - x * d
        attitude[k, 3] = x * c - y * b
    state[0], state[1], state[2], state[3] = ea, eb, ec, ed
    state[4], state[5], state[6], state[7] = height, vx, vy, vz
    state[8], state[9], state[10], state[11] = a, b, c, d
    state[12], state[13], state[14], state[15] = ea_low, eb_low, ec_low, ed_low
    state[16], state[17], state[18], state[19] = a_low, b_low, c_low, d_low
    return len(step)
