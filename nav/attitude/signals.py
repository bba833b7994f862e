"""Rotations known in closed form, with their exact increments: what the attitude methods are tested and studied on.

Each signal gives the attitude ``q_ib`` and the body rate at any times, and the integrals of the body rate over steps
of any length.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from nav.increments import FloatArray

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)


class Signal(Protocol):
    """A rotation in closed form."""

    def attitude(self, time: ArrayLike) -> FloatArray:
        """Attitudes q_ib (n, 4) at `time` (n,), s."""
        ...

    def rate(self, time: ArrayLike) -> FloatArray:
        """Body rates w_ib_b (n, 3) at `time` (n,), rad/s."""
        ...

    def increments(self, edges: ArrayLike) -> FloatArray:
        """Integrals of the body rate (n, 3) between consecutive `edges` (n + 1,), rad."""
        ...


def _edges(edges: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Middle and length of the steps between `edges`."""
    e = np.asarray(edges, dtype=np.float64)
    return 0.5 * (e[1:] + e[:-1]), np.diff(e)


def _sinc(x: FloatArray) -> FloatArray:
    return np.sinc(x / np.pi)


@dataclass(frozen=True)
class Coning:
    """Classic coning: the rotation vector keeps its length and turns in the y-z plane; x coarsely stays where it is.

    Attributes
    ----------
    half_cone : float
        Half-angle of the cone, rad.
    frequency_hz : float
        Turns of the rotation vector per second.
    """

    half_cone: float
    frequency_hz: float

    @property
    def _pulsation(self) -> float:
        return 2.0 * math.pi * self.frequency_hz

    def attitude(self, time: ArrayLike) -> FloatArray:
        """As `Signal.attitude`."""
        phase = self._pulsation * np.asarray(time, dtype=np.float64)
        s = math.sin(0.5 * self.half_cone)
        return np.stack(
            [np.full(phase.shape, math.cos(0.5 * self.half_cone)), 0.0 * phase, s * np.cos(phase), s * np.sin(phase)],
            -1,
        )

    def rate(self, time: ArrayLike) -> FloatArray:
        """As `Signal.rate`: Omega (-2 sin^2(a/2), -sin a sin(Omega t), sin a cos(Omega t)), a the half-angle."""
        phase = self._pulsation * np.asarray(time, dtype=np.float64)
        along = np.full(phase.shape, -2.0 * math.sin(0.5 * self.half_cone) ** 2)
        across = math.sin(self.half_cone)
        return self._pulsation * np.stack([along, -across * np.sin(phase), across * np.cos(phase)], -1)

    def increments(self, edges: ArrayLike) -> FloatArray:
        """As `Signal.increments`, in closed form."""
        middle, length = _edges(edges)
        swing = _sinc(0.5 * self._pulsation * length)
        out: FloatArray = self.rate(middle) * (length[:, None] * np.stack([np.ones_like(swing), swing, swing], -1))
        return out


@dataclass(frozen=True)
class Precession:
    """Regular precession (Fomichev 2011, sec. 1): Euler angles psi = W t, theta constant, phi = w t.

    Attributes
    ----------
    precession : float
        W, rad/s.
    spin : float
        w, rad/s.
    nutation : float
        theta, rad.
    """

    precession: float
    spin: float
    nutation: float

    def attitude(self, time: ArrayLike) -> FloatArray:
        """As `Signal.attitude` (eq. 1 of the source)."""
        t = np.asarray(time, dtype=np.float64)
        plus, minus = 0.5 * (self.precession + self.spin) * t, 0.5 * (self.precession - self.spin) * t
        s, c = math.sin(0.5 * self.nutation), math.cos(0.5 * self.nutation)
        return np.stack([c * np.cos(plus), s * np.cos(minus), s * np.sin(minus), c * np.sin(plus)], -1)

    def rate(self, time: ArrayLike) -> FloatArray:
        """As `Signal.rate`: (W sin theta sin wt, W sin theta cos wt, W cos theta + w)."""
        phase = self.spin * np.asarray(time, dtype=np.float64)
        across = self.precession * math.sin(self.nutation)
        along = np.full(phase.shape, self.precession * math.cos(self.nutation) + self.spin)
        return np.stack([across * np.sin(phase), across * np.cos(phase), along], -1)

    def increments(self, edges: ArrayLike) -> FloatArray:
        """As `Signal.increments`, in closed form."""
        middle, length = _edges(edges)
        swing = _sinc(0.5 * self.spin * length)
        out: FloatArray = self.rate(middle) * (length[:, None] * np.stack([swing, swing, np.ones_like(swing)], -1))
        return out


@dataclass(frozen=True)
class Swinging:
    """Heading, pitch and roll, each ``amplitude sin(pulsation t + phase)``: no symmetry helps a method here.

    Attributes
    ----------
    amplitude, pulsation, phase : (3,) tuple of float
        Of heading, pitch and roll: rad, rad/s, rad.
    """

    amplitude: tuple[float, float, float] = (1.1, 0.7, 0.9)
    pulsation: tuple[float, float, float] = (3.1, 5.3, 4.1)
    phase: tuple[float, float, float] = (0.3, 1.2, -0.7)

    def _angles(self, time: ArrayLike) -> tuple[FloatArray, FloatArray]:
        t = np.asarray(time, dtype=np.float64)[..., None]
        amplitude, pulsation = np.array(self.amplitude), np.array(self.pulsation)
        phase = pulsation * t + np.array(self.phase)
        return amplitude * np.sin(phase), amplitude * pulsation * np.cos(phase)

    def attitude(self, time: ArrayLike) -> FloatArray:
        """As `Signal.attitude`."""
        half = 0.5 * self._angles(time)[0]
        (ch, cp, cr), (sh, sp, sr) = np.moveaxis(np.cos(half), -1, 0), np.moveaxis(np.sin(half), -1, 0)
        return np.stack(
            [
                ch * cp * cr + sh * sp * sr,
                ch * cp * sr - sh * sp * cr,
                ch * sp * cr + sh * cp * sr,
                sh * cp * cr - ch * sp * sr,
            ],
            -1,
        )

    def rate(self, time: ArrayLike) -> FloatArray:
        """As `Signal.rate`."""
        angles, speeds = self._angles(time)
        _, pitch, roll = np.moveaxis(angles, -1, 0)
        heading_rate, pitch_rate, roll_rate = np.moveaxis(speeds, -1, 0)
        level = heading_rate * np.cos(pitch)
        return np.stack(
            [
                roll_rate - heading_rate * np.sin(pitch),
                pitch_rate * np.cos(roll) + level * np.sin(roll),
                level * np.cos(roll) - pitch_rate * np.sin(roll),
            ],
            -1,
        )

    def increments(self, edges: ArrayLike) -> FloatArray:
        """As `Signal.increments`, by sixteen Gauss nodes a step: exact to rounding for steps below the shortest period."""
        middle, length = _edges(edges)
        rates = self.rate(middle[:, None] + 0.5 * length[:, None] * _NODES)
        out: FloatArray = 0.5 * length[:, None] * np.einsum("j,njc->nc", _WEIGHTS, rates)
        return out
