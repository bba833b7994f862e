"""What the navigator knows without another sensor: rest where it is seen, and what the vehicle never does for long.

Rows of `nav.aiding.AIDING`, made of the inertial samples and of the filter's present answer, once a stride of the detector
(:mod:`nav.filter.stillness`, 0.1 s).

*Rest.* Samples that are still say that nothing changes. A body in smooth flight or in a steady turn is still as well. So rest is
more than that; in sigmas of the filter and of the window, `SURE` of them:

    rate      of the window's mean, corrected, is the Earth's: no turn
    force     of the window's mean, corrected, is 1 g long: no coordinated turn
    velocity  the filter's is zero, and known to be below `smooth`: what may have been flying since the last fix, its velocity
              lost, is not taken for a body at rest

Then the velocity is zero (`TREMOR_MS`) and the body turns with the Earth alone. Sigmas hold what the blocks in the window
scatter by. The two take turns, stride by stride, so that each is judged with what the other has corrected.

*Bounds*, for attitude and heading without a receiver: the vehicle accelerates by `acceleration` at random, is about as fast as
`speed` and about as far as `place` from where it started. Each is a Gauss-Markov process: the acceleration lasts
speed / acceleration, velocity and place last place / speed. A row each T of such a process with deviation s and correlation time
tau is given the white noise of the same power at low frequencies, s sqrt(2 tau / T): rows one after another do not pretend to be
independent news. The acceleration's is the vertical, `Kind.GRAVITY`. In a manoeuvre it weighs less: s^2 grows by the squares of
what the force differs from 1 g in length, of what it scatters by within the window (jerk), and of rate times `speed` (the turn).
At rest it says nothing new and is left out, as is the velocity's.

*Wheels* roll forwards: sideways and upwards the velocity is zero but for `wheels`, which lasts `SLIP_S`.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from nav.aiding import AIDING, Kind, aiding
from nav.earth import RATE, normal_gravity
from nav.errors import HilError
from nav.filter.aided import AidedNavigator
from nav.filter.states import ACCELEROMETER_BIAS, ACCELEROMETER_SCALE, GYRO_BIAS, correct_one
from nav.filter.stillness import Stillness, StillnessDetector
from nav.increments import FloatArray
from nav.kernel import kernel
from nav.turn import rotate

_GYRO, _FORCE, _FORCE_SCALE = GYRO_BIAS.start, ACCELEROMETER_BIAS.start, ACCELEROMETER_SCALE.start
SURE = 4.0
"""Sigmas within which rest must fit."""
TREMOR_MS = 0.01
"""Velocity of a body at rest, one sigma of each axis, m/s."""
SLIP_S = 1.0
"""How long wheels slip the same way, s."""
EVERY = 10
"""Strides between two rows of the bounds of velocity and place."""
ITSELF = -1
"""Source of the rows."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """What the vehicle does on the long run, one sigma of each axis: m/s^2, m/s, m."""

    acceleration: float
    speed: float
    place: float

    def __post_init__(self) -> None:
        """Refuse what bounds nothing."""
        if not all(0.0 < getattr(self, one.name) < math.inf for one in fields(self)):
            raise HilError(f"{self}: every bound is positive and finite")


@dataclass(frozen=True, slots=True)
class Assumptions:
    """What is assumed.

    Attributes
    ----------
    stillness : Stillness
        Of the detector.
    rest : bool
        Stillness may be rest.
    smooth : float
        Speed from which on the vehicle may move as smoothly as it stands, m/s.
    bounds : Bounds, optional
        None: the vehicle may do anything.
    wheels : float, optional
        Velocity sideways and upwards of a vehicle on wheels, m/s, one sigma at the navigated point; None: it may move in any way.
    """

    stillness: Stillness
    rest: bool = True
    smooth: float = 5.0
    bounds: Bounds | None = None
    wheels: float | None = None


class Assumed:
    """Makes the rows; see the module. It is told the start, then takes samples and answers by turns."""

    def __init__(self, assumptions: Assumptions) -> None:
        self.settings = assumptions
        self.detector = StillnessDetector(assumptions.stillness)
        self._place = (0.0, 0.0, 0.0)
        self._strides = 0
        self._mean_variance = assumptions.stillness.variance / assumptions.stillness.blocks
        self._room = np.zeros(3), np.zeros(3)

    def start(self, lat: float, lon: float, height: float) -> None:
        """Begin where the navigator begins, rad and m."""
        self._place = (lat, lon, height)
        self._strides = 0
        self.detector.clear()

    def rows(self, aided: AidedNavigator) -> NDArray[np.void]:
        """What is assumed of the stride that the detector has just decided on, at the navigator's time."""
        bounds, time = self.settings.bounds, aided.time
        self._strides += 1
        rest = self.settings.rest and self.detector.still and self._fits_rest(aided)
        rows = [self._rest_row(aided)] if rest else []
        stride_s = self.settings.stillness.block_s * self.settings.stillness.stride
        if self.settings.wheels is not None and not rest:
            slip = self.settings.wheels * math.sqrt(2.0 * SLIP_S / stride_s)
            rows.append(aiding(time, Kind.BODY_VELOCITY, (0.0,) * 3, (math.inf, slip, slip), ITSELF - 2))
        if bounds is not None:
            if not rest and self.detector.filled >= self.settings.stillness.stride:
                rows.append(self._vertical(bounds, aided, stride_s))
            if self._strides % EVERY == 0:
                widen = math.sqrt(2.0 * bounds.place / bounds.speed / (EVERY * stride_s))
                rows.append(aiding(time, Kind.GNSS, self._place, 3 * (widen * bounds.place,), ITSELF))
                if not rest:
                    rows.append(aiding(time, Kind.BODY_VELOCITY, (0.0,) * 3, 3 * (widen * bounds.speed,), ITSELF - 1))
        return np.array(rows, AIDING)

    def _fits_rest(self, aided: AidedNavigator) -> bool:
        """The window's mean and the filter's velocity are those of a body at rest."""
        noise = self._mean_variance[0], self._mean_variance[3]
        known = aided.estimates, aided.solution, aided.sigma
        return bool(_fits_rest(*known, self.detector.mean, *noise, self.settings.smooth, *self._room))

    def _rest_row(self, aided: AidedNavigator) -> np.void:
        """Zero velocity or zero rate; the filter takes the rate of its last interval, which is as long as a block or shorter."""
        spread, stillness = self.detector.spread, self.settings.stillness
        if self._strides % 2:
            velocity = np.hypot(TREMOR_MS, stillness.block_s * spread[3:])
            return aiding(aided.time, Kind.BODY_VELOCITY, (0.0,) * 3, tuple(velocity), ITSELF)
        rate = np.maximum(spread[:3], stillness.rate_white / math.sqrt(aided.settings.predict_s))
        return aiding(aided.time, Kind.ZERO_RATE, (), tuple(rate), ITSELF)

    def _vertical(self, bounds: Bounds, aided: AidedNavigator, stride_s: float) -> np.void:
        known = aided.estimates, aided.solution
        surplus, rate = _manoeuvre(*known, self.detector.newest, *self._room)
        scatter = math.hypot(*self.detector.spread[3:])
        acceleration = math.hypot(bounds.acceleration, surplus, bounds.speed * rate, scatter)
        sigma = acceleration * math.sqrt(2.0 * bounds.speed / bounds.acceleration / stride_s)
        return aiding(aided.time, Kind.GRAVITY, (), (sigma, sigma), ITSELF)


