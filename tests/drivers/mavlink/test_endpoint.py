"""The protocol on real sockets and a real pseudo-terminal, with pymavlink at the other end."""

import math
import os
import pty
import re
import select
import socket
import time
import tty
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink.commands import MESSAGE_NAMES
from drivers.mavlink.endpoint import Endpoint
from drivers.mavlink.link import Listener, UdpLink, open_link
from drivers.mavlink.messages import KINDS, ClockReading
from drivers.mavlink.station import Identity, Station
from nav.errors import HilError
from nav.state import NAV_STATE, Health, Mode

GCS = (255, 190)


class Bench:
    """A station on one link, and a ground station at the other end of it; time is told, not waited for."""

    def __init__(self, url: str, dial: Callable[[Any], tuple[Callable[[bytes], Any], Callable[[], bytes]]]) -> None:
        self.commands: list[str] = []
        self.station = Station(Identity(), {}, lambda lat, lon: 20.0, self.commands.append)
        self.station.set_clock(ClockReading(10**18, 1.0, 1.0, 0))
        self.link: Any = open_link(url)
        self.write, self.read = dial(self.link)
        if isinstance(self.link, Listener):
            select.select([self.link], [], [], 1.0)
            self.listener = self.link
            (self.link,) = self.listener.accept(1)
        self.endpoint = Endpoint(self.station, self.link)
        self.client = mav.MAVLink(None, *GCS)
        self.client.robust_parsing = True
        self.now_s = 1000.0
        self.row = np.zeros(1, NAV_STATE)
        self.set(mode=Mode.NAVIGATE, lat=0.87, lon=0.63, height=150.0, q_nb=(1.0, 0.0, 0.0, 0.0), f_b=(0, 0, -9.8))

    def set(self, **fields: Any) -> None:
        for name, value in fields.items():
            self.row[name] = value

    def tell(self, message: Any) -> None:
        self.write(message.pack(self.client))
        self.client.seq = (self.client.seq + 1) % 256

    def heard(self) -> list[Any]:
        messages = []
        while data := self.read():
            messages += self.client.parse_buffer(data) or []
        assert not [m for m in messages if m.get_type() == "BAD_DATA"]
        return messages

    def settle(self) -> list[Any]:
        """Let what was told arrive, and hear the answers."""
        messages = []
        select.select([self.link], [], [], 0.5)
        for _ in range(3):
            self.endpoint.poll(self.now_s)
            time.sleep(0.002)
            messages += self.heard()
        return messages

    def ask(self, message: Any) -> list[Any]:
        self.tell(message)
        return self.settle()

    def command(self, number: int, *params: float, target: tuple[int, int] = (1, 1)) -> list[Any]:
        p = [*params, *[0.0] * (7 - len(params))]
        return self.ask(mav.MAVLink_command_long_message(*target, number, 0, *p))

    def run(self, duration_s: float, rate_hz: float = 200.0) -> list[Any]:
        """Let device and host time pass with a solution every 1 / rate_hz."""
        messages = []
        for _ in range(round(duration_s * rate_hz)):
            self.now_s += 1.0 / rate_hz
            self.row["time"] += 1.0 / rate_hz
            self.station.update(self.row[0], self.now_s)
            self.endpoint.poll(self.now_s)
            messages += self.heard()
        return messages


def over_udp(link: UdpLink) -> tuple[Callable[[bytes], Any], Callable[[], bytes]]:
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.connect(("127.0.0.1", link.port))
    client.setblocking(False)
    return client.send, lambda: quiet(lambda: client.recv(65535))


def over_tcp(link: Listener) -> tuple[Callable[[bytes], Any], Callable[[], bytes]]:
    client = socket.create_connection(("127.0.0.1", link.port))
    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    client.setblocking(False)
    return client.send, lambda: quiet(lambda: client.recv(65535))


def quiet(read: Callable[[], bytes]) -> bytes:
    try:
        return read()
    except BlockingIOError:
        return b""


