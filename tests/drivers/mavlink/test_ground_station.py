"""What a ground station sets and fetches: home, parameters that stay, metadata by FTP, events; what it is shown of receivers."""

import json
import math
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink import extra
from drivers.mavlink.endpoint import Endpoint
from drivers.mavlink.events import EVENTS, KEPT, PACE_S
from drivers.mavlink.files import DATA, PAYLOAD, FileServer
from drivers.mavlink.intake import Intake
from drivers.mavlink.messages import FIX_S, gps_raw_int, heartbeat
from drivers.mavlink.metadata import checksum
from drivers.mavlink.options import LinkOptions
from drivers.mavlink.solution import Home
from drivers.mavlink.station import Identity, Station
from drivers.mavlink.store import Store
from nav.aiding import OPERATOR, RELAYED, Kind, aiding, of_receivers
from nav.state import NAV_STATE, Health, Mode

OPEN, READ, LIST, BURST, ACK, NAK = 4, 5, 3, 15, 128, 129


class Wire:
    """A link that keeps what is sent on it."""

    url, datagrams, gone = "wire", True, False

    def __init__(self) -> None:
        self.frames: list[bytes] = []
        self.waiting: list[bytes] = []

    def fileno(self) -> int:
        return -1

    def ready(self) -> bool:
        return True

    def heard(self) -> None:
        return

    def receive(self) -> bytes:
        return self.waiting.pop(0) if self.waiting else b""

    def send(self, frame: bytes) -> bool:
        self.frames.append(frame)
        return True

    def close(self) -> None:
        return


class Desk:
    """A navigating station, an endpoint and a ground station."""

    def __init__(self, store: Store | None = None, intake: Intake | None = None, **identity: Any) -> None:
        self.commands: list[str] = []
        rates = {"ATTITUDE": 40.0}
        self.station = Station(Identity(**identity), rates, lambda lat, lon: 20.0, self.commands.append, intake, store)
        self.wire = Wire()
        self.endpoint = Endpoint(self.station, self.wire, LinkOptions("wire"))
        self.client = mav.MAVLink(None, 255, 190)
        self.row, self.now_s = np.zeros(1, NAV_STATE), 10.0
        self.row["mode"], self.row["q_nb"], self.row["sigma"] = Mode.NAVIGATE, (1.0, 0.0, 0.0, 0.0), np.inf
        self.row["lat"], self.row["lon"], self.row["height"] = 0.87, 0.63, 150.0
        self.endpoint.wants_events = True
        self.tick()

    def tick(self, step_s: float = 1.0, **fields: Any) -> list[Any]:
        for name, value in fields.items():
            self.row[name] = value
        self.row["time"] += step_s
        self.now_s += step_s
        self.station.update(self.row[0], self.now_s)
        return self.poll()

    def poll(self) -> list[Any]:
        self.wire.frames.clear()
        self.endpoint.poll(self.now_s)
        return [message for frame in self.wire.frames for message in mav.MAVLink(None).parse_buffer(frame)]

    def ask(self, message: Any) -> list[Any]:
        self.wire.waiting.append(bytes(message.pack(self.client)))
        return self.poll()

    def command(self, number: int, *params: float) -> int:
        return the(self.ask(mav.MAVLink_command_long_message(1, 1, number, 0, *params)), "COMMAND_ACK").result

    def command_int(self, number: int, frame: int, *rest: float) -> int:
        message = mav.MAVLink_command_int_message(1, 1, frame, number, 0, 0, 0, 0, 0, 0, *rest)
        return the(self.ask(message), "COMMAND_ACK").result


def the(messages: list[Any], name: str) -> Any:
    (message,) = [message for message in messages if message.get_type() == name]
    return message


def test_our_extra_messages_have_the_checks_of_their_definitions() -> None:
    """CRC_EXTRA by the rule of the protocol, which gives that of pymavlink's own messages too."""
    kinds = (
        extra.ComponentMetadata,
        extra.Event,
        extra.CurrentEventSequence,
        extra.RequestEvent,
        extra.ResponseEventError,
    )
    for kind in (*kinds, mav.MAVLink_attitude_message, mav.MAVLink_param_value_message):
        text = f"{kind.msgname} ".encode()
        for place, field in enumerate(kind.ordered_fieldnames):
            text += f"{kind.fieldtypes[kind.fieldnames.index(field)]} {field} ".encode()
            if size := kind.array_lengths[place]:
                text += bytes([size])
        crc = mav.x25crc(bytearray(text)).crc
        assert (crc & 255) ^ (crc >> 8) == kind.crc_extra, kind.msgname


