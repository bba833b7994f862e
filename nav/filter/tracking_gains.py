"""Gains of the tracking correction: fixed time constants, or those of a steady Kalman filter (source 002, Babich).

A level axis of w is a place, a velocity and the tilt that turns gravity into it; the vertical has no tilt; A stands alone:

    p' = v,    v' = g phi + b + white,    phi' = -v / R + d + white,    A' = d + white

The bias b of the accelerometers and the drift d of the gyros are not estimated: the scheme has no states for them. They are
considered (Schmidt 1966): they stand in the covariance as constants of known sigma, and their own gain is zero. Left out, the
gains of good gyros would fall to almost nothing and the bias would stand at d / K. For A with fixes of the variance r, T apart,

    cov(A, d)' = d^2 - K cov(A, d) = 0,    P' = 2 cov(A, d) + q - K^2 r T = 0,    K = P / (r T)

so that the steady gain is the root of

    K^3 r T = 2 d^2 + q K

with q the density of the white noise: noise alone gives K = sqrt(q / (r T)), drift alone K = (2 d^2 / (r T))^(1/3). The other
channels have no such formula; the recursion is run until its gains stand.
"""

import math
from dataclasses import astuple, dataclass
from typing import Protocol

import numpy as np

from nav.earth import STANDARD_GRAVITY, A
from nav.errors import HilError
from nav.increments import FloatArray
from nav.kernel import kernel

STEADY = 1e-10
"""The covariance stands when a step changes no variance by more than this share."""
LONGEST = 10_000_000
"""Steps until then."""


class TrackingGains(Protocol):
    """What a difference, measured less computed, corrects."""

    def fix(self, elapsed: float) -> tuple[FloatArray, FloatArray]:
        """Of place and velocity `elapsed` s after the fix before: (3, 2) place, velocity, tilt of a level axis; (2, 2) up."""
        ...

    def attitude(self, elapsed: float) -> tuple[FloatArray, float]:
        """Of a tilt: (3,) place, velocity, tilt of its axis; and of the heading, through A."""
        ...


@dataclass(frozen=True, slots=True)
class Gains:
    """Time constants 1/K, s; infinite leaves a channel free.

    Attributes
    ----------
    place, velocity : float
        Of C_ew (its vertical) and the height, and of V.
    tilt, azimuth : float
        Of C_wb, and of A.
    """

    place: float = 20.0
    velocity: float = 20.0
    tilt: float = 20.0
    azimuth: float = 20.0

    def __post_init__(self) -> None:
        """Refuse what is no time."""
        if not all(value > 0.0 for value in astuple(self)):
            raise HilError(f"tracking: time constants {astuple(self)} s; they must be positive (10 to 40 s are usual)")

    def fix(self, elapsed: float) -> tuple[FloatArray, FloatArray]:
        """See `TrackingGains`: the share 1 - exp(-K T) of each difference."""
        own = np.diag([_share(elapsed, self.place), _share(elapsed, self.velocity), 0.0])
        return own[:, :2], own[:2, :2]

    def attitude(self, elapsed: float) -> tuple[FloatArray, float]:
        """See `TrackingGains`."""
        return np.array([0.0, 0.0, _share(elapsed, self.tilt)]), _share(elapsed, self.azimuth)


@dataclass(frozen=True, slots=True)
class Noise:
    """What steady gains are made of; one sigma.

    Attributes
    ----------
    gyro_white, gyro_drift : float
        rad/sqrt(s), and what stands, rad/s.
    accelerometer_white, accelerometer_bias : float
        m/s/sqrt(s), and what stands, m/s^2.
    place, velocity : (2,) float
        Of a fix, level and vertical, m and m/s.
    tilt, heading : float
        Of an attitude, rad.
    period : float
        Between fixes, and between attitudes, s.

    Raises
    ------
    HilError
        A value is not finite or not positive.
    """

    gyro_white: float
    gyro_drift: float
    accelerometer_white: float
    accelerometer_bias: float
    place: tuple[float, float]
    velocity: tuple[float, float]
    tilt: float
    heading: float
    period: float

    def __post_init__(self) -> None:
        """Refuse what has no steady gain."""
        values = np.hstack(astuple(self))
        if not (np.isfinite(values) & (values > 0.0)).all():
            raise HilError(f"tracking: noise {self}: each must be finite and positive")


