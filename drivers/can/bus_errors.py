"""Error frames of SocketCAN: what the CAN controller says of the bus and of itself, counted by kind.

Classes are bits of the identifier, details are in the data (Linux, ``include/uapi/linux/can/error.h``). A frame may say several
things at once; each is counted.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from drivers.can.frames import EFF, ERR, RTR, FrameArray

TX_TIMEOUT, LOST_ARBITRATION, CONTROLLER, PROTOCOL, TRANSCEIVER, NO_ACK, BUS_OFF, BUS_ERROR, RESTARTED = (
    1 << bit for bit in range(9)
)
_OVERFLOW, _WARNING, _PASSIVE = 0x03, 0x0C, 0x30
"""Bits of ``data[1]`` of a controller's frame: its receive or transmit buffer, level or state."""


def is_error(batch: FrameArray) -> NDArray[np.bool_]:
    """Which of `batch` (n,) are error frames; chunks of serial bytes are none."""
    found: NDArray[np.bool_] = (batch["can_id"] & np.uint32(EFF | RTR | ERR)) == ERR
    return found


@dataclass(slots=True)
class BusErrors:
    """Counts of what error frames have said."""

    bus_off: int = 0
    """The controller has left the bus."""
    restarted: int = 0
    """It is back."""
    error_passive: int = 0
    """128 errors: it no longer marks the errors that it sees."""
    error_warning: int = 0
    """96 errors."""
    overflow: int = 0
    """Its buffer was full: frames are lost."""
    no_ack: int = 0
    """Nobody acknowledged what it sent."""
    protocol: int = 0
    """A frame violated the protocol: bit, stuffing, form, check."""
    lost_arbitration: int = 0
    tx_timeout: int = 0
    transceiver: int = 0

    def add(self, batch: FrameArray) -> None:
        """Count the error frames in `batch` (n,)."""
        for row in batch[is_error(batch)]:
            said, state = int(row["can_id"]), int(row["data"][1])
            self.bus_off += bool(said & BUS_OFF)
            self.restarted += bool(said & RESTARTED)
            self.error_passive += bool(said & CONTROLLER and state & _PASSIVE)
            self.error_warning += bool(said & CONTROLLER and state & _WARNING)
            self.overflow += bool(said & CONTROLLER and state & _OVERFLOW)
            self.no_ack += bool(said & NO_ACK)
            self.protocol += bool(said & (PROTOCOL | BUS_ERROR))
            self.lost_arbitration += bool(said & LOST_ARBITRATION)
            self.tx_timeout += bool(said & TX_TIMEOUT)
            self.transceiver += bool(said & TRANSCEIVER)

    def as_dict(self) -> dict[str, int]:
        """Name to count, of what there was."""
        return {one.name: count for one in fields(self) if (count := getattr(self, one.name))}
