"""The autopilot feeds: whole frames of the lockstep between two processes, over real sockets."""

import multiprocessing
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from hil.bench.timing import Row, Sizes, Work, rows_in_turns
from hil.control import Control
from hil.feed.common import ACTUATORS, Socket
from hil.feed.config import FeedConfig
from hil.feed.process import run_feed
from hil.feed.tap import Gate
from hil.ring import Ring, Wake
from hil.scenario import load
from nav.errors import HilError
from nav.state import NAV_STATE, Mode

_END_S = 10.0
_PX4_SAMPLES = 4
"""Solutions of a HIL_SENSOR: 1000 Hz to 250 Hz."""


def rows(sizes: Sizes) -> list[Row]:
    """A row for each feed that has a lockstep."""
    frames = max(sizes.calls // 4, 1)
    with _fed("ardupilot-json") as (port, push), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sitl:
        sitl.connect(("127.0.0.1", port))
        sitl.settimeout(_END_S)
        what = "a frame of ArduPilot's JSON lockstep, over UDP"
        json = rows_in_turns([Work("feed-json", what, _Sitl(sitl, push, frames), frames)], sizes.repeats)
    with _fed("px4") as (port, push), socket.create_connection(("127.0.0.1", port), _END_S) as px4:
        px4.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        what = "a HIL_SENSOR of PX4's lockstep, over TCP"
        return json + rows_in_turns([Work("feed-px4", what, _Px4(px4, push, frames), frames)], sizes.repeats)


class _Sitl:
    """The other end of the JSON interface: asks, and waits for the answer."""

    def __init__(self, channel: socket.socket, push: Callable[[int], None], frames: int) -> None:
        self._channel, self._push, self._frames, self._count = channel, push, frames, 0

    def __call__(self) -> None:
        for _ in range(self._frames):
            self._push(1)
            self._channel.send(struct.pack("<HHI16H", 18458, 1000, self._count, *[1500] * 16))
            self._channel.recv(4096)
            self._count += 1


class _Px4:
    """The other end of the simulator interface: answers each HIL_SENSOR with actuators."""

    def __init__(self, channel: socket.socket, push: Callable[[int], None], frames: int) -> None:
        self._channel, self._push, self._frames, self._data = channel, push, frames, b""
        message = mav.MAVLink_hil_actuator_controls_message(0, [0.5] * 16, 129, 1)
        self._actuators = bytes(message.pack(mav.MAVLink(None, 1, 1)))

    def __call__(self) -> None:
        for _ in range(self._frames):
            self._push(_PX4_SAMPLES)
            self._channel.sendall(self._actuators)
            while not self._sensor():
                self._data += self._channel.recv(4096)

    def _sensor(self) -> bool:
        """Whether the messages that are there hold a HIL_SENSOR; up to it they are taken out."""
        while len(self._data) > 12 and len(self._data) >= 12 + self._data[1]:
            kind = int.from_bytes(self._data[7:10], "little")
            self._data = self._data[12 + self._data[1] :]
            if kind == mav.MAVLINK_MSG_ID_HIL_SENSOR:
                return True
        return False


@contextmanager
def _fed(kind: str) -> Iterator[tuple[int, Callable[[int], None]]]:
    """A feed in simulated time: its port, and what pushes so many solutions to it."""
    context = multiprocessing.get_context("forkserver")
    states, stop = Ring(NAV_STATE, 4096, 1), Wake()
    report, theirs = context.Pipe()
    joint = Socket(states, 0, Ring(ACTUATORS, 64, 0), Gate(1), 0, Control())
    config = FeedConfig.model_validate({"kind": kind, "address": "127.0.0.1:0"})
    process = context.Process(target=run_feed, args=(config, load(None), joint, stop, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        said = report.recv()
        if "failed" in said:
            raise HilError(str(said["failed"]))
        row = np.zeros(1, NAV_STATE)
        row["mode"], row["q_nb"] = Mode.NAVIGATE, (1.0, 0.0, 0.0, 0.0)
        yield int(said["place"].rpartition(":")[2]), partial(_push, states, row)
    finally:
        stop.call()
        process.join(_END_S)


def _push(states: Ring, row: np.ndarray[tuple[int], np.dtype[np.void]], count: int) -> None:
    rows = np.repeat(row, count)
    rows["time"] += 1e-3 * np.arange(1, count + 1)
    row["time"] = rows["time"][-1]
    states.push(rows)
