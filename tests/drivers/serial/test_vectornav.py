"""VectorNav: layouts of binary packets, ASCII lines between them, registers, refusals."""

import math
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from pty_board import Plugged, decoded, moving

from drivers.serial import vectornav as vn
from drivers.serial.chunks import to_chunks
from drivers.serial.dialog import Dialog
from drivers.serial.port import SerialPort
from drivers.serial.vectornav import VectorNav, layout, line_of, packet_of, vectornav
from drivers.serial.vectornav_emulator import VectorNavEmulator
from nav.errors import HilError


def test_the_example_of_the_manual() -> None:
    """Yaw, pitch, roll of group 1, as the manual prints them: 93.20, ... deg; no sample for us."""
    packet = bytes.fromhex("FA01080093502E42833EF13F48B504BB9288")
    found = layout(packet[1:4])
    assert found is not None
    assert found.length == len(packet)
    assert VectorNav().good(packet)
    assert VectorNav().read(packet) == "foreign"


def test_increments_of_the_imu_group() -> None:
    """DeltaTheta (step and angle, deg) and DeltaVel of group 3, time of group 2."""
    angle, push = (0.5, -0.25, 0.125), (0.01, 0.02, -0.098)
    data = struct.pack("<Q", 7_000_000_000) + struct.pack("<4f", 0.01, *angle) + struct.pack("<3f", *push)
    reading = VectorNav().read(packet_of(0x06, (0x0001, 0x00C0), data))
    assert not isinstance(reading, str)
    assert reading.time_ns == 7_000_000_000
    assert reading.step_ns == pytest.approx(10_000_000, abs=1)
    assert reading.turn == pytest.approx(tuple(map(math.radians, angle)))
    assert reading.push == pytest.approx(push, rel=1e-6)


@pytest.mark.parametrize(
    ("groups", "masks", "order"),
    [
        (0x05, (0x0001, 0x060C), "compensated last"),
        (0x05, (0x0001, 0x0600), "plain"),
        (0x01, (0x0201,), "plain"),
        (0x01, (0x0121,), "swapped"),
    ],
)
def test_rates_where_there_are_no_increments(groups: int, masks: tuple[int, ...], order: str) -> None:
    force, rate = (1.0, 2.0, -9.5), (0.1, 0.2, 0.3)
    values = (*rate, *force) if order == "swapped" else (*force, *rate)
    data = struct.pack("<Q", 5) + struct.pack("<6f", *values)
    if order == "compensated last":
        data += struct.pack("<6f", *[9.0] * 6)  # the uncompensated ones are taken
    reading = VectorNav().read(packet_of(groups, masks, data))
    assert not isinstance(reading, str)
    assert not reading.coned
    assert reading.push == pytest.approx(force)
    assert reading.turn == pytest.approx(rate)


def test_ascii_lines_between_are_counted() -> None:
    packets = VectorNavEmulator().packets(moving(50))
    line = line_of("VNYPR,+010.071,+000.278,-002.026")
    driver = vectornav()
    got = decoded(driver, to_chunks(b"".join(line + packet for packet in packets)))
    assert len(got) == 50
    assert driver.identity()["ascii_lines"] == 50 == driver.counters.foreign
    assert driver.identity()["skipped_bytes"] == 0


def test_a_packet_without_time_is_short() -> None:
    driver = vectornav()
    driver.decode(to_chunks(packet_of(0x01, (0x0800,), struct.pack("<7f", 0.01, *[0.0] * 6))))
    assert driver.counters.short == 1


def test_slow_outputs_are_foreign_with_a_time_or_without() -> None:
    attitude = struct.pack("<3f", 10.0, 2.0, -1.0)
    assert VectorNav().read(packet_of(0x01, (0x0008,), attitude)) == "foreign"
    assert VectorNav().read(packet_of(0x01, (0x0009,), struct.pack("<Q", 5) + attitude)) == "foreign"
    assert VectorNav().read(packet_of(0x06, (0x0001, 0x0010), struct.pack("<Qf", 5, 25.0))) == "foreign"