def types(messages: list[Any]) -> Counter[str]:
    return Counter(message.get_type() for message in messages)


def the(messages: list[Any], name: str) -> Any:
    (message,) = [m for m in messages if m.get_type() == name]
    return message


@pytest.fixture(params=["udpin", "tcpin"])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    made = Bench(f"{request.param}:127.0.0.1:0", over_udp if request.param == "udpin" else over_tcp)
    made.ask(mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3))
    made.run(0.02)
    yield made
    made.link.close()


def test_rates_are_the_built_in_ones_and_nothing_is_lost(bench: Bench) -> None:
    messages = bench.run(10.0)
    counts = types(messages)
    for name, kind in KINDS.items():
        assert counts[name] == pytest.approx(10.0 * kind.rate_hz, abs=1.01), name
    sequence = np.array([m.get_seq() for m in messages])
    assert set(np.diff(sequence) % 256) == {1}


def test_a_solution_is_sent_once_however_slow_the_sensor(bench: Bench) -> None:
    messages = bench.run(4.0, rate_hz=20.0)
    times = [m.time_boot_ms for m in messages if m.get_type() == "ATTITUDE"]
    assert len(times) == 80
    assert len(set(times)) == 80
    before = sum(bench.endpoint.sent.values())
    for _ in range(100):
        bench.now_s += 0.01
        bench.endpoint.poll(bench.now_s)
    after = types(bench.heard())
    assert set(after) <= {"HEARTBEAT", "SYS_STATUS", "HOME_POSITION"}
    assert sum(bench.endpoint.sent.values()) - before == after.total()


def test_every_command_is_acknowledged(bench: Bench) -> None:
    for number in (mav.MAV_CMD_NAV_TAKEOFF, mav.MAV_CMD_COMPONENT_ARM_DISARM, 31999, 65535):
        ack = the(bench.command(number), "COMMAND_ACK")
        assert (ack.command, ack.result) == (number, mav.MAV_RESULT_UNSUPPORTED)
        assert (ack.target_system, ack.target_component) == GCS
    ack = the(
        bench.ask(mav.MAVLink_command_int_message(1, 0, 0, mav.MAV_CMD_DO_REPOSITION, 0, 0, 0, 0, 0, 0, 0, 0, 0)),
        "COMMAND_ACK",
    )
    assert ack.result == mav.MAV_RESULT_UNSUPPORTED
    assert "COMMAND_ACK" in types(bench.command(31999, target=(0, 0)))
    for target in ((2, 1), (1, 2), (7, 0)):
        assert "COMMAND_ACK" not in types(bench.command(31999, target=target))


def test_set_message_interval_changes_this_link(bench: Bench) -> None:
    attitude = mav.MAVLINK_MSG_ID_ATTITUDE
    results = []
    for interval_us, count in ((10_000.0, 200), (-1.0, 0), (0.0, 100)):
        results.append(the(bench.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, attitude, interval_us), "COMMAND_ACK"))
        bench.run(0.1)
        assert types(bench.run(2.0))["ATTITUDE"] == pytest.approx(count, abs=1.01)
        told = the(bench.command(mav.MAV_CMD_GET_MESSAGE_INTERVAL, attitude), "MESSAGE_INTERVAL")
        assert told.interval_us == {10_000.0: 10_000, -1.0: -1, 0.0: 20_000}[interval_us]
    assert {ack.result for ack in results} == {mav.MAV_RESULT_ACCEPTED}


@pytest.mark.parametrize(
    ("number", "interval_us", "result"),
    [
        (12345, 1e5, mav.MAV_RESULT_UNSUPPORTED),
        (math.nan, 1e5, mav.MAV_RESULT_UNSUPPORTED),
        (mav.MAVLINK_MSG_ID_ATTITUDE, math.nan, mav.MAV_RESULT_DENIED),
        (mav.MAVLINK_MSG_ID_ATTITUDE, -7.0, mav.MAV_RESULT_DENIED),
        (mav.MAVLINK_MSG_ID_ATTITUDE, 10.0, mav.MAV_RESULT_DENIED),
        (mav.MAVLINK_MSG_ID_HEARTBEAT, -1.0, mav.MAV_RESULT_DENIED),
        (mav.MAVLINK_MSG_ID_HEARTBEAT, 1e7, mav.MAV_RESULT_DENIED),
    ],
)
def test_wrong_intervals_are_refused(bench: Bench, number: float, interval_us: float, result: int) -> None:
    assert the(bench.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, number, interval_us), "COMMAND_ACK").result == result


