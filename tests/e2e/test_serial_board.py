"""A real board's bytes on a pseudo-terminal, through the loop: aligned, navigated, recorded, replayed to the same bit."""

import contextlib
import json
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import commands
import numpy as np
import pytest
from serial.tools.list_ports_common import ListPortInfo

sys.path.append(str(Path(__file__).parents[1] / "drivers" / "serial"))
from pty_board import BOARDS, Plugged

from drivers import driver_names
from drivers.can.bus import open_port
from drivers.can.frames import FrameArray, frames
from drivers.logs.recording import RecordingWriter
from hil.bridge import Loop, LoopOrder, Outlets
from hil.decoder import decode_file, record_bus
from hil.scenario import Scenario
from hil.source import FileSource, scenario_table
from nav.increments import ImuIncrements
from nav.rotation import euler_from_quaternion
from nav.state import NAV_STATE

pytestmark = pytest.mark.skipif(
    "xsens-xbus" not in driver_names(), reason="installed before these boards were added: pip install -e ."
)
RATE_HZ, REST_S, TURN_S, TURN_DEG = 100, 2.0, 1.5, 90.0
GRAVITY = 9.81
"""Near enough: the level alignment takes the direction, and the turn takes seconds."""


def standing_then_turning() -> ImuIncrements:
    """A level board that stands, then turns to the right and stands again."""
    n = int(RATE_HZ * (2 * REST_S + TURN_S))
    imu = ImuIncrements.empty(n)
    imu.step[:] = 1.0 / RATE_HZ
    imu.time[:] = 10.0 + np.arange(1, n + 1) / RATE_HZ
    imu.dvel[:, 2] = -GRAVITY / RATE_HZ
    turning = slice(int(REST_S * RATE_HZ), int((REST_S + TURN_S) * RATE_HZ))
    imu.dtheta[turning, 2] = np.radians(TURN_DEG) / (TURN_S * RATE_HZ)
    return imu


def scenario(name: str, url: str) -> Scenario:
    return Scenario.model_validate(
        {
            "name": "desk",
            "driver": name,
            "bus": url,
            "mavlink": {"links": []},
            "navigation": {"alignment": "level", "align_s": 1.0, "start": {"heading_deg": 30.0}},
        }
    )


@pytest.fixture
def port_file(tmp_path: Path) -> Path:
    return tmp_path / "ttyIMU"


def navigated(chosen: Scenario, batches: Iterator[FrameArray]) -> tuple[Loop, Any]:
    """A loop that has taken all of `batches`, and its last solution."""
    outlets = Outlets.make(recording=False, readers=1)
    loop = Loop(LoopOrder(chosen, paced=False), outlets)
    for batch in batches:
        loop.take(batch)
    row = np.zeros(1, NAV_STATE)
    assert outlets.states.latest(row)
    return loop, row[0]


def heading_deg(row: Any) -> float:
    return float(np.degrees(euler_from_quaternion(row["q_nb"])[0]))


def replayed(path: Path, size: int) -> Iterator[FrameArray]:
    with contextlib.closing(FileSource(path, paced=False)) as source:
        batch = frames(size)
        while n := source.receive(batch, 0.0):
            yield batch[:n]


@pytest.mark.parametrize("name", BOARDS)
def test_a_board_is_aligned_navigated_and_replayed(name: str, port_file: Path, tmp_path: Path) -> None:
    chosen, path = scenario(name, f"serial:{port_file}:921600"), tmp_path / "desk.dhil"
    emulator = BOARDS[name][1]()
    packets = emulator.packets(standing_then_turning())
    lost = range(260, 265)  # in the turn: the gap is interpolated
    kept = [packet for k, packet in enumerate(packets) if k not in lost]
    with (
        Plugged(emulator, port_file) as board,
        contextlib.closing(open_port(chosen.bus)) as port,
        RecordingWriter(path, {"scenario": chosen.model_dump(mode="json")}) as writer,
    ):

        def live() -> Iterator[FrameArray]:
            batch = frames(64)
            for start in range(0, len(kept), 7):
                data = b"".join(kept[start : start + 7])
                board.send(data)
                came, deadline = 0, time.monotonic() + 5.0
                while came < len(data) and time.monotonic() < deadline:
                    n = port.receive(batch, 0.1)
                    came += int(batch["length"][:n].sum())
                    writer.write(batch[:n])
                    yield batch[:n]

        loop, row = navigated(chosen, live())
    result = loop.result()
    assert result["mode"] == "navigate"
    assert loop.driver.counters.lost == len(lost)
    assert abs(heading_deg(row) - 30.0 - TURN_DEG) < 0.05
    for size in (1, 5, 1000):
        again, _ = navigated(chosen, replayed(path, size))
        assert again.result()["navigation_digest"] == result["navigation_digest"]
        assert again.driver.counters == loop.driver.counters
    lines, counters, problem = decode_file(name, path)
    assert len(list(lines)) == counters()["samples"] == loop.driver.counters.samples
    assert problem() == ""


