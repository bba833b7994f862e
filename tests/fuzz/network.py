"""Fuzz target: MAVLink from the network."""

import re
import struct
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from fuzz.wires import cut
from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.can.aiding import AidingEncoder
from drivers.mavlink.endpoint import Endpoint
from drivers.mavlink.intake import Intake
from drivers.mavlink.messages import KINDS
from drivers.mavlink.station import Identity, Station
from nav.state import NAV_STATE, Mode

_MARKER = re.compile(b"[\xfd\xfe]")
HEARD = ("GPS_INPUT", "VISION_POSITION_ESTIMATE", "ODOMETRY", "GLOBAL_POSITION_INT", "ATTITUDE_QUATERNION")
ASKED = (
    *("COMMAND_LONG", "COMMAND_INT", "REQUEST_DATA_STREAM", "PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET"),
    *("MISSION_REQUEST_LIST", "MISSION_REQUEST_INT", "MISSION_COUNT", "MISSION_CLEAR_ALL", "TIMESYNC", "PING"),
    *("FILE_TRANSFER_PROTOCOL", "HEARTBEAT"),
)
COMMANDS = (
    *("SET_MESSAGE_INTERVAL", "GET_MESSAGE_INTERVAL", "REQUEST_MESSAGE", "PREFLIGHT_CALIBRATION"),
    *("EXTERNAL_POSITION_ESTIMATE", "FIXED_MAG_CAL_YAW", "GET_HOME_POSITION"),
)


class Wire:
    """A link whose other end has sent `pieces`; satisfies `drivers.mavlink.link.Link`."""

    url = "fuzz:"

    def __init__(self, pieces: list[bytes], *, datagrams: bool) -> None:
        self.pieces, self.datagrams = pieces[::-1], datagrams
        self.sent: list[bytes] = []

    def fileno(self) -> int:
        """See `Link.fileno`."""
        return -1

    def ready(self) -> bool:
        """See `Link.ready`."""
        return True

    def receive(self) -> bytes:
        """See `Link.receive`."""
        return self.pieces.pop() if self.pieces else b""

    def heard(self) -> None:
        """See `Link.heard`."""

    def gone(self) -> bool:
        """See `Link.gone`."""
        return False

    def send(self, frame: bytes) -> bool:
        """See `Link.send`."""
        self.sent.append(frame)
        return True

    def close(self) -> None:
        """See `Link.close`."""


def mavlink() -> tuple[Callable[[bytes], None], list[bytes]]:
    """A station that navigates and takes measurements of system 255, and follows 2/1."""
    row = np.zeros(1, NAV_STATE)
    row["time"], row["mode"], row["q_nb"], row["lat"] = 50.0, Mode.NAVIGATE, (1.0, 0.0, 0.0, 0.0), 0.87
    quiet = dict.fromkeys(KINDS, 0.0) | {"HEARTBEAT": 1.0}
    types = len(mav.mavlink_map) + 1

    def take(data: bytes) -> None:
        how, body = data[0] if data else 0, data[1:]
        if how & 1:
            body = mended(body)
        if how & 2:
            starts = [0, *(found.start() for found in _MARKER.finditer(body)), len(body)]
            pieces = [body[a:b] for a, b in pairwise(starts) if b > a]
        else:
            size = 1 + (how >> 2) * 8
            pieces = [body[piece] for piece in cut(len(body), size)]
        encoder = AidingEncoder()

        def relay(rows: Any) -> None:
            assert np.isfinite(encoder.frames(rows)["data"]).all()
            assert np.isfinite(rows["value"]).all()
            assert (rows["sigma"] > 0.0).all()

        intake = Intake((255,), (2, 1), 0.1, relay)
        station = Station(Identity(), quiet, lambda lat, lon: 20.0, lambda name: None, intake)
        station.update(row[0], 1000.0)
        link = Wire(pieces, datagrams=bool(how & 2))
        endpoint = Endpoint(station, link)
        for k in range(len(pieces) + 1):
            next_s = endpoint.poll(1000.0 + 0.05 * k)
            assert not np.isnan(next_s)
            assert len(endpoint._parser.buf) <= 280, "what waits is one frame at most"
        assert len(endpoint.received) <= types, "counters are bounded by the message set"
        assert len(link.sent) <= 8 * len(KINDS) * (1 + len(pieces)), "one message draws a bounded answer"
        sent = mav.MAVLink(None).parse_buffer(b"".join(link.sent)) or []
        assert len(sent) == len(link.sent) == endpoint.sent.total()

    seeds = []
    for name in (*HEARD, *ASKED):
        made = _message(name)
        system = (2, 1) if name in HEARD[-2:] else (255, 190)
        seeds.append(b"\x03" + made.pack(mav.MAVLink(None, *system)))
        seeds.append(b"\x01" + made.pack(mav.MAVLink(None, *system), force_mavlink1=made.id < 256))
    for number in COMMANDS:
        for value in (30.0, 1e10, float("nan")):
            params = getattr(mav, f"MAV_CMD_{number}"), 0, value, 1e5, 30.0, 0.1, 50.5, 30.25, 0.0
            seeds.append(b"\x03" + mav.MAVLink_command_long_message(1, 1, *params).pack(mav.MAVLink(None, 255, 190)))
    together = [b"".join(seed[1:] for seed in seeds[k : k + 4]) for k in range(0, len(seeds), 4)]
    return take, [*seeds, *(b"\x01" + some for some in together)]


def _message(name: str) -> Any:
    made = getattr(mav, f"MAVLink_{name.lower()}_message")
    lengths = {made.ordered_fieldnames[k]: length for k, length in enumerate(made.array_lengths)}
    fields: dict[str, Any] = {}
    for field, kind in zip(made.fieldnames, made.fieldtypes, strict=True):
        fields[field] = b"HIL_COMPID" if kind == "char" else [1] * lengths[field] if lengths[field] else 1
    known = {
        "fix_type": 3,
        "lat": 500_000_000,
        "lon": 300_000_000,
        "frame_id": 1,
        "child_frame_id": 12,
        "param_type": 9,
    }
    return made(**(fields | {key: value for key, value in known.items() if key in fields}))


def mended(data: bytes) -> bytes:
    """`data` with the check of every frame in it made right."""
    whole, at = bytearray(data), 0
    while (found := _MARKER.search(whole, at)) is not None and found.start() + 8 <= len(whole):
        at = found.start()
        second = whole[at] == 0xFD
        head = 10 if second else 6
        number = int.from_bytes(whole[at + 7 : at + 10], "little") if second else whole[at + 5]
        end = at + head + whole[at + 1]
        if number not in mav.mavlink_map or end + 2 > len(whole):
            at += 1
            continue
        crc = mav.x25crc(whole[at + 1 : end] + bytes([mav.mavlink_map[number].crc_extra])).crc
        whole[end : end + 2] = struct.pack("<H", crc)
        at = end + 2
    return bytes(whole)
