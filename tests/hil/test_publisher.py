"""The publisher as it runs: a spawned process, fed through the ring, heard over UDP."""

import multiprocessing
import os
import signal
import socket
import time
from collections import Counter
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from hil.bridge import EVENTS
from hil.control import Control, run_part
from hil.publisher import Taps, run_publisher
from hil.ring import Ring, Wake
from hil.scenario import MavlinkConfig
from nav.rotation import euler_from_quaternion, quaternion_from_euler
from nav.state import NAV_STATE, Mode

SPAWN = multiprocessing.get_context("spawn")


class Running:
    """A publisher, its ring, and a ground station."""

    def __init__(self, **config: Any) -> None:
        self.client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.client.bind(("127.0.0.1", 0))
        self.client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 21)
        self.client.setblocking(False)
        self.mav = mav.MAVLink(None, 255, 190)
        self.ring = Ring(NAV_STATE, 1024, 1)
        self.control, self.stop = Control(), Wake()
        self.report, report = SPAWN.Pipe()
        links = config.pop("links", (f"udpout:127.0.0.1:{self.client.getsockname()[1]}",))
        self.events = Ring(EVENTS, 16, 0)
        taps = Taps(self.ring, 0, self.events, self.control)
        arguments = (MavlinkConfig(links=links, **config), taps, self.stop, report)
        self.process = SPAWN.Process(target=run_part, args=(taps.control, 0, False, run_publisher, *arguments))
        self.process.start()
        report.close()
        self.row = np.zeros(1, NAV_STATE)
        self.address: Any = None

    def feed(self, duration_s: float, rate_hz: float = 500.0, mode: Mode = Mode.NAVIGATE) -> list[Any]:
        """Push solutions of a turning vehicle in real time; returns (arrival time, message) heard meanwhile."""
        heard = []
        start_s, pushed = time.monotonic(), 0
        while (now_s := time.monotonic() - start_s) < duration_s:
            while pushed / rate_hz <= now_s:  # late ones too: the vehicle's time is the host's
                self.push(1.0 / rate_hz, mode)
                pushed += 1
            heard += self.hear()
            time.sleep(min(0.01, max(0.0, pushed / rate_hz - (time.monotonic() - start_s))))
        return heard

    def push(self, step_s: float, mode: Mode) -> None:
        row = self.row
        row["time"] += step_s
        row["sequence"] += 1
        row["mode"] = mode
        row["lat"], row["lon"], row["height"] = 0.87, 0.63, 150.0
        row["q_nb"] = quaternion_from_euler(0.1 * row["time"][0], 0.1, 0.2)
        row["arrival_ns"] = row["solution_ns"] = time.time_ns()
        self.ring.push(row)

    def hear(self) -> list[Any]:
        messages = []
        while True:
            try:
                data, self.address = self.client.recvfrom(65535)
            except BlockingIOError:
                return messages
            for message in self.mav.parse_buffer(data) or []:
                message.heard_ns = time.time_ns()
                messages.append(message)

    def end(self) -> dict[str, Any]:
        self.stop.call()
        assert self.report.poll(10.0)
        counters: dict[str, Any] = self.report.recv()
        self.process.join(10.0)
        assert self.process.exitcode == 0
        return counters


@pytest.fixture
def running() -> Iterator[Running]:
    made = Running()
    yield made
    made.process.kill()


