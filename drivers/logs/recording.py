"""Our own recording: every frame as it came in, with its time, and the events that the navigation depends on.

Layout: the magic line, a header (length, CRC-32, JSON), then blocks of whole `FRAME` records, each block with its count
and CRC-32. A block is written at least every `FLUSH_S`, so that a killed process loses no more than that. A record whose
``reserved[0]`` is `EVENT` is no frame but an event of the loop, in its place among the frames.
"""

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
BLOCK = 4096
"""Most frames in one block."""
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
        try:
            self._file: BinaryIO = path.open("wb")
        except OSError as error:
            raise HilError(f"recording {path}: {error.strerror}") from error
        text = json.dumps(header).encode()
        self._file.write(MAGIC + _HEAD.pack(len(text), zlib.crc32(text)) + text)
        self._file.flush()
        self._block = frames(BLOCK)
        self._filled = 0
        self._flushed = time.monotonic()
        self.written = 0
        """Records written."""

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
        if self._filled:
            data = self._block[: self._filled].tobytes()
            self._file.write(_BLOCK_HEAD.pack(b"BLK1", self._filled, zlib.crc32(data)) + data)
            self._file.flush()
            self.written += self._filled
            self._filled = 0

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
        text = file.read(length)
        if len(text) != length or zlib.crc32(text) != crc:
            file.close()
            raise HilError(f"recording {path}: damaged header at offset {len(MAGIC)}")
        return RecordingReader(path, json.loads(text), "", file, file.tell())

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