def test_an_interval_longer_than_can_be_told(bench: Bench) -> None:
    bench.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_ATTITUDE, 1e10)
    told = the(bench.command(mav.MAV_CMD_GET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_ATTITUDE), "MESSAGE_INTERVAL")
    assert told.interval_us == 2**31 - 1


def test_messages_of_numbers_nobody_knows_are_counted_as_one(bench: Bench) -> None:
    for number in range(0x500000, 0x500032):
        bench.write(b"\xfd\0\0\0\0\xff\x01" + number.to_bytes(3, "little") + b"\0\0")
    bench.settle()
    while bench.endpoint.received["UNKNOWN"] < 50:
        bench.settle()
    assert set(bench.endpoint.received) <= {"UNKNOWN", "HEARTBEAT"}


def test_interval_of_a_message_we_do_not_have(bench: Bench) -> None:
    assert the(bench.command(mav.MAV_CMD_GET_MESSAGE_INTERVAL, 12345), "MESSAGE_INTERVAL").interval_us == 0


@pytest.mark.parametrize("number", MESSAGE_NAMES)
def test_request_message_sends_it(bench: Bench, number: int) -> None:
    bench.run(0.5)
    answers = bench.command(mav.MAV_CMD_REQUEST_MESSAGE, number)
    assert the(answers, "COMMAND_ACK").result == mav.MAV_RESULT_ACCEPTED
    assert types(answers)[MESSAGE_NAMES[number]] == 1


def test_request_of_what_is_not_there_yet() -> None:
    bench = Bench("udpin:127.0.0.1:0", over_udp)
    answers = bench.command(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_HOME_POSITION)
    assert the(answers, "COMMAND_ACK").result == mav.MAV_RESULT_TEMPORARILY_REJECTED
    bench.link.close()


def test_autopilot_version_is_real(bench: Bench) -> None:
    version = the(bench.command(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION), "AUTOPILOT_VERSION")
    assert version.flight_sw_version >> 8 > 0
    assert version.capabilities & mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    assert not version.capabilities & (
        mav.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE | mav.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY
    )
    assert "AUTOPILOT_VERSION" in types(bench.command(mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1))


def test_request_data_stream(bench: Bench) -> None:
    bench.ask(mav.MAVLink_request_data_stream_message(1, 1, mav.MAV_DATA_STREAM_EXTRA1, 10, 1))
    bench.run(0.2)
    counts = types(bench.run(4.0))
    assert counts["ATTITUDE"] == pytest.approx(40, abs=1.01)
    assert counts["GLOBAL_POSITION_INT"] == pytest.approx(40, abs=1.01)
    bench.ask(mav.MAVLink_request_data_stream_message(1, 1, mav.MAV_DATA_STREAM_ALL, 4, 0))
    counts = types(bench.run(4.0))
    assert set(counts) <= {"HEARTBEAT", "HOME_POSITION"}
    assert counts["HEARTBEAT"] == pytest.approx(4, abs=1.01)


