"""States of the error-state filter, which of them are used, and how sure and how steady they are for a grade of sensors.

Nine states are the errors of the navigator, computed less true, as in :mod:`nav.error_dynamics`: position, velocity,
attitude. The others are what is left of the parameters, true less estimated; with w and f the rate and the specific force,
what the corrected increments still err by is

    dw = gyro bias + gyro scale * w + misalignment w + gyro g * f,     df = accelerometer bias + accelerometer scale * f

A parameter without a state is not estimated. What it would have explained becomes noise. What is constant at 1 g widens the
bias. What goes with the rate (scale factor, misalignment), or with the force beyond that of level flight (drift by force,
along the input axis and the other one of its channel), is white noise of the density sigma^2 w^2 `TURN_S`, as sure as the
parameter after a turn of that length.

Flicker of B has the spectrum B^2 / w at w, rad/s. It lies nowhere above that of white noise and a random walk together,

    B^2 / w <= B^2 T / 2 + B^2 / (2 T w^2),

and touches it at w = 1 / T. So white noise is that of the grade and B^2 T / 2, with T = `FLICKER_S`, about the time in which
GNSS at some hertz corrects velocity and tilt; the bias walks with B / sqrt(2 T), and what is slower than T widens it at the
start. No Gauss-Markov process: the same state holds the turn-on bias, which does not decay.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from nav.earth import STANDARD_GRAVITY
from nav.errors import HilError
from nav.increments import FloatArray, IntArray
from nav.instruments.grades import Grade
from nav.instruments.noise import flicker_processes
from nav.instruments.sources import combination
from nav.kernel import inline_kernel, kernel

GYRO_BIAS, ACCELEROMETER_BIAS = slice(9, 12), slice(12, 15)
GYRO_SCALE, ACCELEROMETER_SCALE = slice(15, 18), slice(18, 21)
GYRO_G, LEVER_ARM = slice(21, 24), slice(24, 27)
GNSS_DELAY, BAROMETER_BIAS = slice(27, 28), slice(28, 29)
GYRO_MISALIGNMENT = slice(29, 35)
"""What gyro x senses of the rates about y and z, gyro y of z and x, gyro z of x and y."""
STATES = 35
"""Of the full set; every array of states has these places, whatever is used."""

FLICKER_S = 10.0
TURN_S = 10.0
LEVEL = STANDARD_GRAVITY
"""Specific force of level flight, up, m/s^2."""


class Block(Enum):
    """Parameters that can be estimated, and their places."""

    GYRO_BIAS = GYRO_BIAS
    ACCELEROMETER_BIAS = ACCELEROMETER_BIAS
    GYRO_SCALE = GYRO_SCALE
    ACCELEROMETER_SCALE = ACCELEROMETER_SCALE
    GYRO_G = GYRO_G
    LEVER_ARM = LEVER_ARM
    GNSS_DELAY = GNSS_DELAY
    BAROMETER_BIAS = BAROMETER_BIAS
    GYRO_MISALIGNMENT = GYRO_MISALIGNMENT


SENSOR_BLOCKS = (
    Block.GYRO_BIAS,
    Block.ACCELEROMETER_BIAS,
    Block.GYRO_SCALE,
    Block.ACCELEROMETER_SCALE,
    Block.GYRO_MISALIGNMENT,
)
"""What is estimated of the sensors where nothing else is said: 27 states."""


def places(blocks: Iterable[Block]) -> IntArray:
    """(n,): places of the states that are used, in order: the navigator's nine and those of the blocks."""
    chosen = [*range(9)]
    for block in Block:
        if block in set(blocks):
            chosen += range(block.value.start, block.value.stop)
    return np.array(chosen, np.int64)


@dataclass(frozen=True, slots=True)
class Tuning:
    """What the filter believes of the sensors; one sigma.

    Attributes
    ----------
    blocks : tuple of Block
        What is estimated.
    sigma : (STATES,) float
        Of the parameters at the start; the first nine are not looked at.
    white : (6,) float
        Noise of gyros and accelerometers in b, rad/sqrt(s), m/s/sqrt(s).
    by_rate : (3, 3) float
        More noise of gyro i by the rate about axis j: variance density by the square of the rate, s.
    walk : (STATES,) float
        Random walks of the parameters, unit / sqrt(s).
    by_force : (3, 3) float
        As `by_rate`, by the force along axis j beyond that of level flight, s (rad/s / (m/s^2))^2.

    Raises
    ------
    HilError
        A value is negative, not finite or of a wrong shape.
    """

    blocks: tuple[Block, ...]
    sigma: FloatArray
    white: FloatArray
    by_rate: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    walk: FloatArray = field(default_factory=lambda: np.zeros(STATES))
    by_force: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))

    def __post_init__(self) -> None:
        """Refuse what would end in NaN."""
        shapes = {"sigma": (STATES,), "white": (6,), "by_rate": (3, 3), "walk": (STATES,), "by_force": (3, 3)}
        for name, shape in shapes.items():
            array = np.ascontiguousarray(getattr(self, name), np.float64)
            if array.shape != shape or not (np.isfinite(array) & (array >= 0.0)).all():
                raise HilError(f"filter tuning: {name} must be {shape} numbers, finite and not negative")
            object.__setattr__(self, name, array)


