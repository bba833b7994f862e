"""Tracking correction: the inertial navigator is pulled to what GNSS says (source 002, Babich).

    C_ew' = C_ew [rho x] + K (C_ew* - C_ew), likewise C_wb and V;   1/K = 10..40 s, or Kalman gains

Between fixes the navigator runs free; at a fix that comes T after the one before, a share of the difference is taken:
1 - exp(-K T), or the gain of a steady filter (:mod:`nav.filter.tracking_gains`). On the quaternions of the wander
mechanization a difference is a small rotation, so that nothing needs to be made orthonormal again.

The heading is corrected through the azimuth A of the platform alone: the gyroscopic heading psi_r is taken as exact, and the
vertical drift of the platform counts as a drift of A. So an attitude corrects C_wb by its two tilts and C_ew by the third angle.
"""

import math

import numpy as np

from nav.aiding import Kind
from nav.earth import A
from nav.errors import HilError
from nav.filter.tracking_gains import TrackingGains
from nav.frames import level_in_earth
from nav.increments import FloatArray
from nav.rotation import attitude_error, product, relative, rotated
from nav.strapdown import Strapdown

_UP = np.array([0.0, 0.0, -1.0])


class Tracking:
    """Pulls a navigator to fixes.

    Parameters
    ----------
    core : Strapdown
        In the wander mechanization.
    gains : TrackingGains
        How much of a difference is taken: `Gains`, or what `steady` finds.
    time : float
        Device time of the core, s.

    Raises
    ------
    HilError
        Another mechanization.
    """

    def __init__(self, core: Strapdown, gains: TrackingGains, time: float) -> None:
        if core.mechanization != "wander":
            raise HilError(f"tracking corrects the azimuth of a platform: choose wander, not {core.mechanization!r}")
        self._core, self._gains = core, gains
        self._last = {Kind.GNSS: time, Kind.ATTITUDE: time}
        self._q_en = level_in_earth(float(core.solution[0]), float(core.solution[1]))

    def take(self, row: np.void) -> None:
        """Correct the core by a fix of the present moment; the sigmas are of no concern.

        Parameters
        ----------
        row : row of AIDING
            Of `Kind.GNSS` or `Kind.ATTITUDE`.

        Raises
        ------
        HilError
            Another kind, a value that is not finite, or a time before the last one.
        """
        kind, time, value = int(row["kind"]), float(row["time"]), row["value"]
        if kind not in self._last or not np.isfinite([time, *value]).all() or time < self._last[Kind(kind)]:
            raise HilError(
                f"tracking: the fix of {time:.3f} s is none of GNSS or attitude, not finite, or late: leave it"
            )
        elapsed = time - self._last[Kind(kind)]
        self._last[Kind(kind)] = time
        if kind == Kind.GNSS:
            self._pull_place(value, elapsed)
        else:
            self._pull_attitude(value[:4], elapsed)

    def _pull_place(self, value: FloatArray, elapsed: float) -> None:
        now = self._core.solution
        self._q_en = level_in_earth(float(value[0]), float(value[1]))
        q_nn = relative(level_in_earth(float(now[0]), float(now[1])), self._q_en)  # near a pole not nearly the identity
        up, velocity = rotated(q_nn, np.stack([_UP, value[3:]]))
        place, change = A * self._platform(up), self._platform(velocity - now[3:6])
        level, vertical = self._gains.fix(elapsed)
        height, climb = vertical @ [float(value[2] - now[2]), change[2]]
        self._correct(level @ [place[:2], change[:2]], 0.0, height, climb)

    def _pull_attitude(self, q_nb: FloatArray, elapsed: float) -> None:
        now = self._core.solution
        q_en = level_in_earth(float(now[0]), float(now[1]))
        if self._last[Kind.GNSS] == self._last[Kind.ATTITUDE]:  # the receiver's own north
            q_nb = product(relative(q_en, self._q_en), q_nb)
        x, y, z = self._platform(attitude_error(q_nb, now[6:10]))
        level, azimuth = self._gains.attitude(elapsed)
        self._correct(np.outer(level, [y, -x]), azimuth * z, 0.0, 0.0)

    def _correct(self, level: FloatArray, turn: float, height: float, climb: float) -> None:
        """Correct place, velocity and tilt along X and Y (3, 2), the platform by a `turn` about Z, height and V_z."""
        (px, py), (vx, vy), (tx, ty) = level
        self._core.correct_platform(
            np.array([-py / A, px / A, turn]), np.array([-ty, tx, 0.0]), np.array([vx, vy, climb]), height
        )

    def _platform(self, v_n: FloatArray) -> FloatArray:
        """A vector of n in w."""
        s, c = math.sin(self._core.azimuth), math.cos(self._core.azimuth)
        return np.array([c * v_n[1] - s * v_n[0], s * v_n[1] + c * v_n[0], -v_n[2]])
