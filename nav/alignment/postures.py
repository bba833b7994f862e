"""How a board lies at rest, and how it has turned between: what a stated sequence of postures says of its axes.

    flat -> nose up -> flat -> right side down -> flat -> nose to the right

The specific force of each rest points along a known axis of the body, and so does each turn between two of them: the
first says how the accelerometers lie, the second how the gyros do, each without the other.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from nav.alignment.axes import Fit, fit, turned
from nav.errors import HilError
from nav.increments import FloatArray, ImuIncrements
from nav.rotation import product, relative, rotation_vector_from_quaternion

BLOCK_S = 0.25
"""Averages are taken over so long, s."""
STILL = 3
"""Still averages that make a rest."""
STEADY_RATE, STEADY_FORCE = 0.1, 0.5
"""At rest an average differs by no more from the one before, rad/s and m/s^2."""
LARGEST_BIAS = 0.35
"""A rate beyond this is no bias, rad/s."""
LEAST_TURN = math.radians(30.0)
"""A rest that is nearer to the one before is the same."""
_AT_ONCE = 1024
_UP, _FORWARD, _LEFT = (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)
ORDERS = (
    "lay it as it lies in the level vehicle, and let go of it",
    "raise its nose by 90 deg, and hold still",
    "lay it down again as before",
    "tilt it to the right by 90 deg: right side down, and hold still",
    "lay it down again as before",
    "turn it on the table to the right by 90 deg (clockwise, seen from above)",
)
"""What to do before each rest, in words for the user."""
FORCES = np.array([_UP, _FORWARD, _UP, _LEFT, _UP, _UP])
"""(6, 3) where the specific force of each rest points, body axes."""
TURNS = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""(5, 3) axes of the turns between them."""


@dataclass(frozen=True, slots=True)
class Posture:
    """A rest.

    Attributes
    ----------
    time : float
        Of the board, when it was found, s.
    force : (3,) float
        Mean specific force, m/s^2.
    right, left : (4,) float
        Attitude by the gyros since the first sample, and by gyros of opposite sign.
    """

    time: float
    force: FloatArray
    right: FloatArray
    left: FloatArray


class Postures:
    """Finds the rests in a stream of samples; how it is split into batches changes nothing.

    Attributes
    ----------
    found : list of Posture
        So far.
    """

    def __init__(self) -> None:
        self.found: list[Posture] = []
        self._rows = np.zeros((0, 8))
        """Step, increments and time of the samples of an average that is not complete."""
        self._bias, self._before = np.zeros(3), np.full(6, np.inf)
        self._still: list[FloatArray] = []
        self._right, self._left = np.array([1.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])

    def take(self, imu: ImuIncrements) -> None:
        """Take the next samples."""
        new = np.column_stack([imu.step, imu.dtheta, imu.dvel, imu.time])
        for start in range(0, len(new), _AT_ONCE):
            rows = np.vstack([self._rows, new[start : start + _AT_ONCE]])
            while (last := int(np.searchsorted(np.cumsum(rows[:, 0]), BLOCK_S - 1e-9))) < len(rows):
                self._block(rows[: last + 1])
                rows = rows[last + 1 :]
            self._rows = rows

    def _block(self, rows: FloatArray) -> None:
        step = rows[:, :1]
        dtheta = rows[:, 1:4] - self._bias * step
        self._right, self._left = product(self._right, turned(dtheta)), product(self._left, turned(-dtheta))
        mean = rows[:, 1:7].sum(axis=0) / step.sum()
        change, self._before = np.abs(mean - self._before), mean
        size = np.linalg.norm(mean[:3] - self._bias)
        steady = (
            change[:3].max() < STEADY_RATE
            and change[3:].max() < STEADY_FORCE
            and size < (STEADY_RATE if self.found else LARGEST_BIAS)
        )
        self._still = [*self._still, mean] if steady else []
        if len(self._still) == STILL:
            self._rest(np.mean(self._still, axis=0), float(rows[-1, 7]))

    def _rest(self, mean: FloatArray, time: float) -> None:
        here = Posture(time, mean[3:], self._right, self._left)
        if not self.found:
            self._bias = mean[:3]
        elif _angle(self.found[-1], here) < LEAST_TURN:
            return
        self.found.append(here)


def judged(postures: list[Posture]) -> tuple[Fit, Fit]:
    """How accelerometers and gyros lie, by the whole sequence.

    Raises
    ------
    HilError
        It is not the whole sequence; says what was found.
    """
    if len(postures) != len(ORDERS):
        raise HilError(
            f"{len(postures)} rests were found where the sequence has {len(ORDERS)}, each of a second and turned by 30 deg and "
            "more from the one before: do it again, in quick turns, without a stop on the way"
        )
    forces = np.array([one.force for one in postures])
    pairs = list(itertools.pairwise(postures))
    right = np.array([rotation_vector_from_quaternion(relative(a.right, b.right)) for a, b in pairs])
    left = np.array([-rotation_vector_from_quaternion(relative(a.left, b.left)) for a, b in pairs])
    if not (np.linalg.norm(forces, axis=1) > 0.0).all():
        raise HilError("a specific force is zero: the accelerometers do not measure")
    if not (np.linalg.norm(right, axis=1) > 0.5 * LEAST_TURN).all():
        raise HilError("the gyros do not feel a turn that the accelerometers show: is their unit right?")
    return fit(FORCES, forces, forces), fit(TURNS, right, left)


def _angle(a: Posture, b: Posture) -> float:
    """How far the board has turned, by the gyros or by the force, whichever says more, rad."""
    turn = float(np.linalg.norm(rotation_vector_from_quaternion(relative(a.right, b.right))))
    across = float(np.linalg.norm(np.cross(a.force, b.force)))
    return max(turn, math.atan2(across, float(a.force @ b.force)))
