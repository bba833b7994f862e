"""Xbus: real packets of an MTi-300 against the vendor tool's decoding, number formats, clock and counter, refusals."""

import json
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pty_board import STEP_S, Plugged, decoded, moving

from drivers import Counters
from drivers.serial import xbus
from drivers.serial.chunks import to_chunks
from drivers.serial.stream import ByteStream
from drivers.serial.timeline import Timeline
from drivers.serial.xbus import Xbus, message, payload, read_fields, xsens_xbus
from drivers.serial.xbus_emulator import XbusEmulator, encode_numbers
from nav.errors import HilError
from nav.increments import Validity

NAMES = {
    "PacketCounter": 0x1020,
    "SampleTimeFine": 0x1060,
    "Quaternion": 0x2010,
    "RotationMatrix": 0x2020,
    "EulerAngles": 0x2030,
    "BaroPressure": 0x3010,
    "DeltaV": 0x4010,
    "Acceleration": 0x4020,
    "FreeAcceleration": 0x4030,
    "Temperature": 0x0810,
    "RateOfTurn": 0x8020,
    "DeltaQ": 0x8030,
    "MagneticField": 0xC020,
    "StatusWord": 0xE020,
}
VALUE = re.compile(r"(?<![\w.])-?\d+\.\d+|(?<![\w.])-?\d+(?![\w.])")


def vendor_fields(lines: list[str]) -> dict[int, tuple[list[str], str]]:
    """The vendor tool's print by identifier: numbers as they stand there, and the axes."""
    fields = {}
    for entry in " ".join(lines).split("), ("):
        for text in re.split(r"(?=\((?:" + "|".join(NAMES) + r")\b)", entry if entry.startswith("(") else f"({entry}"):
            head = re.match(r"\((\w+)([|\w]*), (\d+) bytes,|\((\w+)([|\w]*),", text)
            if head is None:
                continue
            name, flags = head.group(1) or head.group(4), head.group(2) or head.group(5) or ""
            axes = next((word for word in flags.split("|") if word in {"ENU", "NED", "NWU"}), "")
            fields[NAMES[name]] = (VALUE.findall(text[head.end() :]), axes)
    return fields


def test_every_value_is_that_of_the_vendor_tool(hil_data: Path) -> None:
    packets: dict[str, Any] = json.loads((hil_data / "xsens_xbus_packets.json").read_text())["packets"]
    compared = 0
    for case in packets.values():
        whole = bytes.fromhex(case["hex"])
        stream = ByteStream(Xbus())
        assert [packet for packet, _ in stream.take(to_chunks(b"\xfa" + whole))] == [whole]
        ours = read_fields(payload(whole))
        assert ours is not None
        theirs = vendor_fields(case["decoded_by_vendor_tool"])
        assert theirs.keys() == ours.keys()
        for name, (texts, axes) in theirs.items():
            assert ours[name].axes == axes
            assert len(ours[name].values) == len(texts)
            for value, text in zip(ours[name].values, texts, strict=True):
                if name == xbus.STATUS:
                    assert format(int(value), "032b") == text
                    continue
                digits = len(text.partition(".")[2])
                assert abs(value - float(text)) <= 0.51 * 10.0**-digits, (name, value, text)
                compared += 1
    assert compared == 2 + 4 + 2 + 4 + 3 + 3 + 3 + 3 + 4 + 3 + 1 + 1 + 3 + 4 + 3 + 1 + 9


def test_a_clipped_sample_of_a_real_board_is_suspect(hil_data: Path) -> None:
    packets = json.loads((hil_data / "xsens_xbus_packets.json").read_text())["packets"]
    board = Xbus()
    reading = board.read(bytes.fromhex(packets["shake_clipping"]["hex"]))
    assert not isinstance(reading, str)
    assert reading.suspect
    assert reading.push == pytest.approx((-0.07186279, 0.07130830, 0.18206376), abs=1e-8)  # forward-right-down
    quarter = 0.0025  # 400 Hz
    rate = np.array([4.16570139, 10.33340263, 4.51734877])
    np.testing.assert_allclose(np.array(reading.turn) / quarter, rate, rtol=2e-4)
    assert board.read(bytes.fromhex(packets["quat_minimal"]["hex"])) == "foreign"


@pytest.mark.parametrize(
    ("form", "resolution"), [("float32", 1e-9), ("fp12.20", 2.0**-20), ("fp16.32", 2.0**-32), ("double", 1e-15)]
)
def test_number_formats_keep_what_they_can(form: str, resolution: float) -> None:
    values = (0.0, 1.0, -1.0, -0.001234567890123, 0.004999999999, 0.0001)
    data = encode_numbers(values, {"float32": 0, "fp12.20": 1, "fp16.32": 2, "double": 3}[form])
    packet = (
        struct.pack(">HB", 0x4010 | {"float32": 0, "fp12.20": 1, "fp16.32": 2, "double": 3}[form], len(data)) + data
    )
    fields = read_fields(packet)
    assert fields is not None
    np.testing.assert_allclose(fields[0x4010].values, values, rtol=6e-8, atol=0.51 * resolution)
    sent = moving(100)
    got = decoded(xsens_xbus(), to_chunks(b"".join(XbusEmulator(form).packets(sent))))
    np.testing.assert_allclose(got.dtheta[1:], sent.dtheta[2:], atol=2.0 * resolution + 3e-9)
    np.testing.assert_allclose(got.dvel[1:], sent.dvel[2:], atol=2.0 * resolution + 3e-8)


