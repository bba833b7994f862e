"""A pseudo-terminal as a `drivers.mavlink.link.Link` or a bus: another program opens it like a serial port."""

import os
import select
import termios
import time
import tty
from pathlib import Path

from drivers.can.frames import FrameArray
from drivers.serial.chunks import chunk_bytes, fill_chunks, is_chunk
from nav.errors import HilError

_CHUNK = 2048
_TERMINALS = Path("/dev/pts")


class PtyLink:
    """A new pseudo-terminal, for another program on this machine.

    What nobody reads is thrown away when the terminal's queue is full, as on a wire.

    Parameters
    ----------
    path : Path, optional
        A link to the terminal is made there; such a link whose terminal is gone is replaced.

    Raises
    ------
    HilError
        There is anything else at `path`, or its folder cannot be written.
    """

    datagrams = False
    gone = False

    def __init__(self, path: Path | None = None) -> None:
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self._device = Path(os.ttyname(self._theirs))
        self._path = path
        self.url = str(path or self._device)
        if path is None:
            return
        there = None
        try:
            there = path.readlink() if path.is_symlink() else None
            if there is not None and self._is_left(there):
                path.unlink()
            path.symlink_to(self._device)
        except OSError as error:
            self._path = None
            self.close()
            link = f" (a link to {there}: remove it if no program needs it)" if there else ""
            raise HilError(f"pty:{path}: {error.strerror}{link}; give a path where nothing is") from error

    def _is_left(self, terminal: Path) -> bool:
        """Whether a link to `terminal` was left behind: that is gone, or its number is ours now."""
        return terminal == self._device or (terminal.parent == _TERMINALS and not terminal.exists())

    def fileno(self) -> int:
        """Descriptor to wait on for reading; constant."""
        return self._ours

    def ready(self) -> bool:
        """Whether somebody may be listening: one cannot tell."""
        return True

    def receive(self) -> bytes:
        """Bytes that have arrived, at most one chunk."""
        try:
            return os.read(self._ours, _CHUNK)
        except BlockingIOError:
            return b""

    def heard(self) -> None:
        """There is but one peer: nothing to do."""

    def send(self, frame: bytes) -> bool:
        """Send a whole frame or nothing; False when it was dropped."""
        try:
            sent = os.write(self._ours, frame)
        except BlockingIOError:
            sent = 0
        if sent < len(frame):
            termios.tcflush(self._theirs, termios.TCIFLUSH)  # nobody reads: what waits is old
        return sent == len(frame)

    def close(self) -> None:
        """Give everything back."""
        if self._path is not None and self._path.is_symlink() and self._path.readlink() == self._device:
            self._path.unlink()  # while the number is ours: another terminal may get it
        for fd in (self._ours, self._theirs):
            os.close(fd)


class PtyPort:
    """The board's end of a serial line, ``pty:PATH``; satisfies `drivers.can.bus.Port`.

    Parameters
    ----------
    path : Path
        Where the other end is found, as ``serial:PATH:BAUD``.

    Raises
    ------
    HilError
        As `PtyLink`.
    """

    def __init__(self, path: Path) -> None:
        self._place, self.dropped = path, 0
        self._link: PtyLink | None = PtyLink(path)

    def plug(self, plugged: bool) -> None:
        """Pull the line out or put it back."""
        if not plugged:
            self.close()
        elif self._link is None:
            self._link = PtyLink(self._place)

    def receive(self, batch: FrameArray, timeout: float) -> int:
        """See `drivers.can.bus.Port.receive`."""
        if self._link is None:
            time.sleep(timeout)
            return 0
        if not select.select([self._link], [], [], timeout)[0]:
            return 0
        return fill_chunks(batch, self._link.receive(), time.time_ns())

    def send(self, batch: FrameArray) -> None:
        """Write the bytes of each chunk in `batch`; other frames, and what nobody reads, count as dropped."""
        for k in range(len(batch)):
            row = batch[k : k + 1]
            if self._link is None or not is_chunk(row)[0] or not self._link.send(chunk_bytes(row)):
                self.dropped += 1

    def close(self) -> None:
        """Give everything back."""
        if self._link is not None:
            self._link.close()
        self._link = None
