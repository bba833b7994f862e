"""CAN frames in bulk: one numpy record a frame, laid out as Linux lays out ``struct canfd_frame``, with a time stamp before it.

The same 80 bytes travel on the `unix:` bus, in the shared-memory ring and in our own recordings.
"""

import numpy as np
from numpy.typing import NDArray

FRAME = np.dtype(
    [
        ("time_ns", "<i8"),  # host clock (UTC): when sent (unix: bus) or received (all others)
        ("can_id", "<u4"),  # with the flags EFF, RTR, ERR below
        ("length", "u1"),  # bytes of data
        ("flags", "u1"),  # BRS, ESI, FDF
        ("reserved", "u1", 2),
        ("data", "u1", 64),
    ]
)
FrameArray = NDArray[np.void]

EFF = 0x80000000
"""Bit of `can_id`: 29-bit identifier."""
RTR = 0x40000000
"""Bit of `can_id`: remote request."""
ERR = 0x20000000
"""Bit of `can_id`: error frame."""
BRS = 0x01
"""Bit of `flags`: FD bit-rate switch."""
ESI = 0x02
"""Bit of `flags`: FD error state indicator."""
FDF = 0x04
"""Bit of `flags`: the frame is CAN FD."""


def frames(n: int) -> FrameArray:
    """Room for `n` frames, zeroed."""
    return np.zeros(n, FRAME)


def as_bytes(batch: FrameArray) -> NDArray[np.uint8]:
    """The frames (n,) as bytes (n, 80), for kernels: a view where `batch` is contiguous."""
    return np.ascontiguousarray(batch).view(np.uint8).reshape(len(batch), FRAME.itemsize)
