"""Models of what can be measured: each fills the residual, the rows of H and the variances, and says how many rows.

Residual, computed less measured, = H x + noise, x the errors of :mod:`nav.filter.states`. A component whose sigma is not
finite gives no row. The computed values are those of the navigator at an instant (`INSTANT`), taken back by `age`, s: the
measurement was true that long ago. It goes back along the present velocity, acceleration and rate, which is as
good as they are steady; the age is a part of a sample, and the delay of a receiver.

A GNSS antenna stands at l in b; its receiver's delay t makes everything older than it says:

    position   p + C l - age v + age^2 / 2 a       rows: p: I, v: -age, phi: -[C l x], l: -C, t: v
    velocity   v + C (w x l) - age a               rows: v: I, phi: -[C (w x l) x] + age [C f x], gyro bias: -C [l x],
                                                         l: -C [w x], t: a
"""

import math

from nav.earth import RATE, curvature_radii, normal_gravity
from nav.increments import FloatArray
from nav.kernel import inline_kernel, kernel
from nav.turn import cross, matrix_from_quaternion, multiply, quaternion_of, vector_from_quaternion

_RATE_MEAN, _FORCE_MEAN, _RATE, _FORCE, _ROOM = 10, 13, 16, 19, 22
INSTANT = 40
"""lat, lon, height, vel_n (3), q_nb (4) | mean w_ib_b, f_b (3 each) of the last interval | those of the last sample | room.

All as corrected, in rad, m, m/s, rad/s, m/s^2."""
MEAN_PART, LAST_PART = slice(_RATE_MEAN, _RATE), slice(_RATE, _ROOM)
MANOEUVRE = 0.5
"""Share of the difference of the measured force from 1 g that is taken for an acceleration, one sigma, by `gravity`."""
STEEP = 1e-4
"""Smallest cos^2 of the pitch for which there is a heading."""
STEEPEST_FLUX = 0.01
"""Smallest cos^2 of the dip for which a magnetic flux tells a heading."""


@inline_kernel
def _turned(c: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        c[0, 0] * x + c[0, 1] * y + c[0, 2] * z,
        c[1, 0] * x + c[1, 1] * y + c[1, 2] * z,
        c[2, 0] * x + c[2, 1] * y + c[2, 2] * z,
    )


@inline_kernel
def _vector(instant: FloatArray, place: int, length: int) -> FloatArray:
    """Room to work in."""
    room: FloatArray = instant[_ROOM + place : _ROOM + place + length]
    return room


@inline_kernel
def _matrix(instant: FloatArray) -> FloatArray:
    """The first nine of the room as (3, 3)."""
    room: FloatArray = instant[_ROOM : _ROOM + 9].reshape((3, 3))
    return room


@inline_kernel
def _fill_skew(row: FloatArray, axis: int, place: int, sign: float, x: float, y: float, z: float) -> None:
    """Row `axis` of `sign` [(x, y, z) x] added to `row` at `place`."""
    if axis == 0:
        row[place + 1] -= sign * z
        row[place + 2] += sign * y
    elif axis == 1:
        row[place] += sign * z
        row[place + 2] -= sign * x
    else:
        row[place] -= sign * y
        row[place + 1] += sign * x


@inline_kernel
def _fill_quaternion(instant: FloatArray, age: float, q: FloatArray) -> None:
    """q_nb at the measurement's time."""
    q[0], q[1], q[2], q[3] = quaternion_of(-age * instant[_RATE], -age * instant[_RATE + 1], -age * instant[_RATE + 2])
    multiply(instant[6:10], q, q)


@inline_kernel
def _fill_matrix(instant: FloatArray, age: float, c: FloatArray) -> None:
    """C_nb at the measurement's time."""
    q = instant[_ROOM + 9 : _ROOM + 13]
    _fill_quaternion(instant, age, q)
    matrix_from_quaternion(q, c)


