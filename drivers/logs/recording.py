"""Our own recording: every frame as it came in, with its time, and the events that the navigation depends on.

Layout: the magic line, a header (length, CRC-32, JSON), then blocks of whole `FRAME` records, each block with its count
and CRC-32. A block is written at least every `FLUSH_S`, so that a killed process loses no more than that. A block that the
disk does not take is taken back whole: what was recorded before stays readable, and recording goes on when there is room. A
record whose ``reserved[0]`` is `EVENT` is no frame but an event of the loop, in its place among the frames.
"""

import contextlib
import json
import struct
import time
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from drivers.can.frames import FRAME, FrameArray, frames
from nav.errors import HilError

MAGIC = b"DTGHIL recording 1\n"
FLUSH_S = 0.05
RETRY_S = 0.5
"""Time between tries to write on a disk that was full."""
BLOCK = 4096
"""Most frames in one block."""
LONGEST_HEADER = 1 << 24
"""Bytes: a longer header is damage, and is not read."""
EVENT = 1
"""Value of ``reserved[0]`` that marks an event record."""
SILENCE = 1
"""Event, ``data[0]``: the sensor fell silent here."""
REALIGN = 2
"""Event: a new alignment was ordered here."""
MARK = 3
"""Event: the user marked this moment."""
_HEAD = struct.Struct("<II")
_BLOCK_HEAD = struct.Struct("<4sII")


def event_record(kind: int, time_ns: int) -> FrameArray:
    """One event as a (1,) record."""
    row = frames(1)
    row["time_ns"] = time_ns
    row["reserved"][0, 0] = EVENT
    row["data"][0, 0] = kind
    return row


class RecordingWriter:
    """Writes a recording; use as a context manager.

    Parameters
    ----------
    path : Path
        Overwritten if it exists.
    header : dict
        JSON-able; the scenario and the origin of the frames.

    Raises
    ------
    HilError
        The file cannot be created.
    """

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        self.path = path
        text = json.dumps(header).encode()
        try:
            self._file = path.open("wb", buffering=0)
            self._end = self._put(MAGIC + _HEAD.pack(len(text), zlib.crc32(text)) + text)
        except OSError as error:
            raise HilError(f"recording {path}: {error.strerror}") from error
        self._block = frames(BLOCK)
        self._filled = 0
        self._flushed = time.monotonic()
        self._retry = 0.0
        self.written = 0
        """Records written."""
        self.lost = 0
        """Records that the disk did not take."""
        self.problem = ""
        """Why the disk does not take what comes now; empty while it does."""

    def write(self, batch: FrameArray) -> None:
        """Append `batch`; flushes by count and by time."""
        start = 0
        while start < len(batch):
            n = min(len(batch) - start, BLOCK - self._filled)
            self._block[self._filled : self._filled + n] = batch[start : start + n]
            self._filled += n
            start += n
            if self._filled == BLOCK:
                self.flush()
        if time.monotonic() - self._flushed >= FLUSH_S:
            self.flush()

    def flush(self) -> None:
        """Write what is buffered as one block."""
        self._flushed = time.monotonic()
        count, self._filled = self._filled, 0
        if not count:
            return
        if self.problem and self._flushed < self._retry:
            self.lost += count
            return
        data = self._block[:count].tobytes()
        try:
            self._end += self._put(_BLOCK_HEAD.pack(b"BLK1", count, zlib.crc32(data)) + data)
            self.written += count
            self.problem = ""
        except OSError as error:
            self.lost += count
            self._retry = self._flushed + RETRY_S
            self.problem = f"recording {self.path}: {error.strerror}"
            with contextlib.suppress(OSError):
                self._file.truncate(self._end)
            self._file.seek(self._end)

    def _put(self, data: bytes) -> int:
        """Write all of `data`; its length."""
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) :]
        return len(data)

    def close(self) -> None:
        """Flush and close."""
        self.flush()
        self._file.close()

    def __enter__(self) -> "RecordingWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclass(slots=True)
class RecordingReader:
    """Reads a recording block by block.

    Attributes
    ----------
    header : dict
        What the writer put there.
    problem : str
        Why reading ended before the end of the file, with the offset; empty when it did not. What came before is good.
    """

    path: Path
    header: dict[str, Any]
    problem: str
    _file: BinaryIO
    _offset: int

    @staticmethod
    def open(path: Path) -> "RecordingReader":
        """Open `path`.

        Raises
        ------
        HilError
            The file cannot be read, is no recording, or its header is damaged (with the offset).
        """
        try:
            file = path.open("rb")
        except OSError as error:
            raise HilError(f"recording {path}: {error.strerror}") from error
        start = file.read(len(MAGIC) + _HEAD.size)
        if not start.startswith(MAGIC) or len(start) < len(MAGIC) + _HEAD.size:
            file.close()
            raise HilError(f"recording {path}: not a recording of ours at offset 0")
        length, crc = _HEAD.unpack(start[len(MAGIC) :])
        text = file.read(min(length, LONGEST_HEADER))
        header = _header(text) if len(text) == length and zlib.crc32(text) == crc else None
        if header is None:
            file.close()
            raise HilError(f"recording {path}: damaged header at offset {len(MAGIC)}")
        return RecordingReader(path, header, "", file, file.tell())

    def read(self) -> FrameArray:
        """The next block; empty at the end (see `problem`)."""
        head = self._file.read(_BLOCK_HEAD.size)
        if not head:
            return frames(0)
        if len(head) == _BLOCK_HEAD.size:
            mark, count, crc = _BLOCK_HEAD.unpack(head)
            if mark == b"BLK1" and 0 < count <= BLOCK:
                data = self._file.read(count * FRAME.itemsize)
                if len(data) == count * FRAME.itemsize and zlib.crc32(data) == crc:
                    self._offset = self._file.tell()
                    return np.frombuffer(data, FRAME).copy()
        self.problem = f"recording {self.path}: truncated or damaged at offset {self._offset}; what came before is used"
        return frames(0)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _header(text: bytes) -> dict[str, Any] | None:
    """The header, whose check is right; None where it says nothing that a writer of ours says."""
    try:
        header = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return header if isinstance(header, dict) else None
