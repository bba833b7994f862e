"""Tracking correction with fixed gains: the inertial navigator is pulled to what GNSS says (source 002, Babich).

    C_ew' = C_ew [rho x] + K (C_ew* - C_ew), likewise C_wb and V;   1/K = 10..40 s

Between fixes the navigator runs free; at a fix that comes T after the one before, the share 1 - exp(-K T) of the difference
is taken. On the quaternions of the wander mechanization a difference is a small rotation, so that nothing needs to be made
orthonormal again.

The heading is corrected through the azimuth A of the platform alone: the gyroscopic heading psi_r is taken as exact, and the
vertical drift of the platform counts as a drift of A. So an attitude corrects C_wb by its two tilts and C_ew by the third angle.
"""

import math
from dataclasses import astuple, dataclass

import numpy as np

from nav.aiding import Kind
from nav.errors import HilError
from nav.frames import level_in_earth
from nav.increments import FloatArray
from nav.rotation import attitude_error, product, relative, rotated
from nav.strapdown import Strapdown

_UP = np.array([0.0, 0.0, -1.0])


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


class Tracking:
    """Pulls a navigator to fixes.

    Parameters
    ----------
    core : Strapdown
        In the wander mechanization.
    gains : Gains
        How fast.
    time : float
        Device time of the core, s.

    Raises
    ------
    HilError
        Another mechanization.
    """

    def __init__(self, core: Strapdown, gains: Gains, time: float) -> None:
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
        place = _share(elapsed, self._gains.place)
        turn = self._platform(place * np.cross(_UP, up))
        change = self._platform(_share(elapsed, self._gains.velocity) * (velocity - now[3:6]))
        self._core.correct_platform(turn, np.zeros(3), change, place * float(value[2] - now[2]))

    def _pull_attitude(self, q_nb: FloatArray, elapsed: float) -> None:
        now = self._core.solution
        q_en = level_in_earth(float(now[0]), float(now[1]))
        if self._last[Kind.GNSS] == self._last[Kind.ATTITUDE]:  # the receiver's own north
            q_nb = product(relative(q_en, self._q_en), q_nb)
        x, y, z = self._platform(attitude_error(q_nb, now[6:10]))
        platform = np.array([0.0, 0.0, _share(elapsed, self._gains.azimuth) * z])
        tilt = _share(elapsed, self._gains.tilt) * np.array([x, y, 0.0])
        self._core.correct_platform(platform, tilt, np.zeros(3), 0.0)

    def _platform(self, v_n: FloatArray) -> FloatArray:
        """A vector of n in w."""
        s, c = math.sin(self._core.azimuth), math.cos(self._core.azimuth)
        return np.array([c * v_n[1] - s * v_n[0], s * v_n[1] + c * v_n[0], -v_n[2]])


def _share(elapsed: float, constant: float) -> float:
    return -math.expm1(-elapsed / constant)
