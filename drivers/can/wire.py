"""How long frames are on the wire, in bits: what a bus is loaded with.

Stuff bits depend on the content, so that a length lies between two bounds: none, and one after each four bits (Davis, Burns,
Bril & Lukkien 2007, eq. 1). The three bits between frames are counted in.
"""

from dataclasses import dataclass

import numpy as np

from drivers.can.frames import BRS, EFF, FDF, RTR, FrameArray
from drivers.serial.chunks import is_chunk
from nav.increments import IntArray

_TAIL = 13
"""Delimiters, acknowledgement, end of frame, intermission."""
SERIAL_BITS = 10
"""Of a byte on a serial line: start, eight of data, stop."""


@dataclass(frozen=True, slots=True)
class Bits:
    """Bits of n frames, at the nominal rate and at that of the data of CAN FD; each least and most.

    Attributes
    ----------
    nominal, data : (n, 2) int
    """

    nominal: IntArray
    data: IntArray

    def seconds(self, bitrate: float, data_bitrate: float) -> tuple[float, float]:
        """How long all of them take, least and most, s."""
        low, high = (self.nominal / bitrate + self.data / data_bitrate).sum(axis=0).tolist()
        return low, high


def bits(batch: FrameArray) -> Bits:
    """Length of each frame of `batch` (n,); of a chunk of serial bytes, of these."""
    extended, fd = (batch["can_id"] & EFF) != 0, (batch["flags"] & FDF) != 0
    payload = 8 * np.where((batch["can_id"] & RTR) != 0, 0, batch["length"].astype(np.int64))
    classic_head = np.where(extended, 54, 34)
    classic = _stuffed(classic_head + payload, classic_head + payload + _TAIL)
    head = np.where(extended, 36, 17)
    check = np.where(batch["length"] > 16, 4 + 21 + 7, 4 + 17 + 6)  # stuff count, CRC, fixed stuff bits
    body = _stuffed(5 + payload + 1, 5 + payload + check)
    nominal = np.where(fd[:, None], _stuffed(head, head + _TAIL), classic)
    data = np.where(fd[:, None], body, 0)
    slow = ((batch["flags"] & BRS) == 0)[:, None]
    serial = is_chunk(batch)
    nominal = np.where(slow, nominal + data, nominal)
    nominal[serial] = SERIAL_BITS * batch["length"][serial, None].astype(np.int64)
    data = np.where(slow | serial[:, None], 0, data)
    return Bits(nominal, data)


def _stuffed(open_to_it: IntArray, whole: IntArray) -> IntArray:
    return np.stack([whole, whole + (open_to_it - 1) // 4], axis=1)
