"""Frames from a SocketCAN interface, by our port and by python-can on the same interface: rows where there is a vcan0."""

import contextlib
import socket
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import can
import numpy as np

from drivers.can.frames import EFF, FDF, FrameArray, frames
from drivers.can.socketcan import SocketCanPort
from hil.bench.timing import Row, Sizes, paired_ratio, row
from nav.errors import HilError

BUS = "vcan0"
ROUND = 192
"""Frames in one round: what the smallest receive buffer holds."""
LAYOUTS = ("fd", "classic", "j1939")


def rows(sizes: Sizes) -> list[Row]:
    """A row for each layout and its peer; none without the interface."""
    found = []
    for layout in LAYOUTS:
        try:
            ours, theirs = costs(layout, 5 * sizes.repeats)
        except HilError:
            return []
        name, ns = f"receive-socketcan-{layout}", statistics.median(ours)
        found += [
            row(name, f"receive on {BUS}, {layout}", ns, "python-can", ns * paired_ratio(theirs, ours)),
            row(
                f"receive-python-can-{layout}", f"receive on {BUS}, {layout}, by python-can", statistics.median(theirs)
            ),
        ]
    return found


def costs(layout: str, rounds: int, interface: str = BUS) -> tuple[list[float], list[float]]:
    """Processor time of a frame (ns) in each of `rounds`, ours and python-can's: both receive the same frames, in turns.

    The frames lie in the sockets' buffers before the time begins, so that nothing waits.

    Raises
    ------
    HilError
        There is no such interface.
    """
    sent = of_layout(layout)
    batch = frames(1024)
    ours: list[float] = []
    theirs: list[float] = []
    with (
        contextlib.closing(SocketCanPort(interface)) as port,
        contextlib.closing(SocketCanPort(interface, listen=False)) as sender,
        _python_can(interface) as bus,
    ):
        for _ in range(rounds + 1):
            sender.send(sent)
            theirs.append(_timed(lambda: _drained(bus)))
            ours.append(_timed(lambda: port.receive(batch, 0.0)))
    return ours[1:], theirs[1:]


def of_layout(layout: str) -> FrameArray:
    """A round of frames: CAN FD of 64 bytes, classic ones, or J1939 rates."""
    sent = frames(ROUND)
    sent["can_id"] = {"fd": 0x120, "classic": 0x130, "j1939": 0x08F02AE2 | EFF}[layout]
    sent["length"], sent["flags"] = (64, FDF) if layout == "fd" else (8, 0)
    sent["data"][:, :8] = np.arange(ROUND, dtype=np.int64)[:, None].view(np.uint8)
    return sent


def _timed(receive: Callable[[], int]) -> float:
    began = time.perf_counter_ns()
    n = receive()
    spent = time.perf_counter_ns() - began
    if n != ROUND:
        raise HilError(f"{n} of {ROUND} frames came: {BUS} is in use by others")
    return spent / ROUND


def _drained(bus: Any) -> int:
    n = 0
    while bus.recv(0) is not None:
        n += 1
    return n


@contextlib.contextmanager
def _python_can(interface: str) -> Iterator[can.BusABC]:
    bus: Any = can.Bus(interface="socketcan", channel=interface, fd=True)
    bus.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
    try:
        yield bus
    finally:
        bus.shutdown()
