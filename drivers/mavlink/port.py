"""A MAVLink link as a `Port`: its bytes as chunks, for ring, recording and replay. ``mavlink:udpin:127.0.0.1:14560``."""

import select
import time

from drivers.can.frames import FrameArray
from drivers.mavlink.link import Link, Listener, open_link
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
        self._listener = opened if isinstance(opened, Listener) else None
        self._link: Link | None = None if isinstance(opened, Listener) else opened
        self.dropped = 0
        """Frames that were to be sent: nothing is sent here."""
        self._poll = select.poll()
        self._poll.register(opened.fileno(), select.POLLIN)

    def receive(self, batch: FrameArray, timeout: float) -> int:
        """See `drivers.can.bus.Port.receive`; one arrival time holds for all bytes of a call."""
        if self._link is not None and not self._link.gone:
            self._link.ready()
        self._poll.poll(max(0.0, timeout * 1000.0))
        if self._listener is not None:
            self._accept(self._listener)
        data = b""
        while self._link is not None and len(data) + _PIECE <= len(batch) * SIZE:
            part = self._link.receive()
            if not part:
                break
            data += part
        return fill_chunks(batch, data, time.time_ns())

    def _accept(self, listener: Listener) -> None:
        if self._link is not None and self._link.gone:
            self._poll.unregister(self._link.fileno())
            self._link.close()
            self._link = None
        for link in listener.accept(0 if self._link is not None else 1):
            self._link = link
            self._poll.register(link.fileno(), select.POLLIN)

    def send(self, batch: FrameArray) -> None:
        """Nothing is sent; what was to be is counted."""
        self.dropped += len(batch)

    def close(self) -> None:
        """Give the link back."""
        for one in (self._link, self._listener):
            if one is not None:
                one.close()
