"""A MAVLink link as a `Port`: its bytes as chunks, for ring, recording and replay. ``mavlink:udpin:127.0.0.1:14560``.

With ``?signing_key=FILE`` behind it what is not signed with the key in that file goes no further: it is neither recorded nor
navigated.
"""

import select
import time
from collections import Counter
from pathlib import Path
from urllib.parse import parse_qsl

from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.can.frames import FrameArray
from drivers.mavlink.imu import MavlinkImu
from drivers.mavlink.link import Link, Listener, open_link, parts_of
from drivers.mavlink.signing import Signer, read_key
from drivers.mavlink.sole import SoleClient
from drivers.mavlink.store import Store, state_folder
from drivers.serial.chunks import SIZE, fill_chunks
from drivers.serial.stream import ByteStream
from nav.errors import HilError

KEY = "signing_key"
"""The option of the URL."""
_PIECE = 2048
"""Most bytes that a link hands over at once."""


class _Guard:
    """Lets signed packets pass; `refused` counts the others by reason."""

    def __init__(self, key: bytes) -> None:
        self.refused: Counter[str] = Counter()
        self._stream = ByteStream(MavlinkImu())
        self._parser = mav.MAVLink(None)
        self._signer = Signer(key, Store(state_folder() / "mavlink-signing.json"))

    @property
    def waiting(self) -> int:
        """Bytes of a packet that is not complete yet."""
        return self._stream.waiting

    def passed(self, batch: FrameArray) -> bytes:
        """The packets among the chunks of `batch` that are signed."""
        data = b"".join(packet for packet, _ in self._stream.take(batch) if self._signed(packet))
        if self._stream.bad_checks:
            self.refused["damaged"] = self._stream.bad_checks
        return data

    def _signed(self, packet: bytes) -> bool:
        try:
            reason = self._signer.refusal(self._parser.decode(bytearray(packet)))
        except mav.MAVError:
            reason = "damaged"
        self.refused.update([reason] if reason else [])
        return not reason

    def close(self) -> None:
        """Keep the times of the senders."""
        self._signer.close()


class MavlinkPort:
    """One link, heard only; satisfies `drivers.can.bus.Port`.

    Parameters
    ----------
    url : str
        Of the link, with the option of the module.

    Raises
    ------
    HilError
        The URL is malformed, the key cannot be read, or the link cannot be opened.
    """

    def __init__(self, url: str) -> None:
        link, key = input_of(url)
        self._guard = None if key is None else _Guard(key)
        opened = open_link(link)
        self._link: Link = SoleClient(opened) if isinstance(opened, Listener) else opened
        self.refused: Counter[str] = Counter() if self._guard is None else self._guard.refused
        """Packets without the right signature, by reason."""
        self.dropped = 0
        """Frames that were to be sent: nothing is sent here."""
        self._poll = select.poll()
        self._poll.register(self._link.fileno(), select.POLLIN)

    @property
    def trouble(self) -> str:
        """What the user must know of the packets that are refused."""
        return f"{self._link.url}: packets are refused: {', '.join(self.refused)}" if self.refused else ""

    def receive(self, batch: FrameArray, timeout: float) -> int:
        """See `drivers.can.bus.Port.receive`; one arrival time holds for all bytes of a call."""
        self._link.ready()
        self._poll.poll(max(0.0, timeout * 1000.0))
        guard, data = self._guard, b""
        room = len(batch) * SIZE - (guard.waiting if guard is not None else 0)
        while len(data) + _PIECE <= room:
            part = self._link.receive()
            if not part:
                break
            data += part
        now_ns = time.time_ns()
        n = fill_chunks(batch, data, now_ns)
        return n if guard is None else fill_chunks(batch, guard.passed(batch[:n]), now_ns)

    def send(self, batch: FrameArray) -> None:
        """Nothing is sent; what was to be is counted."""
        self.dropped += len(batch)

    def close(self) -> None:
        """Give the link back."""
        self._link.close()
        if self._guard is not None:
            self._guard.close()


def input_of(url: str) -> tuple[str, bytes | None]:
    """The link of a URL, and the key with which its packets must be signed; None: they need not be.

    Raises
    ------
    HilError
        The URL is malformed, or the key cannot be read.
    """
    link, _, query = url.partition("?")
    parts_of(link)
    options = dict(parse_qsl(query, keep_blank_values=True))
    if unknown := sorted(set(options) - {KEY}):
        raise HilError(f"bus 'mavlink:{url}': unknown option {unknown[0]!r}; expected {KEY}=FILE")
    return link, read_key(Path(options[KEY]).expanduser()) if options else None
