"""One navigation solution as MAVLink needs it: plain numbers, and what follows from them, each worked out once.

Frames and units as in :mod:`nav`.
"""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING, Any

from nav.earth import E2, RATE, A
from nav.state import NAV_STATE, Health, Mode
from nav.turn import euler_of

if TYPE_CHECKING:
    from functools import cached_property
else:

    class cached_property:
        """That of functools as it is from Python 3.12 on, without a lock."""

        def __init__(self, function):
            self._function, self.__doc__ = function, function.__doc__

        def __get__(self, instance, owner=None):
            """Work it out the first time."""
            if instance is None:
                return self
            value = instance.__dict__[self._function.__name__] = self._function(instance)
            return value


_CODES = {"<i8": "q", "<i4": "i", "<f8": "d", "<f4": "f"}
_LENGTHS = {name: math.prod(NAV_STATE[name].shape) for name in NAV_STATE.names or ()}
_ROW = struct.Struct("<" + "".join(f"{n}{_CODES[NAV_STATE[name].base.str]}" for name, n in _LENGTHS.items()))
"""A row as plain numbers, which numpy gives one by one only."""
_PARTS = {
    name: slice(end - _LENGTHS[name], end) for name, end in zip(_LENGTHS, accumulate(_LENGTHS.values()), strict=True)
}
_SINGLE = [_PARTS[name].start for name in ("arrival_ns", "time", "mode", "health", "lat", "lon", "height")]
_SEVERAL = [_PARTS[name] for name in ("vel_n", "q_nb", "w_ib_b", "f_b", "sigma", "test_ratio")]

Vector = tuple[float, float, float]
Undulation = Callable[[float, float], float]
"""(lat, lon), rad, to the height of the geoid above the ellipsoid, m."""

_LARGEST = 1e30
"""Larger than any quantity and within single precision."""
_LATEST_S = 9e9
"""Nanoseconds up to here fit 64 bits."""
_WORST = 1e15
"""Squares of sigmas up to here are within single precision."""


@dataclass(frozen=True)
class Home:
    """The place that relative positions refer to."""

    lat: float
    lon: float
    height: float

    def offset(self, place: "Home") -> Vector:
        """`place` north, east, down of here in the local level of here, m."""
        dx, dy, dz = (a - b for a, b in zip(_ecef_of(place), _ecef_of(self), strict=True))
        s, c = math.sin(self.lat), math.cos(self.lat)
        sl, cl = math.sin(self.lon), math.cos(self.lon)
        outward = cl * dx + sl * dy
        return c * dz - s * outward, cl * dy - sl * dx, -(c * outward + s * dz)


