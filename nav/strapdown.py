"""A strapdown core: an attitude method, a mechanization and a gravity field, joined behind one interface.

The sensors enter through the body integrals (:mod:`nav.body_integrals`); with an attitude method other than `two-sample`
and `high-order` the rotation comes from that method and the velocity and position integrals are the two-sample ones. Every
mechanization answers in the same terms: geodetic position, velocity in n, q_nb.
"""

import math
from collections.abc import Callable
from copy import deepcopy
from types import MethodType
from typing import Any, NamedTuple

import numpy as np

from nav import attitude as attitudes
from nav import step as kernels
from nav.body_integrals import MAX_WINDOW, integrate_blocks, integrate_body
from nav.checks import check_room, read_array
from nav.cut import Cut
from nav.earth import RATE, curvature_radii
from nav.errors import HilError
from nav.gravitation import field_code
from nav.increments import FloatArray, first_bad
from nav.kernel import kernel
from nav.mechanization import cartesian, geographic, wander
from nav.rotation import normalised
from nav.turn import multiply, quaternion_of, turns_between

MECHANIZATIONS = kernels.MECHANIZATIONS
ATTITUDES = (
    "two-sample",
    f"high-order[:N] (N = 3..{MAX_WINDOW})",
    *(name for name in attitudes.NAMES if name != "two-sample" and not name.startswith("high-order[")),
)
"""What there is, for messages and help."""


_push: Any = kernels.push
_Body = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


class Answers(NamedTuple):
    """The solution at the end of each sample: lat, lon (rad), height (m); vel_n, m/s; q_nb."""

    position: FloatArray
    velocity: FloatArray
    attitude: FloatArray


