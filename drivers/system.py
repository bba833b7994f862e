"""What kernels ask of the operating system themselves: the time, to wake a reader, packets from a socket and to others."""

from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from nav.increments import IntArray
from nav.kernel import kernel

_clock_gettime = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.intp))
_write = types.ExternalFunction("write", types.intp(types.int32, types.intp, types.intp))
_recv = types.ExternalFunction("recv", types.intp(types.int32, types.intp, types.intp, types.int32))
_send = types.ExternalFunction("send", types.intp(types.int32, types.intp, types.intp, types.int32))
_REALTIME, _DONTWAIT, _NOSIGNAL = 0, 0x40, 0x4000


@kernel
def day_ns(room: IntArray) -> int:
    """The host's clock, ns since 1970; `room` is (2,) of scratch."""
    _clock_gettime(_REALTIME, room.ctypes.data)
    return int(room[0] * 1_000_000_000 + room[1])


@kernel
def call(wakes: IntArray, room: IntArray) -> None:
    """Add one to each event counter (eventfd); `room` is (1 or more,) of scratch."""
    room[0] = 1
    for fd in wakes:
        _write(fd, room.ctypes.data, 8)


@kernel
def receive(fd: int, room: NDArray[np.uint8], start: int, least: int, unit: int) -> int:
    """Put the packets that wait at the socket `fd` into `room` from `start` on, while it has `least` bytes; where they end.

    Of each packet whole records of `unit` bytes count.
    """
    while start + least <= room.shape[0]:
        size = _recv(fd, room.ctypes.data + start, room.shape[0] - start, _DONTWAIT)
        if size <= 0:
            break
        start += size - size % unit
    return start


@kernel
def send(fds: IntArray, packet: NDArray[Any], refused: IntArray) -> int:
    """Send a packet to each socket; how many `refused` it, which are at the front there then."""
    count = 0
    for fd in fds:
        if _send(fd, packet.ctypes.data, packet.size * packet.itemsize, _DONTWAIT | _NOSIGNAL) < 0:
            refused[count] = fd
            count += 1
    return count
