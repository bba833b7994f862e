"""A pseudo-terminal as a `drivers.mavlink.link.Link`: another program opens it like a serial port."""

import os
import termios
import tty
from pathlib import Path

from nav.errors import HilError

_CHUNK = 2048


class PtyLink:
    """A new pseudo-terminal, for another program on this machine.

    What nobody reads is thrown away when the terminal's queue is full, as on a wire.

    Parameters
    ----------
    path : Path, optional
        A link to the terminal is made there; what is in its place must be such a link.

    Raises
    ------
    HilError
        There is something else at `path`, or its folder cannot be written.
    """

    datagrams = False
    gone = False

    def __init__(self, path: Path | None = None) -> None:
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        device = os.ttyname(self._theirs)
        self._path = path
        self.url = device if path is None else str(path)
        if path is None:
            return
        try:
            if path.is_symlink():
                path.unlink()
            path.symlink_to(device)
        except OSError as error:
            self._path = None
            self.close()
            raise HilError(f"pty:{path}: {error.strerror}; give a path where nothing is") from error

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
        for fd in (self._ours, self._theirs):
            os.close(fd)
        if self._path is not None and self._path.is_symlink():
            self._path.unlink()
