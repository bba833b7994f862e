"""Averages at rest, in blocks, with the tests that say "this is not rest" or "these are not metres per second".

The sums run sample by sample, so that the result does not depend on how samples were batched.
"""

import math
from dataclasses import dataclass, fields

import numpy as np

from nav.earth import STANDARD_GRAVITY
from nav.errors import HilError
from nav.increments import FloatArray
from nav.kernel import kernel

BLOCK_S = 0.5
"""Length of a block, s."""
RATE_LIMIT = 0.01
"""A block whose mean rate differs by more than this from the mean so far is motion, rad/s."""
FORCE_LIMIT = 0.05
"""A block whose mean specific force differs by more than this is motion, m/s^2."""
TURN_LIMIT = 0.1
"""A mean rate above this is motion and not bias, rad/s."""

_LIES = {
    "+x": ("stands on its tail", "x and z look swapped"),
    "-x": ("stands on its nose", "x and z look swapped"),
    "+y": ("lies on its left side", "y and z look swapped"),
    "-y": ("lies on its right side", "y and z look swapped"),
    "+z": ("lies on its back", "the sign of z looks wrong (z points up)"),
}
"""What the body does, and else what looks wrong, where the specific force is along an axis."""

# Layout of the sums: block time, dtheta, dvel | total time, dtheta, dvel | blocks, sum of squares of block rate, force
_BLOCK, _TOTAL, _COUNT, _SQUARES = 0, 7, 14, 15
SUMS = 21


@kernel
def accumulate(
    sums: FloatArray, step: FloatArray, dtheta: FloatArray, dvel: FloatArray, goal_s: float
) -> tuple[int, int]:
    """Add samples until a block of `BLOCK_S` is complete or the batch ends.

    Parameters
    ----------
    sums : (SUMS,) float
        Updated in place.
    step, dtheta, dvel
        As in `ImuIncrements`.
    goal_s : float
        Time to average in all.

    Returns
    -------
    used : int
        Samples consumed.
    event : int
        0 the batch is used up; 1 a block was completed; 2 the goal is reached; 3 motion: the sums start again.
    """
    for k in range(step.shape[0]):
        sums[_BLOCK] += step[k]
        for i in range(3):
            sums[_BLOCK + 1 + i] += dtheta[k, i]
            sums[_BLOCK + 4 + i] += dvel[k, i]
        if sums[_BLOCK] < BLOCK_S - 1e-9:
            continue
        time = sums[_BLOCK]
        moved = False
        rate2 = 0.0
        for i in range(6):
            mean = sums[_BLOCK + 1 + i] / time
            if i < 3:
                rate2 += mean * mean
            if sums[_COUNT] > 0.0:
                so_far = sums[_TOTAL + 1 + i] / sums[_TOTAL]
                moved = moved or abs(mean - so_far) > (RATE_LIMIT if i < 3 else FORCE_LIMIT)
        if moved or rate2 > TURN_LIMIT * TURN_LIMIT:
            for i in range(sums.shape[0]):
                sums[i] = 0.0
            return k + 1, 3
        for i in range(6):
            mean = sums[_BLOCK + 1 + i] / time
            sums[_SQUARES + i] += mean * mean
        for i in range(7):
            sums[_TOTAL + i] += sums[_BLOCK + i]
            sums[_BLOCK + i] = 0.0
        sums[_COUNT] += 1.0
        return k + 1, 2 if sums[_TOTAL] >= goal_s - 1e-9 else 1
    return step.shape[0], 0


@dataclass(frozen=True, slots=True)
class Sensors:
    """What is known of the sensors, one sigma an axis; 0: not stated.

    Attributes
    ----------
    angle_random_walk, velocity_random_walk : float
        White noise of rate and specific force, rad/sqrt(s) and m/s/sqrt(s). Not stated, it is the scatter of the blocks.
    gyro_bias, accelerometer_bias : float
        rad/s and m/s^2.
    upright_drift : float
        What gravity adds to the bias of the upright axis, rad/s; no heading feels it.

    Raises
    ------
    HilError
        A value is negative or not finite.
    """

    angle_random_walk: float = 0.0
    velocity_random_walk: float = 0.0
    gyro_bias: float = 0.0
    accelerometer_bias: float = 0.0
    upright_drift: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what would end in NaN."""
        if not all(0.0 <= getattr(self, one.name) < math.inf for one in fields(self)):
            raise HilError(f"{self}: a standard deviation is 0 or more, and finite")


UNSTATED = Sensors()


@dataclass(frozen=True, slots=True)
class Means:
    """Averages over all complete blocks.

    Attributes
    ----------
    time_s : float
        Averaged time, s.
    w, f : (3,) float
        Mean rate, rad/s, and specific force, m/s^2.
    sigma_w, sigma_f : float
        Standard deviation of the means (worst axis) from the scatter of the blocks; 0 of a single one.
    blocks : int
        How many.
    """

    time_s: float
    w: FloatArray
    f: FloatArray
    sigma_w: float
    sigma_f: float
    blocks: int


def means(sums: FloatArray) -> Means:
    """The averages in `sums` (at least one complete block)."""
    time, count = sums[_TOTAL], sums[_COUNT]
    mean = sums[_TOTAL + 1 : _TOTAL + 7] / time
    variance = np.maximum(sums[_SQUARES : _SQUARES + 6] / count - mean**2, 0.0) / max(count - 1.0, 1.0)
    sigma = np.sqrt(variance)
    return Means(float(time), mean[:3], mean[3:], float(sigma[:3].max()), float(sigma[3:].max()), int(count))


def blocks(sums: FloatArray) -> int:
    """Complete blocks in `sums`."""
    return int(sums[_COUNT])


def progress(sums: FloatArray, goal_s: float) -> float:
    """How much of `goal_s` is averaged, 0..1."""
    return min(1.0, float(sums[_TOTAL] / goal_s))


def gravity_verdict(f_b: FloatArray) -> str | None:
    """What is wrong with the specific force at rest (3,), m/s^2; None when it is 1 g to five per cent."""
    g = float(np.linalg.norm(f_b)) / STANDARD_GRAVITY
    if math.isfinite(g) and abs(g - 1.0) <= 0.05:
        return None
    return f"specific force at rest is {g:.2f} g: units or signs?"


def upright_verdict(f_b: FloatArray) -> str | None:
    """What a specific force at rest (3,) that is nearer to another axis than -z says of the mounting; None where it is not."""
    axis = int(np.abs(f_b).argmax())
    if axis == 2 and f_b[2] <= 0.0:
        return None
    along = ("-" if f_b[axis] < 0.0 else "+") + "xyz"[axis]
    lies, wrong = _LIES[along]
    return (
        f"specific force at rest is along {along} of the body and not -z: the vehicle {lies}, or {wrong}: "
        "see head.axes, and hil check-axes"
    )
