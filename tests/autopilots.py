"""The other ends of the autopilot feeds, written from the byte-level descriptions and without any codec of ours.

`Sitl` is ArduPilot SITL with the JSON interface, `Px4` PX4's simulator interface, `ArduPilotAhrs` ArduPilot's ExternalAHRS
driver for VectorNav boards, in its older and its newer form.
"""

import os
import re
import select
import socket
import struct
import termios
import time
import tty
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common as mav

NUMBER = r"(-?\d+(?:\.\d+)?(?:e[+-]?\d+)?)"


def after(text: str, section: str, key: str) -> str:
    """What SITL's parser has before it when it reads a value: the text behind ``KEY":``, KEY being the first behind SECTION."""
    at = text.index(section) + len(section) + 1
    return text[text.index(key, at) + len(key) + 2 :]


def scanned(text: str, count: int) -> list[float]:
    """``sscanf(text, "[%f, %f, ...]")``: no blank before the bracket."""
    found = re.match(r"\[" + r",\s*".join([NUMBER] * count) + r"\]", text)
    assert found, f"SITL cannot parse {text[:60]!r}"
    return [float(part) for part in found.groups()]


@dataclass(frozen=True)
class Sensed:
    """What SITL has parsed of a line."""

    timestamp: float
    gyro: list[float]
    accel_body: list[float]
    position: list[float]
    quaternion: list[float]
    velocity: list[float]


class Sitl:
    """ArduPilot SITL: ``sim_vehicle.py -f JSON:127.0.0.1``."""

    def __init__(self, port: int, channels: int = 16, rate_hz: int = 1200, own_port: int = 0) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", own_port))
        self.socket.connect(("127.0.0.1", port))
        self.socket.settimeout(5.0)
        self.magic = {16: 18458, 32: 29569}[channels]
        self.channels, self.rate_hz, self.count = channels, rate_hz, 0

    def servos(self, count: int) -> bytes:
        """A servo packet; channel n has 1000 + n us."""
        pwm = (1000 + n for n in range(self.channels))
        return struct.pack(f"<HHI{self.channels}H", self.magic, self.rate_hz, count, *pwm)

    def send(self) -> None:
        """The packet of the frame that is due."""
        self.socket.send(self.servos(self.count))

    def receive(self) -> Sensed:
        """The answer, parsed as SITL does; the next frame is due."""
        line = self.socket.recv(65536)
        self.count += 1
        return self.parsed(line)

    def frame(self) -> Sensed:
        """One step of the lockstep."""
        self.send()
        return self.receive()

    @staticmethod
    def parsed(line: bytes) -> Sensed:
        """A datagram of the simulator."""
        assert line[:1] == line[-1:] == b"\n"
        assert line.count(b"\n") == 2
        text = line[1:-1].decode("ascii")
        stamp = re.match(r"\s*" + NUMBER, after(text, "", "timestamp"))
        assert stamp
        return Sensed(
            float(stamp[1]),
            scanned(after(text, "imu", "gyro"), 3),
            scanned(after(text, "imu", "accel_body"), 3),
            scanned(after(text, "", "position"), 3),
            scanned(after(text, "", "quaternion"), 4),
            scanned(after(text, "", "velocity"), 3),
        )

    def close(self) -> None:
        self.socket.close()


class Px4:
    """PX4's simulator_mavlink: connects, tells its heartbeat, answers every HIL_SENSOR of id 0 with its actuators."""

    def __init__(self, port: int, *, lockstep: bool = True) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=5.0)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.mav = mav.MAVLink(None, 1, 1)
        self.lockstep = lockstep
        self.clock_us = 0
        """CLOCK_MONOTONIC of the lockstep scheduler."""
        self.heard: list[Any] = []
        self.send(mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GENERIC, mav.MAV_AUTOPILOT_PX4, 0, 0, 0, 3))
        interval = (mav.MAVLINK_MSG_ID_HIL_STATE_QUATERNION, 5e3)
        self.send(mav.MAVLink_command_long_message(0, 0, mav.MAV_CMD_SET_MESSAGE_INTERVAL, 0, *interval, 0, 0, 0, 0, 0))

    def send(self, message: Any) -> None:
        self.socket.sendall(message.pack(self.mav))

    def actuators(self, values: tuple[float, ...] = (0.5,) * 16, mode: int = 129) -> None:
        self.send(mav.MAVLink_hil_actuator_controls_message(self.clock_us, values, mode, int(self.lockstep)))

    def sensors(self, seconds: float = 5.0) -> list[Any]:
        """HIL_SENSOR of id 0 that have come, at least one; all messages go to `heard`."""
        deadline, found = time.monotonic() + seconds, []
        while not found and time.monotonic() < deadline:
            self.socket.settimeout(max(0.01, deadline - time.monotonic()))
            try:
                data = self.socket.recv(2048)
            except TimeoutError:
                break
            assert data, "the simulator has hung up"
            for message in self.mav.parse_buffer(data) or []:
                self.heard.append(message)
                if message.get_type() == "HIL_SENSOR" and message.id == 0:
                    assert message.time_usec > self.clock_us, "PX4's clock may not stand or go back"
                    self.clock_us = message.time_usec
                    found.append(message)
        return found

    def of(self, kind: str) -> list[Any]:
        return [message for message in self.heard if message.get_type() == kind]

    def close(self) -> None:
        self.socket.close()


