"""The `unix:` bus: CAN frames between processes of one machine over AF_UNIX SEQPACKET, without loss and without a kernel CAN.

Every participant listens on a socket of its own in the bus's folder and, on joining, connects to all that are there; so
the bus is a full mesh with no hub, and participants may start, stop and die in any order. A packet holds one or more
whole frames (80 bytes each, see :mod:`drivers.can.frames`); a sender may put many into one packet, which is what makes
`--speed max` fast. `UnixPort` is the bulk interface of the bridge, `UnixBus` the python-can interface ``unix``.
"""

import contextlib
import errno
import fcntl
import os
import re
import select
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np

from drivers.can.convert import from_message, to_message
from drivers.can.frames import FRAME, FrameArray, frames
from drivers.system import day_ns, receive, send
from nav.errors import HilError
from nav.increments import IntArray
from nav.kernel import kernel

PACKET = 64
"""Most frames in one packet."""
_BUFFER = 4 << 20
_MUTE = "-mute"
"""End of the socket's name of a pure sender."""
_BACKLOG = 4096
"""Most participants that may join while one does not look."""


@kernel
def _stamp_and_send(fds: IntArray, packet: FrameArray, keep: bool, refused: IntArray) -> int:
    """Give frames the time, but for those that `keep` one, and send them to each of `fds`; how many of these `refused` them."""
    now = day_ns(refused)
    for k in range(packet.shape[0]):
        if not keep or packet[k].time_ns == 0:
            packet[k].time_ns = now
    return send(fds, packet, refused)


class UnixPort:
    """One participant of the bus `name`.

    Parameters
    ----------
    name : str
        Letters, digits, dot, dash, underscore.
    listen : bool
        False for a pure sender: others do not queue frames for it.
    lossless : bool
        True: `send` waits for a slow listener; False: it drops the packet for that listener and counts it.

    Raises
    ------
    HilError
        Bad name, or the folder of the bus belongs to another user.
    """

    def __init__(self, name: str, *, listen: bool = True, lossless: bool = False) -> None:
        check_name(name)
        self.name = name
        self.dropped = 0
        """Frames that did not fit into a listener's queue."""
        self._batch = frames(PACKET)
        self._room = self._batch.view(np.uint8)
        """Bytes of the batch that is filled."""
        _stamp_and_send(np.zeros(0, np.int64), self._batch, False, np.zeros(2, np.int64))  # compiled now, not in a run
        receive(-1, self._room, 0, PACKET * FRAME.itemsize, FRAME.itemsize)
        self._listen = listen
        self._lossless = lossless
        self._peers: dict[int, socket.socket] = {}
        self._deaf: set[int] = set()
        self._epoll = select.epoll()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            folder = _folder(name)
            self._path = folder / f"{os.getpid()}-{time.monotonic_ns():x}{'' if listen else _MUTE}.sock"
            with _locked(folder):
                others = list(folder.glob("*.sock"))
                self._listener.bind(str(self._path))
                self._listener.listen(_BACKLOG)
                self._epoll.register(self._listener, select.EPOLLIN)
                for other in others:
                    self._connect(other)
        except OSError as error:  # the folder is another user's or not writable, or its path is too long for a socket
            self._listener.close()
            self._epoll.close()
            raise HilError(
                f"unix:{name}: {error}; set XDG_RUNTIME_DIR to a folder of yours with a short path"
            ) from error

    def _connect(self, path: Path) -> None:
        peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            peer.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):  # its owner died without cleaning up
            peer.close()
            path.unlink(missing_ok=True)
            return
        except OSError:  # its owner lives but its queue of joiners is full: it has not looked for a long time
            peer.close()
            return
        self._add(peer)
        if path.stem.endswith(_MUTE):  # it may not have accepted us yet: nothing may be queued for it
            self._deaf.add(peer.fileno())

    def _add(self, peer: socket.socket) -> None:
        for option in (getattr(socket, "SO_SNDBUFFORCE", 32), socket.SO_SNDBUF):
            with contextlib.suppress(OSError):
                peer.setsockopt(socket.SOL_SOCKET, option, _BUFFER)
        if not self._listen:
            peer.shutdown(socket.SHUT_RD)
        else:
            self._epoll.register(peer, select.EPOLLIN)
        self._peers[peer.fileno()] = peer

    def _remove(self, fd: int) -> None:
        peer = self._peers.pop(fd, None)
        if peer is None:  # another thread was quicker
            return
        self._deaf.discard(fd)
        if self._listen:
            self._epoll.unregister(fd)
        peer.close()

    def _accept(self) -> None:
        while True:
            try:
                peer, _ = self._listener.accept()
            except OSError:
                return
            peer.setblocking(False)
            self._add(peer)

    @property
    def listeners(self) -> int:
        """Participants that take frames from us."""
        self._accept()
        return len(self._peers) - len(self._deaf)

    def fileno(self) -> int:
        """Readable when `receive` would find something."""
        return self._epoll.fileno()

    def receive(self, batch: FrameArray, timeout: float) -> int:
        """Fill `batch` (at least `PACKET` long) with what is there; waits up to `timeout` s for the first frame."""
        if batch is not self._batch:
            self._batch, self._room = batch, batch.view(np.uint8)
        filled, until = 0, 0.0
        while filled == 0:
            ready = self._epoll.poll(max(0.0, until - time.monotonic()) if until else timeout)
            if not ready:
                return 0
            for fd, _ in ready:
                if fd == self._listener.fileno():
                    until = until or time.monotonic() + timeout
                    self._accept()
                    continue
                before = filled
                filled = receive(fd, self._room, filled, PACKET * FRAME.itemsize, FRAME.itemsize)
                if filled == before:  # the end, an error or rubbish
                    until = until or time.monotonic() + timeout
                    peer = self._peers.get(fd)
                    if peer is not None and _has_gone(peer):
                        self._remove(fd)
        n = filled // FRAME.itemsize
        batch["reserved"][:n] = 0  # what marks an event in a recording is nothing that a bus can say
        return n

    def send(self, batch: FrameArray) -> None:
        """Send `batch` to every listener, stamped with the host's clock; when lossless, a stamp that a frame has is kept."""
        self._accept()
        if not (batch.flags.c_contiguous and batch.flags.writeable):
            batch = batch.copy()
        for start in range(0, len(batch), PACKET):
            packet = batch[start : start + PACKET]
            peers = {fd: peer for fd, peer in list(self._peers.items()) if fd not in self._deaf}
            refused = np.zeros(len(peers) + 2, np.int64)
            count = _stamp_and_send(np.array(list(peers), np.int64), packet, self._lossless, refused)
            for fd in refused[:count].tolist():
                self._send_one(fd, peers[fd], packet.tobytes())

    def _send_one(self, fd: int, peer: socket.socket, data: bytes) -> None:
        while True:
            try:
                peer.send(data)
                return
            except BlockingIOError:
                if not self._lossless:
                    self.dropped += len(data) // FRAME.itemsize
                    return
                select.select([], [fd], [], 1.0)
            except OSError as error:
                if error.errno == errno.EPIPE and _alive(peer):
                    self._deaf.add(fd)
                else:
                    self._remove(fd)
                return

    def close(self) -> None:
        """Leave the bus."""
        self._path.unlink(missing_ok=True)
        for fd in list(self._peers):
            self._remove(fd)
        self._listener.close()
        self._epoll.close()


