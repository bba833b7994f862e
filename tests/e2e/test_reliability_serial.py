"""A board on a serial port that is pulled out and put back, and bytes that are damaged on the line."""

import sys
import time
from pathlib import Path

import numpy as np
import pytest
from rows import counts, note, recorded

sys.path.append(str(Path(__file__).parents[1] / "drivers" / "serial"))
from pty_board import BOARDS, Plugged, moving

from hil.pytest_plugin import Bridge, StartBridge

STEP_S = 0.01
SCENARIO = {
    "driver": "xsens-xbus",
    "navigation": {"alignment": "level", "align_s": 0.5, "start": {"heading_deg": 30.0}},
}


def packets(n: int) -> list[bytes]:
    """A still board's packets, one a sample."""
    imu = moving(n, STEP_S)
    imu.dtheta[:], imu.dvel[:] = 0.0, [0.0, 0.0, -9.81 * STEP_S]
    made: list[bytes] = BOARDS["xsens-xbus"][1]().packets(imu)
    return made


def feed(board: Plugged, packets: list[bytes]) -> None:
    for packet in packets:
        board.send(packet)
        time.sleep(STEP_S)


def wait_for_samples(bridge: Bridge, count: int) -> None:
    deadline = time.monotonic() + 20.0
    while bridge.summary()["samples"] < count:
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture
def started(hil_bridge: StartBridge, tmp_path: Path) -> Bridge:
    """A bridge on a port that no board has been plugged into yet but a mute one."""
    with Plugged(None, tmp_path / "ttyIMU"):
        return hil_bridge(
            "rest",
            simulate_head=False,
            bus=f"serial:{tmp_path / 'ttyIMU'}:921600",
            record=tmp_path / "run.dhil",
            mavlink={"links": ()},
            **SCENARIO,
        )


def test_a_port_pulled_out_and_put_back(started: Bridge, tmp_path: Path) -> None:
    sent = packets(400)
    with Plugged(None, tmp_path / "ttyIMU") as board:
        time.sleep(1.2)  # the mute one was pulled out: the port is opened anew
        feed(board, sent[:200])
        wait_for_samples(started, 199)
    time.sleep(0.3)
    feed_later = sent[250:]
    with Plugged(None, tmp_path / "ttyIMU") as board:
        plugged = time.monotonic()
        while started.summary()["samples"] < 201 and feed_later:
            feed(board, [feed_later.pop(0)])
        back_s = time.monotonic() - plugged
        before = started.summary()["samples"]
        feed(board, feed_later)
        wait_for_samples(started, before + len(feed_later) - 1)
    summary = started.stop()
    bytes_in = int(recorded(tmp_path / "run.dhil")[0]["length"].sum())
    assert summary["restarts"] == 0
    assert summary["silences"] >= 1
    assert summary["lost"] >= 50, "what was sent while it was out, by the board's counter"
    newest = 1 + summary["samples"] + summary["lost"]
    assert newest == len(sent), "every sample is received or counted"
    assert bytes_in == (summary["samples"] + 1) * len(sent[0]), "every byte that came is recorded"
    told = [text for _, severity, text in started.events() if severity in {"error", "warning", "notice"}]
    assert any("unplugged?" in text for text in told)
    told = [text.replace(str(tmp_path), "/dev") for text in told if "align" not in text]
    note(
        22,
        "serial port pulled out",
        "0.3 s, another pseudo-terminal after it",
        counts(summary),
        told,
        f"{back_s:.3f}",
        "0",
    )


def test_damaged_bytes_cost_the_packets_that_they_hit(started: Bridge, tmp_path: Path) -> None:
    sent, rng = packets(300), np.random.default_rng(4)
    hit = sorted(rng.choice(np.arange(100, 290), 10, replace=False).tolist())
    for k in hit:
        packet = bytearray(sent[k])
        packet[int(rng.integers(4, len(packet)))] ^= 1 << int(rng.integers(8))
        sent[k] = bytes(packet)
    with Plugged(None, tmp_path / "ttyIMU") as board:
        time.sleep(1.2)
        feed(board, sent)
        wait_for_samples(started, len(sent) - 1 - len(hit))
    summary = started.stop()
    assert summary["lost"] == len(hit)
    assert summary["samples"] == len(sent) - 1 - len(hit), "the first one sets the clock"
    assert summary["crc_errors"] >= len(hit)
    told = [text for _, _, text in started.events() if text.startswith(("crc_errors", "lost:"))]
    note(23, "serial bytes damaged", "one bit of 10 packets of 300", counts(summary), told, "0, NAVIGATE", "0")