def test_parameters_are_listed_densely_and_read_both_ways(bench: Bench) -> None:
    listed = [m for m in bench.ask(mav.MAVLink_param_request_list_message(1, 1)) if m.get_type() == "PARAM_VALUE"]
    assert [m.param_index for m in listed] == list(range(len(listed)))
    assert {m.param_count for m in listed} == {len(listed)}
    assert len({m.param_id for m in listed}) == len(listed)
    assert all(re.fullmatch(r"[A-Z0-9_]{1,16}", m.param_id) for m in listed)
    by_name = the(bench.ask(mav.MAVLink_param_request_read_message(1, 1, b"SR_ATT_HZ", -1)), "PARAM_VALUE")
    by_index = the(bench.ask(mav.MAVLink_param_request_read_message(1, 1, b"", by_name.param_index)), "PARAM_VALUE")
    assert by_name.to_dict() == by_index.to_dict()
    assert by_name.param_value == 50.0
    for name, index in ((b"NO_SUCH", -1), (b"", 999), (b"", -2)):
        assert "PARAM_VALUE" not in types(bench.ask(mav.MAVLink_param_request_read_message(1, 1, name, index)))


def test_parameters_are_set_within_bounds(bench: Bench) -> None:
    real = mav.MAV_PARAM_TYPE_REAL32

    def put(name: bytes, value: float, kind: int = real) -> Any:
        return the(bench.ask(mav.MAVLink_param_set_message(1, 1, name, value, kind)), "PARAM_VALUE").param_value

    assert put(b"SR_ATT_HZ", 100.0) == 100.0
    bench.run(0.1)
    assert types(bench.run(2.0))["ATTITUDE"] == pytest.approx(200, abs=1.01)
    for wrong in (-1.0, 1e6, math.nan, math.inf):
        assert put(b"SR_ATT_HZ", wrong) == 100.0
    assert put(b"SR_ATT_HZ", 5.0, mav.MAV_PARAM_TYPE_INT32) == 100.0
    assert put(b"SR_BEAT_HZ", 0.0) == 1.0
    assert put(b"SYSID_THISMAV", 9.0) == 1.0
    assert "PARAM_VALUE" not in types(bench.ask(mav.MAVLink_param_set_message(1, 1, b"NO_SUCH", 1.0, real)))


@pytest.mark.parametrize("kind", [0, 1, 2, 255])
def test_there_is_no_mission(bench: Bench, kind: int) -> None:
    count = the(bench.ask(mav.MAVLink_mission_request_list_message(1, 1, kind)), "MISSION_COUNT")
    assert (count.count, count.mission_type) == (0, kind)
    assert (count.target_system, count.target_component) == GCS
    ack = the(bench.ask(mav.MAVLink_mission_count_message(1, 1, 3, kind)), "MISSION_ACK")
    assert (ack.type, ack.mission_type) == (mav.MAV_MISSION_UNSUPPORTED, kind)
    ack = the(bench.ask(mav.MAVLink_mission_clear_all_message(1, 1, kind)), "MISSION_ACK")
    assert ack.type == mav.MAV_MISSION_ACCEPTED


def test_timesync_answers_questions_only_and_in_device_time(bench: Bench) -> None:
    bench.run(0.5)
    answer = the(bench.ask(mav.MAVLink_timesync_message(0, 987654321)), "TIMESYNC")
    assert answer.ts1 == 987654321
    assert answer.tc1 * 1e-9 == pytest.approx(bench.row["time"][0], abs=1e-6)
    assert "TIMESYNC" not in types(bench.ask(mav.MAVLink_timesync_message(5, 987654321)))


def test_ping_and_file_requests_are_answered(bench: Bench) -> None:
    ping = the(bench.ask(mav.MAVLink_ping_message(123, 7, 0, 0)), "PING")
    assert (ping.time_usec, ping.seq, ping.target_system, ping.target_component) == (123, 7, *GCS)
    assert "PING" not in types(bench.ask(mav.MAVLink_ping_message(123, 7, 1, 1)))
    payload = [5, 0, 0, 4, 10, *[0] * 246]
    nak = the(bench.ask(mav.MAVLink_file_transfer_protocol_message(0, 1, 1, payload)), "FILE_TRANSFER_PROTOCOL")
    assert nak.payload[:2] == [6, 0]
    assert nak.payload[3:6] == [129, 1, 4]


