"""Where the loop's frames come from: a bus or a recording, behind the same `receive`."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import can
import numpy as np

from drivers.can.bus import open_port
from drivers.can.convert import from_message
from drivers.can.frames import FrameArray, frames
from drivers.logs.blf import BlfReader
from drivers.logs.recording import EVENT, MAGIC, RecordingReader
from nav.errors import HilError

_READERS: dict[str, Any] = {".log": can.CanutilsLogReader, ".blf": BlfReader, ".asc": can.ASCReader}
"""By file ending; python-can finds the others itself, among its plug-ins."""

PAUSE_NS = 10_000_000_000
"""No pause in a recording is kept up for longer: the host's clock may have been set by an hour, or by years at its start."""


class Source(Protocol):
    """Frames for the loop."""

    live: bool
    """Arrival times are those of the host now: silence and latency mean something."""
    exhausted: bool
    """Nothing more will come."""

    @property
    def watched(self) -> Sequence[int]:
        """The descriptor that is readable when frames wait; empty where there is none."""

    @property
    def trouble(self) -> str:
        """Why nothing can come now, with what mends it; empty when all is well."""

    @property
    def overflowed(self) -> int:
        """Frames that the kernel dropped because we did not take them in time."""

    @property
    def refused(self) -> Mapping[str, int]:
        """Packets whose signature was missing or wrong, by reason."""

    def receive(self, batch: FrameArray, timeout: float) -> int:
        """As `drivers.can.bus.Port.receive`."""

    def close(self) -> None:
        """Let go."""

    def problem(self) -> str:
        """What went wrong with the source, in a line; empty when nothing."""


class BusSource:
    """A bus; `paced` False: simulated time, so no silence and no latency."""

    def __init__(self, url: str, *, paced: bool) -> None:
        self.live = paced
        self.exhausted = False
        self._port = open_port(url, lossless=not paced)

    @property
    def trouble(self) -> str:
        """See `Source.trouble`."""
        return getattr(self._port, "trouble", "")

    @property
    def watched(self) -> Sequence[int]:
        """See `Source.watched`."""
        fileno: Callable[[], int] = getattr(self._port, "fileno", lambda: -1)
        return [fd] if (fd := fileno()) >= 0 else []

    def receive(self, batch: FrameArray, timeout: float) -> int:
        """See `Source.receive`."""
        return self._port.receive(batch, timeout)

    def close(self) -> None:
        """Leave the bus."""
        self._port.close()

    def problem(self) -> str:
        """Failures of the interface, and frames that it lost."""
        failures = getattr(self._port, "failures", 0)
        said = [f"the bus failed {failures} times and was reopened"] if failures else []
        if self.overflowed:
            said.append(
                f"{self.overflowed} frames were lost because the receive buffer was full: raise net.core.rmem_max"
            )
        if refused := ", ".join(f"{count} {reason}" for reason, count in self.refused.items()):
            said.append(f"packets were refused: {refused}")
        return "; ".join(said)

    @property
    def refused(self) -> Mapping[str, int]:
        """See `Source.refused`."""
        counts: Mapping[str, int] = getattr(self._port, "refused", {})
        return counts

    @property
    def overflowed(self) -> int:
        """See `Source.overflowed`."""
        count: int = getattr(self._port, "overflowed", 0)
        return count


class FileSource:
    """A recording: ours, candump ``.log``, ``.blf``, ``.asc`` and what else python-can reads.

    Parameters
    ----------
    path : Path
        The recording.
    paced : bool
        Hand frames out at the times at which they were recorded; else as fast as they are asked for.
    """

    watched: Sequence[int] = ()
    trouble = ""
    overflowed = 0
    refused: Mapping[str, int] = {}

    def __init__(self, path: Path, *, paced: bool) -> None:
        self.live = False
        self.exhausted = False
        self.path = path
        self._paced = paced
        self._problem = ""
        self._chunks = self._own() if is_own(path) else self._foreign()
        self._chunk = frames(0)
        self._shift_ns: int | None = None

    def _own(self) -> Iterator[FrameArray]:
        reader = RecordingReader.open(self.path)
        while len(chunk := reader.read()):
            yield chunk
        self._problem = reader.problem
        reader.close()

    def _foreign(self) -> Iterator[FrameArray]:
        chunk, n, total = frames(256), 0, 0
        try:
            with _READERS.get(self.path.suffix.lower(), can.LogReader)(self.path) as reader:
                for message in reader:
                    from_message(message, chunk[n])
                    n += 1
                    total += 1
                    if n == len(chunk):
                        yield chunk
                        n = 0
        except OSError as error:
            raise HilError(f"recording {self.path}: {error.strerror or error}") from error
        except Exception as error:  # python-can's readers raise whatever the bytes provoke
            if total == 0:
                raise HilError(f"recording {self.path}: no frames in it: {error}") from error
            self._problem = f"recording {self.path}: unreadable after frame {total}: {error}; what came before is used"
        yield chunk[:n]

    def receive(self, batch: FrameArray, timeout: float) -> int:
        """See `Source.receive`."""
        while len(self._chunk) == 0:
            following = next(self._chunks, None)
            if following is None:
                self.exhausted = True
                return 0
            self._chunk = following
        n = min(len(batch), len(self._chunk))
        if self._paced:
            n = self._due(n, timeout)
        batch[:n] = self._chunk[:n]
        self._chunk = self._chunk[n:]
        return n

    def batches(self, room: int) -> Iterator[FrameArray]:
        """All frames, `room` at most at a time, without the events among them; each valid until the next."""
        batch = frames(room)
        while n := self.receive(batch, 0.0):
            taken = batch[:n]
            yield taken[taken["reserved"][:, 0] != EVENT]

    def _due(self, n: int, timeout: float) -> int:
        times = self._chunk["time_ns"][:n]
        now = time.monotonic_ns()
        if self._shift_ns is None:
            self._shift_ns = now - int(times[0])
        wait = int(times[0]) + self._shift_ns - now
        if abs(wait) > PAUSE_NS:
            self._shift_ns, wait = now - int(times[0]), 0
        if wait > 0:
            time.sleep(min(wait * 1e-9, timeout))
            now = time.monotonic_ns()
        return int(np.count_nonzero(np.cumprod(times + self._shift_ns <= now)))

    def close(self) -> None:
        """Close the file."""
        self._chunk = frames(0)

    def problem(self) -> str:
        """Damage of the file."""
        return self._problem


def scenario_table(path: Path) -> dict[str, Any] | None:
    """The scenario in the header of our own recording `path`, as it stands there; None where there is none.

    Raises
    ------
    HilError
        The file cannot be read.
    """
    reader = RecordingReader.open(path)
    reader.close()
    table = reader.header.get("scenario")
    return table if isinstance(table, dict) else None


def is_own(path: Path) -> bool:
    """Whether `path` is a recording of ours.

    Raises
    ------
    HilError
        The file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError as error:
        raise HilError(f"recording {path}: {error.strerror}") from error