@pytest.mark.parametrize(("form", "error"), [("float32", 1e-6), ("double", 1e-6), ("fp16.32", 1e-3), ("fp12.20", None)])
def test_what_the_formats_leave_of_the_earths_rate(form: str, error: float | None) -> None:
    """At 100 Hz the half-angle of a step is 0.36e-6, and the last place of 12.20 is 0.95e-6: a resting board sends zeros."""
    earth, sent = 7.292115e-5, moving(50)
    sent.dtheta[:] = [earth * STEP_S, 0.0, 0.0]
    got = decoded(xsens_xbus(), to_chunks(b"".join(XbusEmulator(form).packets(sent))))
    rate = got.dtheta[:, 0].mean() / STEP_S
    assert rate == 0.0 if error is None else abs(rate / earth - 1.0) < error


def test_counter_and_clock_turn_over() -> None:
    sent = moving(300, start_s=2**32 * 1e-4 - 1.0)
    driver = xsens_xbus()
    packets = XbusEmulator(first=65500).packets(sent)
    got = decoded(driver, to_chunks(b"".join(packets)))
    assert len(got) == 299
    assert driver.counters.as_list()[2:] == [0] * (len(driver.counters.as_list()) - 2)
    np.testing.assert_allclose(np.diff(got.time), STEP_S, atol=1e-6)
    assert (np.diff(got.sequence) == 1).all()


@pytest.mark.parametrize("missing", [1, 65535, 65536, 65537, 200_000])
def test_a_gap_longer_than_the_counter_is_counted_by_the_clock(missing: int) -> None:
    counters = Counters()
    line = Timeline(counters, xbus.TICK_NS << 32, 1 << 16)
    step = 2_500_000
    for k in (0, 1, 2 + missing, 3 + missing):
        line.place(k * step + (k > 5) * xbus.TICK_NS, k & 0xFFFF)  # the clock is a tick off
    assert counters.lost == missing
    assert line.sequence == 3 + missing
    assert counters.restarts == counters.crc_errors == 0


def test_one_sample_that_fits_neither_counter_nor_clock_is_damage() -> None:
    """The check is a sum of eight bits: one damaged packet in 256 passes it."""
    driver, emulator = xsens_xbus(), XbusEmulator()
    packets = emulator.packets(moving(40))
    fields = bytearray(payload(packets[20]))
    fields[3] ^= 0x40  # the counter, high byte
    packets[20] = message(xbus.MTDATA2, bytes(fields))
    got = decoded(driver, to_chunks(b"".join(packets)))
    assert len(got) == 38
    assert (driver.counters.crc_errors, driver.counters.lost, driver.counters.restarts) == (1, 1, 0)


def test_a_failed_self_test_is_said() -> None:
    packets = XbusEmulator().packets(moving(3), status=0x02, temperature_c=41.5)
    driver = xsens_xbus()
    got = decoded(driver, to_chunks(b"".join(packets)))
    assert (got.validity == Validity.SENSOR).all()
    assert driver.identity()["temperature_c"] == 41.5


def test_packets_that_lack_something_are_short() -> None:
    driver = xsens_xbus()
    whole = payload(XbusEmulator().packets(moving(1))[0])
    lacks = [whole[5:], whole[:-1], whole[:5] + whole[12:], message(0x36, whole)[4:9]]
    decoded(driver, to_chunks(b"".join(message(xbus.MTDATA2, part) for part in lacks) + message(0x31)))
    assert driver.counters.short == 3
    assert driver.counters.foreign == 2
    assert driver.counters.samples == 0


def test_long_messages() -> None:
    data = bytes(range(256)) * 3
    for part in (data[:254], data[:255], data):
        stream = ByteStream(Xbus())
        found = [packet for packet, _ in stream.take(to_chunks(message(0x36, part)))]
        assert [payload(packet) for packet in found] == [part]


def test_a_rate_that_the_board_does_not_grant(tmp_path: Path) -> None:
    from contextlib import closing

    from drivers.serial.dialog import Dialog
    from drivers.serial.port import SerialPort

    emulator = XbusEmulator(device=0x0123ABCD)
    with Plugged(emulator, tmp_path / "imu"), closing(SerialPort(f"serial:{tmp_path / 'imu'}:2000000")) as port:
        said = Xbus().configure(Dialog(port, Xbus()), 400.0, port.baud)
        assert said["device_id"] == "0123ABCD"
        assert {xbus.DELTA_Q: 400, xbus.DELTA_V: 400}.items() <= emulator.outputs.items()
        with pytest.raises(HilError, match=r"asked for 2500 Hz, the board grants none: take another rate"):
            Xbus().configure(Dialog(port, Xbus()), 2500.0, port.baud)
        assert emulator.measuring, "what is refused leaves no board silent"
        emulator.measuring = False
        with pytest.raises(HilError, match="refuses Nonsense: error 04"):
            xbus._ask(Dialog(port, Xbus()), "Nonsense", 0x12)