@pytest.mark.parametrize(
    ("group", "bit"), [(0x01, 5), (0x01, 8), (0x04, 2), (0x04, 3), (0x04, 7), (0x04, 9), (0x04, 10)]
)
@pytest.mark.parametrize("timed", [True, False])
def test_half_of_a_pair_is_short(group: int, bit: int, timed: bool) -> None:
    """A rate without a force, or the other way round, is what the board should send, and not enough."""
    time = struct.pack("<Q", 5) * timed
    groups, masks = (0x01, (int(timed) | 1 << bit,)) if group == 0x01 else (0x01 | group, (int(timed), 1 << bit))
    assert VectorNav().read(packet_of(groups, masks, time + struct.pack("<3f", 0.1, 0.2, 0.3))) == "short"


def test_a_step_that_is_no_time_is_short() -> None:
    driver = vectornav()
    for step in (0.0, -1.0, math.nan, math.inf):
        data = struct.pack("<Q", 1) + struct.pack("<7f", step, *[0.0] * 6)
        driver.decode(to_chunks(packet_of(0x01, (0x0801,), data)))
    assert driver.counters.short == 4


def test_no_nan_gets_in() -> None:
    driver = vectornav()
    data = struct.pack("<Q", 1) + struct.pack("<7f", 0.01, *[math.nan] * 6)
    assert len(driver.decode(to_chunks(packet_of(0x01, (0x0801,), data)))) == 0
    assert driver.counters.crc_errors == 1


@pytest.mark.parametrize(("model", "divisor"), [("VN-100T-CR", "4"), ("VN-200", "4"), ("VN-300", "2")])
def test_registers_are_written_and_read_back(tmp_path: Path, model: str, divisor: str) -> None:
    emulator = VectorNavEmulator(model)
    with Plugged(emulator, tmp_path / "imu") as board, closing(SerialPort(f"serial:{tmp_path / 'imu'}:921600")) as port:
        board.send(line_of("VNYPR,+010.071,+000.278,-002.026"))
        said = VectorNav().configure(Dialog(port, VectorNav()), 200.0, port.baud)
        assert said == {"model": model, "rate_hz": 200.0}
        assert emulator.registers["75"] == f"3,{divisor},05,0801,0810"
        assert emulator.registers["82"] == "0,0,0,0,0"
        assert emulator.registers["06"] == "0"
        with pytest.raises(HilError, match=r"refuses \$VNRRG,99: \$VNERR,08"):
            vn._ask(Dialog(port, VectorNav()), "VNRRG,99")


def test_a_register_that_does_not_stick(tmp_path: Path) -> None:
    class Stubborn(VectorNavEmulator):
        def _answer(self, text: str) -> str:
            return "VNRRG,75,2,8,01,0029" if text == "VNRRG,75" else super()._answer(text)

    emulator = Stubborn()
    with (
        Plugged(emulator, tmp_path / "imu"),
        closing(SerialPort(f"serial:{tmp_path / 'imu'}:921600")) as port,
        pytest.raises(HilError, match="did not take it"),
    ):
        VectorNav().configure(Dialog(port, VectorNav()), 200.0, port.baud)
    assert emulator.measuring


def test_the_configured_packet_is_the_emulators() -> None:
    packet = VectorNavEmulator().packets(moving(1))[0]
    header = bytes([vn.GROUPS]) + struct.pack("<2H", *vn.MASKS)
    found = layout(header)
    assert packet[1 : 1 + len(header)] == header
    assert found is not None
    assert found.length == len(packet)
    assert np.frombuffer(packet, "<f4", 3, found.push)[2] < 0.0  # gravity pulls a level board: specific force is up


def test_layouts_that_are_remembered_are_few() -> None:
    """There are 2^112 headers: a line of rubbish may not fill the memory."""
    for mask in range(2000):
        layout(b"\x01" + struct.pack("<H", mask))
    assert layout.cache_info().currsize < 1000
