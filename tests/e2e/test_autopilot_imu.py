"""Another autopilot's MAVLink as the IMU of the loop: aligned, navigated, compared, recorded, replayed to the same bit."""

import contextlib
import socket
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers import driver_names
from drivers.can.bus import open_port
from drivers.can.frames import frames
from drivers.logs.recording import RecordingWriter
from drivers.mavlink.signing import EPOCH_S, TICKS
from hil.bridge import Loop, LoopOrder, Outlets
from hil.pytest_plugin import StartBridge
from hil.scenario import Scenario
from hil.source import FileSource
from nav.rotation import euler_from_quaternion
from nav.state import NAV_STATE

pytestmark = pytest.mark.skipif(
    "mavlink-imu" not in driver_names(), reason="installed before this driver was added: pip install -e ."
)
RATE_HZ, REST_S, TURN_S, TURN, START_DEG = 100, 2.0, 1.5, np.pi / 2.0, 30.0


def send(address: tuple[str, int], done: threading.Event, key: bytes = b"") -> None:
    """A level vehicle that stands, turns to the right by `TURN` and stands, as an autopilot tells it, five times as fast.

    With a `key` it signs, and somebody else tells of a wild turn in its name.
    """
    packer, forger = mav.MAVLink(None, 7, 1), mav.MAVLink(None, 7, 1)
    if key:
        packer.signing.secret_key, packer.signing.sign_outgoing = key, True
        packer.signing.timestamp = int((time.time() - EPOCH_S) * TICKS)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for k in range(round(RATE_HZ * (2.0 * REST_S + TURN_S))):
            since = k / RATE_HZ - REST_S
            turning = 0.0 <= since < TURN_S
            yaw = np.radians(START_DEG) + TURN * np.clip((since + 1.0 / RATE_HZ) / TURN_S, 0.0, 1.0)
            time_us = 10_000_000 + round(1e6 * k / RATE_HZ)
            for message in (
                mav.MAVLink_highres_imu_message(
                    time_us, 0.0, 0.0, -9.81, 0.0, 0.0, TURN / TURN_S * turning, *[0.0] * 7, 0b111111
                ),
                mav.MAVLink_attitude_message(time_us // 1000, 0.0, 0.0, yaw, 0.0, 0.0, 0.0),
            ):
                sock.sendto(bytes(message.pack(packer)), address)
                packer.seq = (packer.seq + 1) % 256
            if key:
                wild = mav.MAVLink_highres_imu_message(
                    time_us + 1000, 0.0, 0.0, -9.81, *[20.0] * 3, *[0.0] * 7, 0b111111
                )
                sock.sendto(bytes(wild.pack(forger)), address)
            time.sleep(0.2 / RATE_HZ)
    done.set()


def free_address() -> tuple[str, int]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        host, number = probe.getsockname()
    return str(host), int(number)


def finished(loop: Loop, outlets: Outlets) -> tuple[Any, dict[str, Any]]:
    row = np.zeros(1, NAV_STATE)
    assert outlets.states.latest(row)
    return row[0], loop.result()


def test_it_is_navigated_compared_and_replayed(tmp_path: Path) -> None:
    address = free_address()
    chosen = Scenario.model_validate(
        {
            "driver": "mavlink-imu",
            "bus": f"mavlink:udpin:127.0.0.1:{address[1]}",
            "navigation": {"alignment": "level", "align_s": 1.0, "start": {"heading_deg": START_DEG}},
        }
    )
    outlets, done, batch = Outlets.make(recording=False, readers=1), threading.Event(), frames(1024)
    loop, recording = Loop(LoopOrder(chosen), outlets), tmp_path / "autopilot.dhil"
    with (
        contextlib.closing(open_port(chosen.bus)) as port,
        RecordingWriter(recording, {"scenario": chosen.model_dump(mode="json")}) as writer,
    ):
        sender = threading.Thread(target=send, args=(address, done))
        sender.start()
        while (n := port.receive(batch, 0.2)) or not done.is_set():
            writer.write(batch[:n])
            loop.take(batch[:n])
        sender.join()
    row, result = finished(loop, outlets)
    assert np.degrees(euler_from_quaternion(row["q_nb"])[0]) == pytest.approx(START_DEG + 90.0, abs=0.1)
    assert result["head"]["message"] == "HIGHRES_IMU"
    assert result["other_attitude"]["compared"] > 100
    assert result["other_attitude"]["total_deg"]["max"] < 1.0  # one sample of the turn

    again_outlets = Outlets.make(recording=False, readers=1)
    again, source = (
        Loop(LoopOrder(chosen, file=recording, paced=False), again_outlets),
        FileSource(recording, paced=False),
    )
    while n := source.receive(batch, 0.0):
        again.take(batch[:n])
    _, replayed = finished(again, again_outlets)
    assert replayed["navigation_digest"] == result["navigation_digest"]


def test_a_run_with_a_key_navigates_by_the_signed_packets_alone(hil_bridge: StartBridge, tmp_path: Path) -> None:
    """Somebody who speaks in the autopilot's name and has no key is refused, counted and told, in a run with its processes."""
    key, address = tmp_path / "mavlink.key", free_address()
    key.touch(0o600)
    key.write_bytes(bytes(range(32)))
    navigation = {"alignment": "level", "align_s": 1.0, "start": {"heading_deg": START_DEG}, "silence_s": 1.0}
    bus = f"mavlink:udpin:127.0.0.1:{address[1]}?signing_key={key}"
    bridge = hil_bridge(simulate_head=False, bus=bus, driver="mavlink-imu", navigation=navigation)
    done, sent = threading.Event(), round(RATE_HZ * (2.0 * REST_S + TURN_S))
    send(address, done, key.read_bytes())
    deadline = time.monotonic() + 20.0
    while bridge.session.outlets.stats["samples"] < sent - 1 and time.monotonic() < deadline:
        assert bridge.session.running
        time.sleep(0.05)
    row, summary = bridge.state(), bridge.stop()
    assert np.degrees(euler_from_quaternion(row["q_nb"])[0]) == pytest.approx(START_DEG + 90.0, abs=0.1)
    assert summary["samples"] == sent - 1
    assert summary["refused"] == {"unsigned": sent}
    assert summary["problem"] == f"packets were refused: {sent} unsigned"
    assert any("packets are refused: unsigned" in text for _, severity, text in bridge.events() if severity == "error")
