"""The closed form of the motion: where the vehicle is and what it feels at one time, on the WGS-84 Earth.

The motion runs on its own time tau(t) (`hil.scenario.MotionConfig`): 0 during the rest, then tau' rises to 1 along the
septic smoothstep (three continuous derivatives at both ends), then 1. Channels are closed forms of tau, so everything
below follows by the chain rule, with no numerical differentiation:

- latitude, longitude and height are scaled path channels; ``vel_n`` and its derivative come from them and from the
  radii of curvature and their slopes;
- ``f_n = d(vel_n)/dt + (2 w_ie + w_en) x vel_n - g_n``; ``w_ib_b = C_bn (w_ie + w_en) + w_nb_b``, where ``w_en`` is
  written with the rate of longitude, so that no tangent of the latitude appears;
- a cone turns the body inside the Euler attitude: ``q_nb = q_euler * q_cone``.

Time is a pair ``whole + part`` and phases are reduced by whole periods before they are scaled, so that a late time is
as exact as an early one.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.scenario import Channel, MotionConfig
from nav import earth
from nav.errors import HilError
from nav.kernel import inline_kernel, kernel

FloatArray = NDArray[np.float64]
Vector = tuple[float, float, float]

_CONE = 6
"""Row of the cone's phase, after the six channels."""
_LEAST_SPEED = 1e-3
"""A coordinated path must keep this share of its largest speed in the horizontal plane."""


class State(NamedTuple):
    """The vehicle at one time; angles rad, rates rad/s, specific force m/s^2 at the navigated point."""

    lat: float
    lon: float
    height: float
    north: float  # velocity, m/s
    east: float
    down: float
    heading: float
    pitch: float
    roll: float
    cone: float  # phase of the cone
    wx: float  # w_ib_b
    wy: float
    wz: float
    fx: float  # f_b
    fy: float
    fz: float


class Plan(NamedTuple):
    """A `MotionConfig` as the kernels want it: SI, flat. A row of `sines` is amplitude, rate, phase, frequency, period."""

    lat: float
    lon: float
    height: float
    north_radius: float
    east_radius: float
    gravity: float
    rest: float
    ramp: float
    coordinated: bool
    cone_sin: float
    cone_cos: float
    first: NDArray[np.int64]  # (8,) first row of each channel in `sines`, north east up heading pitch roll cone
    linear: FloatArray  # (6, 2) offset, rate
    sines: FloatArray  # (n, 6), the period as 24 high bits and the rest


@inline_kernel
def _motion_time(plan: Plan, whole: float, part: float) -> tuple[float, float, float, float]:
    """Motion time as a pair, with its first and second derivatives, at the time whole + part."""
    if plan.ramp == 0.0:
        return whole, part, 1.0, 0.0
    x = ((whole - plan.rest) + part) / plan.ramp
    if x <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    if x >= 1.0:
        shift = -(plan.rest + 0.5 * plan.ramp)
        tau = whole + shift
        added = tau - whole
        return tau, ((whole - (tau - added)) + (shift - added)) + part, 1.0, 0.0
    x3 = x * x * x
    tau = plan.ramp * x3 * x * x * (7.0 - x * (14.0 - x * (10.0 - 2.5 * x)))
    speed = x3 * x * (35.0 - x * (84.0 - x * (70.0 - 20.0 * x)))
    return tau, 0.0, speed, 140.0 * x3 * (1.0 - x) ** 3 / plan.ramp


@inline_kernel
def _phase(plan: Plan, row: int, tau: float, part: float) -> float:
    """Phase of one sinusoid, rad, less a whole number of turns."""
    s = plan.sines
    turns = math.floor(tau * s[row, 3] + 0.5)
    phase: float = s[row, 1] * (((tau - turns * s[row, 4]) - turns * s[row, 5]) + part) + s[row, 2]
    return phase


@inline_kernel
def _channel(plan: Plan, channel: int, tau: float, part: float) -> tuple[float, float, float, float]:
    """Value and three derivatives in tau of one channel."""
    x1 = plan.linear[channel, 1]
    x0 = plan.linear[channel, 0] + x1 * (tau + part)
    x2 = x3 = 0.0
    for row in range(plan.first[channel], plan.first[channel + 1]):
        phase = _phase(plan, row, tau, part)
        rate = plan.sines[row, 1]
        s = plan.sines[row, 0] * math.sin(phase)
        c = plan.sines[row, 0] * rate * math.cos(phase)
        x0 += s
        x1 += c
        x2 -= s * rate * rate
        x3 -= c * rate * rate
    return x0, x1, x2, x3


@inline_kernel
def _to_body(sines: Vector, cosines: Vector, v: Vector) -> Vector:
    """Vector from n to b by sines and cosines of heading, pitch, roll."""
    (sh, sp, sr), (ch, cp, cr) = sines, cosines
    level = ch * v[0] + sh * v[1]
    right = ch * v[1] - sh * v[0]
    under = sp * level + cp * v[2]
    return cp * level - sp * v[2], cr * right + sr * under, cr * under - sr * right


