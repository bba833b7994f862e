"""A MAVLink link as a `Port`: its bytes as chunks, for ring, recording and replay. ``mavlink:udpin:127.0.0.1:14560``."""

import select
import time

from drivers.can.frames import FrameArray
from drivers.mavlink.link import Link, Listener, open_link
from drivers.mavlink.sole import SoleClient
from drivers.serial.chunks import SIZE, fill_chunks

_PIECE = 2048
"""Most bytes that a link hands over at once."""


class MavlinkPort:
    """One link, heard only; satisfies `drivers.can.bus.Port`.

    Raises
    ------
    HilError
        The URL is malformed or the link cannot be opened.
    """

    def __init__(self, url: str) -> None:
        opened = open_link(url)
        self._link: Link = SoleClient(opened) if isinstance(opened, Listener) else opened
        self.dropped = 0
        """Frames that were to be sent: nothing is sent here."""
        self._poll = select.poll()
        self._poll.register(self._link.fileno(), select.POLLIN)

    def receive(self, batch: FrameArray, timeout: float) -> int:
        """See `drivers.can.bus.Port.receive`; one arrival time holds for all bytes of a call."""
        self._link.ready()
        self._poll.poll(max(0.0, timeout * 1000.0))
        data = b""
        while len(data) + _PIECE <= len(batch) * SIZE:
            part = self._link.receive()
            if not part:
                break
            data += part
        return fill_chunks(batch, data, time.time_ns())

    def send(self, batch: FrameArray) -> None:
        """Nothing is sent; what was to be is counted."""
        self.dropped += len(batch)

    def close(self) -> None:
        """Give the link back."""
        self._link.close()
