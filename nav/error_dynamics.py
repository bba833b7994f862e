"""Linear dynamics of the errors of a level, north-slaved navigator.

An error is the computed value less the true one, each in its own n:

    position   (M + h) dB, (N + h) cos B dL, -dh: north, east, down, m, with the radii at the true place
    velocity   of vel_n, m/s
    attitude   rotation vector in n that takes the true attitude to the computed one, rad (`nav.rotation.attitude_error`)

Nine states in this order. With w_ie, w_en the rates of the Earth and of the level, f the specific force, dw and df the errors
of the gyros and the accelerometers in b:

    B' = v_n / (M + h),   L' = v_e / ((N + h) cos B),   h' = -v_d                                         linearized
    dv'   = phi x f - (2 w_ie + w_en) x dv - (2 dw_ie + dw_en) x v + dg + C_nb df
    phi'  = -w_in x phi - dw_in + C_nb dw

(Groves 2013, sec. 14.2, with phi of the other sign; here with the change of both radii and of normal gravity.) Singular at the
poles, as n is. All kernels fill arrays that are given to them.
"""

import math

from nav.earth import E2, RATE, curvature_radii, normal_gravity_gradient
from nav.increments import FloatArray
from nav.kernel import kernel

STATES = 9
POSITION, VELOCITY, ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)
"""Places of the states."""


@kernel
def fill_dynamics(
    lat: float, height: float, vel_n: FloatArray, c_nb: FloatArray, f_b: FloatArray, f: FloatArray
) -> None:
    """Fill F of x' = F x.

    Parameters
    ----------
    lat, height : float
        Geodetic latitude, rad, and height, m.
    vel_n : (3,) float
        m/s.
    c_nb : (3, 3) float
        Attitude.
    f_b : (3,) float
        Specific force, m/s^2.
    f : (9, 9) float
        Out.
    """
    s, c = math.sin(lat), math.cos(lat)
    t = s / c
    meridian, prime = curvature_radii(s)
    w2 = 1.0 - E2 * s * s
    m, n = meridian + height, prime + height
    # Change of each radius per metre to the north.
    dn_north = prime * E2 * s * c / (w2 * m)
    dm_north = 3.0 * meridian * E2 * s * c / (w2 * m)
    g_lat, g_height = normal_gravity_gradient(s, c, height)
    vn, ve, vd = vel_n[0], vel_n[1], vel_n[2]
    a, b = ve / n, vn / m  # w_en = (a, -b, -a tan B)
    u, v = RATE * c, RATE * s
    # d(w_ie), d(w_en) per metre to the north and down; the rest of w_en goes by the velocity.
    u_north, v_north = -v / m, u / m
    a_north, a_down = -a * dn_north / n, a / n
    b_north, b_down = -b * dm_north / m, b / m
    k_north, k_down = a_north * t + a / (c * c * m), a_down * t

    f[:] = 0.0
    f[0, 0], f[0, 2] = -vd / m, b
    f[1, 0], f[1, 1], f[1, 2] = a * t, -(vn * t + vd) / n, a
    f[0, 3] = f[1, 4] = f[2, 5] = 1.0

    # The Coriolis rate 2 w_ie + w_en = (x, y, z), and how place and velocity change it.
    x, y, z = 2.0 * u + a, -b, -2.0 * v - a * t
    x_north, y_north, z_north = 2.0 * u_north + a_north, -b_north, -2.0 * v_north - k_north
    x_down, y_down, z_down = a_down, -b_down, -k_down
    f[3, 0], f[3, 2] = z_north * ve - y_north * vd, z_down * ve - y_down * vd
    f[4, 0], f[4, 2] = x_north * vd - z_north * vn, x_down * vd - z_down * vn
    f[5, 0], f[5, 2] = y_north * vn - x_north * ve, y_down * vn - x_down * ve
    f[5, 0] += g_lat / m
    f[5, 2] -= g_height
    f[3, 3], f[3, 4], f[3, 5] = vd / m, z - a * t, -y
    f[4, 3], f[4, 4], f[4, 5] = -z, (vd + vn * t) / n, x
    f[5, 3], f[5, 4], f[5, 5] = y - b, -x - a, 0.0

    fn = c_nb[0, 0] * f_b[0] + c_nb[0, 1] * f_b[1] + c_nb[0, 2] * f_b[2]
    fe = c_nb[1, 0] * f_b[0] + c_nb[1, 1] * f_b[1] + c_nb[1, 2] * f_b[2]
    fd = c_nb[2, 0] * f_b[0] + c_nb[2, 1] * f_b[1] + c_nb[2, 2] * f_b[2]
    f[3, 7], f[3, 8] = fd, -fe
    f[4, 6], f[4, 8] = -fd, fn
    f[5, 6], f[5, 7] = fe, -fn

    f[6, 0], f[6, 2], f[6, 4] = -u_north - a_north, -a_down, -1.0 / n
    f[7, 0], f[7, 2], f[7, 3] = b_north, b_down, 1.0 / m
    f[8, 0], f[8, 2], f[8, 4] = v_north + k_north, k_down, t / n
    x, y, z = u + a, -b, -v - a * t
    f[6, 7], f[6, 8] = z, -y
    f[7, 6], f[7, 8] = -z, x
    f[8, 6], f[8, 7] = y, -x


@kernel
def fill_transition(f: FloatArray, step: float, transition: FloatArray) -> None:
    """Fill the transition over a step, I + F T + F^2 T^2 / 2: of second order where F is that of mid-step.

    Parameters
    ----------
    f : (9, 9) float
        F at mid-step.
    step : float
        T, s.
    transition : (9, 9) float
        Out.
    """
    half = 0.5 * step * step
    for i in range(STATES):
        for j in range(STATES):
            square = 0.0
            for k in range(STATES):
                square += f[i, k] * f[k, j]
            transition[i, j] = step * f[i, j] + half * square
        transition[i, i] += 1.0


@kernel
def fill_input(f: FloatArray, c_nb: FloatArray, step: float, gain: FloatArray) -> None:
    """Fill what errors of the increments of a step do: (I + F T / 2) (0; C_nb on attitude, C_nb on velocity).

    The errors are even over the step.

    Parameters
    ----------
    f : (9, 9) float
        F at mid-step.
    c_nb : (3, 3) float
        Attitude at mid-step.
    step : float
        T, s.
    gain : (9, 6) float
        Out: by the errors of the angle increments (3), rad, and of the velocity increments (3), m/s, in b.
    """
    half = 0.5 * step
    for i in range(STATES):
        for j in range(3):
            turned = pushed = 0.0
            for k in range(3):
                turned += f[i, 6 + k] * c_nb[k, j]
                pushed += f[i, 3 + k] * c_nb[k, j]
            gain[i, j], gain[i, 3 + j] = half * turned, half * pushed
    for i in range(3):
        for j in range(3):
            gain[6 + i, j] += c_nb[i, j]
            gain[3 + i, 3 + j] += c_nb[i, j]
