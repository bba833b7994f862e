"""The run in a terminal: a real one (a pty), real keys."""

import fcntl
import os
import pty
import select
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from commands import hil
from hypothesis import given
from hypothesis import strategies as st

from hil.tui import horizon

SCENARIO = """
name = "terminal"
[motion]
rest_s = 0.5
ramp_s = 2
attitude = "coordinated"
north = { rate = 30 }
[head]
rate_hz = 200
instruments = "ideal"
[navigation]
alignment = "truth"
"""


def ground(pitch_deg: float, roll_deg: float) -> list[list[bool]]:
    """Which letters of the horizon show ground, row by row."""
    text = horizon(pitch_deg, roll_deg)
    rows: list[list[bool]] = [[]]
    for span in text.spans:
        rows[-1].append("#7a4a21" in str(span.style))
        if text.plain[span.end : span.end + 1] == "\n":
            rows.append([])
    return rows[:-1]


def share(rows: list[list[bool]]) -> float:
    return sum(map(sum, rows)) / sum(map(len, rows))


@given(st.floats(-15, 10), st.floats(-60, 60))
def test_nose_up_shows_more_sky(pitch: float, roll: float) -> None:
    assert share(ground(pitch + 5.0, roll)) <= share(ground(pitch, roll))


@given(st.floats(-20, 20), st.floats(5, 60))
def test_the_low_wing_is_on_the_side_of_the_ground(pitch: float, roll: float) -> None:
    right, left = ([row[side] for row in ground(pitch, roll)] for side in (-1, 0))
    assert sum(right) >= sum(left), "a roll to the right brings the ground up on the right"


def test_upside_down_the_ground_is_above() -> None:
    assert all(ground(0.0, 180.0)[0])
    assert not any(ground(0.0, 180.0)[-1])


def test_without_a_terminal_it_says_so() -> None:
    _, said = hil("run", "--tui", "--duration", "1", code=2)
    assert "--tui needs a terminal" in said


@pytest.mark.slow
def test_a_run_is_shown_and_obeys_keys(tmp_path: Path) -> None:
    (tmp_path / "terminal.toml").write_text(SCENARIO)
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 45, 110, 0, 0))
    run = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "from hil.cli import main; main()",
            "run",
            "terminal.toml",
            "--tui",
            "--mavlink",
            "none",
        ],
        cwd=tmp_path,
        stdin=theirs,
        stderr=theirs,
        stdout=subprocess.DEVNULL,
        env=os.environ | {"TERM": "xterm-256color"},
    )
    os.close(theirs)
    before = termios.tcgetattr(ours)
    shown = b""

    def until(found: Callable[[bytes], bool]) -> None:
        nonlocal shown
        deadline = time.monotonic() + 120.0
        while not found(shown):
            assert time.monotonic() < deadline, shown[-2000:]
            if select.select([ours], [], [], 0.1)[0]:
                shown += os.read(ours, 65536)

    try:
        until(lambda text: b"NAVIGATE" in text and b"attitude" in text and b"error position" in text)
        os.write(ours, b"m")
        until(lambda text: b"mark 1" in text)
        os.write(ours, b"a")
        until(lambda text: b"ALIGN" in text)
        os.write(ours, b"q")
        end = time.monotonic() + 60.0
        while run.poll() is None and time.monotonic() < end:
            if select.select([ours], [], [], 0.1)[0]:
                os.read(ours, 65536)
        assert run.returncode == 0
    finally:
        run.kill()
        run.wait()
    assert termios.tcgetattr(ours)[3] == before[3], "the terminal is as it was"
    os.close(ours)
