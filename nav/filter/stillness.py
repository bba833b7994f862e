"""Does the body stand still? A decision from the inertial samples alone, by the noise that they would have at rest.

Samples are averaged in blocks; the newest `Stillness.blocks` of them are the window. At rest the mean of a block is one vector
(6,) of rate and specific force plus noise of the variance

    white^2 / T + (lsb / T)^2 / 6 + tremor^2        T the length of the block, lsb the step of the summed increments

so that, n blocks in the window and m new ones in a stride,

    whole   sum over the window of (x - mean)^2 / variance               chi-square of 6 (n - 1) degrees of freedom
    fresh   (mean of the new - mean of the others)^2 / (variance (1/m + 1/(n - m)))        chi-square of 6

This is the generalised likelihood ratio of "constant" against "anything" (Skog et al. 2010), the mean left free. Of the mean it
says nothing: a body that flies straight or turns steadily is as still as one that stands, and who asks must know more
(:mod:`nav.filter.assumptions`). The body becomes still where `whole` is below its `enter` quantile, and moves again where one of
both is above its `leave` quantile. What is known of a stride is known at its last sample, however samples were batched.
"""

import math
from dataclasses import dataclass, fields

import numpy as np

from nav.chi_square import quantile
from nav.errors import HilError
from nav.increments import FloatArray, ImuIncrements, IntArray, Validity
from nav.kernel import kernel

_SPOILT = int(Validity.BRIDGED | Validity.SENSOR)
_FILLED, _PLACE, _NEW = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Stillness:
    """What a body at rest shows, and how sure the decision is.

    Attributes
    ----------
    rate_white, force_white : float
        White noise, worst axis, rad/sqrt(s) and m/s/sqrt(s).
    rate_lsb, force_lsb : float
        Steps in which the increments come, their remainders carried on, rad and m/s.
    rate_tremor, force_tremor : float
        One sigma of what a block's mean itself moves by at rest: a desk, an idling engine, rad/s and m/s^2.
    block_s : float
        Length of a block, s.
    blocks, stride : int
        In the window, and between two decisions.
    enter, leave : float
        Probabilities with which a body at rest stays below the limits.

    Raises
    ------
    HilError
        A noise is negative or not finite, no noise at all, or lengths and probabilities that cannot be.
    """

    rate_white: float
    force_white: float
    rate_lsb: float = 0.0
    force_lsb: float = 0.0
    rate_tremor: float = 5e-4
    force_tremor: float = 0.01
    block_s: float = 0.02
    blocks: int = 50
    stride: int = 5
    enter: float = 0.99
    leave: float = 1.0 - 1e-6

    def __post_init__(self) -> None:
        """Refuse what decides nothing."""
        if not all(0.0 <= getattr(self, one.name) < math.inf for one in fields(self)):
            raise HilError(f"{self}: every number is 0 or more, and finite")
        if not (self.block_s > 0.0 and 0 < self.stride < self.blocks and 0.5 < self.enter <= self.leave < 1.0):
            raise HilError(f"{self}: needs block_s > 0, stride in 1..blocks - 1, 0.5 < enter <= leave < 1")
        if not (self.variance > 0.0).all():
            raise HilError(f"{self}: without any noise nothing is ever still: state the noise or the tremor")

    @property
    def variance(self) -> FloatArray:
        """(6,): of a block's mean at rest, (rad/s)^2 and (m/s^2)^2."""
        rate = self.rate_white**2 / self.block_s + (self.rate_lsb / self.block_s) ** 2 / 6.0 + self.rate_tremor**2
        force = self.force_white**2 / self.block_s + (self.force_lsb / self.block_s) ** 2 / 6.0 + self.force_tremor**2
        return np.repeat([rate, force], 3)


