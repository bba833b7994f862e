"""Rows of docs/reliability.md: each test measures its own, and `make reliability` has them written (HIL_RELIABILITY=FOLDER)."""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers import FrameDriver
from drivers.can.frames import FrameArray
from drivers.logs.recording import EVENT, RecordingReader
from hil.pytest_plugin import Bridge
from nav.state import NAV_STATE, Mode

COUNTERS = (
    *("lost", "duplicated", "late", "crc_errors", "foreign", "short", "version_errors"),
    *("restarts", "frozen", "clock_steps", "silences"),
)
"""Counters of the summary that a fault may move."""
OF_FRAMES: dict[str, dict[str, Any]] = {
    "drop": {"share": 0.05, "for_s": 0.5},
    "duplicate": {"share": 0.05, "for_s": 0.5},
    "reorder": {"share": 0.05, "for_s": 0.5},
    "delay": {"delay_s": 0.3, "for_s": 0.5},
    "jitter": {"delay_s": 0.02, "for_s": 0.5},
    "bit-flip": {"share": 0.05, "for_s": 0.5},
}
"""Faults that every line has alike."""
UNITS = {"delay_s": " s", "step_s": " s", "drift_ppm": " ppm"}


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


def said(says: dict[str, str], kind: str, fault: dict[str, Any]) -> str:
    """What a fault of a scenario does, in words with its numbers in the places of its keys."""
    text = says[kind]
    for key, value in fault.items():
        text = text.replace(f"`{key}`", f"{value:g}{UNITS.get(key, '')}" if "_" in key else f"{100 * value:g} %")
    return f"{text}, for {fault['for_s']:g} s" if "for_s" in fault else text


@dataclass
class Found:
    """What one fault of a flight has left."""

    kind: str
    moved: dict[str, int]
    told: list[str]
    mode: str
    back: str


def each_fault(
    bridge: Bridge, frames: FrameArray, driver: FrameDriver, windows: dict[str, tuple[float, float]], for_s: float
) -> Iterator[Found]:
    """What each fault of a flight has left, by what it began and ended (device time); `for_s` from the begin on is its own."""
    rows, events = solutions(bridge), bridge.events()
    marks = counted_until(frames, driver, [start + for_s for start, _ in windows.values()])
    clean = rows["time"] < min(start for start, _ in windows.values())
    offset = np.min(rows["solution_ns"][clean] * 1e-9 - rows["time"][clean])
    for number, (kind, (start, end)) in enumerate(windows.items()):
        after = np.flatnonzero(rows["time"] > end + 1e-6)[0]
        back_s = rows["solution_ns"][after] * 1e-9 - rows["time"][after] - offset
        mode = Mode(int(rows["mode"][np.flatnonzero(rows["time"] < start + for_s)[-1]])).name
        told = [text for moment, _, text in events if start - 0.1 <= moment < start + for_s]
        moved = {name: marks[number + 1][name] - marks[number][name] for name in marks[0]}
        moved["silences"] = told.count("no samples: the sensor is silent")
        yield Found(kind, moved, told, mode, f"{max(back_s, 0.0):.3f}, {mode}")


def solutions(bridge: Bridge) -> Any:
    """All solutions of the run, the filled ones too."""
    ring = bridge.session.outlets.states
    rows = np.zeros(ring.capacity, NAV_STATE)
    copied, first = ring.pull(rows, 0)
    assert first == 0, "none was overwritten"
    return rows[:copied]


def counted_until(frames: FrameArray, driver: FrameDriver, times: list[float]) -> list[dict[str, int]]:
    """What `driver` has counted before the first of `frames`, and by the device times `times`."""
    marks = [driver.counters.as_dict()]
    for k in range(len(frames)):
        raw = driver.decode(frames[k : k + 1])
        if len(raw) and len(marks) <= len(times) and raw.time[0] > times[len(marks) - 1]:
            marks.append(driver.counters.as_dict())
    marks += [driver.counters.as_dict()] * (len(times) + 1 - len(marks))
    return [{name: mark[name] for name in COUNTERS if name in mark} for mark in marks]
