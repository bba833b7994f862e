"""Logs of a run that is ended by Ctrl-C, by SIGTERM, by a kill of the command, by a kill of the writer."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mcap")
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader

pytestmark = [pytest.mark.slow]
HIL = [sys.executable, "-c", "from hil.cli import main; main()"]


def begun(path: Path, tlog: Path) -> "subprocess.Popen[str]":
    """A run whose files have begun to grow."""
    command = [
        *HIL,
        "run",
        "rest",
        "--mavlink",
        "udpout:127.0.0.1:9",
        "--tlog",
        str(tlog),
        "--mcap",
        str(path),
        "--json",
    ]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    deadline = time.monotonic() + 180.0
    while (not path.exists() or path.stat().st_size < 60_000) and time.monotonic() < deadline:
        assert run.poll() is None, run.communicate()
        time.sleep(0.1)
    return run


def writer_of(run: Any, path: Path) -> int:
    """The process that has the file open for writing."""
    for process in Path("/proc").iterdir():
        if process.name.isdigit() and int(process.name) != run.pid:
            try:
                if any(os.readlink(one) == str(path) for one in (process / "fd").iterdir()):
                    return int(process.name)
            except OSError:
                continue
    raise AssertionError(f"nobody writes {path}")


@pytest.mark.parametrize("how", ["ctrl-c", "term", "kill"])
def test_the_file_is_finished(tmp_path: Path, how: str) -> None:
    path, tlog = tmp_path / "a.mcap", tmp_path / "a.tlog"
    run = begun(path, tlog)
    writer = writer_of(run, path)
    if how == "ctrl-c":
        os.killpg(run.pid, signal.SIGINT)  # as a terminal does
    else:
        run.send_signal(signal.SIGTERM if how == "term" else signal.SIGKILL)
    run.wait(timeout=60.0)
    deadline = time.monotonic() + 30.0
    while Path(f"/proc/{writer}").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        count = sum(channel.topic == "/imu" for _, channel, _ in make_reader(file).iter_messages())
    assert count > 1000
    assert tlog.stat().st_size > 1000


def test_a_killed_writer_leaves_what_it_had_and_the_run_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    run = begun(path, tmp_path / "a.tlog")
    os.kill(writer_of(run, path), signal.SIGKILL)
    time.sleep(2.0)
    assert run.poll() is None
    run.send_signal(signal.SIGINT)
    out, _ = run.communicate(timeout=60.0)
    assert "the mcap process died" in out
    count = 0
    with path.open("rb") as file:
        messages = NonSeekingReader(file).iter_messages(log_time_order=False)
        try:
            for _ in messages:
                count += 1
        except McapError:
            pass
    assert count > 1000
