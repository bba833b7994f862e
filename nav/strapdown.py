"""A strapdown core: an attitude method, a mechanization and a gravity field, joined behind one interface.

The sensors enter through the body integrals (:mod:`nav.body_integrals`); with an attitude method other than `two-sample`
and `high-order` the rotation comes from that method and the velocity and position integrals are the two-sample ones. Every
mechanization answers in the same terms: geodetic position, velocity in n, q_nb.
"""

import numpy as np

from nav import attitude as attitudes
from nav.body_integrals import MAX_WINDOW, MEMORY, integrate_blocks, integrate_body
from nav.earth import RATE
from nav.errors import HilError
from nav.gravitation import field_code
from nav.increments import FloatArray
from nav.mechanization import cartesian, geographic, wander
from nav.turn import turns_between

MECHANIZATIONS = ("geographic", "wander", "earth", "inertial", "inertial-source")
ATTITUDES = (
    "two-sample",
    f"high-order[:N] (N = 3..{MAX_WINDOW})",
    *(name for name in attitudes.NAMES if name != "two-sample" and not name.startswith("high-order[")),
)
"""What there is, for messages and help."""


class Strapdown:
    """See the module.

    Parameters
    ----------
    attitude : str
        ``two-sample``, ``high-order[:N]`` (polynomials through N = 3..8 samples for rotation, velocity and position alike) or
        a method of :mod:`nav.attitude`.
    mechanization : str
        One of `MECHANIZATIONS`. ``inertial-source`` has its own attitude and takes no other.
    gravity : str
        ``normal`` or ``j2``.
    whole_record : bool
        `advance` is called once with a whole record: high order then works in blocks, to both sides, which is more exact.

    Raises
    ------
    HilError
        A name is not known.
    """

    def __init__(
        self,
        attitude: str = "two-sample",
        mechanization: str = "geographic",
        gravity: str = "normal",
        *,
        whole_record: bool = False,
    ) -> None:
        if mechanization not in MECHANIZATIONS:
            raise HilError(f"unknown mechanization {mechanization!r}; there is: {', '.join(MECHANIZATIONS)}")
        if mechanization == "inertial-source" and attitude != "two-sample":
            raise HilError(f"mechanization 'inertial-source' has its own attitude: it takes no {attitude!r}")
        self._mechanization = mechanization
        self._field = field_code(gravity)
        self._window = _window(attitude)
        self._method = None if self._window else _method(attitude)
        self._whole = whole_record
        self._room(256)
        self.start(0.0, 0.0, 0.0, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    def start(self, lat: float, lon: float, height: float, vel_n: FloatArray, q_nb: FloatArray) -> None:
        """Begin at a position (rad, m) with a velocity (3,), m/s, and an attitude (4,), and no increments before."""
        self.solution = np.array([lat, lon, height, *vel_n, *q_nb])
        """Newest lat, lon, height, vel_n (3), q_nb (4)."""
        self.azimuth = 0.0
        """Wander azimuth A of the Y axis, rad; 0 in the other mechanizations."""
        place = lat, lon, height, np.asarray(vel_n, float), np.asarray(q_nb, float)
        if self._mechanization == "geographic":
            self._state = geographic.start(*place)
        elif self._mechanization == "wander":
            self._state = wander.start(*place)
        else:
            self._state = cartesian.start(*place, RATE if self._mechanization == "earth" else 0.0)
        self._memory = np.zeros(MEMORY)
        self._previous = np.zeros(4)
        self._q = np.array([1.0, 0.0, 0.0, 0.0])
        self._stream = None if self._method is None else self._method.stream(self._q)

    def advance(
        self,
        step: FloatArray,
        dtheta: FloatArray,
        dvel: FloatArray,
        gyro_bias: FloatArray,
        position: FloatArray,
        velocity: FloatArray,
        attitude: FloatArray,
    ) -> int:
        """Take increments, fill the answers; the number of steps done.

        Parameters
        ----------
        step : (n,) float
            s; a step of zero changes nothing.
        dtheta, dvel : (n, 3) float
            Increments, rad and m/s, body axes.
        gyro_bias : (3,) float
            Taken off the rates, rad/s.
        position, velocity, attitude : (n, 3), (n, 3), (n, 4) float
            Out: lat, lon (rad), height (m); vel_n (m/s); q_nb, at the end of each step.

        Returns
        -------
        int
            Fewer than n where the geographic mechanization stands before a pole.
        """
        n = len(step)
        if n == 0:
            return 0
        if n > len(self._dq):
            self._room(2 * n)
        if self._mechanization == "inertial-source":
            raw = dtheta - gyro_bias * step[:, None] if gyro_bias.any() else dtheta
            out = position, velocity, attitude
            done = cartesian.advance_source(self._state, self._field, step, raw, dvel, self._previous, *out)
        else:
            self._body(step, dtheta, dvel, gyro_bias)
            body = step, self._dq[:n], self._dv[:n], self._ds[:n]
            out = position, velocity, attitude
            if self._mechanization == "geographic":
                done = geographic.advance(self._state, self._field, *body, *out)
            elif self._mechanization == "wander":
                done = wander.advance(self._state, self._field, *body, *out, self._azimuths[:n])
                self.azimuth = float(self._azimuths[n - 1])
            else:
                turn = RATE if self._mechanization == "earth" else 0.0
                done = cartesian.advance(self._state, self._field, turn, *body, *out)
        if done:
            self.solution[0:3], self.solution[3:6] = position[done - 1], velocity[done - 1]
            self.solution[6:10] = attitude[done - 1]
        return int(done)

    def _room(self, n: int) -> None:
        self._dq, self._dv, self._ds = np.zeros((n, 4)), np.zeros((n, 3)), np.zeros((n, 3))
        self._azimuths = np.zeros(n)

    def _body(self, step: FloatArray, dtheta: FloatArray, dvel: FloatArray, gyro_bias: FloatArray) -> None:
        n = len(step)
        out = self._dq[:n], self._dv[:n], self._ds[:n]
        if self._whole and self._window > 2:
            moving = step > 0.0  # steps of zero have no place in a polynomial
            if moving.all():
                integrate_blocks(self._window, step, dtheta, dvel, gyro_bias, *out)
                return
            some = tuple(np.zeros((int(moving.sum()), array.shape[1])) for array in out)
            if moving.any():
                integrate_blocks(self._window, step[moving], dtheta[moving], dvel[moving], gyro_bias, *some)
            for array, part in zip(out, some, strict=True):
                array[:] = 0.0
                array[moving] = part
            return
        integrate_body(self._memory, self._window or 2, step, dtheta, dvel, gyro_bias, *out)
        if self._stream is not None:
            raw = dtheta - gyro_bias * step[:, None] if gyro_bias.any() else dtheta
            rows = np.empty((n, 4))
            self._stream.push(step, np.ascontiguousarray(raw), rows)
            before = np.concatenate([self._q[None], rows[:-1]])
            turns_between(before, rows, self._dq[:n])
            self._q = rows[-1].copy()


def _method(attitude: str) -> attitudes.AttitudeMethod:
    """A method of `nav.attitude`; the refusal lists what there is here."""
    try:
        return attitudes.method(attitude)
    except HilError as refusal:
        raise HilError(str(refusal).replace(", ".join(attitudes.NAMES), ", ".join(ATTITUDES))) from None


def _window(attitude: str) -> int:
    """Samples of the polynomial of an integrated method; 0 for a method of `nav.attitude`."""
    name, _, count = attitude.partition(":")
    if attitude == "two-sample":
        return 2
    if name != "high-order":
        return 0
    if not count:
        return 4
    if not count.isdecimal() or not 3 <= int(count) <= MAX_WINDOW:
        raise HilError(f"attitude method {attitude!r}: high-order:N takes N = 3..{MAX_WINDOW}")
    return int(count)