def test_home_is_set_from_the_map_and_told() -> None:
    desk = Desk()
    accepted, denied = mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_DENIED
    number = mav.MAV_CMD_DO_SET_HOME
    assert desk.command(number, 0, 0, 0, 0, 50.0, 36.0, 180.0) == accepted
    home = desk.station.situation.home
    assert home is not None
    assert (math.degrees(home.lat), math.degrees(home.lon), home.height) == pytest.approx((50.0, 36.0, 200.0))
    frames = (mav.MAV_FRAME_GLOBAL_INT, mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, mav.MAV_FRAME_LOCAL_NED)
    results = [desk.command_int(number, frame, 500000000, 360000000, 30.0) for frame in frames]
    assert results == [accepted, accepted, denied]
    home = desk.station.situation.home
    assert home is not None
    assert home.height == pytest.approx(30.0 + 20.0 + 30.0)
    told = the(
        desk.ask(mav.MAVLink_set_home_position_message(1, 510000000, 360000000, 10000, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)),
        "HOME_POSITION",
    )
    assert (told.latitude, told.longitude, told.altitude) == (510000000, 360000000, 10000)
    told = the(desk.ask(mav.MAVLink_set_gps_global_origin_message(1, 520000000, 360000000, 10000)), "HOME_POSITION")
    assert told.latitude == 520000000
    assert desk.command(number, 1, 0, 0, 0, 0, 0, 0) == accepted
    home = desk.station.situation.home
    assert home == Home(0.87, 0.63, 150.0)
    for wrong in ((91.0, 0.0, 0.0), (math.nan, 1.0, 0.0), (0.0, 0.0, 0.0), (50.0, 181.0, 0.0), (50.0, 36.0, math.inf)):
        assert desk.command(number, 0, 0, 0, 0, *wrong) == denied
    assert desk.station.situation.home == home


def test_home_is_moved_by_those_alone_whose_measurements_refer_to_it() -> None:
    desk = Desk(intake=Intake((7,), None, 0.0, lambda rows: None))
    before = desk.station.situation.home
    assert desk.command(mav.MAV_CMD_DO_SET_HOME, 0, 0, 0, 0, 50.0, 36.0, 180.0) == mav.MAV_RESULT_DENIED
    assert desk.station.situation.home == before


@pytest.mark.parametrize(
    ("params", "mode", "health", "result", "aligned"),
    [
        ((1, 0, 0, 0, 0, 0, 0), Mode.NAVIGATE, 0, mav.MAV_RESULT_ACCEPTED, True),
        ((1, 0, 0, 0, 0, 0, 0), Mode.NAVIGATE, Health.SILENT, mav.MAV_RESULT_TEMPORARILY_REJECTED, False),
        ((0, 1, 0, 0, 0, 0, 0), Mode.NAVIGATE, 0, mav.MAV_RESULT_UNSUPPORTED, False),
        ((0, 0, 0, 0, 1, 0, 0), Mode.NAVIGATE, 0, mav.MAV_RESULT_UNSUPPORTED, False),
        ((0, 0, 0, 0, 0, 0, 0), Mode.NAVIGATE, 0, mav.MAV_RESULT_UNSUPPORTED, False),
    ],
)
def test_a_calibration_does_what_it_says_or_nothing(
    params: tuple[float, ...], mode: Mode, health: int, result: int, aligned: bool
) -> None:
    desk = Desk()
    desk.tick(mode=mode, health=health)
    assert desk.command(mav.MAV_CMD_PREFLIGHT_CALIBRATION, *params) == result
    assert (desk.commands == ["align"]) == aligned


def put(desk: Desk, name: bytes, value: float) -> float:
    return float(
        the(
            desk.ask(mav.MAVLink_param_set_message(1, 1, name, value, mav.MAV_PARAM_TYPE_REAL32)), "PARAM_VALUE"
        ).param_value
    )


