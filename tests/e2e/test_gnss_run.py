"""Satellite receivers on pseudo-terminals beside the simulated head: the navigator follows them, and a replay too."""

import contextlib
import json
import os
import sys
import threading
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import commands
import numpy as np
import pytest
from serial.tools.list_ports_common import ListPortInfo

sys.path.append(str(Path(__file__).parents[1] / "drivers" / "serial"))
from pty_board import Plugged

from drivers.serial.nmea_emulator import NmeaEmulator
from drivers.serial.ubx_emulator import UbxEmulator
from hil.bridge import LoopOrder
from hil.geoid import undulation
from hil.scenario import Scenario
from hil.session import Session, simulated_head
from hil.world.aiding import SimulatedAiding
from nav.aiding import Kind, aiding_rows

DELAY_S = 0.08
ARMS = (1.5, 0.0, -1.0), (-2.0, 0.5, -1.0)
SCENARIO = Scenario.model_validate(
    {
        "name": "receivers",
        "duration_s": 25.0,
        "motion": {
            "rest_s": 8.0,
            "ramp_s": 3.0,
            "north": {"rate": 20.0, "sines": [{"amplitude": 60.0, "period_s": 25.0}]},
            "east": {"sines": [{"amplitude": 60.0, "period_s": 20.0}]},
        },
        "head": {"rate_hz": 200, "instruments": "dtg", "grade": "mems"},
        "navigation": {
            "alignment": "level",
            "align_s": 6.0,
            "aided": True,
            "start": {"heading_deg": 0.0, "latitude_deg": 50.0001},
        },
        "mavlink": {"links": []},
    }
)
SENSOR = {"rate_hz": 5.0, "delay_s": DELAY_S, "position_sigma_m": (0.3, 0.3, 0.6)}


class Sky:
    """Receivers that measure the simulated world in the time of a session, each on its pseudo-terminal."""

    def __init__(self, session: Session, plugs: list[tuple[Plugged, Any, tuple[float, ...]]], utc: datetime) -> None:
        self._session, self._utc, self._ended = session, utc, threading.Event()
        self._receivers = [
            (plug, emulator, SimulatedAiding(SCENARIO.with_changes(aiding={"gnss": [{**SENSOR, "lever_arm_m": arm}]})))
            for plug, emulator, arm in plugs
        ]
        self._thread = threading.Thread(target=self._send)
        self.sent = 0

    def _send(self) -> None:
        while not self._ended.wait(0.005):
            if (state := self._session.state()) is None:
                continue
            for plug, emulator, world in self._receivers:
                rows, _ = world.arrived(round(1e6 * float(state["time"])))
                for packet in emulator.packets(rows[-1:]):  # of what a busy machine kept from us, the newest
                    plug.send(packet)
                    self.sent += 1

    def __enter__(self) -> "Sky":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()


def flown(scenario: Scenario, ports: list[Path], emulators: list[Any], record: Path | None = None) -> dict[str, Any]:
    """The summary of a run in real time with `emulators` on `ports`."""
    receivers = [
        {"port": f"serial:{port}:115200", "lever_arm_m": arm, "delay_s": DELAY_S}
        for port, arm in zip(ports, ARMS, strict=False)
    ]
    chosen = scenario.with_changes(receiver=receivers, bus=f"unix:receivers-{time.monotonic_ns()}")
    order = LoopOrder(chosen, own_world=True)
    with contextlib.ExitStack() as stack:
        plugs = [stack.enter_context(Plugged(emulator, port)) for emulator, port in zip(emulators, ports, strict=True)]
        session = Session(order, feeder=simulated_head(order), record=record)
        with session:
            session.wait_ready()
            with Sky(session, list(zip(plugs, emulators, ARMS, strict=False)), datetime.now(UTC)):
                while session.running:
                    time.sleep(0.05)
    return session.summary()


