"""A serial port as a `Port`: ``serial:/dev/ttyUSB0:921600``, or ``serial:socket://HOST:PORT`` for a port server on the network.

Reads take all that is there, without a thread; the bytes go on as chunks (:mod:`drivers.serial.chunks`). A port that is pulled
out is opened again when it is back.
"""

import contextlib
import errno
import os
import select
import time

import serial
from serial.tools import list_ports

from drivers.can.frames import FrameArray
from drivers.serial.chunks import SIZE, chunk_bytes, fill_chunks, is_chunk
from nav.errors import HilError

REOPEN_S = 0.5
"""Time between tries to reopen a port that failed."""
WRITE_S = 1.0
"""Longest time for a board to take what is sent to it."""
_READ = 4096
"""What a terminal hands over in one read at most."""
_LOST = select.POLLHUP | select.POLLERR | select.POLLNVAL
FORM = "serial:/dev/NAME:BAUD or serial:socket://HOST:PORT"


class SerialPort:
    """One port, opened for us alone; satisfies `drivers.can.bus.Port`.

    Parameters
    ----------
    url : str
        See the module.

    Raises
    ------
    HilError
        The URL is malformed or the port cannot be opened; the message says how to mend it.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self.place, self.baud = parts_of(url)
        self.dropped = 0
        """Chunks that the port did not take."""
        self.failures = 0
        """Times the port was lost."""
        self.trouble = ""
        """Why it cannot be used now."""
        self._poll = select.poll()
        self._fd = -1
        self._port: serial.SerialBase | None = None
        self._retry = 0.0
        self._open()

    def _open(self) -> None:
        try:
            port = serial.serial_for_url(self.place, self.baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError) as error:  # pyserial's errors are OSErrors
            raise HilError(f"{self.url}: {_reason(self.place, error)}") from error
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            port.set_low_latency_mode(True)  # only some drivers offer it
        self._port, self._fd = port, port.fileno()
        self._poll.register(self._fd, select.POLLIN)

    def _failed(self) -> None:
        self.failures += 1
        self.trouble = f"{self.url}: the port is lost: unplugged?"
        self.close()
        self._retry = time.monotonic() + REOPEN_S

    def _alive(self) -> bool:
        if self._port is None and time.monotonic() >= self._retry:
            try:
                self._open()
                self.trouble = ""
            except HilError:
                self._retry = time.monotonic() + REOPEN_S
        return self._port is not None

    def receive(self, batch: FrameArray, timeout: float) -> int:
        """See `drivers.can.bus.Port.receive`; one arrival time holds for all bytes of a call."""
        if not self._alive():
            time.sleep(min(timeout, REOPEN_S))
            return 0
        ready = self._poll.poll(max(0.0, timeout * 1000.0))
        if not ready:
            return 0
        data, room = b"", len(batch) * SIZE
        try:
            while len(data) < room:
                wanted = min(room - len(data), _READ)
                part = os.read(self._fd, wanted)
                data += part
                if len(part) < wanted:
                    break
        except BlockingIOError:
            pass
        except OSError:
            self._failed()
        if not data and self._port is not None:  # readable without a byte: the other end is gone
            self._failed()
        return fill_chunks(batch, data, time.time_ns())

    def send(self, batch: FrameArray) -> None:
        """Write the bytes of all chunks in `batch`; other frames, and what the port does not take, count as dropped."""
        chunks = batch[is_chunk(batch)]
        self.dropped += len(batch) - len(chunks)
        data = chunk_bytes(chunks)
        deadline = time.monotonic() + WRITE_S
        while data and self._alive():
            try:
                data = data[os.write(self._fd, data) :]
            except BlockingIOError:
                if not _writable(self._fd, deadline):
                    break
            except OSError:
                self._failed()
        self.dropped += -(-len(data) // SIZE)

    def close(self) -> None:
        """Give the port back."""
        if self._port is not None:
            with contextlib.suppress(KeyError, OSError):
                self._poll.unregister(self._fd)
            with contextlib.suppress(OSError):
                self._port.close()
        self._port, self._fd = None, -1


def _writable(fd: int, deadline: float) -> bool:
    poll = select.poll()
    poll.register(fd, select.POLLOUT)
    ready = poll.poll(max(0.0, (deadline - time.monotonic()) * 1000.0))
    return bool(ready) and not ready[0][1] & _LOST


def parts_of(url: str) -> tuple[str, int]:
    """Device or pyserial URL, and baud rate (that of a network port is set at its other end).

    Raises
    ------
    HilError
        The URL is malformed.
    """
    kind, _, rest = url.partition(":")
    place, _, baud = rest.rpartition(":")
    if kind == "serial" and rest.startswith("socket://") and place.count(":") == 1 and baud.isdigit():
        return rest, 115200
    if kind != "serial" or not place or "://" in rest:
        raise HilError(f"bus {url!r}: expected {FORM}")
    if not (baud.isascii() and baud.isdigit() and 1 <= int(baud) <= 20_000_000):
        raise HilError(f"bus {url!r}: baud rate {baud!r} is not a whole number up to 20000000; expected {FORM}")
    return place, int(baud)


def port_names() -> list[str]:
    """The serial ports of this machine."""
    return sorted(port.device for port in list_ports.comports())


def _reason(place: str, error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code == errno.EACCES:
        return "no permission; sudo usermod -aG dialout $USER, then log in again"
    if code in {errno.ENOENT, errno.ENODEV, errno.ENXIO}:
        return f"there is no such port; there is: {', '.join(port_names()) or 'none'}"
    if code in {errno.EBUSY, errno.EAGAIN}:
        return f"another program has it; find it with: fuser -v {place} (often ModemManager)"
    if code == errno.ENOTTY or "configure port" in str(error):  # pyserial hides the number here
        return "that is no serial port"
    return f"cannot open it: {error}"
