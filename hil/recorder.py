"""The recorder's process: takes frames from the loop's ring into a recording, and is never waited for in real time."""

import select
import signal
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from drivers.can.frames import frames
from drivers.logs.recording import FLUSH_S, RecordingWriter
from hil.bridge import Outlets
from hil.stats import Phase
from nav.errors import HilError


def run_recorder(path: Path, header: dict[str, Any], outlets: Outlets, answer: Connection) -> None:
    """Record until the loop is done or hands on no more, and the ring is empty.

    Answers ``{"file", "frames", "lost"}`` or ``{"failed"}``.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ring, control, stats = outlets.frames, outlets.control, outlets.stats
    wake = ring.wakes[0]
    batch = frames(4096)
    lost = 0
    try:
        with RecordingWriter(path, header) as writer:
            ring.pull(batch, 0)  # loads the kernel; nothing is sent before we are ready
            answer.send({"ready": True})
            while True:
                done = stats["phase"] in (Phase.DONE, Phase.FAILED) or not control.recording
                number = control.recorded
                copied, first = ring.pull(batch, number)
                if first > number:
                    lost += first - number
                    stats["recorder_lost"] = lost
                writer.write(batch[:copied])
                control.recorded = first + copied
                if copied == 0:
                    if done:
                        break
                    select.select([wake], [], [], FLUSH_S)
                    wake.clear()
            writer.flush()
        answer.send({"file": str(path), "frames": writer.written, "lost": lost})
    except (HilError, OSError) as error:
        control.recorded = 1 << 62  # the loop must not wait for us
        answer.send({"failed": f"recorder: {error}"})
    finally:
        answer.close()
