"""The ordinary sample in one compiled call: alone, the next one, flagged like the one before, of a solution that goes on.

At a thousand samples a second nearly all are of this kind. What is not goes the way of batches, with the same answer to the
last bit.
"""

from typing import Any

import numpy as np
from numba import carray
from numpy.typing import NDArray

from nav.gaps import rates
from nav.increments import FloatArray, IntArray, first_bad
from nav.kernel import float_pointer, kernel
from nav.solutions import add_to_rows, fill_rows
from nav.step import DONE, SOLUTION_PART, push

_SOLUTION = 8 * SOLUTION_PART.start

Parts = tuple[FloatArray, NDArray[np.float32], NDArray[np.float32], NDArray[Any], FloatArray, FloatArray]
"""Gyro bias (3,), rad/s; sigmas (9,) and ratios (len(Ratio),), what the solution is worth; out: rows of `NAV_STATE` (2 or more,),
the solution in row 1 and again in row 0; out: rate and force of the sample (3,), rad/s and m/s^2."""


@kernel
def take_one(
    core: int,
    expected: tuple[int, int, int],
    what: tuple[int, int, float],
    parts: Parts,
    sample: tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray, IntArray],
) -> bool:
    """Take the only sample; False, and nothing has changed, when it is not an ordinary one.

    False as well where it is so large that the solution is no number any more: the way of batches says so too.

    Parameters
    ----------
    core : int
        Address of the core (:func:`nav.step.push`).
    expected : tuple
        Sequence number, flags, and which flags count.
    what : tuple
        Mode, health, progress.
    parts : tuple
        See `Parts`.
    sample : tuple
        The arrays of :class:`nav.increments.ImuIncrements`, with one row each.
    """
    gyro_bias, sigma, ratio, rows, rate, force = parts
    time, step, dtheta, dvel, validity, sequence = sample
    number, flags, mask = expected
    t = step[0]
    if sequence[0] != number or validity[0] & mask != flags or not t > 0.0 or first_bad(time, step, dtheta, dvel) >= 0:
        return False
    x, y, z = dtheta[0, 0] - gyro_bias[0] * t, dtheta[0, 1] - gyro_bias[1] * t, dtheta[0, 2] - gyro_bias[2] * t
    if push(core, t, x, y, z, dvel[0, 0], dvel[0, 1], dvel[0, 2]) != DONE:
        return False
    position = carray(float_pointer(core + _SOLUTION), (1, 3))
    velocity = carray(float_pointer(core + _SOLUTION + 24), (1, 3))
    attitude = carray(float_pointer(core + _SOLUTION + 48), (1, 4))
    fill_rows(rows, 1, 2, what, position, velocity, attitude, gyro_bias, sigma, ratio)
    add_to_rows(rows, time, step, dtheta, dvel, sequence)
    rates(step, dtheta, dvel, 0, rate, force)
    rows[0] = rows[1]
    return True