@kernel
def gnss_position(
    instant: FloatArray,
    arm: FloatArray,
    delay: float,
    value: FloatArray,
    sigma: FloatArray,
    age: float,
    h: FloatArray,
    residual: FloatArray,
    variance: FloatArray,
) -> int:
    """Position of an antenna.

    Parameters
    ----------
    instant : (INSTANT,) float
        See there.
    arm : (3,) float
        From the navigated point to the antenna, b, m.
    delay : float
        How much older the measurement is than it says, s.
    value : (3,) float
        lat, lon (rad), height (m).
    sigma : (3,) float
        North, east, down, m.
    age : float
        The instant less the time that the measurement says, s.
    h, residual, variance : (3, STATES), (3,), (3,) float
        Out.

    Returns
    -------
    int
        Rows.
    """
    c = _matrix(instant)
    matrix_from_quaternion(instant[6:10], c)
    old = age + delay
    lx, ly, lz = arm[0], arm[1], arm[2]
    reach, swing, push = _vector(instant, 9, 3), _vector(instant, 12, 3), _vector(instant, 15, 3)
    reach[0], reach[1], reach[2] = _turned(c, lx, ly, lz)
    x, y, z = cross(instant[_RATE], instant[_RATE + 1], instant[_RATE + 2], lx, ly, lz)
    swing[0], swing[1], swing[2] = _turned(c, x, y, z)
    push[0], push[1], push[2] = _turned(c, instant[_FORCE], instant[_FORCE + 1], instant[_FORCE + 2])
    s = math.sin(instant[0])
    push[2] += normal_gravity(s, instant[2])
    meridian, prime = curvature_radii(s)
    east = instant[1] - value[1]
    east -= 2.0 * math.pi * math.floor(east / (2.0 * math.pi) + 0.5)
    apart = (
        (instant[0] - value[0]) * (meridian + instant[2]),
        east * (prime + instant[2]) * math.cos(instant[0]),
        value[2] - instant[2],
    )
    m = 0
    for i in range(3):
        if not sigma[i] < math.inf:
            continue
        speed = instant[3 + i] + swing[i]
        residual[m] = apart[i] + reach[i] - old * speed + 0.5 * old * old * push[i]
        variance[m] = sigma[i] * sigma[i]
        h[m] = 0.0
        h[m, i], h[m, 3 + i] = 1.0, -old
        _fill_skew(h[m], i, 6, -1.0, reach[0], reach[1], reach[2])
        for j in range(3):
            h[m, 24 + j] = -c[i, j]
        h[m, 27] = speed - old * push[i]
        m += 1
    return m


@kernel
def gnss_velocity(
    instant: FloatArray,
    arm: FloatArray,
    delay: float,
    value: FloatArray,
    sigma: FloatArray,
    age: float,
    h: FloatArray,
    residual: FloatArray,
    variance: FloatArray,
) -> int:
    """Velocity of an antenna, north, east, down, m/s; parameters as of `gnss_position`."""
    c, swing, push = _matrix(instant), _vector(instant, 9, 3), _vector(instant, 12, 3)
    matrix_from_quaternion(instant[6:10], c)
    old = age + delay
    lx, ly, lz = arm[0], arm[1], arm[2]
    wx, wy, wz = instant[_RATE], instant[_RATE + 1], instant[_RATE + 2]
    x, y, z = cross(wx, wy, wz, lx, ly, lz)
    swing[0], swing[1], swing[2] = _turned(c, x, y, z)
    push[0], push[1], push[2] = _turned(c, instant[_FORCE], instant[_FORCE + 1], instant[_FORCE + 2])
    gravity = normal_gravity(math.sin(instant[0]), instant[2])
    m = 0
    for i in range(3):
        if not sigma[i] < math.inf:
            continue
        acceleration = push[i] + (gravity if i == 2 else 0.0)
        residual[m] = instant[3 + i] + swing[i] - old * acceleration - value[i]
        variance[m] = sigma[i] * sigma[i]
        h[m] = 0.0
        h[m, 3 + i] = 1.0
        turned = swing[0] - old * push[0], swing[1] - old * push[1], swing[2] - old * push[2]
        _fill_skew(h[m], i, 6, -1.0, turned[0], turned[1], turned[2])
        # Rows of C times [l x] and [w x].
        x, y, z = cross(c[i, 0], c[i, 1], c[i, 2], lx, ly, lz)
        h[m, 9], h[m, 10], h[m, 11] = -x, -y, -z
        x, y, z = cross(c[i, 0], c[i, 1], c[i, 2], wx, wy, wz)
        h[m, 24], h[m, 25], h[m, 26] = -x, -y, -z
        h[m, 27] = acceleration
        m += 1
    return m