def test_calibration_asks_for_an_alignment(bench: Bench) -> None:
    ack = the(bench.command(mav.MAV_CMD_PREFLIGHT_CALIBRATION, 1), "COMMAND_ACK")
    assert ack.result == mav.MAV_RESULT_ACCEPTED
    assert bench.commands == ["align"]
    ack = the(bench.command(mav.MAV_CMD_PREFLIGHT_CALIBRATION, 0, 1), "COMMAND_ACK")
    assert ack.result == mav.MAV_RESULT_UNSUPPORTED
    assert bench.commands == ["align"]


def test_changes_are_told_once_in_words(bench: Bench) -> None:
    bench.run(1.0)
    assert "STATUSTEXT" not in types(bench.run(2.0))
    bench.set(mode=Mode.DEGRADED, health=Health.SENSOR)
    texts = [(m.severity, m.text) for m in bench.run(2.0) if m.get_type() == "STATUSTEXT"]
    assert texts == [
        (mav.MAV_SEVERITY_WARNING, "Navigation degraded"),
        (mav.MAV_SEVERITY_ERROR, "The sensor reports a fault"),
    ]
    bench.set(mode=Mode.NAVIGATE, health=0)
    texts = [(m.severity, m.text) for m in bench.run(2.0) if m.get_type() == "STATUSTEXT"]
    assert texts == [
        (mav.MAV_SEVERITY_INFO, "Navigating"),
        (mav.MAV_SEVERITY_INFO, "Over: The sensor reports a fault"),
    ]


def test_notes_are_told_once_on_every_link_and_in_order(bench: Bench) -> None:
    bench.run(1.0)
    long = "the filter had diverged: it starts again where GNSS says"
    bench.station.tell("warning", "GNSS position 0 is rejected: 12.3 sigma")
    bench.station.tell("notice", long)
    told = [m for m in bench.run(3.0) if m.get_type() == "STATUSTEXT"]
    assert (told[0].severity, told[0].text) == (mav.MAV_SEVERITY_WARNING, "GNSS position 0 is rejected: 12.3 sigma")
    assert (told[0].id, told[0].chunk_seq) == (0, 0)
    assert {m.id for m in told[1:]} == {1}
    assert [m.chunk_seq for m in told[1:]] == [0, 1]
    assert "".join(m.text for m in told[1:]) == long


def test_of_too_many_notes_the_newest_are_told(bench: Bench) -> None:
    bench.run(1.0)
    for k in range(100):
        bench.station.tell("info", f"note {k}")
    told = [m.text for m in bench.run(20.0, rate_hz=20.0) if m.get_type() == "STATUSTEXT"]
    assert told == [f"note {k}" for k in range(84, 100)]


def test_a_flapping_flag_does_not_fill_the_link(bench: Bench) -> None:
    said = 0
    for k in range(200):
        bench.set(health=Health.SENSOR if k % 2 else 0)
        said += types(bench.run(0.015))["STATUSTEXT"]
    assert said <= 7


def test_our_own_messages_looped_back_are_ignored(bench: Bench) -> None:
    received = dict(bench.endpoint.received)
    echo = mav.MAVLink(None, 1, 1)
    bench.write(mav.MAVLink_command_long_message(1, 1, 31999, 0, *[0.0] * 7).pack(echo))
    assert "COMMAND_ACK" not in types(bench.settle())
    assert bench.endpoint.received == received


def test_garbage_is_counted_and_does_not_cost_the_next_message(bench: Bench) -> None:
    for garbage in (b"\xfd\xff" + b"\x00" * 40, b"hello\n" * 50, os.urandom(3000)):
        bench.write(garbage)
        bench.settle()
        for _ in range(20):  # on a stream a false header swallows what follows, until it proves false
            if "PING" in types(bench.ask(mav.MAVLink_ping_message(1, 1, 0, 0))):
                break
        else:
            pytest.fail("the endpoint did not recover")
    assert bench.endpoint.bad_data > 0