class Strapdown:
    """See the module.

    Near a pole `geographic` hands over to `wander`, which has no singular place.

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

    Attributes
    ----------
    mechanization : str
        The present one.
    solution : (10,) float
        Newest lat, lon, height, vel_n (3), q_nb (4).
    push : callable
        One sample: ``push(step, dtheta_x, dtheta_y, dtheta_z, dvel_x, dvel_y, dvel_z)`` with the gyro bias taken off; see
        :func:`nav.step.push`. Its answer is `nav.step.DONE`, or ``POLE`` (`hand_over`, then push again) or ``NOT_FINITE``,
        and then nothing has changed. Compiled from the moment that the polynomials have all their samples; fetch it anew
        after `start`. For `whole_record` there is none.

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
        self._first = self.mechanization = mechanization
        self._field = field_code(gravity)
        self._window = _window(attitude)
        self._method = None if self._window else _method(attitude)
        self._blocks = whole_record and self._window > 2
        self._core = np.zeros(kernels.CORE)
        self._core[kernels.FIELD], self._core[kernels.WINDOW] = self._field, self._window
        self._look()
        self._room(256)
        self.start(0.0, 0.0, 0.0, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    def _look(self) -> None:
        """Look into the core, and into the room for the integrals."""
        self._views = Cut(self._cut)
        self._memory, self._state = self._core[kernels.MEMORY_PART], self._core[kernels.STATE_PART]
        self.solution = self._core[kernels.SOLUTION_PART][:10]
        self._azimuth = self._core[kernels.SOLUTION_PART][10:]
        self._address = _Address(self._core)
        self.push: Callable[[float, float, float, float, float, float, float], int] = self._push_first

    def __getstate__(self) -> dict[str, Any]:
        """What copies and pickles are made of: all but the ways into the core."""
        ways = "_memory", "_state", "solution", "_azimuth", "_address", "push", "_views"
        return {name: value for name, value in self.__dict__.items() if name not in ways}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Go on with a core of one's own."""
        self.__dict__.update(deepcopy(state))
        self._look()

    @property
    def address(self) -> int:
        """Of the core, for :func:`nav.step.push` in kernels; 0 while, or where, only `advance` serves."""
        return 0 if self._lead is not None or self._stream is not None or self._blocks else self._address

    @property
    def azimuth(self) -> float:
        """Wander azimuth A of the Y axis, rad; 0 in the other mechanizations."""
        return float(self._azimuth[0])

    def start(
        self, lat: float, lon: float, height: float, vel_n: FloatArray, q_nb: FloatArray, azimuth: float = 0.0
    ) -> None:
        """Begin at a position (rad, m) with a velocity (3,), m/s, and an attitude (4,), and no increments before.

        `azimuth` is that of the wander mechanization at the start, rad.

        Raises
        ------
        HilError
            A value is not finite, the latitude is beyond a pole, or the attitude is no rotation.
        """
        place = read_array("start: lat, lon, height, vel_n, q_nb", [lat, lon, height, *vel_n, *q_nb], 10)
        if not np.isfinite([*place, azimuth]).all():
            raise HilError(f"start: a value is not a number: {place.tolist()}, azimuth {azimuth}")
        if abs(lat) > 0.5 * np.pi:
            raise HilError(f"start: latitude {np.degrees(lat):g} deg lies beyond a pole")
        place[6:] = normalised(place[6:])
        self.solution[:] = place
        self._settle(self._first, azimuth)
        self._memory[:] = 0.0
        self._sound = True
        self._q = np.array([1.0, 0.0, 0.0, 0.0])
        self._stream = None if self._method is None else self._method.stream(self._q)
        young = self._window > 2 and not self._blocks
        self._lead: list[FloatArray] | None = [] if young else None
        self._origin = self._state.copy()
        self.push = self._push_first

    def hand_over(self, mechanization: str, azimuth: float = 0.0) -> None:
        """Go on in another mechanization, from the present solution and with the increments before.

        Raises
        ------
        HilError
            Unknown mechanization, or one of the two is ``inertial-source``, which keeps other memories.
        """
        if mechanization not in MECHANIZATIONS or "inertial-source" in (mechanization, self.mechanization):
            raise HilError(f"no hand-over from {self.mechanization!r} to {mechanization!r}")
        self._settle(mechanization, azimuth)
        self._origin, self._lead = self._state.copy(), None if self._lead is None else []

    def correct_azimuth(self, change: float) -> None:
        """Correct the heading by `change`, rad, through the azimuth of the platform alone (Babich 2011).

        The gyroscopic heading and the velocity in the platform's axes are taken as exact; both turn in n.

        Raises
        ------
        HilError
            The mechanization is not ``wander``.
        """
        self.correct_platform(np.array([0.0, 0.0, -change]), np.zeros(3), np.zeros(3), 0.0)

    def correct_platform(self, platform: FloatArray, tilt: FloatArray, vel_w: FloatArray, height: float) -> None:
        """Correct the wander mechanization's state as :func:`nav.mechanization.wander.correct` does.

        Raises
        ------
        HilError
            The mechanization is not ``wander``.
        """
        if self.mechanization != "wander":
            raise HilError(
                f"mechanization {self.mechanization!r} has no azimuth and no platform to correct: choose wander"
            )
        wander.correct(self._state, platform, tilt, vel_w, height)
        nothing = np.zeros(1), np.zeros((1, 4)), np.zeros((1, 3)), np.zeros((1, 3))
        out = self.solution[None, 0:3], self.solution[None, 3:6], self.solution[None, 6:10]
        wander.advance(self._state, self._field, *nothing, *out, self._azimuth)

    def correct(self, position: FloatArray, velocity: FloatArray, attitude: FloatArray) -> None:
        """Take errors (:mod:`nav.error_dynamics`) off the solution and go on from it, with the increments before.

        Parameters
        ----------
        position : (3,) float
            North, east, down, m.
        velocity : (3,) float
            Of vel_n, m/s.
        attitude : (3,) float
            Rotation vector in n that takes the true attitude to the computed one, rad, of any size.
        """
        _take_off(self.solution, position, velocity, attitude)
        before = self._state[cartesian.PREVIOUS_PART].copy()
        self._settle(self.mechanization, self.azimuth)
        if self.mechanization == "inertial-source":
            self._state[cartesian.PREVIOUS_PART] = before
        self._origin, self._lead = self._state.copy(), None if self._lead is None else []

    def memory(self) -> tuple[Any, ...]:
        """All that the next answer depends on, for `recall`."""
        lead = None if self._lead is None else list(self._lead)
        return self.mechanization, self._core.copy(), self._q, deepcopy(self._stream), lead, self._origin

    def recall(self, memory: tuple[Any, ...]) -> None:
        """Be again, to the last bit, what `memory` was taken of: the same core, not started anew since."""
        self.mechanization, core, self._q, stream, lead, self._origin = memory
        self._core[:] = core
        self._stream, self._lead = deepcopy(stream), None if lead is None else list(lead)
        self.push = self._push_first

    def _settle(self, mechanization: str, azimuth: float) -> None:
        lat, lon, height = (float(value) for value in self.solution[:3])
        place = lat, lon, height, self.solution[3:6], self.solution[6:10]
        if mechanization == "geographic":
            state = geographic.start(*place)
        elif mechanization == "wander":
            state = wander.start(*place, azimuth)
        else:
            state = cartesian.start(*place, RATE if mechanization == "earth" else 0.0)
        self._state[: len(state)] = state
        self._azimuth[0] = azimuth if mechanization == "wander" else 0.0
        self.mechanization = mechanization
        self._core[kernels.CODE] = MECHANIZATIONS.index(mechanization)

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
        """Take increments, fill the answers; the number of steps before a hand-over, n where there was none.

        Parameters
        ----------
        step : (n,) float
            s; a step of zero or less changes nothing.
        dtheta, dvel : (n, 3) float
            Increments, rad and m/s, body axes.
        gyro_bias : (3,) float
            Taken off the rates, rad/s.
        position, velocity, attitude : (n, 3), (n, 3), (n, 4) float
            Out: lat, lon (rad), height (m); vel_n (m/s); q_nb, at the end of each step. Contiguous, float64.

        Raises
        ------
        HilError
            A shape does not fit, or an increment is not a number: nothing has changed. Or one was so large that the answer
            is not a number: `start` again.
        """
        n = len(step)
        step, gyro_bias = read_array("step", step, n), read_array("gyro_bias", gyro_bias, 3)
        dtheta, dvel = read_array("dtheta", dtheta, n, 3), read_array("dvel", dvel, n, 3)
        check_room("position", position, n, 3)
        check_room("velocity", velocity, n, 3)
        check_room("attitude", attitude, n, 4)
        bad = first_bad(step, step, dtheta, dvel)
        if bad >= 0 or not math.isfinite(gyro_bias[0] + gyro_bias[1] + gyro_bias[2]):
            what = "the gyro bias" if bad < 0 else f"increment {bad} of the batch"
            raise HilError(f"strapdown: {what} is not a number: mend the driver or the file")
        return self.carry(step, dtheta, dvel, gyro_bias, Answers(position, velocity, attitude))

    def carry(self, step: FloatArray, dtheta: FloatArray, dvel: FloatArray, gyro_bias: FloatArray, out: Answers) -> int:
        """`advance` without its checks: all arrays are contiguous floats (float64) that fit, and all values are numbers.

        Raises
        ------
        HilError
            An increment was so large that the answer is not a number: `start` again.
        """
        n = alone = len(step)
        position, velocity, attitude = out
        if n > len(self._body[0]):
            self._room(2 * n)
        done = 0
        while done < n and self._lead is not None:
            one = slice(done, done + 1)
            there = Answers(position[one], velocity[one], attitude[one])
            if not self._advance(step[one], dtheta[one], dvel[one], gyro_bias, there):
                alone = done
            self._lead_in(self._lead, step[done], dtheta[done] - gyro_bias * step[done], dvel[done], there)
            done += 1
        if done == 0 < n:
            alone = self._advance(step, dtheta, dvel, gyro_bias, out)
        elif done < n:
            there = Answers(position[done:], velocity[done:], attitude[done:])
            alone = min(alone, done + self._advance(step[done:], dtheta[done:], dvel[done:], gyro_bias, there))
        if not self._sound:
            bad = int(np.flatnonzero(~np.isfinite(np.hstack(out)).all(axis=1))[0])
            raise HilError(f"strapdown: increment {bad} of the batch is too large to be one: start again without it")
        return alone

    def _advance(
        self, step: FloatArray, dtheta: FloatArray, dvel: FloatArray, gyro_bias: FloatArray, out: Answers
    ) -> int:
        n = len(step)
        code, (dq, dv, ds, azimuths) = int(self._core[kernels.CODE]), self._views[n]
        body = dq, dv, ds
        if self._stream is None and (not self._blocks or (step > 0.0).all()):
            how = code, self._field, self._window, self._blocks
            work = self._memory, self._state, gyro_bias
            done = int(kernels.advance(*how, *work, step, dtheta, dvel, *body, *out, azimuths))
        else:
            if self._stream is not None:
                integrate_body(self._memory, 2, step, dtheta, dvel, gyro_bias, *body)
                self._turn(self._stream, step, dtheta - gyro_bias * step[:, None])
            else:  # steps of zero have no place in a polynomial
                moving = step > 0.0
                some = tuple(np.zeros((int(moving.sum()), array.shape[1])) for array in body)
                if moving.any():
                    integrate_blocks(self._window, step[moving], dtheta[moving], dvel[moving], gyro_bias, *some)
                for array, part in zip(body, some, strict=True):
                    array[:] = 0.0
                    array[moving] = part
            done = int(kernels.mechanize(code, self._field, self._state, step, *body, *out, azimuths))
        self._keep(done, out)
        if done < n:
            self.hand_over("wander")
            rest = [array[done:] for array in (step, *body, *out, azimuths)]
            kernels.mechanize(MECHANIZATIONS.index("wander"), self._field, self._state, *rest)
            self._keep(n, out)
        return done

    def _keep(self, n: int, out: Answers) -> None:
        if n:
            self._sound = _last(n - 1, *out, self.solution)
            if self.mechanization == "wander":
                self._azimuth[0] = self._body[3][n - 1]

    def _lead_in(self, lead: list[FloatArray], step: float, dtheta: FloatArray, dvel: FloatArray, out: Answers) -> None:
        """The first samples were taken with less than the full order: when the window is full, take them again as a block."""
        if step > 0.0:
            lead.append(np.array([step, *dtheta, *dvel]))
        n = len(lead)
        if n < self._window:
            return
        rows = np.array(lead)
        data = [np.ascontiguousarray(part) for part in (rows[:, 0], rows[:, 1:4], rows[:, 4:7])]
        again = Answers(np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4)))
        dq, dv, ds, azimuths = self._views[n]
        self._state[:] = self._origin
        how = MECHANIZATIONS.index(self.mechanization), self._field, self._window, True
        work = self._memory, self._state, np.zeros(3)
        kernels.advance(*how, *work, data[0], data[1], data[2], dq, dv, ds, *again, azimuths)
        self._keep(n, again)
        for array, value in zip(out, again, strict=True):
            array[0] = value[-1]
        self._lead = None

    def _push_first(self, step: float, x: float, y: float, z: float, vx: float, vy: float, vz: float) -> int:
        """Take a sample as `advance` does, until all that the compiled function needs is there."""
        if self._blocks:
            raise HilError("push: a core for a whole record takes it by advance; make one without whole_record")
        if not np.isfinite(step + x + y + z + vx + vy + vz):
            return kernels.NOT_FINITE
        one = np.empty((1, 3)), np.empty((1, 3)), np.empty((1, 4))
        self.advance(np.array([step]), np.array([[x, y, z]]), np.array([[vx, vy, vz]]), np.zeros(3), *one)
        if self._lead is None and self._stream is None:
            # The compiled function itself: numba's dispatcher costs as much as the step.
            self.push = MethodType(_push.compile(kernels.PUSH), self._address)
        return kernels.DONE

    def _room(self, n: int) -> None:
        self._body = np.zeros((n, 4)), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n)
        self._views.clear()

    def _cut(self, n: int) -> _Body:
        """Room for the body integrals (rotation, velocity, position) and azimuths of `n` samples."""
        dq, dv, ds, azimuths = self._body
        return dq[:n], dv[:n], ds[:n], azimuths[:n]

    def _turn(self, stream: attitudes.AttitudeStream, step: FloatArray, dtheta: FloatArray) -> None:
        """Replace the rotation by that of the attitude method."""
        n = len(step)
        rows = np.empty((n, 4))
        stream.push(step, np.ascontiguousarray(dtheta), rows)
        before = np.concatenate([self._q[None], rows[:-1]])
        turns_between(before, rows, self._body[0][:n])
        self._q = rows[-1].copy()


