"""A board on a pseudo-terminal, and what all boards are asked to send."""

import os
import select
import termios
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import numpy as np

from drivers.can.frames import FrameArray, frames
from drivers.serial.chunks import fill_chunks
from drivers.serial.driver import SerialDriver
from drivers.serial.mip import microstrain_mip
from drivers.serial.mip_emulator import MipEmulator
from drivers.serial.vectornav import vectornav
from drivers.serial.vectornav_emulator import VectorNavEmulator
from drivers.serial.xbus import xsens_xbus
from drivers.serial.xbus_emulator import XbusEmulator
from nav.increments import ImuIncrements

STEP_S = 0.01
G = 9.80665


class Emulator(Protocol):
    """What the three emulators have in common."""

    measuring: bool

    def packets(self, imu: ImuIncrements) -> list[bytes]:
        """A packet for each sample."""

    def answer(self, data: bytes) -> bytes:
        """What comes back for bytes of the host."""


BOARDS: dict[str, tuple[Callable[[], SerialDriver], Callable[..., Any]]] = {
    "xsens-xbus": (xsens_xbus, XbusEmulator),
    "vectornav": (vectornav, VectorNavEmulator),
    "microstrain-mip": (microstrain_mip, MipEmulator),
}


def moving(n: int, step_s: float = STEP_S, start_s: float = 5.0) -> ImuIncrements:
    """A board that sways and shakes, no two samples alike."""
    imu = ImuIncrements.empty(n)
    k = np.arange(n)
    imu.step[:] = step_s
    imu.time[:] = start_s + (k + 1) * step_s
    phase = 0.37 * k[:, None] + np.array([0.0, 1.0, 2.0])
    imu.dtheta[:] = step_s * np.array([0.4, 0.3, 0.2]) * np.sin(phase)
    imu.dvel[:] = step_s * (np.array([0.0, 0.0, -G]) + 2.0 * np.cos(phase))
    return imu


def cut(data: bytes, sizes: list[int], time_ns: int = 0, period_ns: int = 1000) -> FrameArray:
    """`data` in reads of these sizes (the last one goes on), one arrival time each."""
    batch, used, at = frames(len(data) + len(sizes) + 1), 0, 0
    for k, size in enumerate([*sizes, len(data)]):
        part = data[at : at + size]
        used += fill_chunks(batch[used:], part, time_ns + k * period_ns)
        at += len(part)
    return batch[:used]


def decoded(driver: SerialDriver, batch: FrameArray, every: int = 0) -> ImuIncrements:
    """All samples of `batch`, decoded `every` frames at a time (0: all at once)."""
    parts = []
    for start in range(0, max(len(batch), 1), every or max(len(batch), 1)):
        got = driver.decode(batch[start : start + (every or len(batch))])
        parts.append([column.copy() for column in columns(got)] + [driver.arrivals().copy()])
    joined = [np.concatenate(rows) for rows in zip(*parts, strict=True)]
    driver.all_arrivals = joined.pop()  # type: ignore[attr-defined]
    return ImuIncrements(*joined)


def columns(imu: ImuIncrements) -> list[Any]:
    """The arrays of a batch."""
    return [imu.time, imu.step, imu.dtheta, imu.dvel, imu.validity, imu.sequence]


class Plugged:
    """An emulator behind a pseudo-terminal that `path` names, which answers from a thread of its own.

    `only_baud`: what it sends is garbled while the host has set another rate, as on a real line.
    """

    def __init__(self, emulator: Emulator | None, path: Path, only_baud: int | None = None) -> None:
        self.emulator = emulator
        self.path = path
        self.heard = b""
        self._speed = None if only_baud is None else getattr(termios, f"B{only_baud}")
        self._master, self._slave = os.openpty()
        os.set_blocking(self._master, False)
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(self._slave))
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while not self._ended.is_set():
            if select.select([self._master], [], [], 0.02)[0]:
                try:
                    data = os.read(self._master, 4096)
                except OSError:
                    continue
                self.heard += data
                if self.emulator is not None:
                    self.send(self.emulator.answer(data))

    def send(self, data: bytes) -> None:
        """Put bytes on the line; what nobody reads for a second is lost."""
        if self._speed is not None and termios.tcgetattr(self._slave)[5] != self._speed:
            data = bytes((byte * 7 + 3) & 0xFF for byte in data)
        while data and select.select([], [self._master], [], 1.0)[1]:
            data = data[os.write(self._master, data) :]

    def unplug(self) -> None:
        """Pull it out."""
        self._ended.set()
        self._thread.join()
        os.close(self._slave)
        os.close(self._master)

    def __enter__(self) -> "Plugged":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._ended.is_set():
            self.unplug()
