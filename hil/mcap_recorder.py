"""MCAP files: the process that writes one beside a run, and the export of a recording."""

import time
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from drivers.logs.mcap_log import McapLog
from hil.bridge import BATCH, EVENTS, Loop, Outlets, take_with_events
from hil.player import plan_replay
from hil.smoothing import batches
from hil.stats import Phase
from nav.errors import HilError
from nav.state import NAV_STATE

_LOOK_S = 0.02
"""Time between two looks into the ring, a small part of what it holds."""


class _Taker:
    """Takes what is new in the rings of a run to a log."""

    def __init__(self, log: McapLog, outlets: Outlets) -> None:
        self._log, self._states, self._events = log, outlets.states, outlets.events
        self._rows, self._notes = np.zeros(BATCH, NAV_STATE), np.zeros(64, EVENTS)
        self._state_number = self._event_number = 0
        self.lost = 0
        """Solutions that were overwritten before they could be taken."""

    def take(self) -> int:
        """Take a batch; how many solutions it held."""
        copied, first = self._states.pull(self._rows, self._state_number)
        self.lost += first - self._state_number
        self._state_number = first + copied
        self._log.solutions(self._rows[:copied])
        noted, first = self._events.pull(self._notes, self._event_number)
        self._event_number = first + noted
        for note in self._notes[:noted]:
            self._log.note(note["severity"].decode(), note["text"].decode(errors="replace"))
        return copied


def run_mcap(path: Path, outlets: Outlets, answer: Connection) -> None:
    """Write until the loop is done and the rings are empty; answers ``{"file", "messages", "lost"}`` or ``{"failed"}``."""
    try:
        with McapLog(path) as log:
            taker = _Taker(log, outlets)
            taker.take()  # loads the kernel
            answer.send({"ready": True})
            while True:
                done = outlets.stats["phase"] in (Phase.DONE, Phase.FAILED)
                if taker.take() == 0:
                    if done:
                        break
                    log.flush()
                    time.sleep(_LOOK_S)
        answer.send({"file": str(path), "messages": log.written, "lost": taker.lost})
    except (HilError, OSError) as error:
        answer.send({"failed": f"mcap: {error}"})
    finally:
        answer.close()


def export_mcap(path: Path, driver: str | None, out: Path) -> dict[str, Any]:
    """Navigate a recording once more and write what comes of it; no solution is left out.

    Raises
    ------
    HilError
        The recording cannot be read, or the file not be written.
    """
    order, _ = plan_replay(path, None, None, paced=False)
    if driver is not None:
        order = replace(order, scenario=order.scenario.with_changes(driver=driver))
    outlets = Outlets.make(recording=False, readers=1)
    loop = Loop(replace(order, file=path), outlets)
    with McapLog(out) as log:
        taker = _Taker(log, outlets)
        for batch in batches(path):
            take_with_events(loop, batch)
            while taker.take():
                pass
            if loop.finished:
                break
    return {"file": str(out), "messages": log.written, "lost": taker.lost}