def test_parameters_outlive_the_run_until_the_scenario_says_otherwise(tmp_path: Path) -> None:
    store = Store(tmp_path / "parameters.json")
    first = Desk(store)
    assert put(first, b"SR_ATT_HZ", 10.0) == 10.0
    again = Desk(store)
    assert again.station.interval_s("ATTITUDE") == 0.1
    assert "SR_ATT_HZ is 10, kept from an earlier run" in [text for _, text in again.station.notes]
    edited = Station(Identity(), {"ATTITUDE": 80.0}, lambda lat, lon: 0.0, print, store=store)
    assert edited.interval_s("ATTITUDE") == 1.0 / 80.0
    assert again.command(mav.MAV_CMD_PREFLIGHT_STORAGE, 2, 0, 0, 0, 0, 0, 0) == mav.MAV_RESULT_ACCEPTED
    assert again.station.interval_s("ATTITUDE") == Desk(store).station.interval_s("ATTITUDE") == 1.0 / 40.0


@pytest.mark.parametrize(
    "kept",
    [
        {"SR_ATT_HZ": 3},
        {"SR_ATT_HZ": {"value": -5, "over": 40.0}},
        {"SR_ATT_HZ": {"value": "x", "over": 40.0}},
        {"NO_SUCH": {"value": 5, "over": 0}},
        {"SYSID_THISMAV": {"value": 9, "over": 1.0}},
    ],
)
def test_nonsense_that_was_kept_is_passed_over(tmp_path: Path, kept: Any) -> None:
    path = tmp_path / "parameters.json"
    path.write_text(json.dumps(kept))
    desk = Desk(Store(path))
    assert desk.station.interval_s("ATTITUDE") == 1.0 / 40.0
    assert desk.station.parameters.kept == {}