@kernel
def barometer(
    instant: FloatArray,
    offset: float,
    value: FloatArray,
    sigma: FloatArray,
    age: float,
    h: FloatArray,
    residual: FloatArray,
    variance: FloatArray,
) -> int:
    """Height (1,) by pressure, m, that reads `offset` too high; others as of `gnss_position`."""
    if not sigma[0] < math.inf:
        return 0
    residual[0] = instant[2] + age * instant[5] + offset - value[0]
    variance[0] = sigma[0] * sigma[0]
    h[0] = 0.0
    h[0, 2], h[0, 5], h[0, 28] = -1.0, age, -1.0
    return 1


@kernel
def heading(
    instant: FloatArray,
    value: FloatArray,
    sigma: FloatArray,
    age: float,
    h: FloatArray,
    residual: FloatArray,
    variance: FloatArray,
) -> int:
    """True heading (1,), rad; none where the nose points up or down."""
    c = _matrix(instant)
    _fill_matrix(instant, age, c)
    north, east, down = c[0, 0], c[1, 0], c[2, 0]
    level = north * north + east * east
    if level < STEEP or not sigma[0] < math.inf:
        return 0
    apart = math.atan2(east, north) - value[0]
    residual[0] = apart - 2.0 * math.pi * math.floor(apart / (2.0 * math.pi) + 0.5)
    variance[0] = sigma[0] * sigma[0]
    h[0] = 0.0
    h[0, 6], h[0, 7], h[0, 8] = -north * down / level, -east * down / level, 1.0
    return 1


@kernel
def attitude(
    instant: FloatArray,
    value: FloatArray,
    sigma: FloatArray,
    age: float,
    h: FloatArray,
    residual: FloatArray,
    variance: FloatArray,
) -> int:
    """Attitude q_nb (4,), sigma (3,) about north, east, down, rad. With large residuals the rows hold for the mean attitude."""
    q, turn, phi = _vector(instant, 0, 4), _vector(instant, 4, 4), _vector(instant, 8, 3)
    _fill_quaternion(instant, age, q)
    turn[0], turn[1], turn[2], turn[3] = value[0], -value[1], -value[2], -value[3]
    multiply(q, turn, q)
    vector_from_quaternion(q, phi)
    m = 0
    for i in range(3):
        if sigma[i] < math.inf:
            residual[m], variance[m] = phi[i], sigma[i] * sigma[i]
            h[m] = 0.0
            h[m, 6 + i] = 1.0
            m += 1
    return m


@kernel
def body_velocity(
    instant: FloatArray,
    value: FloatArray,
    sigma: FloatArray,
    age: float,
    h: FloatArray,
    residual: FloatArray,
    variance: FloatArray,
) -> int:
    """Velocity over the ground of the navigated point in b (3,), m/s: zero at rest; sideways and up zero of a wheel."""
    c = _matrix(instant)
    _fill_matrix(instant, age, c)
    ax, ay, az = _turned(c, instant[_FORCE], instant[_FORCE + 1], instant[_FORCE + 2])
    az += normal_gravity(math.sin(instant[0]), instant[2])
    x, y, z = instant[3] - age * ax, instant[4] - age * ay, instant[5] - age * az
    m = 0
    for i in range(3):
        if not sigma[i] < math.inf:
            continue
        cx, cy, cz = c[0, i], c[1, i], c[2, i]
        residual[m] = cx * x + cy * y + cz * z - value[i]
        variance[m] = sigma[i] * sigma[i]
        h[m] = 0.0
        h[m, 3], h[m, 4], h[m, 5] = cx, cy, cz
        h[m, 6], h[m, 7], h[m, 8] = cross(cx, cy, cz, x, y, z)
        m += 1
    return m