@kernel
def _last(row: int, position: FloatArray, velocity: FloatArray, attitude: FloatArray, solution: FloatArray) -> bool:
    """Keep the last solution; whether all of it are numbers."""
    for i in range(3):
        solution[i], solution[3 + i] = position[row, i], velocity[row, i]
    for i in range(4):
        solution[6 + i] = attitude[row, i]
    total = 0.0
    for i in range(10):
        total += solution[i]
    return math.isfinite(total)


@kernel
def _take_off(solution: FloatArray, position: FloatArray, velocity: FloatArray, attitude: FloatArray) -> None:
    """`Strapdown.correct` of the solution (10,)."""
    meridian, prime = curvature_radii(math.sin(solution[0]))
    lon = solution[1] - position[1] / ((prime + solution[2]) * math.cos(solution[0]))
    solution[0] -= position[0] / (meridian + solution[2])
    solution[1] = lon - 2.0 * math.pi * math.floor(lon / (2.0 * math.pi) + 0.5)
    solution[2] += position[2]
    for i in range(3):
        solution[3 + i] -= velocity[i]
    turn = np.empty(4)
    turn[0], turn[1], turn[2], turn[3] = quaternion_of(-attitude[0], -attitude[1], -attitude[2])
    multiply(turn, solution[6:10], solution[6:10])


class _Address(int):
    """Address of an array that keeps the array alive."""

    def __new__(cls, array: FloatArray) -> "_Address":
        """Of `array`."""
        address = super().__new__(cls, array.ctypes.data)
        address._array = array
        return address

    _array: FloatArray


def _method(attitude: str) -> attitudes.AttitudeMethod:
    """A method of `nav.attitude`; the refusal lists what there is here."""
    try:
        return attitudes.method(attitude)
    except HilError as refusal:
        raise HilError(str(refusal).replace(", ".join(attitudes.NAMES), ", ".join(ATTITUDES))) from None


def _window(attitude: str) -> int:
    """Samples of the polynomial of an integrated method; 0 for a method of `nav.attitude`."""
    name, colon, count = attitude.partition(":")
    if attitude == "two-sample":
        return 2
    if name != "high-order":
        return 0
    if not colon:
        return 4
    if not count.isdecimal() or not 3 <= int(count) <= MAX_WINDOW:
        raise HilError(f"attitude method {attitude!r}: high-order:N takes N = 3..{MAX_WINDOW}")
    return int(count)
