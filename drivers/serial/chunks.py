"""Serial bytes as frames: chunks of up to 64 bytes with their arrival, so that ring, recording and replay carry them as they are.

A chunk is a `FRAME` whose `can_id` is `CHUNK`: extended, remote and error frame at once, which no CAN bus delivers.
"""

import numpy as np
from numpy.typing import NDArray

from drivers.can.frames import FrameArray, frames

CHUNK = 0xFFFFFFFF
"""`can_id` of a chunk of serial bytes."""
SIZE = 64
"""Most bytes in one chunk."""


def is_chunk(batch: FrameArray) -> NDArray[np.bool_]:
    """Which of `batch` (n,) are chunks of serial bytes."""
    found: NDArray[np.bool_] = batch["can_id"] == CHUNK
    return found


def fill_chunks(batch: FrameArray, data: bytes, time_ns: int) -> int:
    """Write `data` into the first frames of `batch` as chunks that arrived at `time_ns`; how many it took."""
    n = -(-len(data) // SIZE)
    rows = batch[:n]
    rows["time_ns"], rows["can_id"], rows["flags"], rows["reserved"] = time_ns, CHUNK, 0, 0
    rows["length"] = SIZE
    if n:
        rows["length"][-1] = len(data) - SIZE * (n - 1)
    rows["data"] = np.frombuffer(data.ljust(SIZE * n, b"\0"), np.uint8).reshape(n, SIZE)
    return n


def to_chunks(data: bytes, time_ns: int = 0) -> FrameArray:
    """`data` as chunks that arrived at `time_ns`."""
    batch = frames(-(-len(data) // SIZE))
    fill_chunks(batch, data, time_ns)
    return batch


def chunk_bytes(batch: FrameArray) -> bytes:
    """The bytes of chunks, joined."""
    there = np.arange(SIZE) < batch["length"][:, None]
    return bytes(batch["data"][there].tobytes())
