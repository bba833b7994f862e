"""Frames without navigation: decoding a file to JSON lines, recording a bus."""

import json
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can

from drivers import make_driver
from drivers.can.convert import to_message
from drivers.can.frames import frames
from drivers.logs.recording import RecordingWriter
from drivers.serial.chunks import is_chunk
from hil.scenario import Scenario
from hil.source import BusSource, FileSource
from nav.errors import HilError

_FIELDS = ("time", "step", "sequence", "validity", "dtheta", "dvel", "rotor")


def decode_file(driver_name: str, path: Path) -> tuple[Iterator[str], Callable[[], dict[str, int]], Callable[[], str]]:
    """JSON lines of the samples in `path`, and, once they are drawn, the driver's counters and what was wrong."""
    driver = make_driver(driver_name)
    source = FileSource(path, paced=False)

    def lines() -> Iterator[str]:
        for batch in source.batches(256):
            samples = driver.decode(batch)
            for k in range(len(samples)):
                yield (
                    json.dumps({name: _plain(getattr(samples, name)[k]) for name in _FIELDS if hasattr(samples, name)})
                    + "\n"
                )

    return lines(), driver.counters.as_dict, source.problem


def _plain(value: Any) -> Any:
    """A JSON value; NaN (not on this wire) is null."""
    listed = value.tolist()
    if isinstance(listed, list):
        return [None if math.isnan(item) else item for item in listed]
    return listed


def record_bus(
    scenario: Scenario,
    path: Path,
    duration_s: float | None,
    cancelled: Callable[[], bool],
    tell: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Record frames of the scenario's bus until cancelled; what was recorded. `tell` hears at once when disk or bus fail."""
    source = BusSource(scenario.bus, paced=True)
    batch = frames(1024)
    count, chunks, problem, trouble, began = 0, 0, "", "", time.monotonic()
    writer = _writer(path, scenario)
    try:
        with writer as write:
            while not cancelled() and (duration_s is None or time.monotonic() - began < duration_s):
                n = source.receive(batch, 0.05)
                write(batch[:n])
                count += n
                chunks += int(is_chunk(batch[:n]).sum())
                if writer.problem() != problem:
                    problem = writer.problem()
                    tell(f"{problem}: frames are lost to it" if problem else f"recording {path}: there is room again")
                if source.trouble != trouble:
                    trouble = source.trouble
                    tell(trouble or f"{scenario.bus} is back")
    finally:
        source.close()
    left_out = {"not_exported": chunks} if path.suffix != ".dhil" and chunks else {}
    return {
        "file": str(path),
        "frames": count - writer.lost(),
        "lost": writer.lost(),
        "overflowed": source.overflowed,
        **left_out,
        **({"problem": source.problem()} if source.problem() else {}),
        "seconds": time.monotonic() - began,
    }


class _writer:
    """Our recording by the ending .dhil, python-can's writers by any other."""

    def __init__(self, path: Path, scenario: Scenario) -> None:
        self._own: RecordingWriter | None = None
        if path.suffix == ".dhil":
            header = {"scenario": scenario.model_dump(mode="json"), "created_ns": time.time_ns()}
            self._own = RecordingWriter(path, header)
            return
        try:
            self._foreign: Any = can.Logger(path)
        except (ValueError, OSError) as error:
            raise HilError(f"record {path}: {error}; endings: .dhil, .log (candump), .blf, .asc") from error

    def __enter__(self) -> Callable[[Any], None]:
        return self._own.write if self._own is not None else self._write_foreign

    def _write_foreign(self, batch: Any) -> None:
        for row in batch[~is_chunk(batch)]:  # serial bytes are no CAN frames
            self._foreign.on_message_received(to_message(row, "can0"))

    def problem(self) -> str:
        return self._own.problem if self._own is not None else ""

    def lost(self) -> int:
        return self._own.lost if self._own is not None else 0

    def __exit__(self, *_: object) -> None:
        if self._own is not None:
            self._own.close()
        else:
            self._foreign.stop()