def until(condition: Any, timeout_s: float = 20.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def types(messages: list[Any]) -> Counter[str]:
    return Counter(message.get_type() for message in messages)


def test_publishes_fresh_solutions_and_reports(running: Running) -> None:
    heard: list[Any] = []
    while not heard:  # the process starts
        heard += running.feed(0.2)
    heard += running.feed(4.0)
    counters = running.end()
    heard += running.hear()
    assert counters["sent"] == dict(types(heard))
    assert set(np.diff([m.get_seq() for m in heard]) % 256) == {1}
    attitudes = [m for m in heard if m.get_type() == "ATTITUDE"][-150:]
    span_s = (attitudes[-1].time_boot_ms - attitudes[0].time_boot_ms) * 1e-3
    assert (len(attitudes) - 1) / span_s == pytest.approx(50.0, rel=0.15)  # a starved publisher leaves some out
    for message in attitudes:
        heading, pitch, roll = euler_from_quaternion(quaternion_from_euler(1e-4 * message.time_boot_ms, 0.1, 0.2))
        assert message.yaw == pytest.approx(heading, abs=1e-4)
        assert (message.pitch, message.roll) == pytest.approx((pitch, roll), abs=1e-5)
    assert counters["latency_us"]["p50"] < 20e3  # younger than the interval between two
    assert counters["dropped"] == counters["bad_data"] == 0


def test_an_idle_publisher_still_beats_and_says_that_nothing_comes(running: Running) -> None:
    heard: list[Any] = []
    until(lambda: heard.extend(running.hear()) or heard)
    running.feed(0.5)
    heard = running.feed(2.6, rate_hz=0.1)
    assert types(heard)["HEARTBEAT"] in (2, 3)
    assert "No samples from the sensor" in [m.text for m in heard if m.get_type() == "STATUSTEXT"]
    assert [m for m in heard if m.get_type() == "HEARTBEAT"][-1].system_status == mav.MAV_STATE_CRITICAL
    recovered = running.feed(1.5)
    assert [m for m in recovered if m.get_type() == "HEARTBEAT"][-1].system_status == mav.MAV_STATE_ACTIVE
    running.end()


def test_home_is_where_navigation_began(running: Running) -> None:
    until(running.hear)
    assert "HOME_POSITION" not in types(running.feed(0.5, mode=Mode.ALIGN))
    heard = running.feed(5.5)
    home = next(m for m in heard if m.get_type() == "HOME_POSITION")
    assert home.latitude == pytest.approx(np.degrees(0.87) * 1e7, abs=1)
    local = [m for m in heard if m.get_type() == "LOCAL_POSITION_NED"][-1]
    assert max(abs(local.x), abs(local.y), abs(local.z)) < 1e-3
    running.end()


def test_a_request_to_align_reaches_the_loop(running: Running) -> None:
    until(lambda: "ATTITUDE" in types(running.feed(0.1)))
    command = mav.MAVLink_command_long_message(1, 1, mav.MAV_CMD_PREFLIGHT_CALIBRATION, 0, 1, 0, 0, 0, 0, 0, 0)
    running.client.sendto(command.pack(running.mav), running.address)
    heard: list[Any] = []
    until(lambda: heard.extend(running.hear()) or "COMMAND_ACK" in types(heard))
    assert running.control.align_requests == 1
    assert running.end()["received"] == {"COMMAND_LONG": 1}


def test_loss_of_samples_shows_in_the_status(running: Running) -> None:
    running.control.set_loss(20, 980)
    heard: list[Any] = []
    until(lambda: heard.extend(running.hear()) or types(heard)["SYS_STATUS"] > 1)
    assert [m for m in heard if m.get_type() == "SYS_STATUS"][-1].drop_rate_comm == 200
    running.end()


def test_events_for_ground_stations_are_told(running: Running) -> None:
    until(running.hear)
    running.feed(0.5)
    rows = np.zeros(2, EVENTS)
    rows["severity"], rows["text"] = b"warning", (b"between ourselves", b"GNSS position 0 is rejected: 12.3 sigma")
    rows["station"] = False, True
    running.events.push(rows)
    texts = [m.text for m in running.feed(2.0) if m.get_type() == "STATUSTEXT"]
    assert "GNSS position 0 is rejected: 12.3 sigma" in texts
    assert "between ourselves" not in texts
    running.end()


def test_every_link_is_served() -> None:
    ports = []
    for _ in range(2):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            ports.append(probe.getsockname()[1])
    running = Running(links=tuple(f"tcpin:127.0.0.1:{port}" for port in ports), rates_hz={"ATTITUDE": 10.0})
    clients: list[socket.socket] = []

    def connected() -> bool:
        try:
            clients.append(socket.create_connection(("127.0.0.1", ports[len(clients)]), timeout=5.0))
        except ConnectionRefusedError:
            return False
        return len(clients) == 2

    until(connected)
    for client in clients:
        assert client.recv(1, socket.MSG_PEEK)  # the publisher is at work
    running.feed(3.0)
    for client in clients:
        heard = mav.MAVLink(None).parse_buffer(client.recv(65536))
        times_ms = [m.time_boot_ms for m in heard if m.get_type() == "ATTITUDE"]
        assert len(times_ms) > 10
        assert np.median(np.diff(times_ms)) == pytest.approx(100.0, rel=0.3)  # neither the default 50 Hz nor 1 Hz
    counters = running.end()
    assert len(counters["links"]) == 2
    assert counters["sent"]["ATTITUDE"] == sum(link["sent"]["ATTITUDE"] for link in counters["links"].values())


def test_a_link_that_cannot_be_opened_is_reported() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"udpin:127.0.0.1:{taken.getsockname()[1]}"
        running = Running(links=(url,))
        assert running.report.poll(20.0)
        assert url in running.report.recv()["failed"]
        running.process.join(5.0)


def test_ctrl_c_is_left_to_the_parent(running: Running) -> None:
    until(running.hear)
    assert running.process.pid is not None
    os.kill(running.process.pid, signal.SIGINT)
    until(lambda: "HEARTBEAT" in types(running.hear()))
    running.end()


def test_a_publisher_does_not_outlive_its_parent(running: Running) -> None:
    until(running.hear)
    assert isinstance(running.report, Connection)
    running.report.close()
    running.process.join(5.0)
    assert running.process.exitcode == 0


def test_the_publisher_sleeps_between_messages(running: Running) -> None:
    until(lambda: running.feed(0.2))
    running.feed(0.5)
    before = cpu_s(running.process.pid)
    running.feed(3.0, rate_hz=1000.0)
    assert (cpu_s(running.process.pid) - before) / 3.0 < 0.25
    running.end()


def cpu_s(pid: int | None) -> float:
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