def test_a_place_that_cannot_be_written_costs_the_memory_alone(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    desk = Desk(Store(tmp_path / "gone" / "parameters.json"))
    desk.station.parameters._store = Store(tmp_path / "file" / "parameters.json")
    assert put(desk, b"SR_ATT_HZ", 10.0) == 10.0
    assert any("cannot be written" in text for _, text in desk.station.notes)


def request(opcode: int, path: str = "", *, session: int = 0, offset: int = 0, size: int | None = None) -> bytes:
    data = path.encode()
    head = struct.pack("<HBBBBBxI", 5, session, opcode, len(data) if size is None else size, 0, 0, offset)
    return (head + data).ljust(PAYLOAD, b"\0")


def replies(server: FileServer, *arguments: Any, **more: Any) -> list[tuple[int, int, int, int, int, bytes]]:
    """(number, session, opcode, complete, offset, data) of each."""
    found = []
    for payload in server.answers(request(*arguments, **more), (255, 190)):
        assert len(payload) == PAYLOAD
        number, session, opcode, size, asked, complete, offset = struct.unpack_from("<HBBBBBxI", payload)
        assert asked == arguments[0]
        found.append((number, session, opcode, complete, offset, payload[12 : 12 + size]))
    return found


def fetched(files: FileServer, name: str) -> bytes:
    ((_, session, opcode, _, _, size),) = replies(files, OPEN, name)
    assert opcode == ACK
    body = b""
    while True:
        part = replies(files, BURST, session=session, offset=len(body), size=DATA)
        if part[0][2] == NAK:
            assert part[0][5] == b"\x06"  # the end of the file
            break
        assert [p[3] for p in part] == [0] * (len(part) - 1) + [1]
        for _, _, _, _, offset, data in part:
            assert offset == len(body)
            body += data
    assert len(body) == struct.unpack("<I", size)[0]
    one_by_one = b"".join(
        replies(files, READ, session=session, offset=at, size=DATA)[0][5] for at in range(0, len(body), DATA)
    )
    assert one_by_one == body
    return body


def test_metadata_describe_every_parameter_and_event() -> None:
    desk = Desk()
    answer = desk.ask(mav.MAVLink_command_long_message(1, 1, mav.MAV_CMD_REQUEST_MESSAGE, 0, 397, 0, 0, 0, 0, 0, 0))
    general = the(answer, "COMPONENT_METADATA")
    files = FileServer(desk.station.files)
    name = re.fullmatch(r"mftp:///(.+)", general.uri.decode())
    assert name is not None
    body = fetched(files, name[1])
    assert checksum(body) == general.file_crc
    listed = {entry["type"]: entry for entry in json.loads(body)["metadataTypes"]}
    assert set(listed) == {1, 4}
    for entry in listed.values():
        assert checksum(fetched(files, entry["uri"].removeprefix("mftp:///"))) == entry["fileCrc"]
    rows = json.loads(desk.station.files["parameters.json"])["parameters"]
    sent = {
        m.param_id: m for m in desk.ask(mav.MAVLink_param_request_list_message(1, 1)) if m.get_type() == "PARAM_VALUE"
    }
    assert [row["name"] for row in rows] == list(sent)
    assert all(row["shortDesc"] for row in rows)
    for row in rows:
        if "max" in row:
            assert put(desk, row["name"].encode(), row["max"]) == row["max"]
            assert put(desk, row["name"].encode(), row["max"] + 1.0) == row["max"]
    events = json.loads(desk.station.files["events.json"])["components"]["1"]["event_groups"]["default"]["events"]
    assert {int(number) + (1 << 24) for number in events} == {kind.number for kind in EVENTS}
    assert len({kind.name for kind in EVENTS}) == len(EVENTS)


def test_checksum_is_that_of_the_protocol() -> None:
    """CRC-32 bit by bit: reversed 0x04C11DB7, begun with zero, not inverted."""
    for data in (b"", b"a", b"123456789", bytes(range(256)) * 3):
        crc = 0
        for byte in data:
            crc ^= byte
            for _ in range(8):
                crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
        assert checksum(data) == crc


def test_nothing_can_be_written_or_reached_beside_the_files() -> None:
    files = FileServer({"a.json": b"{}"})
    for path in ("/etc/passwd", "../a.json", "b.json", "", "@SYS/x"):
        assert replies(files, OPEN, path)[0][2] == NAK
    for opcode in (6, 7, 8, 9, 10, 11, 12, 13):
        ((*_, data),) = replies(files, opcode, "a.json")
        assert data == b"\x09"  # protected
    assert replies(files, LIST, "/")[0][5] == b"Fa.json\t2\0"
    assert replies(files, LIST, "/", offset=1)[0][5] == b"\x06"
    assert replies(files, READ, session=9)[0][5] == b"\x04"


def test_each_client_reads_its_own_file_and_few_are_remembered() -> None:
    server = FileServer({"a": b"A", "b": b"B"})
    for system in range(1, 30):
        list(server.answers(request(OPEN, "ab"[system % 2]), (system, 1)))
    for system, expected in ((29, b"B"), (28, b"A"), (1, b"\x04")):
        (payload,) = server.answers(request(READ, size=DATA), (system, 1))
        assert payload[12:13] == expected


@given(st.binary(min_size=PAYLOAD, max_size=PAYLOAD))
def test_any_request_is_survived(payload: bytes) -> None:
    assert all(len(answer) == PAYLOAD for answer in FileServer({"a": b"x" * 10000}).answers(payload, (1, 1)))


def events_in(messages: list[Any]) -> list[Any]:
    return [message for message in messages if message.get_type() == "EVENT"]


def test_events_are_numbered_and_can_be_asked_for_again() -> None:
    desk = Desk()
    desk.tick()
    (fault,) = events_in(desk.tick(health=Health.SENSOR))
    (over,) = events_in(desk.tick(health=0))
    assert (over.sequence - fault.sequence) % 65536 == 1
    words = json.loads(desk.station.files["events.json"])["components"]["1"]["event_groups"]["default"]["events"]
    assert words[str(fault.id & 0xFFFFFF)]["message"] == "The sensor reports a fault"
    assert words[str(over.id & 0xFFFFFF)]["name"] == "health_sensor_over"
    assert fault.log_levels == mav.MAV_SEVERITY_ERROR << 4 | mav.MAV_SEVERITY_ERROR
    again = events_in(desk.ask(extra.RequestEvent(1, 1, fault.sequence, over.sequence)))
    assert [event.to_dict() for event in again] == [fault.to_dict(), over.to_dict()]
    for k in range(KEPT + 3):
        desk.tick(health=Health.SENSOR if k % 2 == 0 else 0)
    error = the(desk.ask(extra.RequestEvent(1, 1, fault.sequence, fault.sequence)), "RESPONSE_EVENT_ERROR")
    assert error.sequence == fault.sequence
    oldest = events_in(
        desk.ask(extra.RequestEvent(1, 1, error.sequence_oldest_available, error.sequence_oldest_available))
    )
    assert len(oldest) == 1
    assert the(desk.tick(step_s=6.0), "CURRENT_EVENT_SEQUENCE").sequence == desk.station.events.newest


def test_events_go_to_those_who_know_them() -> None:
    """To others they look like losses: their parsers pass over them."""
    desk = Desk()
    desk.endpoint.wants_events = False
    shown = desk.tick(step_s=6.0, health=Health.SENSOR)
    assert not {"EVENT", "CURRENT_EVENT_SEQUENCE"} & {message.get_type() for message in shown}
    desk.command(mav.MAV_CMD_REQUEST_MESSAGE, extra.ComponentMetadata.id, 0, 0, 0, 0, 0, 0)
    assert events_in(desk.tick(health=0))


def test_a_flapping_flag_does_not_fill_the_events() -> None:
    desk = Desk()
    found = []
    for k in range(1000):
        found += events_in(desk.tick(step_s=0.01, health=Health.SENSOR * (k % 2)))
    assert len(found) <= 10.0 / PACE_S + 1


def fix(time: float = 11.0, source: int = 0, sigma: tuple[float, ...] = (2.0, 2.0, 3.0, 0.1, 0.1, 0.2)) -> Any:
    return aiding(time, Kind.GNSS, (0.871, 0.631, 160.0, 3.0, 4.0, 0.0), sigma, source)


def test_the_receivers_message_is_the_receivers() -> None:
    desk = Desk()

    def build() -> Any:
        return gps_raw_int(desk.station.solution, desk.station.situation)

    assert build().fix_type == mav.GPS_FIX_TYPE_NO_GPS
    desk.station.set_fix(fix(desk.row["time"][0]))
    told = build()
    assert told.fix_type == mav.GPS_FIX_TYPE_3D_FIX
    assert (told.lat, told.lon) == (
        round(math.degrees(0.871) * 1e7),
        round(math.degrees(0.631) * 1e7),
    )  # not our 0.87, 0.63
    assert (told.alt, told.alt_ellipsoid, told.vel) == (140000, 160000, 500)
    assert told.cog == round(100.0 * math.degrees(math.atan2(4.0, 3.0)))
    assert (told.h_acc, told.v_acc) == (round(1000.0 * math.hypot(2.0, 2.0)), 3000)
    desk.station.set_fix(fix(desk.row["time"][0], sigma=(2.0, 2.0, *[math.inf] * 4)))
    told = build()
    assert (told.fix_type, told.vel, told.cog, told.v_acc) == (mav.GPS_FIX_TYPE_2D_FIX, 65535, 65535, 0)
    desk.tick(step_s=FIX_S)
    told = build()
    assert (told.fix_type, told.lat) == (mav.GPS_FIX_TYPE_NO_FIX, 0)


def test_only_receivers_are_receivers() -> None:
    rows = np.array([fix(source=source) for source in (0, 3, RELAYED + 1, RELAYED + 16, OPERATOR)])
    assert of_receivers(rows).tolist() == [True, True, True, False, False]
    assert not of_receivers(np.array([aiding(0.0, Kind.HEADING, (1.0,), (0.1,))])).any()


def test_a_position_that_nothing_aids_is_shown_as_untrusted() -> None:
    desk = Desk()
    names = {"ESTIMATOR_STATUS", "EKF_STATUS_REPORT"}
    assert not names & {message.get_type() for message in desk.tick(health=0)}
    shown = desk.tick(health=Health.UNAIDED)
    for name in names:
        assert the(shown, name).flags == mav.ESTIMATOR_ATTITUDE
    assert math.isnan(the(shown, "ESTIMATOR_STATUS").pos_horiz_accuracy)


@pytest.mark.parametrize(("component", "autopilot"), [(1, mav.MAV_AUTOPILOT_GENERIC), (191, mav.MAV_AUTOPILOT_INVALID)])
def test_beside_an_autopilot_we_are_no_vehicle(component: int, autopilot: int) -> None:
    desk = Desk(component_id=component)
    beat = heartbeat(desk.station.solution, desk.station.situation)
    assert beat.autopilot == autopilot
    assert (beat.type == mav.MAV_TYPE_FIXED_WING) == (component == 1)