@dataclass(frozen=True)
class Solution:
    """One row of `NAV_STATE`."""

    time: float
    arrival_ns: int
    mode: Mode
    health: Health
    lat: float
    lon: float
    height: float
    vel_n: Vector
    q_nb: tuple[float, float, float, float]
    w_ib_b: Vector
    f_b: Vector
    sigma: tuple[float, ...]
    test_ratio: tuple[float, ...]
    geoid: Undulation

    @classmethod
    def of(cls, row: Any, geoid: Undulation) -> "Solution":
        """The solution in `row`, one record of `NAV_STATE`."""
        numbers = _ROW.unpack(row.tobytes())
        arrival_ns, time, mode, health, lat, lon, height = (numbers[k] for k in _SINGLE)
        vel_n, q_nb, w_ib_b, f_b, sigma, test_ratio = (numbers[part] for part in _SEVERAL)
        where = lat, lon, height, vel_n, q_nb, w_ib_b, f_b, sigma, test_ratio
        return cls(time, arrival_ns, Mode(mode), Health(health), *where, geoid)

    @cached_property
    def has_imu(self) -> bool:
        """Whether rate, specific force and time are usable numbers."""
        return _usable(self.time, *self.w_ib_b, *self.f_b) and 0.0 <= self.time < _LATEST_S

    @cached_property
    def has_attitude(self) -> bool:
        """Whether there is an attitude: none before the alignment has found one."""
        return self.has_imu and _usable(*self.q_nb) and abs(sum(x * x for x in self.q_nb) - 1.0) < 0.01

    @cached_property
    def has_position(self) -> bool:
        """Whether position and velocity are usable and stand for something."""
        return self.has_attitude and _usable(self.lat, self.lon, self.height, *self.vel_n)

    @cached_property
    def has_sigma(self) -> bool:
        """Whether it is known how good position, velocity and attitude are: by an aided navigator only."""
        known = all(0.0 <= one < _WORST for one in self.sigma) and _usable(*self.test_ratio)
        return self.has_position and known

    @cached_property
    def euler(self) -> Vector:
        """Heading [0, 2 pi), pitch, roll, rad."""
        return euler_of(*self.q_nb)

    @cached_property
    def altitude(self) -> float:
        """Height above mean sea level, m."""
        return self.height - self.geoid(self.lat, self.lon)

    def in_body(self, v_n: Vector) -> Vector:
        """A vector given north, east, down along the body axes."""
        w, x, y, z = self.q_nb
        return _rotated((w, -x, -y, -z), v_n)

    @cached_property
    def vel_b(self) -> Vector:
        """Velocity over the ground, body axes, m/s."""
        return self.in_body(self.vel_n)

    @cached_property
    def vel_b_variance(self) -> Vector:
        """Variances of `vel_b`, of independent errors of `vel_n`, m^2/s^2."""
        w, x, y, z = self.q_nb
        axes = (_rotated((w, x, y, z), axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
        forward, right, down = (sum((c * s) ** 2 for c, s in zip(axis, self.sigma[3:6], strict=True)) for axis in axes)
        return forward, right, down

    @cached_property
    def w_nb_b(self) -> Vector:
        """Rate of the body relative to the local level, body axes, rad/s: Earth and transport rate taken off."""
        s, c = math.sin(self.lat), math.cos(self.lat)
        w2 = 1.0 - E2 * s * s
        prime = A / math.sqrt(w2)
        east = self.vel_n[1] / (prime + self.height)
        north = self.vel_n[0] / (prime * (1.0 - E2) / w2 + self.height)
        turn = east * s / c if abs(c) > 1e-3 else 0.0
        p, q, r = self.in_body((RATE * c + east, -north, -RATE * s - turn))
        return self.w_ib_b[0] - p, self.w_ib_b[1] - q, self.w_ib_b[2] - r

    def relative_to(self, home: Home) -> Vector:
        """Position north, east, down of `home` in its local level, m."""
        return home.offset(Home(self.lat, self.lon, self.height))


def geodetic(home: Home, ned: Vector) -> Vector:
    """lat, lon (rad), height (m) of a point north, east, down of `home` in its local level, m; to micrometres within 100 km."""
    s, c = math.sin(home.lat), math.cos(home.lat)
    outward = -s * ned[0] - c * ned[2]
    sl, cl = math.sin(home.lon), math.cos(home.lon)
    offset = cl * outward - sl * ned[1], sl * outward + cl * ned[1], c * ned[0] - s * ned[2]
    x, y, z = (a + b for a, b in zip(_ecef_of(home), offset, strict=True))
    level, lat, height = math.hypot(x, y), home.lat, home.height
    for _ in range(5):
        prime = A / math.sqrt(1.0 - E2 * math.sin(lat) ** 2)
        lat = math.atan2(z, level * (1.0 - E2 * prime / (prime + height)))
        s, c = math.sin(lat), math.cos(lat)
        height = level * c + z * s - A * math.sqrt(1.0 - E2 * s * s)
    return lat, math.atan2(y, x), height


def _usable(*values: float) -> bool:
    return math.hypot(*values) < _LARGEST  # False for NaN too


def _ecef_of(place: Home) -> Vector:
    s, c = math.sin(place.lat), math.cos(place.lat)
    prime = A / math.sqrt(1.0 - E2 * s * s)
    level = (prime + place.height) * c
    return level * math.cos(place.lon), level * math.sin(place.lon), (prime * (1.0 - E2) + place.height) * s


def _rotated(q: tuple[float, float, float, float], v: Vector) -> Vector:
    w, x, y, z = q
    tx, ty, tz = 2.0 * (y * v[2] - z * v[1]), 2.0 * (z * v[0] - x * v[2]), 2.0 * (x * v[1] - y * v[0])
    return v[0] + w * tx + y * tz - z * ty, v[1] + w * ty + z * tx - x * tz, v[2] + w * tz + x * ty - y * tx
