"""A board on a serial port as a `FrameDriver`: stream, order of samples and increments, the same for every board.

What differs is a `Board`: how its packets are found and what one says.
"""

import math
from collections.abc import Set
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drivers import Counters
from drivers.can.frames import FrameArray, frames
from drivers.serial.chunks import CHUNK
from drivers.serial.dialog import Dialog
from drivers.serial.increments import PAST, to_integrals
from drivers.serial.stream import ByteStream, Framing
from drivers.serial.timeline import Timeline
from nav.increments import ImuIncrements, IntArray, Validity

Three = tuple[float, float, float]
_LARGEST = 1e4
"""A rotation vector (rad) or velocity change (m/s) of a step beyond this is damage."""


class Pairing:
    """Tells whether the increments of angle and velocity in a packet, by their names, are of the same time."""

    def __init__(self, angle: int, velocity: int) -> None:
        self._names, self._uneven = {angle, velocity}, False

    def fits(self, names: Set[int]) -> bool:
        """Whether both are among `names`, and the last that came did not come alone: one of them covers more time then."""
        came = self._names & names
        fit = came == self._names and not self._uneven
        if came:
            self._uneven = came != self._names
        return fit


@dataclass(slots=True)
class Reading:
    """What one packet says, in body axes (Forward-Right-Down)."""

    time_ns: int
    """Of the board's clock, at the end of the step."""
    turn: Three
    """``coned``: rotation vector of the step, rad; else mean rate, rad/s."""
    push: Three
    """``coned``: velocity change in the axes of the step's start, m/s; else mean specific force, m/s^2."""
    coned: bool
    """The board has integrated, with coning and sculling."""
    counter: int = 0
    """Of a board that counts its samples."""
    step_ns: int = 0
    """Length of the step as the board says it; 0 where it does not."""
    suspect: bool = False
    """The board flags an inertial sensor: saturated, or its test failed."""


class Board(Framing, Protocol):
    """What one make of board speaks."""

    clock_ns: int
    """Time after which its clock begins again at zero."""
    turn: int
    """Number of samples after which its counter does; 0 for a board that does not count."""

    def read(self, packet: bytes) -> Reading | str:
        """What a good packet says; ``foreign`` for one without samples, ``short`` for one in which a field is missing."""

    def identity(self) -> dict[str, object]:
        """What the packets said besides."""

    def configure(self, dialog: Dialog, rate_hz: float, baud: int) -> dict[str, object]:
        """Make the board send what `read` wants, `rate_hz` times a second, over a line of `baud`; what it has answered.

        Raises
        ------
        HilError
            The board does not answer or refuses, or the rate is none of its rates or too high for the line.
        """


class SerialDriver:
    """The driver of one board; satisfies `drivers.FrameDriver`."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self.counters = Counters()
        self.world_id = 0
        self.stream = ByteStream(board)
        self._timeline = Timeline(self.counters, board.clock_ns, board.turn)
        self._bad_checks = 0
        self._past = np.zeros(PAST)
        self._room(256)
        self._count = 0
        self.decode(frames(0))  # loads the kernel before the first sample

    def _room(self, n: int) -> None:
        self._batch = ImuIncrements.empty(n)
        self._coned = np.zeros(n, np.int64)
        self._arrivals = np.zeros(n, np.int64)

    @property
    def period_s(self) -> float | None:
        """Sample period as last seen, s."""
        return self._timeline.period_ns * 1e-9 if self._timeline.period_ns else None

    def arrivals(self) -> IntArray:
        """Arrival (ns) of the last byte of each sample of the last `decode`."""
        return self._arrivals[: self._count]

    def identity(self) -> dict[str, object]:
        """What the board says of itself, and the bytes that were part of no packet."""
        return {**self.board.identity(), "packets": self.stream.packets, "skipped_bytes": self.stream.skipped}

    def decode(self, batch: FrameArray) -> ImuIncrements:
        """The samples whose packets `batch` completes; valid until the next call."""
        counters = self.counters
        counters.frames += len(batch)
        counters.foreign += len(batch) - int(np.count_nonzero(batch["can_id"] == CHUNK))
        self._count = 0
        for packet, arrival in self.stream.take(batch):
            reading = self.board.read(packet)
            if isinstance(reading, Reading):
                self._add(reading, arrival)
            elif reading == "short":
                counters.short += 1
            else:
                counters.foreign += 1
        counters.crc_errors += self.stream.bad_checks - self._bad_checks
        self._bad_checks = self.stream.bad_checks
        counters.samples += self._count
        result = self._batch.rows(0, self._count)
        to_integrals(result.dtheta, result.dvel, self._coned[: self._count], result.sequence, self._past)
        return result

    def _add(self, reading: Reading, arrival: int) -> None:
        if not math.hypot(*reading.turn, *reading.push) < _LARGEST:  # nor is NaN
            self.counters.crc_errors += 1
            return
        step_ns = self._timeline.place(reading.time_ns, reading.counter, reading.step_ns, arrival)
        if step_ns <= 0:
            return
        n = self._count
        if n == len(self._batch):
            self._grow()
        batch, step = self._batch, step_ns * 1e-9
        scale = 1.0 if reading.coned else step
        batch.time[n], batch.step[n] = self._timeline.time_ns * 1e-9, step
        for i in range(3):
            batch.dtheta[n, i], batch.dvel[n, i] = reading.turn[i] * scale, reading.push[i] * scale
        batch.validity[n] = Validity.SENSOR.value if reading.suspect else 0
        batch.sequence[n] = self._timeline.sequence
        self._coned[n], self._arrivals[n] = reading.coned, arrival
        self._count += 1

    def _grow(self) -> None:
        old, coned, arrivals, n = self._batch, self._coned, self._arrivals, self._count
        self._room(2 * n)
        self._batch.rows(0, n).fill(old)
        self._coned[:n], self._arrivals[:n] = coned, arrivals


def rotation_vector(q0: float, q1: float, q2: float, q3: float) -> Three:
    """Rotation vector of a quaternion of any length; zeros for the zero quaternion."""
    size = math.sqrt(q1 * q1 + q2 * q2 + q3 * q3)
    if size == 0.0:
        return 0.0, 0.0, 0.0
    scale = math.copysign(2.0, q0) * math.atan2(size, abs(q0)) / size
    return scale * q1, scale * q2, scale * q3
