"""SocketCAN without python-can: many frames a system call, kernel time stamps in integer nanoseconds, drops counted.

`recvmmsg` fills the records of a batch in place (`FRAME` is ``struct canfd_frame`` behind a time stamp). The kernel stamps
each frame on arrival (SO_TIMESTAMPNS), hands on the adapter's own stamp where it has one (SO_TIMESTAMPING, see
:mod:`drivers.can.stamps`), and counts what did not fit into the socket's buffer (SO_RXQ_OVFL). An interface that goes down, or
away, is reopened when it is back.
"""

import contextlib
import ctypes
import errno
import os
import select
import socket
import struct
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from drivers.can.frames import EFF, FDF, FRAME, FrameArray
from drivers.can.stamps import AdapterClock
from nav.errors import HilError

BURST = 64
"""Most frames in one system call."""
RECEIVE_BUFFER = 8 << 20
REOPEN_S = 0.5
"""Time between tries to reopen an interface that failed."""
_CAN_MTU, CANFD_MTU = 16, 72
_SECOND = 1_000_000_000
_NANOSECONDS = np.array([_SECOND, 1])
_SO_TIMESTAMPNS, _SO_TIMESTAMPING, _SO_RXQ_OVFL, _SO_RCVBUFFORCE, _CAN_RAW_ERR_FILTER = 35, 37, 40, 33, 2
_STAMPS = 1 << 2 | 1 << 4 | 1 << 6
"""SOF_TIMESTAMPING: have the adapter stamp; tell the kernel's stamp, tell the adapter's as it is."""
_CONTROL = np.dtype(
    [
        ("stamp_head", "<i8", 2),  # cmsg_len; level and type
        ("seconds", "<i8"),
        ("nanoseconds", "<i8"),
        ("stamps_head", "<i8", 2),
        ("stamps", "<i8", (3, 2)),  # the kernel's, one that is no longer used, the adapter's; zero: none
        ("drop_head", "<i8", 2),
        ("dropped", "<u4"),
        ("pad", "<u4"),
    ]
)
_STAMP_LENGTH = 96
"""Bytes of both kinds of stamps: what is longer counts drops too."""


class _IoVector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Message(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("vectors", ctypes.c_void_p),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
        ("pad", ctypes.c_uint32),  # end of struct msghdr
        ("length", ctypes.c_uint32),
    )


_libc = ctypes.CDLL(None, use_errno=True)


