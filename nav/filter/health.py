"""The gate of each measurement, and what the innovations say of their source.

With nu the innovation over its expected sigma, component by component:

    gate       nu^T S^-1 nu beyond the chi-square quantile: the measurement is rejected and counted
    noisy      the mean of (nu - nu before)^2 / 2, 1 where the stated sigma is true, is above `NOISY`: R is multiplied by it.
               A jump enters once, however long it lasts
    drifting   the mean of nu is beyond `DRIFT` in each component (rms): the source pulls one way, slowly enough for the gate;
               it is rejected until that is over

Means are exponential over about 1 / `SHARE` measurements. No component counts for more than `FARTHEST` in them.
"""

import math
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from nav.increments import FloatArray
from nav.kernel import kernel

SHARE = 0.05
NOISY = 2.0
FARTHEST = 6.0
DRIFT = 1.5


class Channel(IntEnum):
    """What is judged at once."""

    GNSS_POSITION = 0
    GNSS_VELOCITY = 1
    BARO = 2
    MAGNETIC = 3
    HEADING = 4
    ATTITUDE = 5
    BODY_VELOCITY = 6
    ZERO_RATE = 7
    GRAVITY = 8


class Trust(IntFlag):
    """What is wrong with a source; 0 is a good one."""

    GOOD = 0
    REJECTED = 1
    """The newest measurement was rejected."""
    NOISY = 2
    """It is noisier than it says."""
    DRIFTING = 4
    """It pulls one way."""


@dataclass(frozen=True, slots=True)
class ChannelHealth:
    """Of one source.

    Attributes
    ----------
    channel, source : Channel, int
    accepted, rejected : int
        Measurements since the start.
    nis : float
        Of the newest one over its degrees of freedom, with the noise that was believed.
    nis_mean : float
        Mean of the last ones, with the noise as stated: 1 where the filter and the source are right.
    inflation : float
        What the stated variance is multiplied by.
    trust : Trust
    """

    channel: Channel
    source: int
    accepted: int
    rejected: int
    nis: float
    nis_mean: float
    inflation: float
    trust: Trust


ACCEPTED, REJECTED, NIS, NIS_MEAN, SPREAD, TRUST, SINCE, COUNT, MEAN, LAST = 0, 1, 2, 3, 4, 5, 6, 7, 8, 11
TABLE = 14
"""Columns of a source: as `ChannelHealth`; the time of the first rejection in a row (NaN: none); rows of the last
measurement; mean and last nu (3 each)."""


def clear(row: FloatArray) -> None:
    """Begin to judge a source."""
    row[:] = 0.0
    row[NIS_MEAN], row[SPREAD], row[SINCE] = 1.0, 1.0, math.nan


def inflation(row: FloatArray) -> float:
    """What the stated variance is multiplied by."""
    return float(row[SPREAD]) if row[SPREAD] > NOISY else 1.0


@kernel
def judge(
    row: FloatArray,
    m: int,
    residual: FloatArray,
    variance: FloatArray,
    spread: FloatArray,
    nis: float,
    gate: float,
    time: float,
) -> bool:
    """Take note of an innovation; whether it is accepted.

    Parameters
    ----------
    row : (TABLE,) float
        Of the source.
    m : int
        Components.
    residual, variance, spread : (3,), (3,), (3, 3) float
        Computed less measured, stated variance, H P H^T.
    nis, gate : float
        With the believed variance, and the quantile.
    time : float
        s.
    """
    pulled = changed = whole = 0.0
    same = int(row[COUNT]) == m
    for i in range(m):
        nu = residual[i] / math.sqrt(spread[i, i] + variance[i])
        nu = max(-FARTHEST, min(FARTHEST, nu))
        whole += nu * nu
        change = nu - row[LAST + i]
        changed += 0.5 * change * change
        row[MEAN + i] = SHARE * nu + (1.0 - SHARE) * row[MEAN + i] if same else 0.0
        pulled += row[MEAN + i] * row[MEAN + i]
        row[LAST + i] = nu
    if same:
        row[SPREAD] += SHARE * (changed / m - row[SPREAD])
    row[COUNT] = m
    row[NIS] = nis / m
    row[NIS_MEAN] += SHARE * (whole / m - row[NIS_MEAN])
    trust = 0
    widened = row[SPREAD] if row[SPREAD] > NOISY else 1.0
    if widened > 1.0:
        trust |= 2
    if pulled > DRIFT * DRIFT * m * widened:
        trust |= 4
    accepted = nis <= gate and trust & 4 == 0
    if accepted:
        row[ACCEPTED] += 1.0
        row[SINCE] = math.nan
    else:
        row[REJECTED] += 1.0
        trust |= 1
        if math.isnan(row[SINCE]):
            row[SINCE] = time
    row[TRUST] = trust
    return accepted