@dataclass(frozen=True, slots=True)
class SteadyGains:
    """Gains of the steady state, whatever the time since the fix before; see `TrackingGains` and :func:`steady`."""

    level_fix: FloatArray
    vertical_fix: FloatArray
    level_tilt: FloatArray
    azimuth: float

    def fix(self, elapsed: float) -> tuple[FloatArray, FloatArray]:
        """See `TrackingGains`."""
        return self.level_fix, self.vertical_fix

    def attitude(self, elapsed: float) -> tuple[FloatArray, float]:
        """See `TrackingGains`."""
        return self.level_tilt, self.azimuth


def steady(noise: Noise) -> SteadyGains:
    """Gains of the steady Kalman filter that considers drift and bias; see the module."""
    gyro, force = noise.gyro_white**2, noise.accelerometer_white**2
    f = np.zeros((5, 5))  # place, velocity, tilt | bias, drift
    f[0, 1], f[1, 2], f[1, 3], f[2, 1], f[2, 4] = 1.0, STANDARD_GRAVITY, 1.0, -1.0 / A, 1.0
    considered = noise.accelerometer_bias, noise.gyro_drift
    sigma = noise.place[0], noise.velocity[0], noise.tilt
    level = _steady(f, np.array([0.0, force, gyro]), considered, sigma, noise.period)
    f = np.zeros((3, 3))  # place, velocity | bias
    f[0, 1] = f[1, 2] = 1.0
    sigma_up = noise.place[1], noise.velocity[1]
    vertical = _steady(f, np.array([0.0, force]), considered[:1], sigma_up, noise.period)
    f = np.array([[0.0, 1.0], [0.0, 0.0]])  # A | drift
    azimuth = _steady(f, np.array([gyro]), considered[1:], (noise.heading,), noise.period)
    return SteadyGains(_at_once(level), _at_once(vertical), level[:, 2], float(azimuth[0, 0]))


def _at_once(gains: FloatArray) -> FloatArray:
    """(n, 2): gains of place and velocity for the differences before either is taken."""
    return np.stack([gains[:, 0] - gains[:, 1] * gains[1, 0], gains[:, 1]], axis=1)


def _steady(
    f: FloatArray, density: FloatArray, considered: tuple[float, ...], sigma: tuple[float, ...], period: float
) -> FloatArray:
    """Gains (n, n): of each state, all measured one after the other, with `sigma`; the states after them are considered."""
    n, size = len(density), len(f)
    phi = np.eye(size) + period * f + 0.5 * period**2 * (f @ f)
    q = np.zeros((size, size))
    q[:n, :n] = period * np.diag(density)
    p = np.diag(np.square([*sigma, *considered]))
    gains = np.zeros((n, n))
    if not _run(phi, q, np.square(sigma), p, gains):
        raise HilError(f"tracking: no steady gains within {LONGEST * period:g} s; are the sigmas right?")
    return gains


@kernel
def _run(phi: FloatArray, q: FloatArray, variance: FloatArray, p: FloatArray, gains: FloatArray) -> bool:
    """Predict and update `p` until its variances stand; whether they do."""
    size, n = len(phi), len(variance)
    room, before = np.empty((size, size)), np.ones(n)
    for _ in range(LONGEST):
        change = 0.0
        for i in range(size):
            for j in range(size):
                room[i, j] = 0.0
                for m in range(size):
                    room[i, j] += phi[i, m] * p[m, j]
        for i in range(size):
            for j in range(size):
                total = q[i, j]
                for m in range(size):
                    total += room[i, m] * phi[j, m]
                p[i, j] = total
        for k in range(n):
            change = max(change, abs(p[k, k] / before[k] - 1.0))
            before[k] = p[k, k]
        for k in range(n):
            innovation = p[k, k] + variance[k]
            room[0] = p[k]
            for i in range(n):
                gains[i, k] = room[0, i] / innovation
            for i in range(size):
                for j in range(size):
                    one = gains[i, k] if i < n else 0.0
                    other = gains[j, k] if j < n else 0.0
                    p[i, j] += one * other * innovation - one * room[0, j] - other * room[0, i]
        if change < STEADY:
            return True
    return False


def _share(elapsed: float, constant: float) -> float:
    return -math.expm1(-elapsed / constant)