@kernel
def state_at(plan: Plan, whole: float, part: float) -> State:
    """Everything at the time whole + part."""
    tau, part, tau1, tau2 = _motion_time(plan, whole, part)
    n0, n1, n2, n3 = _channel(plan, 0, tau, part)
    e0, e1, e2, e3 = _channel(plan, 1, tau, part)
    u0, u1, u2, _ = _channel(plan, 2, tau, part)
    heading, heading1, _, _ = _channel(plan, 3, tau, part)
    pitch, pitch1, _, _ = _channel(plan, 4, tau, part)
    roll, roll1, _, _ = _channel(plan, 5, tau, part)
    heading1, pitch1, roll1 = heading1 * tau1, pitch1 * tau1, roll1 * tau1

    if plan.coordinated:
        speed = math.hypot(n1, e1)
        speed1 = (n1 * n2 + e1 * e2) / speed
        turn = (n1 * e2 - e1 * n2) / speed  # speed times the rate of the track angle
        turn1 = (n1 * e3 - e1 * n3 - turn * speed1) / speed
        heading += math.atan2(e1, n1)
        heading1 += turn / speed * tau1
        pitch += math.atan2(u1, speed)
        pitch1 += (speed * u2 - u1 * speed1) / (speed * speed + u1 * u1) * tau1
        bank = tau1 * tau1 * turn / plan.gravity
        roll += math.atan(bank)
        roll1 += tau1 * (2.0 * tau2 * turn + tau1 * tau1 * turn1) / plan.gravity / (1.0 + bank * bank)

    lat = plan.lat + n0 / plan.north_radius
    lon = plan.lon + e0 / plan.east_radius
    height = plan.height + u0
    lat1 = n1 * tau1 / plan.north_radius
    lat2 = (n2 * tau1 * tau1 + n1 * tau2) / plan.north_radius
    lon1 = e1 * tau1 / plan.east_radius
    lon2 = (e2 * tau1 * tau1 + e1 * tau2) / plan.east_radius
    up1 = u1 * tau1

    s, c = math.sin(lat), math.cos(lat)
    meridian, prime = earth.curvature_radii(s)
    slope = earth.E2 * s * c / (1.0 - earth.E2 * s * s) * lat1  # rate of ln(prime), a third of that of ln(meridian)
    north_radius, east_radius = meridian + height, prime + height
    vn, ve, vd = north_radius * lat1, east_radius * c * lon1, -up1
    vn1 = north_radius * lat2 + (3.0 * meridian * slope + up1) * lat1
    ve1 = east_radius * (c * lon2 - s * lat1 * lon1) + (prime * slope + up1) * c * lon1
    vd1 = -(u2 * tau1 * tau1 + u1 * tau2)

    # 2 w_ie + w_en, then w_ie + w_en
    rx, ry, rz = (2.0 * earth.RATE + lon1) * c, -lat1, -(2.0 * earth.RATE + lon1) * s
    f_n = (vn1 + ry * vd - rz * ve, ve1 + rz * vn - rx * vd, vd1 + rx * ve - ry * vn - earth.normal_gravity(s, height))
    w_n = ((earth.RATE + lon1) * c, -lat1, -(earth.RATE + lon1) * s)

    sines = (math.sin(heading), math.sin(pitch), math.sin(roll))
    cosines = (math.cos(heading), math.cos(pitch), math.cos(roll))
    wx, wy, wz = _to_body(sines, cosines, w_n)
    wx += roll1 - heading1 * sines[1]
    wy += pitch1 * cosines[2] + heading1 * cosines[1] * sines[2]
    wz += heading1 * cosines[1] * cosines[2] - pitch1 * sines[2]
    fx, fy, fz = _to_body(sines, cosines, f_n)

    # The cone: v cos a - sin a u x v + (1 - cos a) u (u . v) about u = (0, uy, uz), and its own rate
    cone, cone1 = _phase(plan, plan.first[_CONE], tau, part), plan.sines[plan.first[_CONE], 1] * tau1
    uy, uz = math.cos(cone), math.sin(cone)
    sa, ca = plan.cone_sin, plan.cone_cos
    along_w, along_f = (1.0 - ca) * (uy * wy + uz * wz), (1.0 - ca) * (uy * fy + uz * fz)
    return State(
        *(lat, lon, height, vn, ve, vd, heading, pitch, roll, cone),
        wx=ca * wx - sa * (uy * wz - uz * wy) - cone1 * (1.0 - ca),
        wy=ca * wy - sa * uz * wx + uy * along_w - cone1 * sa * uz,
        wz=ca * wz + sa * uy * wx + uz * along_w + cone1 * sa * uy,
        fx=ca * fx - sa * (uy * fz - uz * fy),
        fy=ca * fy - sa * uz * fx + uy * along_f,
        fz=ca * fz + sa * uy * fx + uz * along_f,
    )


