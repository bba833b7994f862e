"""What the fuzz targets of wires share: bytes to frames and chunks, checks put right, and what must hold of every driver."""

import json
from collections.abc import Iterator
from functools import reduce
from itertools import pairwise
from operator import or_
from typing import Any

import numpy as np

from drivers import FrameDriver
from drivers.can.frames import FRAME, FrameArray, frames
from nav.increments import IntArray, Validity

CUTS = 12
"""Most pieces an input is cut into, its rest aside: how many more there are shows nothing new and takes most of the time."""
TICK_NS = 10_000
"""Unit of the delay before a frame, in the reserved bytes of its record."""
_VALID = int(reduce(or_, Validity))


def packed(batch: FrameArray, size: int) -> bytes:
    """Frames as the kernel hands them over, `size` bytes each (16: classic, 72: FD), with the delay in the reserved bytes."""
    batch = batch.copy()
    ticks = np.diff(batch["time_ns"], prepend=batch["time_ns"][:1]) // TICK_NS
    batch["reserved"] = np.clip(ticks, 0, 0xFFFF).astype("<u2")[:, None].view(np.uint8)
    return batch.view(np.uint8).reshape(len(batch), FRAME.itemsize)[:, 8 : 8 + size].tobytes()


def unpacked(data: bytes, size: int) -> FrameArray:
    """The frames in `data`, whatever it is."""
    rows = np.frombuffer(data, np.uint8, len(data) // size * size).reshape(-1, size)
    batch = frames(len(rows))
    batch.view(np.uint8).reshape(len(rows), FRAME.itemsize)[:, 8 : 8 + size] = rows
    batch["time_ns"] = 10**15 + TICK_NS * np.cumsum(batch["reserved"].astype(np.int64) @ [1, 256])
    batch["reserved"] = 0
    return batch


def cut(length: int, size: int) -> Iterator[slice]:
    """`CUTS` pieces of `size` out of `length`, and the rest."""
    edges = [*range(0, length, size)[: CUTS + 1], length]
    return (slice(*edge) for edge in pairwise(edges))


def batches(batch: FrameArray, size: int) -> Iterator[FrameArray]:
    """`batch` in pieces of `size`, and the rest."""
    return (batch[piece] for piece in cut(len(batch), size))


def drive(driver: FrameDriver, batch: FrameArray, size: int) -> None:
    """Decode `batch` in pieces of `size`: finite samples in order, and counters that account for every frame."""
    total, last = 0, -(1 << 63)
    for piece in batches(batch, size):
        got: Any = driver.decode(piece)
        n = len(got)
        total += n
        assert len(driver.arrivals()) == n
        if not n:
            continue
        for values in (got.time, got.step, got.dtheta, got.dvel):
            assert np.isfinite(values).all(), values
        assert (got.step > 0.0).all()
        assert not (got.validity & ~_VALID).any()
        last = in_order(got.sequence, last)
    count = driver.counters
    assert min(count.as_list()) >= 0, count
    assert (count.frames, count.samples) == (len(batch), total)
    json.dumps(driver.identity(), allow_nan=False)


def in_order(sequence: IntArray, last: int) -> int:
    """The last of numbers that rise from `last` on."""
    assert sequence[0] > last
    assert (np.diff(sequence) > 0).all()
    return int(sequence[-1])


def accounted(driver: FrameDriver) -> None:
    """No frame is counted twice."""
    count = driver.counters
    parts = count.samples, count.duplicated, count.late, count.crc_errors, count.foreign, count.short
    assert sum(parts) + count.version_errors <= count.frames, count