@pytest.mark.alone
@pytest.mark.skipif(
    os.getloadavg()[0] > 2 * len(os.sched_getaffinity(0)),
    reason="head, loop, two receivers and their sky in real time: a starved machine shifts the times of the fixes",
)
def test_two_receivers_with_arms_of_their_own_hold_the_position(tmp_path: Path) -> None:
    """The start is 11 m to the north of the truth; the antennas are 3.5 m apart. The recording replays to the same bits."""
    file, utc = tmp_path / "gnss.dhil", datetime.now(UTC)
    emulators = [UbxEmulator(utc), NmeaEmulator(utc, undulation)]
    summary = flown(SCENARIO, [tmp_path / "ttyACM0", tmp_path / "ttyACM1"], emulators, file)
    assert summary["error"]["position_m"]["max"] > 8.0
    assert summary["error"]["position_m"]["final"] < 1.5
    assert not any(summary["aiding_faults"].values())
    receivers = summary["receivers"]
    assert [one["speaks"] for one in receivers] == ["ubx", "nmea"]
    assert all(one["skipped_bytes"] == 0 and one["fixes"] > 50 for one in receivers)
    assert all(0 < one["refused"].pop("clock settles") <= 15 and one["refused"] == {} for one in receivers)
    assert summary["aiding"] == {"GNSS": sum(one["sent"] for one in receivers)}
    assert "problems" not in summary
    # Both say how far the host's clock is from the emulators' sky, whose time began before the run: they must agree
    offsets = [one["host_minus_utc_s"] for one in receivers]
    assert offsets[0] == pytest.approx(offsets[1], abs=0.05)
    again = replayed(file)
    assert again["navigation_digest"] == summary["navigation_digest"]
    assert again["aiding"] == summary["aiding"]


def replayed(file: Path) -> dict[str, Any]:
    said, _ = commands.hil("replay", file, "--speed", "max", "--mavlink", "none", "--json")
    return dict(json.loads(said))


def test_arms_of_their_own_on_the_bus() -> None:
    """The same without the jitter of a busy machine: with one arm for both they contradict each other by 3.5 m."""
    sensors = [{**SENSOR, "lever_arm_m": arm} for arm in ARMS]
    scenario = SCENARIO.with_changes(bus="unix:receivers-bus", aiding={"gnss": sensors})
    order = LoopOrder(scenario, paced=False, own_world=True)
    with Session(order, feeder=simulated_head(order)) as session:
        session.wait_ready()
        while session.running:
            time.sleep(0.05)
    assert session.summary()["error"]["position_m"]["final"] < 0.5


STANDING = SCENARIO.with_changes(motion={"rest_s": 100.0}, navigation={"alignment": "truth"}, duration_s=6.0)
"""The vehicle stands in the whole run."""


class Steady:
    """A receiver that stands where the vehicle of `STANDING` does and speaks ten times a second, from a thread."""

    def __init__(self, plug: Plugged, emulator: Any) -> None:
        self._plug, self._emulator, self._ended = plug, emulator, threading.Event()
        self._thread = threading.Thread(target=self._send)

    def _send(self) -> None:
        began = time.monotonic()
        while not self._ended.wait(0.1):
            motion, now = STANDING.motion, time.monotonic() - began
            place = np.radians(motion.latitude_deg), np.radians(motion.longitude_deg), motion.height_m
            rows = aiding_rows([now], Kind.GNSS, [*place, 0.0, 0.0, 0.0], [0.5, 0.5, 1.0, 0.05, 0.05, 0.05])
            for packet in self._emulator.packets(rows):
                self._plug.send(packet)

    def __enter__(self) -> "Steady":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()


@pytest.fixture
def standing(tmp_path: Path) -> Path:
    """A file of `STANDING` without a bus: the run brings its own head."""
    path = tmp_path / "standing.toml"
    path.write_text(
        "duration_s = 6\n[head]\nrate_hz = 200\ninstruments = 'dtg'\ngrade = 'mems'\n"
        "[navigation]\nalignment = 'truth'\naided = true\n[mavlink]\nlinks = []\n"
    )
    return path


@pytest.fixture
def port_file(tmp_path: Path) -> Path:
    return tmp_path / "ttyACM0"


def gnss_run(
    standing: Path, port: Path, *more: object, baud: int = 115200, code: int = 0
) -> tuple[dict[str, Any], str]:
    out, err = commands.hil("run", standing, "--gnss", f"serial:{port}:{baud}", *more, "--json", code=code)
    return (json.loads(out) if out else {}), err


