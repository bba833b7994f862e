"""Driver of IMUs that speak DroneCAN: uavcan.equipment.ahrs.RawIMU (1003) of one node to `ImuIncrements`.

A message is a transfer of several frames. The last byte of each frame says whether it begins or ends the transfer, alternates a
toggle bit and carries the transfer's number (5 bits); a transfer of several frames begins with a CRC-16 over the type's
signature and the payload. Classic frames and CAN FD are understood. Source: DroneCAN specification, CAN bus transport layer.

Taken are the integrals over the interval where the node sends them (single precision), else the latest rates and accelerations,
which have 11 bits. Axes are forward, right, down already. Without a time stamp the clock is that of the arrival, whose period is
the interval of the first message or a multiple of it; without an interval whole milliseconds, if that fits.
"""

import struct
from binascii import crc_hqx

import numpy as np

from drivers import Counters
from drivers.can.aiding import is_aiding
from drivers.can.frames import EFF, ERR, RTR, FrameArray
from drivers.can.samples import INCREMENT, MEAN_RATE, NUMBER, PUSH, PUSH_IS, RATE, RAW, TICKS, TURN, TURN_IS, Samples
from nav.errors import HilError
from nav.increments import FloatArray, ImuIncrements, IntArray

TYPE = 1003
SIGNATURE = 0x8280632C40E574B5
"""Of the type's definition."""
BASE_CRC = crc_hqx(SIGNATURE.to_bytes(8, "little"), 0xFFFF)
START, END, TOGGLE, COUNTER = 0x80, 0x40, 0x20, 0x1F
"""Bits of the last byte of a frame."""
VALUES = struct.Struct("<f3e3f3e3f")
"""Behind the time (7 bytes): interval, latest rates, their integrals, latest accelerations, their integrals."""
SIZE, LARGEST = 7 + VALUES.size, 128
"""Bytes of a message without its covariance; no transfer is longer."""
TICK_S, GRID_S, USUAL_S = 1e-6, 1e-3, 2e-3
LONGEST_S = 1.0
"""Of an interval; a larger one is damage."""
FITS = 0.02
"""An interval that is the sample period but for this is all of the step; of another one the mean is taken."""


def node_of(option: str) -> int:
    """The node id that follows ``@``, 1 to 127; 0 where there is none. Another text is a `HilError`."""
    node = int(option) if option.isascii() and option.isdigit() else 0
    if option and not 1 <= node <= 127:
        raise HilError(f"dronecan-imu@{option}: give a node id from 1 to 127")
    return node


class DronecanImu:
    """See the module; satisfies `drivers.FrameDriver`.

    Parameters
    ----------
    option : str
        What follows ``@`` in the driver's name: the node id, 1 to 127; left out, the first node that sends the message.

    Raises
    ------
    HilError
        The option is no node id.
    """

    world_id = 0

    def __init__(self, option: str = "") -> None:
        self._node = node_of(option)
        self.counters = Counters()
        self._samples: Samples | None = None
        self._stamped = True
        self._payload, self._transfer, self._toggle = bytearray(), -1, 0
        self._arrivals: IntArray = np.zeros(0, np.int64)

    @property
    def period_s(self) -> float | None:
        """Sample period, s, once learnt."""
        return None if self._samples is None else self._samples.period_s

    def identity(self) -> dict[str, object]:
        """The node, and whether it stamps its messages."""
        return {"node": self._node or None, "time_stamps": self._stamped and self._samples is not None}

    def arrivals(self) -> IntArray:
        """Arrival (ns) of the last frame of each sample of the last `decode`."""
        return self._arrivals

    def decode(self, batch: FrameArray) -> ImuIncrements:
        """The samples that `batch` completes, in order; valid until the next call."""
        ids = batch["can_id"]
        plain = (ids & np.uint32(EFF | ERR | RTR)) == EFF
        ours = plain & ((ids & np.uint32(0x00FFFF80)) == TYPE << 8) & ((ids & np.uint32(0x7F)) != 0)
        if not self._node and ours.any():
            self._node = int(ids[int(ours.argmax())]) & 0x7F
        ours &= (ids & np.uint32(0x7F)) == self._node
        self.counters.frames += len(batch)
        self.counters.foreign += int((~ours & ~is_aiding(ids)).sum())
        raw, arrivals = [], []
        for row in batch[ours]:
            payload = self._joined(bytes(row["data"][: row["length"]]))
            if payload is None:
                continue
            said = self._said(payload, int(row["time_ns"]))
            if said is None:
                self.counters.short += 1
                continue
            raw.append(said)
            arrivals.append(int(row["time_ns"]))
        if self._samples is None:
            return ImuIncrements.empty(0)
        imu, taken = self._samples.take(np.array(raw).reshape(-1, RAW))
        self._arrivals = np.array(arrivals, np.int64)[taken]
        return imu

    def _joined(self, data: bytes) -> bytes | None:
        """The payload of the transfer that a frame ends; frames that fit no transfer are counted."""
        if not data:
            self.counters.short += 1
            return None
        tail = data[-1]
        if tail & START:
            self.counters.short += self._transfer >= 0  # the one before has no end
            self._payload, self._transfer, self._toggle = bytearray(), tail & COUNTER, 0
        follows = tail & COUNTER == self._transfer and tail & TOGGLE == self._toggle
        if not follows or len(self._payload) + len(data) > LARGEST:
            self.counters.short += 1
            self._transfer = -1
            return None
        self._payload += data[:-1]
        self._toggle ^= TOGGLE
        if not tail & END:
            return None
        self._transfer = -1
        if tail & START:
            return bytes(self._payload)
        if crc_hqx(self._payload[2:], BASE_CRC) != int.from_bytes(self._payload[:2], "little"):
            self.counters.crc_errors += 1
            return None
        return bytes(self._payload[2:])

    def _said(self, payload: bytes, arrival_ns: int) -> FloatArray | None:
        """A row of `RAW`; None for a message that makes no sense."""
        if len(payload) < SIZE:
            return None
        time_us = int.from_bytes(payload[:7], "little")
        interval, *values = VALUES.unpack_from(payload, 7)
        latest, integral = [*values[0:3], *values[6:9]], [*values[3:6], *values[9:12]]
        whole = 0.0 < interval <= LONGEST_S
        chosen = np.array(integral if whole else latest)
        if not np.isfinite(chosen).all() or (interval > LONGEST_S):
            return None
        if self._samples is None:
            self._stamped = time_us != 0
            grid_s, usual_s = (max(interval, TICK_S),) * 2 if whole else (GRID_S, USUAL_S)
            self._samples = Samples(self.counters, TICK_S, 0.0 if self._stamped else grid_s, usual_s)
        if self._stamped and time_us == 0:
            return None
        kind, period = RATE, self._samples.period_s
        if whole:
            kind = INCREMENT if period is not None and abs(interval / period - 1.0) < FITS else MEAN_RATE
            chosen = chosen if kind == INCREMENT else chosen / interval
        row = np.zeros(RAW)
        row[TICKS], row[NUMBER] = (time_us if self._stamped else arrival_ns // 1000) % (1 << 32), -1.0
        row[TURN : TURN + 3], row[PUSH : PUSH + 3] = chosen[:3], chosen[3:]
        row[TURN_IS] = row[PUSH_IS] = kind
        return row