@pytest.fixture(scope="module")
def patient() -> Iterator[Bench]:
    made = Bench("udpin:127.0.0.1:0", over_udp)
    yield made
    made.link.close()


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.binary(min_size=1, max_size=300), max_size=10))
def test_random_bytes_do_no_harm(patient: Bench, pieces: list[bytes]) -> None:
    for piece in pieces:
        patient.write(piece)
    for _ in range(12):
        patient.endpoint.poll(patient.now_s)
    patient.heard()
    assert "PING" in types(patient.ask(mav.MAVLink_ping_message(1, 1, 0, 0)))


ASKING = [
    mav.MAVLink_command_long_message,
    mav.MAVLink_command_int_message,
    mav.MAVLink_request_data_stream_message,
    mav.MAVLink_param_request_read_message,
    mav.MAVLink_param_set_message,
    mav.MAVLink_mission_request_list_message,
    mav.MAVLink_timesync_message,
    mav.MAVLink_ping_message,
    mav.MAVLink_file_transfer_protocol_message,
]


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(ASKING), st.data())
def test_well_formed_requests_with_any_content_do_no_harm(patient: Bench, kind: Any, data: st.DataObject) -> None:
    """Any payload under a right checksum, addressed to us where it has an address."""
    payload = bytearray(data.draw(st.binary(min_size=kind.unpacker.size, max_size=kind.unpacker.size)))
    message = kind(*kind.unpacker.unpack(payload)[:0], **_zeros(kind))
    patient.write(_framed(message, bytes(payload)))
    patient.settle()
    patient.now_s += 1.0
    assert "PING" in types(patient.ask(mav.MAVLink_ping_message(1, 1, 0, 0)))


def _zeros(kind: Any) -> dict[str, Any]:
    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    texts = {"param_id": b""}
    return {name: texts.get(name, [0] * lengths[name] if lengths[name] else 0) for name in kind.fieldnames}


def _framed(message: Any, payload: bytes) -> bytes:
    """`payload` in the frame of `message`."""
    header = bytes([0xFD, len(payload), 0, 0, 0, *GCS]) + message.id.to_bytes(3, "little")
    crc = mav.x25crc(bytearray(header[1:] + payload + bytes([message.crc_extra]))).crc
    return header + payload + crc.to_bytes(2, "little")


def test_a_flood_does_not_hold_up_what_is_due() -> None:
    bench = Bench("udpin:127.0.0.1:0", over_udp)
    bench.run(0.1)
    worst = 0.0
    for _ in range(50):
        for _ in range(20):
            try:
                bench.write(b"\xfd\xfe" * 700)
            except BlockingIOError:
                break
        start = time.perf_counter()
        bench.endpoint.poll(bench.now_s)
        worst = max(worst, time.perf_counter() - start)
    assert worst < 0.1
    assert len(bench.endpoint._parser.buf) < 1000  # nothing piles up
    bench.link.close()


def test_serial_link_over_a_pseudo_terminal() -> None:
    master, slave = pty.openpty()
    tty.setraw(master)
    os.set_blocking(master, False)

    def dial(_: Any) -> tuple[Callable[[bytes], Any], Callable[[], bytes]]:
        return lambda data: os.write(master, data), lambda: quiet(lambda: os.read(master, 65535))

    bench = Bench(f"serial:{os.ttyname(slave)}:57600", dial)
    os.close(slave)
    assert types(bench.run(2.0))["ATTITUDE"] == pytest.approx(100, abs=1.01)
    assert the(bench.command(31999), "COMMAND_ACK").result == mav.MAV_RESULT_UNSUPPORTED
    os.close(master)  # unplugged: survives, drops
    for _ in range(3):
        bench.now_s += 0.1
        bench.endpoint.poll(bench.now_s)
    assert not bench.link.send(b"x")
    bench.link.close()


