"""Telemetry logs (``.tlog``): each frame of one link, sent or received, behind its time in microseconds since 1970, big-endian.

What mavlogdump, mavloss, MAVProxy, Mission Planner and QGroundControl read. A file that ends in the middle of a frame loses that
frame.
"""

import math
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from nav.errors import HilError

FLUSH_S = 0.5
"""Longest time that a frame waits for the disk."""
_TIME = struct.Struct(">Q")


class TlogWriter:
    """Writes one log.

    Parameters
    ----------
    path : Path
        Overwritten if it exists.

    Raises
    ------
    HilError
        The file cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problem = ""
        """Why nothing more is written; empty while all is well."""
        try:
            self._file: BinaryIO = path.open("wb")
        except OSError as error:
            raise HilError(f"telemetry log {path}: {error.strerror}") from error
        self._flush_at: float | None = None

    def write(self, frame: bytes) -> None:
        """Append a frame with the time of now."""
        self._do(lambda: self._file.write(_TIME.pack(time.time_ns() // 1000) + frame))
        if self._flush_at is None:
            self._flush_at = time.monotonic() + FLUSH_S

    def flush_due(self) -> float:
        """Flush what has waited long enough; seconds until there is more to do, infinite when nothing waits."""
        if self._flush_at is None:
            return math.inf
        wait_s = self._flush_at - time.monotonic()
        if wait_s > 0.0:
            return wait_s
        self._flush_at = None
        self._do(self._file.flush)
        return math.inf

    def close(self) -> None:
        """Flush and close."""
        self._do(self._file.close)

    def _do(self, step: Callable[[], object]) -> None:
        if self.problem:
            return
        try:
            step()
        except OSError as error:
            self.problem = f"telemetry log {self.path}: {error.strerror}: nothing more is written"