@kernel
def magnetic(
    instant: FloatArray,
    field_n: FloatArray,
    value: FloatArray,
    sigma: FloatArray,
    age: float,
    h: FloatArray,
    residual: FloatArray,
    variance: FloatArray,
) -> int:
    """Magnetic flux in b (3,), calibrated, where it is `field_n` (3,) in n; one unit for all."""
    c = _matrix(instant)
    _fill_matrix(instant, age, c)
    x, y, z = field_n[0], field_n[1], field_n[2]
    m = 0
    for i in range(3):
        if not sigma[i] < math.inf:
            continue
        cx, cy, cz = c[0, i], c[1, i], c[2, i]
        residual[m] = cx * x + cy * y + cz * z - value[i]
        variance[m] = sigma[i] * sigma[i]
        h[m] = 0.0
        h[m, 6], h[m, 7], h[m, 8] = cross(cx, cy, cz, x, y, z)
        m += 1
    return m


@kernel
def magnetic_heading(
    instant: FloatArray,
    declination: float,
    value: FloatArray,
    sigma: FloatArray,
    age: float,
    h: FloatArray,
    residual: FloatArray,
    variance: FloatArray,
) -> int:
    """Where the level part of the magnetic flux (3,) in b points: `declination`, rad; of the length nothing is asked.

    None where the flux is nearly vertical. `sigma` is that of the flux, in its unit; the first one counts.
    """
    c = _matrix(instant)
    _fill_matrix(instant, age, c)
    north, east, down = _turned(c, value[0], value[1], value[2])
    level = north * north + east * east
    if level < STEEPEST_FLUX * (level + down * down) or level == 0.0 or not sigma[0] < math.inf:
        return 0
    apart = math.atan2(east, north) - declination
    residual[0] = apart - 2.0 * math.pi * math.floor(apart / (2.0 * math.pi) + 0.5)
    variance[0] = sigma[0] * sigma[0] / level
    h[0] = 0.0
    h[0, 6], h[0, 7], h[0, 8] = -north * down / level, -east * down / level, 1.0
    return 1


@kernel
def earth_rate(
    instant: FloatArray, sigma: FloatArray, h: FloatArray, residual: FloatArray, variance: FloatArray
) -> int:
    """Zero rate: over the last interval the body turned with the Earth; `sigma` (3,) in b, rad/s."""
    c = _matrix(instant)
    matrix_from_quaternion(instant[6:10], c)
    north, down = RATE * math.cos(instant[0]), -RATE * math.sin(instant[0])
    m = 0
    for i in range(3):
        if not sigma[i] < math.inf:
            continue
        cx, cy, cz = c[0, i], c[1, i], c[2, i]
        earth = cx * north + cz * down
        residual[m] = instant[_RATE_MEAN + i] - earth
        variance[m] = sigma[i] * sigma[i]
        h[m] = 0.0
        x, y, z = cross(cx, cy, cz, north, 0.0, down)
        h[m, 6], h[m, 7], h[m, 8] = -x, -y, -z
        # The scale factor goes with the true rate: the measured one is noise, and its square would be learnt.
        h[m, 9 + i], h[m, 15 + i], h[m, 21 + i] = 1.0, earth, instant[_FORCE_MEAN + i]
        m += 1
    return m


@kernel
def gravity(instant: FloatArray, sigma: FloatArray, h: FloatArray, residual: FloatArray, variance: FloatArray) -> int:
    """The vertical: over the last interval the force was that against gravity, north and east of it zero; two rows.

    `sigma` (2,), m/s^2, is that of cruise. A manoeuvre shows in the length of the force: `MANOEUVRE` of its difference
    from 1 g widens sigma.
    """
    c, push = _matrix(instant), _vector(instant, 9, 3)
    matrix_from_quaternion(instant[6:10], c)
    fx, fy, fz = instant[_FORCE_MEAN], instant[_FORCE_MEAN + 1], instant[_FORCE_MEAN + 2]
    push[0], push[1], push[2] = _turned(c, fx, fy, fz)
    surplus = math.sqrt(fx * fx + fy * fy + fz * fz) - normal_gravity(math.sin(instant[0]), instant[2])
    m = 0
    for i in range(2):
        if not sigma[i] < math.inf:
            continue
        residual[m] = push[i]
        variance[m] = sigma[i] * sigma[i] + MANOEUVRE * MANOEUVRE * surplus * surplus
        h[m] = 0.0
        _fill_skew(h[m], i, 6, -1.0, push[0], push[1], push[2])
        for j in range(3):
            h[m, 12 + j], h[m, 18 + j] = c[i, j], c[i, j] * instant[_FORCE_MEAN + j]
        m += 1
    return m