def crc16_ccitt(data: bytes) -> int:
    """ArduPilot's crc16_ccitt with start 0, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


OLD = {
    bytes.fromhex("342e0706011206"): ("3f3f3ff3f3f3f3f4f3f3d3fff", 170),
    bytes.fromhex("4e02001000b8201800"): ("QfBB3d3f7fBB", 92),
}
"""Header of each packet that firmware up to 4.5 expects: its fields (`VN_INS_packet1`, `VN_INS_packet2`), its length."""
NEW = {
    bytes.fromhex("012107"): ("Q3f3f3f3f3fff", 82),
    bytes.fromhex("31010006011306"): ("Q3f4f3fH3d3fff", 104),
    bytes.fromhex("490300b8261800"): ("QQBB3d3f3ff7fBB", 110),
}
"""The same of newer firmware: `VN_IMU_packet`, `VN_INS_ekf_packet`, `VN_INS_gnss_packet`."""


class ArduPilotAhrs:
    """``EAHRS_TYPE = 1``: sets the board up, then takes packets whose header, length and check are those that it expects."""

    def __init__(self, read: Any, write: Any, *, old: bool, rate_hz: int = 50) -> None:
        self._read, self._write = read, write
        self.expected = OLD if old else NEW
        self.old, self.rate_hz = old, rate_hz
        self.model = ""
        self.packets: list[tuple[bytes, tuple[float, ...]]] = []
        self.stray = 0
        self._buffer = b""

    def command(self, text: str) -> list[str]:
        """`run_command`: the terms of the answer; sent again every 500 ms."""
        check = 0
        for byte in text.encode():
            check ^= byte
        heard, deadline = b"", time.monotonic() + 10.0
        while time.monotonic() < deadline:
            self._write(b"$%s*%02X\r\n" % (text.encode(), check))
            again = time.monotonic() + 0.5
            while time.monotonic() < again:
                heard += self._read(0.05)
                for line in re.findall(rb"\$([^$*]*)\*([0-9A-F]{2})\r\n", heard):
                    terms = line[0].decode().split(",")
                    told = 0
                    for byte in line[0]:
                        told ^= byte
                    if told == int(line[1], 16) and terms[0] == text[:5] and terms[1] == text[6:].partition(",")[0]:
                        return terms
        raise AssertionError(f"no answer to ${text}")

    def initialize(self) -> None:
        """The driver's `initialize`."""
        self.command("VNASY,0")
        for port in (1, 2):
            self.command(f"VNWRG,06,{port}" if self.old else f"VNWRG,06,0,{port}")
        self.model = self.command("VNRRG,01")[2]
        base = 400 if self.model.startswith("VN-300") else 800
        if self.old:
            self.command(f"VNWRG,75,3,{base // self.rate_hz},34,072E,0106,0612")
            self.command(f"VNWRG,76,3,{base // 5},4E,0002,0010,20B8,0018")
        else:
            self.command(f"VNWRG,75,3,{base // self.rate_hz},01,0721")
            self.command(f"VNWRG,76,3,{base // 50},31,0001,0106,0613")
            self.command(f"VNWRG,77,3,{base // 5},49,0003,26B8,0018")
        self.command("VNASY,1")

    def listen(self, seconds: float, wanted: int = 1 << 30) -> None:
        """`check_uart` until `wanted` packets are there or the time is over."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and len(self.packets) < wanted:
            self._buffer += self._read(0.05)
            self._take()

    def _take(self) -> None:
        while (at := self._buffer.find(b"\xfa")) >= 0:
            self.stray += at
            self._buffer = self._buffer[at:]
            header = next((one for one in self.expected if self._buffer[1 : 1 + len(one)] == one), None)
            if header is None:
                if len(self._buffer) < 12:
                    return
                self.stray += 1
                self._buffer = self._buffer[1:]
                continue
            form, length = self.expected[header]
            if len(self._buffer) < length:
                return
            packet = self._buffer[:length]
            assert 1 + len(header) + struct.calcsize("<" + form) + 2 == length
            assert crc16_ccitt(packet[1:]) == 0
            self.packets.append((header, struct.unpack_from("<" + form, packet, 1 + len(header))))
            self._buffer = self._buffer[length:]


def on_terminal(device: str) -> tuple[Any, Any, Any]:
    """Read, write and close of a serial device."""
    fd = os.open(device, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(fd)
    termios.tcflush(fd, termios.TCIOFLUSH)

    def read(seconds: float) -> bytes:
        return os.read(fd, 4096) if select.select([fd], [], [], seconds)[0] else b""

    return read, lambda data: os.write(fd, data), lambda: os.close(fd)


def on_tcp(port: int) -> tuple[Any, Any, Any]:
    """Read, write and close of a TCP connection."""
    connection = socket.create_connection(("127.0.0.1", port), timeout=5.0)

    def read(seconds: float) -> bytes:
        return connection.recv(4096) if select.select([connection], [], [], seconds)[0] else b""

    return read, connection.sendall, connection.close