class StillnessDetector:
    """See the module.

    Parameters
    ----------
    settings : Stillness

    Attributes
    ----------
    still : bool
        As last decided.
    filled : int
        Good blocks in a row, as many as the window holds at most.
    decided : bool
        The last `take` has ended with a decision.
    whole, fresh : float
        The statistics at the last decision.
    mean, spread : (6,) float
        Of the blocks in the window: rate, rad/s, specific force, m/s^2; and their standard deviation.
    newest : (6,) float
        Mean of the last stride.
    """

    def __init__(self, settings: Stillness) -> None:
        self.settings = settings
        self._variance = settings.variance
        n = settings.blocks
        self._enter = quantile(settings.enter, 6 * (n - 1))
        self._leave = quantile(settings.leave, 6 * (n - 1)), quantile(settings.leave, 6)
        self._sums, self._ring, self._count = np.zeros(7), np.zeros((n, 6)), np.zeros(3, np.int64)
        self.mean, self.spread, self.newest = np.zeros(6), np.zeros(6), np.zeros(6)
        self.clear()

    @property
    def filled(self) -> int:
        """See the class."""
        return max(int(self._count[_FILLED]), 0)

    def clear(self) -> None:
        """Forget what was seen."""
        self._sums[:], self._count[:] = 0.0, 0
        self.still, self.decided = False, False
        self.whole = self.fresh = math.inf

    def take(self, imu: ImuIncrements) -> int:
        """Take samples up to the next decision; how many.

        Samples that a failed sensor or a bridged gap has made say nothing: the window begins anew behind them.
        """
        how = self.settings.block_s, self.settings.stride
        data = imu.step, imu.dtheta, imu.dvel, imu.validity
        used, self.decided, spoilt = _accumulate(self._sums, self._ring, self._count, *data, *how)
        if spoilt:
            self.still = False
        if self.decided:
            self._decide()
        return int(used)

    def _decide(self) -> None:
        out = self.mean, self.spread, self.newest
        self.whole, self.fresh = _statistics(self._ring, self._count, self.settings.stride, self._variance, *out)
        if self.filled < self.settings.blocks:
            self.still = False
        elif self.still:
            self.still = self.whole <= self._leave[0] and self.fresh <= self._leave[1]
        else:
            self.still = self.whole <= self._enter and self.fresh <= self._leave[1]


@kernel
def _accumulate(
    sums: FloatArray,
    ring: FloatArray,
    count: IntArray,
    step: FloatArray,
    dtheta: FloatArray,
    dvel: FloatArray,
    validity: IntArray,
    block_s: float,
    stride: int,
) -> tuple[int, bool, bool]:
    """Add samples until a stride is complete: how many, whether it is, whether some were spoilt.

    `sums` (7,): time, dtheta, dvel of the open block; `ring` (n, 6): means of the last blocks; `count` (3,): blocks in the ring,
    place of the next, blocks since the last decision.
    """
    spoilt = False
    for k in range(len(step)):
        if validity[k] & _SPOILT:
            spoilt = True
            count[_FILLED] = -1
        sums[0] += step[k]
        for i in range(3):
            sums[1 + i] += dtheta[k, i]
            sums[4 + i] += dvel[k, i]
        if sums[0] + 0.5 * step[k] < block_s or sums[0] <= 0.0:
            continue
        row = ring[count[_PLACE]]
        for i in range(6):
            row[i] = sums[1 + i] / sums[0]
        for i in range(7):
            sums[i] = 0.0
        count[_PLACE] = (count[_PLACE] + 1) % len(ring)
        count[_FILLED] = min(count[_FILLED] + 1, len(ring))
        count[_NEW] += 1
        if count[_NEW] >= stride:
            count[_NEW] = 0
            return k + 1, True, spoilt
    return len(step), False, spoilt


@kernel
def _statistics(
    ring: FloatArray,
    count: IntArray,
    stride: int,
    variance: FloatArray,
    mean: FloatArray,
    spread: FloatArray,
    newest: FloatArray,
) -> tuple[float, float]:
    """(whole, fresh) of what is in the ring; `mean`, `spread`, `newest` (6,) out."""
    n = max(count[_FILLED], stride)
    first = count[_PLACE] - n
    whole = fresh = 0.0
    for i in range(6):
        old = new = 0.0
        for k in range(n):
            value = ring[(first + k) % len(ring), i]
            if k < n - stride:
                old += value
            else:
                new += value
        mean[i] = (old + new) / n
        newest[i] = new / stride
        square = 0.0
        for k in range(n):
            off = ring[(first + k) % len(ring), i] - mean[i]
            square += off * off
        spread[i] = math.sqrt(square / max(n - 1, 1))
        whole += square / variance[i]
        if n > stride:
            step = newest[i] - old / (n - stride)
            fresh += step * step / (variance[i] * (1.0 / stride + 1.0 / (n - stride)))
    return whole, fresh
