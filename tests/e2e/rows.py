"""Rows of docs/reliability.md: each test measures its own, and `make reliability` has them written (HIL_RELIABILITY=FOLDER)."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from drivers.can.frames import FrameArray
from drivers.logs.recording import EVENT, RecordingReader

COUNTERS = (
    *("lost", "duplicated", "late", "crc_errors", "foreign", "short", "version_errors"),
    *("restarts", "frozen", "clock_steps", "silences"),
)
"""Counters of the summary that a fault may move."""


def note(
    number: int, fault: str, injected: str, counted: dict[str, int] | str, told: list[str] | str, back: str, lost: str
) -> None:
    """Keep one row, where somebody asked for the table."""
    folder = os.environ.get("HIL_RELIABILITY")
    if not folder:
        return
    if isinstance(counted, dict):
        counted = ", ".join(f"`{name}` {count}" for name, count in counted.items() if count) or "-"
    if isinstance(told, list):
        told = "; ".join(f"`{text}`" for text in dict.fromkeys(told)) or "-"
    row = [fault, injected, counted, told, back, lost]
    (Path(folder) / f"{number:03d}.json").write_text(json.dumps(row))


def recorded(path: Path) -> tuple[FrameArray, str]:
    """The frames of a recording without the events among them, and why reading ended before its end."""
    reader, blocks = RecordingReader.open(path), []
    while len(block := reader.read()):
        blocks.append(block)
    reader.close()
    frames: FrameArray = np.concatenate(blocks)
    return frames[frames["reserved"][:, 0] != EVENT], reader.problem


def counts(summary: dict[str, Any]) -> dict[str, int]:
    """The counters of faults of a summary."""
    return {name: summary[name] for name in COUNTERS}
