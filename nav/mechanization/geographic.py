"""Level (geographic, north-slaved) mechanization with two-sample coning and sculling.

State: geodetic position, velocity in n, attitude q_nb. One step takes the increments of that step and remembers them:
the previous increments give the slope of rate and specific force inside the step (two-sample algorithm in its
previous-increment form, exact for a rate and a force that are linear over both steps, unequal steps included).
The local level turns by its mid-step rate; Coriolis, gravity and the radii are taken at mid-step. Second order in all.

Singular at the poles: `advance` stops before a step that starts within `POLAR_CAP` of one.
"""

import math

import numpy as np

from nav.earth import RATE, curvature_radii, normal_gravity
from nav.increments import FloatArray
from nav.kernel import inline_kernel, kernel
from nav.rotation import from_rotation_vector, multiply, normalise, rotate

POLAR_CAP = 1e-3
"""cos(lat) below which the mechanization refuses to go on (6.4 km from the pole)."""

STATE = 17
"""lat, lon, height | vel_n (3) | q_nb (4) | previous dtheta (3), dvel (3), step."""


def initial_state(lat: float, lon: float, height: float, vel_n: FloatArray, q_nb: FloatArray) -> FloatArray:
    """State vector (`STATE`,) at a start with no previous increments.

    Parameters
    ----------
    lat, lon : float
        Geodetic position, rad.
    height : float
        Above the ellipsoid, m.
    vel_n : (3,) float
        North, east, down, m/s.
    q_nb : (4,) float
        Attitude.
    """
    state = np.zeros(STATE)
    state[0:3] = lat, lon, height
    state[3:6] = vel_n
    state[6:10] = q_nb
    return state


@inline_kernel
def local_rate(sin_lat: float, cos_lat: float, height: float, vel: FloatArray, w: FloatArray) -> None:
    """w: (6,) = Earth rate w_ie and transport rate w_en in n, rad/s, at a position with velocity `vel` (n)."""
    meridian, prime = curvature_radii(sin_lat)
    east = vel[1] / (prime + height)
    w[0], w[1], w[2] = RATE * cos_lat, 0.0, -RATE * sin_lat
    w[3], w[4], w[5] = east, -vel[0] / (meridian + height), -east * sin_lat / cos_lat


@kernel
def advance(
    state: FloatArray,
    step: FloatArray,
    dtheta: FloatArray,
    dvel: FloatArray,
    gyro_bias: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    attitude: FloatArray,
) -> int:
    """Integrate a batch of increments.

    Parameters
    ----------
    state : (STATE,) float
        Advanced in place.
    step : (n,) float
        Steps, s; a step of zero leaves the state as it is.
    dtheta, dvel : (n, 3) float
        Increments, rad and m/s, body axes.
    gyro_bias : (3,) float
        Taken off the rates, rad/s.
    position : (n, 3) float
        Out: lat, lon (rad), height (m) at the end of each step.
    velocity : (n, 3) float
        Out: vel_n, m/s.
    attitude : (n, 4) float
        Out: q_nb.

    Returns
    -------
    int
        Number of steps done: less than n where the next would start in the polar cap.
    """
    q = state[6:10]
    vel = state[3:6]
    work = np.empty(24)
    dth, dv, new, mid, w, delta = work[0:3], work[3:6], work[6:9], work[9:12], work[12:18], work[18:22]
    for k in range(step.shape[0]):
        if math.cos(state[0]) < POLAR_CAP:
            return k
        dt = step[k]
        if dt > 0.0:
            for i in range(3):
                dth[i] = dtheta[k, i] - gyro_bias[i] * dt
                dv[i] = dvel[k, i]
            _step(state, q, vel, dt, dth, dv, new, mid, w, delta)
        for i in range(3):
            position[k, i] = state[i]
            velocity[k, i] = vel[i]
        for i in range(4):
            attitude[k, i] = q[i]
    return len(step)