class UnixBus(can.BusABC):
    """python-can interface ``unix``: ``can.Bus(interface="unix", channel="dtg-hil")``; classic and FD frames."""

    def __init__(self, channel: str, can_filters: Any = None, **kwargs: Any) -> None:
        self._port = UnixPort(channel)
        self._waiting = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)  # readable while messages wait in our queue
        self._either = select.epoll()
        self._either.register(self._port.fileno(), select.EPOLLIN)
        self._either.register(self._waiting, select.EPOLLIN)
        self._batch = frames(2 * PACKET)
        self._one = frames(1)
        self._queue: list[can.Message] = []
        self.channel_info = f"unix:{channel}"
        self._can_protocol = can.CanProtocol.CAN_FD
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._queue:
            n = self._port.receive(self._batch, 3600.0 if timeout is None else timeout)
            self._queue = [to_message(row, self.channel_info) for row in self._batch[:n]][::-1]
            if n > 1:
                os.eventfd_write(self._waiting, 1)
        message = self._queue.pop() if self._queue else None
        if not self._queue:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._waiting)
        return message, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one message to every listener."""
        from_message(msg, self._one[0])
        self._port.send(self._one)

    def fileno(self) -> int:
        """Readable when a message can be received."""
        return self._either.fileno()

    def shutdown(self) -> None:
        """Leave the bus."""
        if not self._is_shutdown:
            self._port.close()
            self._either.close()
            os.close(self._waiting)
        super().shutdown()


def check_name(name: str) -> None:
    """Refuse (`HilError`) what is no name of a bus."""
    if not re.fullmatch(r"[A-Za-z0-9._-]{1,40}", name) or name.startswith("."):
        raise HilError(f"unix:{name}: a bus name has 1 to 40 letters, digits, dots, dashes or underscores")


def _has_gone(peer: socket.socket) -> bool:
    """Whether nothing more can come from a peer that has nothing for us now."""
    try:
        return not peer.recv(1, socket.MSG_PEEK)
    except BlockingIOError:
        return False
    except OSError:
        return True


def _alive(peer: socket.socket) -> bool:
    """Whether the other end still exists (it may have shut its receiving side only)."""
    poll = select.poll()
    poll.register(peer, 0)
    return not poll.poll(0)


def remove(name: str) -> None:
    """Leave nothing of a bus that nobody will join any more."""
    shutil.rmtree(_root() / name, ignore_errors=True)


def _root() -> Path:
    return Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()) / f"dtg-hil-{os.getuid()}"


def _folder(name: str) -> Path:
    root = _root()
    folder = root / name
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if root.stat().st_uid != os.getuid():
        raise HilError(f"unix:{name}: {root} belongs to another user; set XDG_RUNTIME_DIR to a folder of yours")
    root.chmod(0o700)
    return folder


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Joining is serialised, so that two participants never connect to each other twice."""
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