class SocketCanPort:
    """One raw socket on a CAN interface; satisfies `drivers.can.bus.Port`.

    Parameters
    ----------
    interface : str
        As ``can0``.
    listen : bool
        False for a pure sender.
    filters : sequence of (int, int)
        Identifiers and masks, with the flag EFF: the kernel keeps back what fits none of them. Empty: all frames come.

    Raises
    ------
    HilError
        No SocketCAN, no such interface, or it is down; the message says how to mend it.
    """

    def __init__(self, interface: str, *, listen: bool = True, filters: Sequence[tuple[int, int]] = ()) -> None:
        self.interface = interface
        self._filters = b"".join(struct.pack("=II", *pair) for pair in filters)
        self._listen = listen
        self.dropped = 0
        """Frames that the interface did not take."""
        self.overflowed = 0
        """Frames that the kernel dropped because our buffer was full."""
        self.failures = 0
        """Times the interface failed."""
        self.trouble = ""
        """Why it cannot be used now, with the command that mends it."""
        self._overflow_base = 0
        self._clock = AdapterClock()
        self._retry = 0.0
        self._frames: FrameArray = np.zeros(BURST, FRAME)
        self._control = np.zeros(BURST, _CONTROL)
        self._vectors = (_IoVector * BURST)()
        self._messages = (_Message * BURST)()
        for k in range(BURST):
            self._vectors[k].base = self._frames.ctypes.data + k * FRAME.itemsize + 8
            self._vectors[k].length = CANFD_MTU
            self._messages[k].vectors = ctypes.addressof(self._vectors[k])
            self._messages[k].vector_count = 1
            self._messages[k].control = self._control.ctypes.data + k * _CONTROL.itemsize
        words: Any = np.frombuffer(memoryview(self._messages).cast("B"), np.uint8).reshape(
            BURST, ctypes.sizeof(_Message)
        )
        offset = _Message.control_length.offset
        self._control_lengths = words[:, offset : offset + 8].view(np.uint64)[:, 0]
        self._lengths = words[:, _Message.length.offset : _Message.length.offset + 4].view(np.uint32)[:, 0]
        self._socket: socket.socket | None = self._open()

    def _open(self) -> socket.socket:
        try:
            sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except (OSError, AttributeError) as error:
            raise HilError(self._why(error)) from error
        try:
            sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
            if self._listen:
                sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, 0x1FFFFFFF)
                if self._filters:
                    sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, self._filters)
            else:
                sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
            for option in (socket.SO_RCVBUF, _SO_RCVBUFFORCE):
                with contextlib.suppress(OSError):
                    sock.setsockopt(socket.SOL_SOCKET, option, RECEIVE_BUFFER)
            sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPING, _STAMPS)
            sock.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
            sock.bind((self.interface,))
            if not _is_up(self.interface):
                raise OSError(errno.ENETDOWN, os.strerror(errno.ENETDOWN))
        except OSError as error:
            sock.close()
            raise HilError(self._why(error)) from error
        sock.setblocking(False)
        self._overflow_base = self.overflowed
        return sock

    def _why(self, error: Exception) -> str:
        return f"bus socketcan:{self.interface}: {explain(self.interface, error)}"

    def _failed(self, code: int) -> None:
        self.failures += 1
        self.trouble = self._why(OSError(code, os.strerror(code)))
        if self._socket is not None:
            self._socket.close()
        self._socket = None
        self._retry = time.monotonic() + REOPEN_S

    def _alive(self) -> socket.socket | None:
        if self._socket is None and time.monotonic() >= self._retry:
            try:
                self._socket = self._open()
                self.trouble = ""
            except HilError as error:
                self.trouble = str(error)
                self._retry = time.monotonic() + REOPEN_S
        return self._socket

    def fileno(self) -> int:
        """The socket; -1 while the interface is away."""
        return -1 if self._socket is None else self._socket.fileno()

    def receive(self, batch: FrameArray, timeout: float) -> int:
        """See `drivers.can.bus.Port.receive`."""
        sock = self._alive()
        if sock is None:
            time.sleep(min(timeout, REOPEN_S))
            return 0
        filled = self._burst(sock, batch, 0)
        if filled == 0 and self._socket is not None and select.select([sock], [], [], timeout)[0]:
            filled = self._burst(sock, batch, 0)
        while filled and filled % BURST == 0 and filled < len(batch):
            more = self._burst(sock, batch, filled)
            if more == 0:
                break
            filled += more
        return filled

    def _burst(self, sock: socket.socket, batch: FrameArray, start: int) -> int:
        wanted = min(BURST, len(batch) - start)
        self._frames["data"][:wanted] = 0
        self._control_lengths[:wanted] = _CONTROL.itemsize
        got = _libc.recvmmsg(sock.fileno(), self._messages, wanted, socket.MSG_DONTWAIT, None)
        if got <= 0:
            code = ctypes.get_errno() if got < 0 else 0
            if code not in {0, errno.EAGAIN, errno.EINTR}:
                self._failed(code)
            return 0
        taken, control = self._frames[:got], self._control[:got]
        kernel, adapter = control["seconds"] * _SECOND + control["nanoseconds"], control["stamps"][:, 2]
        taken["time_ns"] = self._clock.arrivals(kernel, adapter @ _NANOSECONDS) if adapter.any() else kernel
        taken["flags"] = np.where(self._lengths[:got] == CANFD_MTU, taken["flags"] | FDF, 0)
        taken["reserved"] = 0
        if self._control_lengths[got - 1] > _STAMP_LENGTH:
            self.overflowed = self._overflow_base + int(control["dropped"][got - 1])
        batch[start : start + got] = taken
        return int(got)

    def send(self, batch: FrameArray) -> None:
        """Send all of `batch`; waits for a full queue, drops and counts what the interface refuses."""
        for row in batch:
            sock = self._alive()
            if sock is None:
                self.dropped += 1
                continue
            data = row.tobytes()[8:]
            is_fd = data[5] & FDF
            self._send_one(sock, data if is_fd else data[:5] + b"\0\0\0" + data[8:_CAN_MTU])

    def _send_one(self, sock: socket.socket, data: bytes) -> None:
        for _ in range(100):
            try:
                sock.send(data)
                return
            except OSError as error:
                if error.errno in {errno.EAGAIN, errno.ENOBUFS}:
                    time.sleep(0.001)
                    continue
                if error.errno in {errno.ENETDOWN, errno.ENODEV, errno.ENXIO}:
                    self._failed(error.errno)
                break
        self.dropped += 1

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def parse_filters(text: str) -> list[tuple[int, int]]:
    """Identifiers and masks of ``120:7F0,18F00000:1FFF0000``: hexadecimal, eight digits for those of 29 bits, as candump has it.

    Raises
    ------
    HilError
        The text is anything else.
    """
    found = []
    for part in text.split(","):
        names = part.split(":")
        try:
            number, mask = (int(name, 16) for name in names)
        except ValueError:
            number, mask = -1, -1
        extended = len(names[0]) == 8
        if min(number, mask) < 0 or max(number, mask) > (0x1FFFFFFF if extended else 0x7FF):
            raise HilError(f"filter {part!r}: expected ID:MASK as 120:7F0, or with eight digits 18F00000:1FFF0000")
        found.append((number | EFF, mask | EFF) if extended else (number, mask | EFF))
    return found


def _is_up(interface: str) -> bool:
    with contextlib.suppress(OSError, ValueError), open(f"/sys/class/net/{interface}/flags") as flags:
        return bool(int(flags.read(), 16) & 1)
    return True  # no sysfs here: let the first frame decide


def explain(interface: str, error: Exception) -> str:
    """Why an interface cannot be opened, and the command that mends it."""
    code = getattr(error, "errno", None) or getattr(error, "error_code", None)
    if code == errno.EAFNOSUPPORT or isinstance(error, AttributeError):
        return "this kernel has no SocketCAN; use unix:NAME or udp_multicast:239.74.163.2 (see: hil doctor)"
    if code in {errno.ENODEV, errno.ENXIO}:
        make = f"ip link add {interface} type vcan && ip link set {interface} mtu 72 up"
        if not interface.startswith("vcan"):
            make = f"ip link set {interface} up type can bitrate 500000 dbitrate 2000000 fd on"
        return f"no interface {interface}; make it with: sudo sh -c '{make}' (see: hil doctor)"
    if code == errno.ENETDOWN:
        return f"interface {interface} is down; raise it with: sudo ip link set {interface} up"
    return str(error)
