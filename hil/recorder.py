"""The recorder's process: takes frames from the loop's ring into a recording, and is never waited for in real time."""

import select
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

    Answers ``{"file", "frames", "lost"}`` or ``{"failed"}``; ``{"problem": (severity, text)}`` goes out at once when the disk
    takes no more, and when it does again.
    """
    ring, control, stats = outlets.frames, outlets.control, outlets.stats
    wake = ring.wakes[0]
    batch = frames(4096)
    lost, problem = 0, ""
    before = stats["recorder_lost"]  # by those that recorded earlier in the run
    try:
        with RecordingWriter(path, header) as writer:
            ring.pull(batch, 0)  # loads the kernel; nothing is sent before we are ready
            answer.send({"ready": True})
            while True:
                done = stats["phase"] in (Phase.DONE, Phase.FAILED) or not control.recording
                control.beat("recorder")
                number = control.recorded
                copied, first = ring.pull(batch, number)
                lost += max(first - number, 0)
                writer.write(batch[:copied])
                stats["recorder_lost"] = before + lost + writer.lost
                if writer.problem != problem:
                    problem = writer.problem
                    answer.send({"problem": ("error" if problem else "notice", f"recorder: {_news(writer)}")})
                control.recorded = first + copied
                if copied == 0:
                    if done:
                        break
                    select.select([wake], [], [], FLUSH_S)
                    wake.clear()
            writer.flush()
        answer.send({"file": str(path), "frames": writer.written, "lost": lost + writer.lost})
    except (HilError, OSError) as error:
        control.recorder_is_gone()
        answer.send({"failed": f"recorder: {error}"})
    finally:
        answer.close()


def _news(writer: RecordingWriter) -> str:
    if writer.problem:
        return f"{writer.problem}: frames are lost to it from here on, the run goes on"
    return f"recording {writer.path}: there is room again, {writer.lost} frames are lost to it"
