"""The ordinary sample in one compiled call: alone, the next one, flagged like the one before, of a solution that goes on.

At a thousand samples a second nearly all are of this kind. What is not goes the way of batches, with the same answer to the
last bit.
"""

from typing import Any

import numpy as np
from numba import carray
from numpy.typing import NDArray

from nav.increments import FloatArray, IntArray, first_bad
from nav.kernel import float_pointer, kernel
from nav.step import DONE, SOLUTION_PART, push

_SOLUTION = 8 * SOLUTION_PART.start


@kernel
def take_one(
    core: int,
    expected: tuple[int, int, int],
    what: tuple[int, int],
    time: FloatArray,
    step: FloatArray,
    dtheta: FloatArray,
    dvel: FloatArray,
    validity: IntArray,
    sequence: IntArray,
    gyro_bias: FloatArray,
    rows: NDArray[Any],
    rate: FloatArray,
    force: FloatArray,
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
        Mode, health.
    time, step, dtheta, dvel, validity, sequence
        Of :class:`nav.increments.ImuIncrements`.
    gyro_bias : (3,) float
        rad/s.
    rows : (2 or more,) array of NAV_STATE
        Out: the solution, in row 1 and again in row 0.
    rate, force : (3,) float
        Out: of the sample, rad/s and m/s^2.
    """
    number, flags, mask = expected
    t = step[0]
    if sequence[0] != number or validity[0] & mask != flags or not t > 0.0 or first_bad(time, step, dtheta, dvel) >= 0:
        return False
    x, y, z = dtheta[0, 0] - gyro_bias[0] * t, dtheta[0, 1] - gyro_bias[1] * t, dtheta[0, 2] - gyro_bias[2] * t
    if push(core, t, x, y, z, dvel[0, 0], dvel[0, 1], dvel[0, 2]) != DONE:
        return False
    solution = carray(float_pointer(core + _SOLUTION), 10)
    row = rows[1]
    row.time, row.sequence, row.progress = time[0], sequence[0], 1.0
    row.mode, row.health = what
    row.lat, row.lon, row.height = solution[0], solution[1], solution[2]
    for i in range(3):
        rate[i], force[i] = dtheta[0, i] / t, dvel[0, i] / t
        row.vel_n[i], row.gyro_bias[i] = solution[3 + i], gyro_bias[i]
        row.w_ib_b[i], row.f_b[i] = rate[i] - gyro_bias[i], force[i]
    for i in range(4):
        row.q_nb[i] = solution[6 + i]
    for i in range(9):
        row.sigma[i] = np.inf
    for i in range(5):
        row.test_ratio[i] = 0.0
    rows[0] = row
    return True