class Feeder:
    """Sends packets at their pace, from a thread, until it is stopped."""

    def __init__(self, board: Plugged, emulator: Any, imu: ImuIncrements) -> None:
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._feed, args=(board, emulator, imu))
        self._thread.start()

    def _feed(self, board: Plugged, emulator: Any, imu: ImuIncrements) -> None:
        began, sent = time.monotonic(), 0
        while True:
            for packet in emulator.packets(imu):
                if self._stopped.wait(max(0.0, began + sent / RATE_HZ - time.monotonic())):
                    return
                board.send(packet)
                sent += 1
            imu.time[:] += imu.time[-1] - imu.time[0] + imu.step[0]

    def __enter__(self) -> "Feeder":
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()


def hil(*arguments: object, code: int = 0) -> tuple[dict[str, Any], str]:
    """``hil ARGUMENT... --json``: its summary and what it said."""
    out, err = commands.hil(*arguments, "--json", code=code)
    return (json.loads(out) if out else {}), err


def test_the_command_runs_records_and_replays_a_board(port_file: Path, tmp_path: Path) -> None:
    desk, path, url = tmp_path / "desk.toml", tmp_path / "run.dhil", f"serial:{port_file}:921600"
    desk.write_text('[navigation]\nalignment = "level"\nalign_s = 1\nstart = { heading_deg = 30 }\n')
    emulator, rest = BOARDS["xsens-xbus"][1](), standing_then_turning()
    rest.dtheta[:] = 0.0
    with Plugged(emulator, port_file) as board, Feeder(board, emulator, rest):
        summary, _ = hil("run", desk, "--imu", "xsens-xbus", "--bus", url, "--duration", 3, "--record", path)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("drivers.serial.probe.RATES", (921600,))
            _, said = hil("run", desk, "--imu", "vectornav", "--bus", url, code=2)
    assert "use --imu xsens-xbus --bus" in said
    assert summary["samples"] == 3 * RATE_HZ
    assert (summary["lost"], summary["crc_errors"], summary["restarts"]) == (0, 0, 0)
    assert summary["mode"] == "navigate"
    again, _ = hil("replay", path, "--speed", "max")
    assert again["navigation_digest"] == summary["navigation_digest"]


def test_the_doctor_finds_a_board(port_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there = ListPortInfo(str(port_file), skip_link_detection=True)
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [there])
    emulator = BOARDS["microstrain-mip"][1]()
    with Plugged(emulator, port_file) as board, Feeder(board, emulator, standing_then_turning()):
        said, _ = hil("doctor", "--probe")
    found = [finding for finding in said["findings"] if finding["what"] == str(port_file)]
    assert [finding["verdict"] for finding in found] == ["ok"]
    assert found[0]["found"] == f"hil run --imu microstrain-mip --bus serial:{port_file}:115200"


def test_the_command_sets_a_board_up(port_file: Path) -> None:
    emulator = BOARDS["vectornav"][1]("VN-200")
    with Plugged(emulator, port_file):
        said, _ = hil("configure", "vectornav", "--bus", f"serial:{port_file}:921600", "--rate", 200)
        assert said == {"model": "VN-200", "rate_hz": 200.0}
        _, text = hil("configure", "dtg-head", "--bus", f"serial:{port_file}:921600", "--rate", 200, code=2)
        assert "no board on a serial port" in text


def test_recording_a_port_and_what_other_formats_cannot_hold(port_file: Path, tmp_path: Path) -> None:
    chosen = scenario("vectornav", f"serial:{port_file}:921600")
    emulator = BOARDS["vectornav"][1]()
    for ending in ("dhil", "log"):
        path = tmp_path / f"desk.{ending}"
        with Plugged(emulator, port_file) as board, Feeder(board, emulator, standing_then_turning()):
            made = record_bus(chosen, path, 0.5, lambda: False)
        assert made["frames"] > 10
        if ending == "dhil":
            assert "not_exported" not in made
            assert sum(len(batch) for batch in replayed(path, 64)) == made["frames"]
        else:
            assert made["not_exported"] == made["frames"]


def test_a_port_that_is_pulled_out_while_it_is_recorded_is_told(port_file: Path, tmp_path: Path) -> None:
    emulator, path, told = BOARDS["vectornav"][1](), tmp_path / "desk.dhil", list[str]()
    with Plugged(emulator, port_file) as board:
        pulled = threading.Timer(0.5, board.unplug)
        with Feeder(board, emulator, standing_then_turning()):
            pulled.start()
            made = record_bus(
                scenario("vectornav", f"serial:{port_file}:921600"), path, 2.0, lambda: bool(told), told.append
            )
    assert "the port is lost: unplugged?" in told[0]
    assert made["problem"] == "the bus failed 1 times and was reopened"
    assert made["frames"] > 10


def test_a_recording_says_whose_it_is(tmp_path: Path) -> None:
    path, batch = tmp_path / "a.dhil", frames(3)
    bus = f"unix:{time.monotonic_ns():x}"
    assert hil("record", path, "--bus", bus, "--imu", "sbg", "--duration", 0.1)[0]["frames"] == 0
    with RecordingWriter(path, {"scenario": scenario_table(path)}) as writer:
        writer.write(batch)
    _, text = hil("replay", path, "--speed", "max", "--mavlink", "none", "--no-dashboard", code=2)
    assert f"{path}: no sample of sbg in 3 frames: name its driver" in text
