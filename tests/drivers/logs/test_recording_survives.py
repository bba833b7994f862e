"""A recording whose writer is killed at any moment, or whose disk is full, keeps what it had."""

import multiprocessing as mp
import os
import resource
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from drivers.can.frames import FrameArray, frames
from drivers.logs.recording import RETRY_S, RecordingReader, RecordingWriter
from nav.errors import HilError

KEPT_NS = 100_000_000


def read(path: Path) -> tuple[FrameArray, str]:
    reader, blocks = RecordingReader.open(path), [frames(0)]
    while len(block := reader.read()):
        blocks.append(block)
    reader.close()
    return np.concatenate(blocks), reader.problem


def write_for_ever(path: Path, newest: "mp.sharedctypes.Synchronized[int]") -> None:
    batch = frames(1)
    with RecordingWriter(path, {"scenario": {}}) as writer:
        while True:
            batch["time_ns"] = time.monotonic_ns()
            writer.write(batch)
            newest.value = int(batch["time_ns"][0])
            time.sleep(2e-4)


@pytest.mark.parametrize("moment", range(8))
def test_a_killed_writer_loses_no_more_than_100_ms(tmp_path: Path, moment: int) -> None:
    context, path = mp.get_context("fork"), tmp_path / "run.dhil"
    newest = context.Value("q", 0, lock=False)
    process = context.Process(target=write_for_ever, args=(path, newest), daemon=True)
    process.start()
    while newest.value == 0:
        time.sleep(0.001)
    time.sleep(0.2 + float(np.random.default_rng(moment).uniform(0.0, 0.1)))
    assert process.pid
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    found, problem = read(path)
    assert newest.value - int(found["time_ns"][-1]) <= KEPT_NS
    assert np.all(np.diff(found["time_ns"]) > 0)
    assert not problem or "what came before is used" in problem


def test_a_disk_that_is_full_and_has_room_again(tmp_path: Path) -> None:
    """Blocks that do not fit are taken back whole and counted; the file is good at any time."""
    path, batch = tmp_path / "run.dhil", frames(300)
    batch["can_id"] = np.arange(300)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with RecordingWriter(path, {}) as writer:
        writer.write(batch[:100])
        writer.flush()
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 1000, limits[1]))
            writer.write(batch[100:200])
            writer.flush()
            assert "run.dhil: File too large" in writer.problem
            np.testing.assert_array_equal(read(path)[0], batch[:100])
            assert read(path)[1] == ""
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        time.sleep(RETRY_S)
        writer.write(batch[200:])
        writer.flush()
        assert writer.problem == ""
        assert (writer.written, writer.lost) == (200, 100)
    np.testing.assert_array_equal(read(path)[0], np.concatenate([batch[:100], batch[200:]]))


def test_a_device_without_room_is_refused_at_the_start() -> None:
    with pytest.raises(HilError, match="recording /dev/full: No space left on device"):
        RecordingWriter(Path("/dev/full"), {})
