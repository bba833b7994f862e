"""What gyros and accelerometers have in common as channels: coefficients, dependence on conditions, limit and pulses.

A channel is a triple of body axes (0, 1, 2). Its first axis is the sensing one; the meaning of the other two is the
instrument's own.
"""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from nav.errors import HilError
from nav.increments import FloatArray, IntArray
from nav.kernel import kernel

Triple = tuple[int, int, int]
Channelwise = float | tuple[float, ...]
"""One coefficient for all channels, or one for each."""

TRIAD: tuple[Triple, ...] = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
"""Three channels along x, y, z, the other two axes in cyclic order."""


def check(owner: str, channels: tuple[Triple, ...], values: Mapping[str, object], limit: float, pulse: float) -> None:
    """Refuse channels that are no axes, coefficients of another number, and an impossible converter.

    Raises
    ------
    HilError
        Says which.
    """
    if not channels or any(sorted(triple) != [0, 1, 2] for triple in channels):
        raise HilError(f"{owner}: every channel names the axes 0, 1, 2 once each; got {channels}")
    for name, value in values.items():
        array = np.asarray(value, np.float64)
        if array.shape not in ((), (len(channels),)) or not np.isfinite(array).all():
            raise HilError(f"{owner}: {name} must be a number or {len(channels)} numbers, one a channel; got {value}")
    if not limit > 0.0:
        raise HilError(f"{owner}: limit is {limit:g}; it must be positive, or inf for none")
    if not 0.0 <= pulse < math.inf:
        raise HilError(f"{owner}: pulse is {pulse:g}; it must be positive, or 0 for none")


def table(values: Mapping[str, Channelwise], count: int) -> FloatArray:
    """Coefficients as (count, len(values)): a row for each channel."""
    rows: FloatArray = np.stack(
        [np.broadcast_to(np.asarray(value, np.float64), count) for value in values.values()], axis=1
    )
    return np.ascontiguousarray(rows)


def polynomial(coefficients: tuple[Channelwise, ...], x: ArrayLike, n: int, count: int) -> FloatArray:
    """c1 x + c2 x^2 + ... for each sample and channel: (n, count); `x` is a number or (n,)."""
    column = np.broadcast_to(np.asarray(x, np.float64), n)[:, None]
    total = np.zeros((n, count))
    for coefficient in reversed(coefficients):
        total = (total + np.asarray(coefficient, np.float64)) * column
    return total


@kernel
def convert(
    increments: FloatArray, step: float, limit: float, pulse: float, residue: FloatArray, saturated: IntArray
) -> None:
    """Limit the mean rate of each step and count whole pulses, in place; what is below a pulse is carried on.

    Parameters
    ----------
    increments : (n, c) float
        u s, in place.
    step : float
        s.
    limit : float
        Largest mean rate, u.
    pulse : float
        Weight of a pulse, u s; 0 for none.
    residue : (c,) float
        Carried, u s; in place.
    saturated : (c,) int
        Steps at the limit, counted on; in place.
    """
    top = limit * step
    for k in range(increments.shape[0]):
        for c in range(increments.shape[1]):
            value = increments[k, c]
            if abs(value) > top:
                value = math.copysign(top, value)
                saturated[c] += 1
            if pulse > 0.0:
                whole = value + residue[c]
                value = pulse * math.floor(whole / pulse + 0.5)
                residue[c] = whole - value
            increments[k, c] = value


def check_input(owner: str, *arrays: FloatArray) -> None:
    """Refuse increments of another shape or that are not finite.

    Raises
    ------
    HilError
        Says what was got.
    """
    for array in arrays:
        if array.shape != (len(arrays[0]), 3) or not np.isfinite(array).all():
            raise HilError(
                f"{owner}: increments must be finite and of shape (n, 3); got {array.shape}; mend the motion"
            )
