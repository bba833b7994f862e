"""Level, north-slaved mechanization in curvilinear coordinates: geodetic position, velocity in n, attitude q_nb.

A step happens in axes that stand still among the stars: those of n at the step's start. There the body integrals (see
:mod:`nav.body_integrals`) and the gravitation at mid-step add up to the inertial displacement; the Earth's turn is taken
off it exactly; what is left moves latitude, longitude and height along the chord at the mid latitude; the new n is reached
by the rotation of latitude and longitude. Every part is exact but for terms of third order in step / Earth radius and in the
change of gravitation, far below what the sensors' polynomial leaves; so the order is that of the body integrals.

Singular at the poles: stops before a step that starts beyond `MAX_LAT`.
"""

import math

import numpy as np

from nav.earth import RATE, curvature_radii
from nav.gravitation import gravitation_local
from nav.increments import FloatArray
from nav.kernel import kernel
from nav.turn import change_by_turn, cross, turn_of

MAX_LAT = math.acos(1e-3)
"""Latitude beyond which no step starts, rad (6.4 km from the pole)."""
STATE = 16
"""lat, lon, height | vel_n (3) | q_nb (4) | what rounding left of lat, lon, q_nb, carried to the next step."""


def start(lat: float, lon: float, height: float, vel_n: FloatArray, q_nb: FloatArray) -> FloatArray:
    """State vector at a geodetic position (rad, m) with velocity (3,), m/s, and attitude (4,)."""
    state = np.zeros(STATE)
    state[0:3] = lat, lon, height
    state[3:6] = vel_n
    state[6:10] = q_nb
    return state


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
) -> int:
    """Take the body integrals of a batch of steps.

    Parameters
    ----------
    state : (STATE,) float
        Advanced in place.
    field : int
        Gravity field (:mod:`nav.gravitation`).
    step : (n,) float
        s; a step of zero changes nothing.
    dq, dv, ds : (n, 4), (n, 3), (n, 3) float
        Of :func:`nav.body_integrals.integrate_body`.
    position : (n, 3) float
        Out: lat, lon (rad), height (m) at the end of each step.
    velocity, attitude : (n, 3), (n, 4) float
        Out: vel_n (m/s) and q_nb.

    Returns
    -------
    int
        Steps done: fewer than n where the next would start in the polar cap.
    """
    lat, lon, height = state[0], state[1], state[2]
    vn, ve, vd = state[3], state[4], state[5]
    a, b, c, d = state[6], state[7], state[8], state[9]
    lat_low, lon_low = state[10], state[11]
    a_low, b_low, c_low, d_low = state[12], state[13], state[14], state[15]
    done = len(step)
    for k in range(step.shape[0]):
        t = step[k]
        if abs(lat) > MAX_LAT:
            done = k
            break
        sin_lat, cos_lat = math.sin(lat), math.cos(lat)
        if t > 0.0:
            # Body integrals in the axes of n at the step's start.
            x, y, z = dv[k, 0], dv[k, 1], dv[k, 2]
            px, py, pz = cross(b, c, d, x, y, z)
            px, py, pz = 2.0 * px, 2.0 * py, 2.0 * pz
            qx, qy, qz = cross(b, c, d, px, py, pz)
            un, ue, ud = x + a * px + qx, y + a * py + qy, z + a * pz + qz
            x, y, z = ds[k, 0], ds[k, 1], ds[k, 2]
            px, py, pz = cross(b, c, d, x, y, z)
            px, py, pz = 2.0 * px, 2.0 * py, 2.0 * pz
            qx, qy, qz = cross(b, c, d, px, py, pz)
            sn, se, sd = x + a * px + qx, y + a * py + qy, z + a * pz + qz

            meridian, prime = curvature_radii(sin_lat)
            axis = (prime + height) * cos_lat
            turn = RATE * t
            vi = ve + RATE * axis  # inertial velocity to the east

            # Mid-step place, for gravitation: half of the way, the Earth's turn included.
            half = 0.5 * t
            hn, he, hd = half * vn + 0.25 * sn, half * ve + 0.25 * se, half * vd + 0.25 * sd
            gn0, gd0 = gravitation_local(field, sin_lat, cos_lat, height, axis)
            dlat = (hn - 0.125 * t * t * sin_lat * vi * vi / axis) / (meridian + height)
            dlon = he / axis
            sm = sin_lat + dlat * (cos_lat - 0.5 * dlat * sin_lat)
            cm = cos_lat - dlat * (sin_lat + 0.5 * dlat * cos_lat)
            hm = height - hd - 0.125 * t * t * (gd0 - cos_lat * vi * vi / axis - vn * vn / (meridian + height))
            _, prime_m = curvature_radii(sm)
            gn, gd = gravitation_local(field, sm, cm, hm, (prime_m + hm) * cm)
            angle = dlon + 0.5 * turn
            px, ge, pz = change_by_turn(angle * cos_lat, -dlat, -angle * sin_lat, gn, 0.0, gd)
            gn, gd = gn + px, gd + pz

            # Inertial velocity gained and displacement; gravitation is linear in time over the step.
            un, ue, ud = un + gn * t, ue + ge * t, ud + gd * t
            w = t * t
            dn = vn * t + sn + w * (0.5 * gn - (gn - gn0) / 6.0)
            de = vi * t + se + w * (0.5 * ge - ge / 6.0)
            dd = vd * t + sd + w * (0.5 * gd - (gd - gd0) / 6.0)
            # Take the Earth's turn about (cos lat, 0, -sin lat) off the new place, seen from the old one.
            sw = turn - turn * turn * turn / 6.0
            cw = 0.5 * turn * turn
            kx = sin_lat * de
            ky = axis - sin_lat * dn - cos_lat * dd
            kz = cos_lat * de
            rn, re, rd = dn - sw * kx, de - sw * ky, dd - sw * kz
            rn += cw * sin_lat * ky
            re -= cw * de
            rd += cw * cos_lat * ky

            # Along the meridian and around the axis.
            out = -sin_lat * rn - cos_lat * rd
            radius = axis + out
            dlon = re / radius
            dlon -= dlon * dlon * dlon / 3.0
            bulge = 0.5 * re * re / radius
            up = cos_lat * bulge - rd
            north = rn - sin_lat * bulge
            dlat = north / (meridian + height)
            h = 0.5 * dlat
            sm = sin_lat + h * (cos_lat - 0.5 * h * sin_lat)
            cm = cos_lat - h * (sin_lat + 0.5 * h * cos_lat)
            meridian, _ = curvature_radii(sm)
            chord = north - h * (up + 0.5 * h * north)
            rise = up + h * (north - 0.5 * h * up)
            dlat = chord / (meridian + height + 0.5 * rise)

            lat_low += dlat
            low = lat + lat_low
            lat_low -= low - lat
            lat = low
            lon_low += dlon
            low = lon + lon_low
            lon_low -= low - lon
            lon = low
            if lon > math.pi:
                lon -= 2.0 * math.pi
            elif lon < -math.pi:
                lon += 2.0 * math.pi
            height += rise

            # From the old level to the new one.
            angle = dlon + turn
            zx, zy, zz = angle * cm, -dlat, -angle * sm
            px, py, pz = change_by_turn(-zx, -zy, -zz, vn + un, vi + ue, vd + ud)
            vn, ve, vd = vn + (un + px), ve + (ue + py - RATE * (out + bulge)), vd + (ud + pz)
            w, x, y, z = dq[k, 0], dq[k, 1], dq[k, 2], dq[k, 3]
            e = a * w - b * x - c * y - d * z
            f = a * x + b * w + c * z - d * y
            g = a * y - b * z + c * w + d * x
            h = a * z + b * y - c * x + d * w
            w, x, y, z = turn_of(-zx, -zy, -zz)
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
        position[k, 0], position[k, 1], position[k, 2] = lat, lon, height
        velocity[k, 0], velocity[k, 1], velocity[k, 2] = vn, ve, vd
        attitude[k, 0], attitude[k, 1], attitude[k, 2], attitude[k, 3] = a, b, c, d
    state[0], state[1], state[2] = lat, lon, height
    state[3], state[4], state[5] = vn, ve, vd
    state[6], state[7], state[8], state[9] = a, b, c, d
    state[10], state[11] = lat_low, lon_low
    state[12], state[13], state[14], state[15] = a_low, b_low, c_low, d_low
    return done