@inline_kernel
def _step(
    state: FloatArray,
    q: FloatArray,
    vel: FloatArray,
    dt: float,
    dth: FloatArray,
    dv: FloatArray,
    new: FloatArray,
    mid: FloatArray,
    w: FloatArray,
    delta: FloatArray,
) -> None:
    px, py, pz, ux, uy, uz, dt0 = state[10], state[11], state[12], state[13], state[14], state[15], state[16]
    c = dt * dt / (6.0 * dt0 * (dt + dt0)) if dt0 > 0.0 else 0.0
    state[10], state[11], state[12], state[13], state[14], state[15] = dth[0], dth[1], dth[2], dv[0], dv[1], dv[2]
    state[16] = dt

    # Velocity increment in the body axes at the step's start: rotation and sculling.
    hx, hy, hz = 0.5 * dth[0] + c * px, 0.5 * dth[1] + c * py, 0.5 * dth[2] + c * pz
    mid[0] = dv[0] + hy * dv[2] - hz * dv[1] + c * (uy * dth[2] - uz * dth[1])
    mid[1] = dv[1] + hz * dv[0] - hx * dv[2] + c * (uz * dth[0] - ux * dth[2])
    mid[2] = dv[2] + hx * dv[1] - hy * dv[0] + c * (ux * dth[1] - uy * dth[0])
    rotate(q, mid, new)  # new: the increment in n at the step's start

    lat, height = state[0], state[2]
    sin_lat, cos_lat = math.sin(lat), math.cos(lat)
    meridian, prime = curvature_radii(sin_lat)
    # Mid-step velocity: half of the increment, of gravity and of Coriolis, all as at the step's start.
    local_rate(sin_lat, cos_lat, height, vel, w)
    gx, gy, gz = (2.0 * w[0] + w[3]) * dt, (2.0 * w[1] + w[4]) * dt, (2.0 * w[2] + w[5]) * dt
    gravity = normal_gravity(sin_lat, height)
    mid[0] = vel[0] + 0.5 * (new[0] - gy * vel[2] + gz * vel[1])
    mid[1] = vel[1] + 0.5 * (new[1] - gz * vel[0] + gx * vel[2])
    mid[2] = vel[2] + 0.5 * (new[2] - gx * vel[1] + gy * vel[0] + gravity * dt)
    mid_height = height - 0.5 * dt * mid[2]
    mid_lat = lat + 0.5 * dt * mid[0] / (meridian + height)
    sin_lat, cos_lat = math.sin(mid_lat), math.cos(mid_lat)
    local_rate(sin_lat, cos_lat, mid_height, mid, w)
    gravity = normal_gravity(sin_lat, mid_height)

    # The level turns by zeta over the step, by half of it on average while the increment comes in.
    zx, zy, zz = (w[0] + w[3]) * dt, (w[1] + w[4]) * dt, (w[2] + w[5]) * dt
    gx, gy, gz = 2.0 * w[0] + w[3], 2.0 * w[1] + w[4], 2.0 * w[2] + w[5]
    ax = new[0] - 0.5 * (zy * new[2] - zz * new[1]) - dt * (gy * mid[2] - gz * mid[1])
    ay = new[1] - 0.5 * (zz * new[0] - zx * new[2]) - dt * (gz * mid[0] - gx * mid[2])
    az = new[2] - 0.5 * (zx * new[1] - zy * new[0]) - dt * (gx * mid[1] - gy * mid[0]) + gravity * dt

    mid[0], mid[1], mid[2] = vel[0] + 0.5 * ax, vel[1] + 0.5 * ay, vel[2] + 0.5 * az
    meridian, prime = curvature_radii(sin_lat)
    state[0] = lat + dt * mid[0] / (meridian + mid_height)
    state[1] += dt * mid[1] / ((prime + mid_height) * cos_lat)
    state[2] = height - dt * mid[2]
    if state[1] > math.pi:
        state[1] -= 2.0 * math.pi
    elif state[1] < -math.pi:
        state[1] += 2.0 * math.pi
    vel[0] += ax
    vel[1] += ay
    vel[2] += az

    # Attitude: body turns by the coning-corrected rotation vector, the level by zeta.
    from_rotation_vector(
        dth[0] + c * (py * dth[2] - pz * dth[1]),
        dth[1] + c * (pz * dth[0] - px * dth[2]),
        dth[2] + c * (px * dth[1] - py * dth[0]),
        delta,
    )
    multiply(q, delta, q)
    from_rotation_vector(-zx, -zy, -zz, delta)
    multiply(delta, q, q)
    normalise(q)