def test_the_command_tells_a_wrong_rate_and_finds_the_receiver(
    standing: Path, port_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.serial.probe.RATES", (115200, 9600))
    there = ListPortInfo(str(port_file), skip_link_detection=True)
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [there])
    emulator = UbxEmulator(datetime.now(UTC))
    with Plugged(emulator, port_file, only_baud=9600) as plug, Steady(plug, emulator):
        _, said = gnss_run(standing, port_file, code=2)
        assert f"but gnss at 9600 baud: use --gnss serial:{port_file}:9600" in said
        found, _ = commands.hil("doctor", "--probe", "--json")
    board = [one for one in json.loads(found)["findings"] if one["what"] == str(port_file)]
    assert [(one["verdict"], one["found"]) for one in board] == [("ok", f"hil run --gnss serial:{port_file}:9600")]


def test_a_receiver_on_the_port_of_the_board_is_recognised(port_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.serial.probe.RATES", (115200,))
    emulator = NmeaEmulator(datetime.now(UTC), undulation)
    with Plugged(emulator, port_file) as plug, Steady(plug, emulator):
        _, said = commands.hil("run", "--imu", "vectornav", "--bus", f"serial:{port_file}:115200", code=2)
    assert f"use --gnss serial:{port_file}:115200" in said


@pytest.mark.alone
def test_a_receiver_that_is_pulled_out_comes_back(standing: Path, port_file: Path) -> None:
    """Pulled out at two seconds of the run, put back a second later: the run goes on, and its summary says so."""
    utc, swapped = datetime.now(UTC), threading.Event()

    def swap(plug: Plugged, emulator: UbxEmulator) -> None:
        with plug, Steady(plug, emulator):
            while not plug.path.with_name("go").exists():
                time.sleep(0.02)
        time.sleep(1.0)
        with Plugged(emulator, port_file) as other, Steady(other, emulator):
            swapped.wait(60.0)

    emulator = UbxEmulator(utc)
    thread = threading.Thread(target=swap, args=(Plugged(emulator, port_file), emulator))
    thread.start()
    receivers = [{"port": f"serial:{port_file}:115200"}]
    order = LoopOrder(STANDING.with_changes(receiver=receivers, bus="unix:receivers-plug"), own_world=True)
    try:
        with Session(order, feeder=simulated_head(order)) as session:
            session.wait_ready()
            while session.running:
                state = session.state()
                if state is not None and state["time"] > 2.0:
                    port_file.with_name("go").touch()
                time.sleep(0.05)
    finally:
        port_file.with_name("go").touch()
        swapped.set()
        thread.join()
    summary = session.summary()
    receiver = summary["receivers"][0]
    assert summary["problems"] == [f"serial:{port_file}:115200 was lost 1 times"]
    assert 5 < receiver["sent"] < 55
    assert summary["error"]["position_m"]["final"] < 2.0
    assert summary["mode"] == "navigate"


def test_a_silent_port_is_told_and_the_run_goes_on(standing: Path, port_file: Path) -> None:
    with Plugged(None, port_file):
        summary, said = gnss_run(standing, port_file, "--duration", 2)
    assert "nothing comes; is the receiver powered" in said
    assert summary["problems"] == [f"serial:{port_file}:115200: nothing came"]
    assert summary["receivers"][0]["fixes"] == 0


def test_requests_that_cannot_be_met(standing: Path, port_file: Path) -> None:
    assert "no time in which a receiver could speak" in gnss_run(standing, port_file, "--speed", "max", code=2)[1]
    assert "there is no such port" in gnss_run(standing, port_file, code=2)[1]
    _, err = commands.hil("run", standing, "--gnss", "/dev/ttyACM0", code=2)
    assert "receiver.0.port" in err
    assert "serial:/dev/ttyACM0:115200" in err


def test_the_command_sets_a_receiver_up(port_file: Path) -> None:
    emulator = UbxEmulator(datetime.now(UTC))
    with Plugged(emulator, port_file):
        out, _ = commands.hil("configure", "ubx", "--bus", f"serial:{port_file}:115200", "--rate", 5, "--json")
    assert json.loads(out) == {"ports": ["UART1", "USB"], "rate_hz": 5.0}
    assert emulator.settings["CFG_RATE_MEAS"] == 200
