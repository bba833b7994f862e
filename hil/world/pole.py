"""A flight over a pole in closed form: along a meridian at constant height, the body banking to and fro.

The angle along the meridian ellipse grows evenly through 90 degrees: before the pole it is the latitude, beyond it the
latitude falls on the opposite meridian. In axes forward along the path, right, down nothing is singular, so that rate and
specific force have closed forms there. :mod:`hil.world.motion` moves in latitude and longitude and cannot go there.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hil.world.motion import TRUTH
from nav.earth import E2, RATE, A, normal_gravity
from nav.increments import FloatArray

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)


@dataclass(frozen=True)
class PoleFlight:
    """See the module; the increments and the truth are those of :class:`hil.world.motion.Motion`.

    Attributes
    ----------
    crossing_s : float
        Time of the crossing, s.
    south : bool
        Over the south pole; else over the north pole.
    lon, height : float
        Longitude before the pole, rad; height above the ellipsoid, m.
    turn_rate : float
        Of the angle along the meridian, rad/s; the speed is near 240 m/s.
    bank, pulsation : float
        The bank is ``bank sin(pulsation t)``, rad and rad/s.
    """

    crossing_s: float
    south: bool = False
    lon: float = 0.4
    height: float = 9000.0
    turn_rate: float = 240.0 / 6.4e6
    bank: float = 0.3
    pulsation: float = 1.7

    def truth(self, times: ArrayLike) -> NDArray[np.void]:
        """What is true at `times` (n,), s: (n,) rows of `hil.world.motion.TRUTH`."""
        time = np.atleast_1d(np.asarray(times, dtype=np.float64))
        angle, speed, rate, force = self._body(time)
        beyond = angle > 0.5 * math.pi
        lat = np.where(beyond, math.pi - angle, angle)
        northward = np.where(beyond == self.south, 1.0, -1.0)
        half, half_bank = np.where(northward > 0.0, 0.0, 0.5 * math.pi), 0.5 * self.bank * np.sin(self.pulsation * time)
        ch, sh, cr, sr = np.cos(half), np.sin(half), np.cos(half_bank), np.sin(half_bank)
        rows = np.zeros(len(time), TRUTH)
        rows["time"], rows["height"] = time, self.height
        rows["lat"] = -lat if self.south else lat
        rows["lon"] = np.remainder(self.lon + math.pi * beyond + math.pi, 2.0 * math.pi) - math.pi
        rows["vel_n"][:, 0] = northward * speed
        rows["q_nb"] = np.stack([ch * cr, ch * sr, sh * sr, sh * cr], axis=1)
        rows["w_ib_b"], rows["f_b"] = rate, force
        return rows

    def increments(self, first: int, count: int, step: float, dtheta: FloatArray, dvel: FloatArray) -> None:
        """Integrals of the steps `first` to ``first + count`` of `step` s into (count, 3) arrays, by six Gauss nodes."""
        time = step * (first + np.arange(count)[:, None] + 0.5 * (_NODES + 1.0))
        _, _, rate, force = self._body(time.ravel())
        for out, values in ((dtheta, rate), (dvel, force)):
            out[:] = 0.5 * step * np.einsum("j,kji->ki", _WEIGHTS, values.reshape(count, len(_NODES), 3))

    def _body(self, time: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Angle along the meridian and speed (n,), body rate and specific force (n, 3)."""
        angle = 0.5 * math.pi + self.turn_rate * (time - self.crossing_s)
        s, c = np.sin(angle), np.cos(angle)
        meridian = A * (1.0 - E2) / (1.0 - E2 * s * s) ** 1.5
        speed = (meridian + self.height) * self.turn_rate
        slope = 3.0 * meridian * E2 * s * c / (1.0 - E2 * s * s) * self.turn_rate**2
        gravity = np.array([normal_gravity(x, self.height) for x in s])
        # The south is the mirrored north, but for the Earth's turn: as if it turned the other way.
        earth = -RATE if self.south else RATE
        rate = self._banked(time, earth * c, np.full_like(s, -self.turn_rate), -earth * s)
        rate[:, 0] += self.bank * self.pulsation * np.cos(self.pulsation * time)
        force = self._banked(time, slope, -2.0 * earth * speed * s, speed * self.turn_rate - gravity)
        return angle, speed, rate, force

    def _banked(self, time: FloatArray, forward: FloatArray, right: FloatArray, down: FloatArray) -> FloatArray:
        """A vector in body axes."""
        bank = self.bank * np.sin(self.pulsation * time)
        s, c = np.sin(bank), np.cos(bank)
        return np.stack([forward, c * right + s * down, c * down - s * right], axis=1)