def test_a_slow_tcp_peer_gets_whole_frames_or_none() -> None:
    bench = Bench("tcpin:127.0.0.1:0", over_tcp)
    bench.settle()
    for _ in range(40000):  # the peer does not read
        bench.now_s += 0.05
        bench.row["time"] += 0.05
        bench.station.update(bench.row[0], bench.now_s)
        bench.endpoint.poll(bench.now_s)
        if bench.endpoint.dropped > 500:
            break
    assert bench.endpoint.dropped > 500
    received = 0
    for _ in range(50):
        received += len(bench.heard())  # asserts that every frame is whole
        time.sleep(0.001)
    assert received > 100
    bench.link.close()


def test_tcp_client_comes_back_when_its_server_does() -> None:
    server = socket.create_server(("127.0.0.1", 0))
    port = server.getsockname()[1]
    server.close()
    link = open_link(f"tcp:127.0.0.1:{port}")  # nobody there: no error
    endpoint = Endpoint(Station(Identity(), {}, lambda lat, lon: 0.0, print), link)
    endpoint.poll(0.0)
    time.sleep(0.05)
    endpoint.poll(0.1)
    assert endpoint.sent.total() == 0
    with socket.create_server(("127.0.0.1", port)) as server:
        server.settimeout(0.05)
        deadline = time.monotonic() + 5.0
        now_s = 1.0
        client = None
        while client is None and time.monotonic() < deadline:
            now_s += 0.05
            endpoint.poll(now_s)
            try:
                client, _ = server.accept()
            except TimeoutError:
                continue
        assert client is not None
        for _ in range(30):
            now_s += 0.1
            endpoint.poll(now_s)
        assert types(mav.MAVLink(None).parse_buffer(client.recv(4096)))["HEARTBEAT"] > 0
        client.close()
    link.close()


def test_udpout_survives_a_refusing_peer_and_hears_only_it() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        link = open_link(f"udpout:127.0.0.1:{peer.getsockname()[1]}")
        assert link.send(b"one")
        data, address = peer.recvfrom(10)
        assert data == b"one"
        peer.sendto(b"two", address)
        time.sleep(0.01)
        assert link.receive() == b"two"
    for _ in range(5):
        link.send(b"nobody")
        link.receive()
    link.close()


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("nonsense", "expected one of udpout:HOST:PORT"),
        ("tls:127.0.0.1:1", "unknown kind 'tls'"),
        ("udpin:14550", "host or port missing"),
        ("udpin::14550", "host or port missing"),
        ("tcp:127.0.0.1", "host or port missing"),
        ("udpout:127.0.0.1:99999", "port '99999'"),
        ("udpout:127.0.0.1:0", "port '0'"),
        ("udpout:127.0.0.1:http", "port 'http'"),
        ("udpout:no.such.host.invalid:14550", "unknown host"),
        ("serial:/dev/ttyS0", "device or baud rate missing"),
        ("serial:/dev/no-such-device:57600", "/dev/no-such-device"),
        ("serial:/dev/ttyS0:fast", "baud rate 'fast'"),
    ],
)
def test_wrong_urls_are_explained(url: str, says: str) -> None:
    with pytest.raises(HilError, match=re.escape(says)) as caught:
        open_link(url)
    assert url in str(caught.value)


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
def test_port_in_use_is_explained(kind: str) -> None:
    first: Any = open_link(f"{kind}:127.0.0.1:0")
    url = f"{kind}:127.0.0.1:{first.port}"
    with pytest.raises(HilError, match=re.escape(url) + ".*in use"):
        open_link(url)
    first.close()


def test_wrong_settings_are_explained() -> None:
    for rates, says in (({"ATTITUD": 5.0}, "ATTITUD: unknown message; expected one of ATTITUDE, "),
                        ({"ATTITUDE": -1.0}, "ATTITUDE = -1.0: expected 0 to 1000"),
                        ({"HEARTBEAT": 0.0}, "HEARTBEAT = 0.0: expected 0.5 to 1000")):  # fmt: skip
        with pytest.raises(HilError, match=re.escape(says)):
            Station(Identity(), rates, lambda lat, lon: 0.0, print)
    with pytest.raises(HilError, match="balloon"):
        Station(Identity(vehicle="balloon"), {}, lambda lat, lon: 0.0, print)