def tuning(
    grade: Grade,
    blocks: Iterable[Block] = SENSOR_BLOCKS,
    *,
    bias_removed: bool = False,
    lever_arm: float = 0.1,
    delay: float = 0.02,
    barometer: float = 10.0,
    barometer_walk: float = 0.02,
) -> Tuning:
    """What follows of a row of the table of grades; see the module.

    Parameters
    ----------
    grade : Grade
        Of the sensors.
    blocks : iterable of Block
        What is estimated.
    bias_removed : bool
        The gyros' turn-on bias has been removed at rest.
    lever_arm, delay, barometer : float
        Sigma at the start of the antenna's place, m, of the receiver's delay, s, and of the barometer's offset, m.
    barometer_walk : float
        Of the barometer's offset (weather), m/sqrt(s).
    """
    blocks = tuple(block for block in Block if block in set(blocks))
    mix = combination(grade.gyro_channels) ** 2  # channels of one axis are averaged
    share = np.sqrt(mix.sum(axis=1))
    sigma, walk = np.zeros(STATES), np.zeros(STATES)
    scale_known, g_known = Block.GYRO_SCALE in blocks, Block.GYRO_G in blocks
    bias = grade.gyro_bias_removed if bias_removed else grade.gyro_bias
    sigma[GYRO_BIAS] = share * math.sqrt(bias**2 + (1 if g_known else 2) * (grade.gyro_g * LEVEL) ** 2)
    by_scale = 0.0 if Block.ACCELEROMETER_SCALE in blocks else grade.accelerometer_scale * LEVEL
    sigma[ACCELEROMETER_BIAS] = math.hypot(grade.accelerometer_bias, by_scale)
    sigma[GYRO_SCALE], sigma[ACCELEROMETER_SCALE] = share * grade.gyro_scale, grade.accelerometer_scale
    sigma[GYRO_G], sigma[GYRO_MISALIGNMENT] = share * grade.gyro_g, np.repeat(share, 2) * grade.gyro_misalignment
    sigma[LEVER_ARM], sigma[GNSS_DELAY], sigma[BAROMETER_BIAS] = lever_arm, delay, barometer
    white = np.concatenate([share * grade.gyro_white, np.full(3, grade.accelerometer_white)])
    flicker = np.concatenate([share * grade.gyro_flicker, np.full(3, grade.accelerometer_flicker)])
    slow, part = flicker_processes(1.0, FLICKER_S)
    sigma[9:15] = np.hypot(sigma[9:15], part * math.sqrt(len(slow)) * flicker)
    walk[9:15], walk[BAROMETER_BIAS] = flicker / math.sqrt(2.0 * FLICKER_S), barometer_walk
    by_rate = np.full((3, 3), 0.0 if Block.GYRO_MISALIGNMENT in blocks else grade.gyro_misalignment**2)
    np.fill_diagonal(by_rate, 0.0 if scale_known else grade.gyro_scale**2)
    axes = np.eye(3)[np.array(grade.gyro_channels)]
    by_force = grade.gyro_g**2 * mix @ (axes[:, 1] + (0.0 if g_known else axes[:, 0]))
    return Tuning(
        blocks,
        sigma,
        np.hypot(white, flicker * math.sqrt(0.5 * FLICKER_S)),
        TURN_S * (share**2)[:, None] * by_rate,
        walk,
        TURN_S * by_force,
    )


@inline_kernel
def correct_one(
    estimates: FloatArray, step: float, dtheta: FloatArray, dvel: FloatArray, turned: FloatArray, pushed: FloatArray
) -> None:
    """One sample (3,) of `correct_increments`."""
    for i in range(3):
        force = (dvel[i] - estimates[12 + i] * step) / (1.0 + estimates[18 + i])
        pushed[i] = force
        turn = dtheta[i] - estimates[9 + i] * step - estimates[21 + i] * force
        for j in range(2):
            turn -= estimates[29 + 2 * i + j] * dtheta[(i + 1 + j) % 3]
        turned[i] = turn / (1.0 + estimates[15 + i])


@kernel
def correct_increments(
    estimates: FloatArray,
    step: FloatArray,
    dtheta: FloatArray,
    dvel: FloatArray,
    turned: FloatArray,
    pushed: FloatArray,
) -> None:
    """Take what the estimated parameters explain off the increments.

    Parameters
    ----------
    estimates : (STATES,) float
        Of the parameters.
    step : (n,) float
        s.
    dtheta, dvel : (n, 3) float
        Increments as measured.
    turned, pushed : (n, 3) float
        Out: (dtheta - bias T - g dvel' - misalignment dtheta) / (1 + scale) and dvel' = (dvel - bias T) / (1 + scale).
    """
    for k in range(len(step)):
        correct_one(estimates, step[k], dtheta[k], dvel[k], turned[k], pushed[k])
