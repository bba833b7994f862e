"""Chunks of serial bytes to packets: finds them by sync byte, length and check, whatever lies between.

What is found depends on the bytes alone, never on how they were cut into chunks or batches. Where a check fails, the
search goes on one byte behind the false start, so that a good packet inside it is found. A protocol bounds its packets,
so what waits for more bytes is bounded, and every byte is looked at as often as starts overlap, not more.
"""

import re
from bisect import bisect_left
from collections.abc import Iterator
from itertools import pairwise
from typing import Protocol

import numpy as np

from drivers.can.frames import FrameArray
from drivers.serial.chunks import chunk_bytes, is_chunk

MORE, NONE = 0, -1
"""What `Framing.size` says instead of a size: more bytes are needed to tell; no packet begins here."""


class Framing(Protocol):
    """How a protocol marks its packets."""

    sync: re.Pattern[bytes]
    """Matches one byte: the first of a packet."""

    def size(self, data: bytes, at: int) -> int:
        """Size of the packet that begins at `at` (some of it may not be there yet), or `MORE`, or `NONE`."""

    def good(self, packet: bytes) -> bool:
        """Whether the check of a whole packet is right."""


class ByteStream:
    """The packets of one port.

    Attributes
    ----------
    packets : int
        Good ones so far.
    bad_checks : int
        Starts whose check failed.
    skipped : int
        Bytes that are part of no packet.
    """

    def __init__(self, framing: Framing) -> None:
        self._framing = framing
        self._rest = b""
        self._ends = [0]
        """Where each chunk that reaches into the rest ends in it; the first entry is the end of all earlier ones."""
        self._times = [0]
        self.packets = self.bad_checks = self.skipped = 0

    @property
    def waiting(self) -> int:
        """Bytes of a packet that is not complete yet."""
        return len(self._rest)

    def take(self, batch: FrameArray) -> Iterator[tuple[bytes, int]]:
        """Each good packet that `batch` completes, with the arrival (ns) of its last byte; frames of no port are passed over."""
        chunks = batch[is_chunk(batch)]
        if not len(chunks):
            return
        data = self._rest + chunk_bytes(chunks)
        ends = [*self._ends, *(len(self._rest) + np.cumsum(chunks["length"], dtype=np.int64)).tolist()]
        times = [*self._times, *chunks["time_ns"].tolist()]
        framing, at = self._framing, 0
        while (start := framing.sync.search(data, at)) is not None:
            self.skipped += start.start() - at
            at = start.start()
            size = framing.size(data, at)
            if size == MORE or at + size > len(data):
                break
            packet = data[at : at + max(size, 0)]
            if size == NONE or not framing.good(packet):
                self.bad_checks += size != NONE
                self.skipped += 1
                at += 1
                continue
            self.packets += 1
            at += size
            yield packet, times[bisect_left(ends, at)]
        else:
            self.skipped += len(data) - at
            at = len(data)
        self._rest = data[at:]
        kept = [k for k, (_, end) in enumerate(pairwise(ends), 1) if end > at]
        self._ends, self._times = [0, *(ends[k] - at for k in kept)], [0, *(times[k] for k in kept)]
