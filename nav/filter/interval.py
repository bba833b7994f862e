"""Samples gathered to an interval of the filter: corrected by the estimated parameters, and summed.

`sums` (7,): length, s, and the sums of the corrected increments, rad and m/s. `last` (6,): rate and force of the last sample.
"""

from nav.filter.states import correct_one
from nav.increments import FloatArray
from nav.kernel import inline_kernel, kernel


@kernel
def gather(
    time: FloatArray,
    step: FloatArray,
    dtheta: FloatArray,
    dvel: FloatArray,
    first: int,
    stop: int,
    period: float,
    until: float,
    estimates: FloatArray,
    sums: FloatArray,
    last: FloatArray,
    turned: FloatArray,
    pushed: FloatArray,
) -> tuple[int, bool]:
    """Correct samples from `first` up to the end of the interval; how many, and whether it has ended.

    `sums` (7,) goes on: length, increments. `last` (6,) out: rate and force of the last sample.
    """
    n, ended = 0, False
    while first + n < stop and not ended:
        k = first + n
        ended = _add(estimates, time[k], step[k], dtheta[k], dvel[k], period, until, sums, last, turned[n], pushed[n])
        n += 1
    return n, ended


@inline_kernel
def _add(
    estimates: FloatArray,
    time: float,
    step: float,
    dtheta: FloatArray,
    dvel: FloatArray,
    period: float,
    until: float,
    sums: FloatArray,
    last: FloatArray,
    turned: FloatArray,
    pushed: FloatArray,
) -> bool:
    """Correct a sample and add it to the interval; whether that ends with it."""
    correct_one(estimates, step, dtheta, dvel, turned, pushed)
    sums[0] += step
    for i in range(3):
        sums[1 + i] += turned[i]
        sums[4 + i] += pushed[i]
        if step > 0.0:
            last[i], last[3 + i] = turned[i] / step, pushed[i] / step
    return sums[0] + 0.5 * step >= period or time >= until


@kernel
def add_one(
    samples: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    row: int,
    time: float,
    step: float,
    x: float,
    y: float,
    z: float,
    vx: float,
    vy: float,
    vz: float,
    period: float,
    until: float,
    estimates: FloatArray,
    sums: FloatArray,
    last: FloatArray,
    one: FloatArray,
) -> tuple[bool, float, float, float, float, float, float]:
    """Keep a sample in `row` and add it; `one` (6,) is room to work in. Whether the interval ends; corrected increments."""
    samples[0][row], samples[1][row] = time, step
    dtheta, dvel = samples[2][row], samples[3][row]
    dtheta[0], dtheta[1], dtheta[2] = x, y, z
    dvel[0], dvel[1], dvel[2] = vx, vy, vz
    ended = _add(estimates, time, step, dtheta, dvel, period, until, sums, last, one[:3], one[3:])
    return ended, one[0], one[1], one[2], one[3], one[4], one[5]