@kernel
def _manoeuvre(
    estimates: FloatArray, solution: FloatArray, mean: FloatArray, rate: FloatArray, force: FloatArray
) -> tuple[float, float]:
    """By how much the force of a mean (6,) is longer than gravity, m/s^2, and how large its rate is, rad/s.

    Both are corrected, and left in `rate` and `force` (3,).
    """
    correct_one(estimates, 1.0, mean[:3], mean[3:], rate, force)
    length = math.sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2])
    turn = math.sqrt(rate[0] * rate[0] + rate[1] * rate[1] + rate[2] * rate[2])
    return length - normal_gravity(math.sin(solution[0]), solution[2]), turn


@kernel
def _fits_rest(
    estimates: FloatArray,
    solution: FloatArray,
    sigma: FloatArray,
    mean: FloatArray,
    rate_variance: float,
    force_variance: float,
    smooth: float,
    rate: FloatArray,
    force: FloatArray,
) -> bool:
    """The tests of the module; `rate` and `force` (3,) are room to work in."""
    speed2 = doubt2 = 0.0
    for i in range(3):
        speed2 += solution[3 + i] ** 2
        doubt2 += sigma[3 + i] ** 2
    if speed2 > SURE**2 * (doubt2 + TREMOR_MS**2) or math.sqrt(speed2) + 3.0 * math.sqrt(doubt2) > smooth:
        return False
    surplus, _ = _manoeuvre(estimates, solution, mean, rate, force)
    g = normal_gravity(math.sin(solution[0]), solution[2])
    gyro = accelerometer = 0.0
    for i in range(3):
        gyro = max(gyro, sigma[_GYRO + i] ** 2)
        accelerometer = max(accelerometer, sigma[_FORCE + i] ** 2 + (g * sigma[_FORCE_SCALE + i]) ** 2)
    rotate(solution[6:10], rate, rate)
    north, east, down = rate[0] - RATE * math.cos(solution[0]), rate[1], rate[2] + RATE * math.sin(solution[0])
    turn2, off2 = max(north * north, east * east, down * down), surplus * surplus
    return turn2 <= SURE**2 * (gyro + rate_variance) and off2 <= SURE**2 * (accelerometer + force_variance)
