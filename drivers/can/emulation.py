"""What emulated boards share: rates out of increments, the rounding of a board, frames out of raw values."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.can.codec import MessageCodec
from drivers.can.frames import FrameArray
from nav.errors import HilError
from nav.increments import FloatArray, ImuIncrements, IntArray

FRAME_NS = 150_000
"""Between the frames of a sample."""


def check_period(board: str, period_us: int, *, least_us: int, grid_us: int) -> None:
    """Refuse (`HilError`) a sample period that `board` has not: at least `least_us`, in whole `grid_us`."""
    if period_us < least_us or period_us % grid_us:
        raise HilError(
            f"{board} has no sample period of {period_us} us: at least {least_us} us, in steps of {grid_us} us (head.rate_hz)"
        )


def ticks_of(time_s: FloatArray, tick_s: float) -> IntArray:
    """A 32-bit clock of ticks of `tick_s` at times `time_s` (n,)."""
    return np.rint(time_s / tick_s).astype(np.int64) & 0xFFFFFFFF


class EndRates:
    """Rates at the end of each step from increments, for emulators: ``(3 d[k] - d[k-1]) / (2 step)``.

    The mean of two such ends gives increments back without delay: of a rate that changes evenly, the exact ones.
    """

    def __init__(self) -> None:
        self._last: FloatArray | None = None

    def rates(self, imu: ImuIncrements) -> FloatArray:
        """Turn rates, rad/s, and specific forces, m/s^2, as one array (n, 6); the calls follow one another."""
        means = np.hstack([imu.dtheta, imu.dvel]) / imu.step[:, None]
        first = means[:1] if self._last is None else self._last
        before = np.vstack([first, means[:-1]])
        self._last = means[-1:].copy()
        rates: FloatArray = 1.5 * means - 0.5 * before
        return rates


def rounded(values: FloatArray, lsb: float, bits: int = 16) -> tuple[IntArray, NDArray[np.bool_]]:
    """What a board sends for `values` (n, m): raw integers, held at the ends of their range; and (n,) whether all were in range.

    A board rounds each sample for itself: nothing is carried over.
    """
    limit = math.ldexp(1.0, bits - 1)
    exact = np.rint(values / lsb)
    held = np.clip(exact, -limit, limit - 1.0)
    return held.astype(np.int64), (held == exact).all(axis=1)


def axes(values: IntArray, names: Sequence[str]) -> dict[str, IntArray]:
    """The columns of raw values (n, m) by name."""
    return {name: values[:, i] for i, name in enumerate(names)}


def put(codec: MessageCodec, raw: dict[str, IntArray], rows: FrameArray) -> None:
    """Write one message into n classic frames; `raw` has (n,) raw integers by the name of the signal, what is not named is 0."""
    values = np.zeros((len(rows), len(codec.signals)), np.int64)
    for name, column in raw.items():
        values[:, codec.columns[name]] = column
    rows["can_id"], rows["length"] = codec.can_id, codec.length
    rows["data"][:, : codec.length] = codec.encode_raw(values, np.zeros((len(rows), codec.length), np.uint8))


def stamp(batch: FrameArray, time: FloatArray, per_sample: int) -> None:
    """Times of the frames of samples at `time` (n,) s: one after the other."""
    start = np.rint(time * 1e9).astype(np.int64)
    batch["time_ns"] = np.repeat(start, per_sample) + np.tile(FRAME_NS * np.arange(per_sample), len(time))