def plan_of(config: MotionConfig) -> Plan:
    """Check the motion and lay it flat.

    Raises
    ------
    HilError
        The start is at a pole, or a coordinated path is vertical or stands still somewhere.
    """
    if math.cos(math.radians(config.latitude_deg)) < 1e-6:
        raise HilError("motion.latitude_deg: there is no north at a pole; start elsewhere")
    if config.attitude == "coordinated":
        _require_heading(config)
    lat = math.radians(config.latitude_deg)
    meridian, prime = earth.curvature_radii(math.sin(lat))
    degree = math.pi / 180.0
    path, angles = (config.north, config.east, config.up), (config.heading, config.pitch, config.roll)
    scaled = [(channel, 1.0) for channel in path] + [(channel, degree) for channel in angles]
    rows, first = [], [0]
    for channel, unit in scaled:
        rows += [_sine(unit * sine.amplitude, sine.period_s, sine.phase_deg * degree) for sine in channel.sines]
        first.append(len(rows))
    cone = config.cone
    rows.append(_sine(1.0, 1.0 / cone.frequency_hz if cone and cone.frequency_hz else math.inf, 0.0))
    half_angle = math.radians(cone.half_angle_deg) if cone else 0.0
    return Plan(
        lat=lat,
        lon=math.radians(config.longitude_deg),
        height=config.height_m,
        north_radius=meridian + config.height_m,
        east_radius=(prime + config.height_m) * math.cos(lat),
        gravity=earth.normal_gravity(math.sin(lat), config.height_m),
        rest=config.rest_s,
        ramp=config.ramp_s,
        coordinated=config.attitude == "coordinated",
        cone_sin=math.sin(half_angle),
        cone_cos=math.cos(half_angle),
        first=np.array([*first, len(rows)], dtype=np.int64),
        linear=np.array([(unit * channel.offset, unit * channel.rate) for channel, unit in scaled]),
        sines=np.array(rows),
    )


def _sine(amplitude: float, period: float, phase: float) -> tuple[float, float, float, float, float, float]:
    if math.isinf(period):  # a cone that stands
        return amplitude, 0.0, phase, 0.0, 0.0, 0.0
    high = high_bits(period)
    return amplitude, 2.0 * math.pi / period, phase, 1.0 / period, high, period - high


def high_bits(x: float) -> float:
    """`x` rounded to 24 bits: its product with an integer below 2^29 is exact."""
    mantissa, exponent = math.frexp(x)
    return math.ldexp(round(mantissa * 2**24), exponent - 24)


def motion_times(periods: FloatArray) -> FloatArray:
    """Motion times that see every period 16 times and the longest one 20 times over, if 100000 points allow."""
    if not len(periods):
        return np.zeros(1)
    spacing = periods.min() / 16.0
    count = min(math.ceil(20.0 * periods.max() / spacing), 100_000)
    return np.linspace(0.0, float((count - 1) * spacing), count)


def _require_heading(config: MotionConfig) -> None:
    """Refuse a coordinated path without horizontal speed: its heading is not defined there."""

    def slope(channel: Channel, order: int, tau: FloatArray) -> FloatArray:
        value = np.full_like(tau, channel.rate if order == 1 else 0.0)
        for sine in channel.sines:
            rate = 2.0 * math.pi / sine.period_s
            phase = math.radians(sine.phase_deg) + 0.5 * math.pi * order
            value += sine.amplitude * rate**order * np.sin(rate * tau + phase)
        return value

    def slowing(tau: FloatArray) -> FloatArray:
        north, east = config.north, config.east
        product: FloatArray = slope(north, 1, tau) * slope(north, 2, tau) + slope(east, 1, tau) * slope(east, 2, tau)
        return product

    grid = motion_times(
        np.array([sine.period_s for path in (config.north, config.east, config.up) for sine in path.sines])
    )
    sign = slowing(grid)
    slowest = np.flatnonzero((sign[:-1] < 0.0) & (sign[1:] >= 0.0))
    left, right = grid[slowest], grid[slowest + 1]
    for _ in range(60):
        middle = 0.5 * (left + right)
        left, right = np.where(slowing(middle) < 0.0, (middle, right), (left, middle))
    tau = np.concatenate([grid, left])
    horizontal = np.hypot(slope(config.north, 1, tau), slope(config.east, 1, tau))
    if horizontal.min() <= _LEAST_SPEED * np.hypot(horizontal, slope(config.up, 1, tau)).max():
        raise HilError(
            f"motion: the path stands still or is vertical {tau[horizontal.argmin()]:.3f} s after the start of the motion, "
            'so it has no heading; change motion.north and motion.east or take attitude = "free"'
        )
