"""What every board on a serial port must do: same samples out as in, every loss counted, damage and rubbish survived."""

import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pty_board import BOARDS, STEP_S, Plugged, columns, cut, decoded, moving

from drivers import FrameDriver, driver_names, make_driver
from drivers.can.frames import frames
from drivers.serial.chunks import to_chunks
from drivers.serial.driver import SerialDriver
from drivers.serial.port import SerialPort
from drivers.serial.setup import set_up
from nav.errors import HilError
from nav.increments import ImuIncrements, Validity

pytestmark = pytest.mark.parametrize("name", BOARDS)
SILENT = {"vectornav": 0, "xsens-xbus": 1, "microstrain-mip": 1}
"""Samples at the start that only set the clock: those of a board that does not say the length of a step."""
ANGLE, VELOCITY = 3e-9, 3e-8
"""What single precision (of increments below 0.01 rad and 0.2 m/s) and the third order of coning leave, rad and m/s."""


def made(name: str, **options: Any) -> tuple[SerialDriver, Any]:
    driver, emulator = BOARDS[name]
    return driver(), emulator(**options)


def same(got: ImuIncrements, sent: ImuIncrements, angle: float = ANGLE, velocity: float = VELOCITY) -> None:
    """Every sample of `got` is the sample of `sent` at its time; its increments, where the sample before is there too.

    Behind a gap the coning of the board cannot be taken off.
    """
    rows = np.searchsorted(sent.time, got.time - 0.3 * STEP_S)
    np.testing.assert_allclose(got.time, sent.time[rows], atol=1e-9)
    np.testing.assert_allclose(got.step, sent.step[rows], atol=1e-9)
    follows = np.flatnonzero(np.diff(got.sequence) == 1) + 1
    assert len(follows) > 0.7 * len(got)
    np.testing.assert_allclose(got.dtheta[follows], sent.dtheta[rows[follows]], rtol=0, atol=angle)
    np.testing.assert_allclose(got.dvel[follows], sent.dvel[rows[follows]], rtol=0, atol=velocity)


def test_increments_come_out_as_they_went_in(name: str) -> None:
    driver, emulator = made(name)
    sent = moving(400)
    data = b"".join(emulator.packets(sent))
    batch = cut(data, [37] * 50, time_ns=1000)
    got = decoded(driver, batch, every=3)
    assert len(got) == 400 - SILENT[name] == driver.counters.samples
    same(got, sent)
    assert (np.diff(got.sequence) == 1).all()
    assert not got.validity.any()
    assert driver.counters.frames == len(batch)
    assert driver.counters.as_list()[2:] == [0] * (len(driver.counters.as_list()) - 2)
    assert driver.identity()["skipped_bytes"] == 0
    assert driver.period_s == pytest.approx(STEP_S)
    checked: FrameDriver = driver
    assert checked.world_id == 0


def test_the_arrival_of_a_sample_is_that_of_its_last_byte(name: str) -> None:
    driver, emulator = made(name)
    packets = emulator.packets(moving(5))
    batch = np.concatenate([to_chunks(packet, 10 * k) for k, packet in enumerate(packets)])
    driver.decode(batch)
    assert driver.arrivals().tolist() == [10 * k for k in range(SILENT[name], 5)]


def test_rates_become_increments(name: str) -> None:
    driver, emulator = made(name, increments=False)
    sent = moving(50)
    got = decoded(driver, to_chunks(b"".join(emulator.packets(sent))))
    assert len(got) == 49
    if name == "microstrain-mip":  # its time is that of GPS
        got.time[:] -= 2300 * 604800.0
    same(got, sent, 1e-9, 3e-8)


def test_every_missing_packet_is_counted(name: str) -> None:
    driver, emulator = made(name)
    sent = moving(1000)
    packets = emulator.packets(sent)
    gone = {3, 10, 11, 12, *range(300, 800), 998}
    got = decoded(driver, to_chunks(b"".join(packet for k, packet in enumerate(packets) if k not in gone)))
    assert driver.counters.lost == len(gone)
    assert len(got) == 1000 - len(gone) - SILENT[name]
    assert int(got.sequence[-1] - got.sequence[0]) == 999 - SILENT[name]
    np.testing.assert_allclose(got.step, STEP_S, atol=1e-9)  # one step, not the gap
    same(got, sent)


@pytest.mark.parametrize("damage", ["flip", "drop", "insert", "cut"])
def test_damage_costs_the_packets_it_hits_and_no_other(name: str, damage: str) -> None:
    driver, emulator = made(name)
    sent, rng = moving(600), np.random.default_rng(11)
    packets = emulator.packets(sent)
    hit = sorted(rng.choice(np.arange(5, 595, 2), 60, replace=False).tolist())
    for k in hit:
        packet, at = packets[k], int(rng.integers(0, len(packets[k])))
        if damage == "flip":
            packets[k] = packet[:at] + bytes([packet[at] ^ 1 << int(rng.integers(8))]) + packet[at + 1 :]
        elif damage == "drop":
            packets[k] = packet[:at] + packet[at + 1 :]
        elif damage == "insert":
            packets[k] = packet[: at + 1] + bytes([0x5A]) + packet[at + 1 :] if at + 1 < len(packet) else packet[:-1]
        else:
            packets[k] = packet[:at]
    got = decoded(driver, cut(b"".join(packets), [50] * 100), every=2)
    counters = driver.counters
    assert counters.lost == len(hit)
    assert len(got) + counters.lost == 600 - SILENT[name]
    assert counters.restarts == counters.duplicated == counters.late == 0
    same(got, sent)


def test_noise_between_packets_is_skipped_and_counted(name: str) -> None:
    driver, emulator = made(name)
    packets, rng = emulator.packets(moving(100)), np.random.default_rng(5)
    noise = [bytes(rng.integers(0, 0x24, size=int(rng.integers(1, 200)), dtype=np.uint8)) for _ in packets]
    data = b"".join(part for pair in zip(noise, packets, strict=True) for part in pair)
    assert len(decoded(driver, to_chunks(data))) == 100 - SILENT[name]
    assert driver.counters.lost == driver.counters.crc_errors == 0
    assert driver.identity()["skipped_bytes"] == sum(map(len, noise))


@given(data=st.data())
def test_batches_change_nothing_to_the_bit(name: str, data: st.DataObject) -> None:
    emulator = BOARDS[name][1]()
    packets = emulator.packets(moving(30))
    keep = data.draw(st.lists(st.sampled_from(range(30)), max_size=40))  # lost, repeated, in any order
    noise = data.draw(st.lists(st.binary(max_size=20), min_size=len(keep), max_size=len(keep)))
    whole = b"".join(packets[k] + extra for k, extra in zip(keep, noise, strict=True))
    batch = cut(whole, data.draw(st.lists(st.integers(1, 120), max_size=40)))
    one, many = BOARDS[name][0](), BOARDS[name][0]()
    got, again = decoded(one, batch), decoded(many, batch, every=data.draw(st.integers(1, 4)))
    for a, b in zip(columns(got), columns(again), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(one.all_arrivals, many.all_arrivals)  # type: ignore[attr-defined]
    assert one.counters == many.counters
    assert one.identity() == many.identity()


@given(pieces=st.lists(st.tuples(st.integers(0, 59), st.binary(max_size=6), st.integers(0, 70)), max_size=25))
def test_whatever_comes_samples_are_finite_and_in_order(name: str, pieces: list[tuple[int, bytes, int]]) -> None:
    """Packets whose inside is overwritten and whose check is made right again, as no line does and a bad board may."""
    driver, emulator = made(name)
    packets = emulator.packets(moving(60))
    whole = b""
    for k, patch, at in pieces:
        packet = packets[k][:at] + patch + packets[k][at + len(patch) :]
        whole += mended(name, packet[: len(packets[k])])
    got = decoded(driver, to_chunks(whole), every=2)
    assert got.first_bad() == -1
    assert (got.step > 0.0).all()
    assert (np.diff(got.sequence) > 0).all()
    assert driver.counters.samples == len(got)
    assert driver.stream.waiting < 4096


def mended(name: str, packet: bytes) -> bytes:
    from binascii import crc_hqx

    from drivers.serial import mip

    if name == "xsens-xbus":
        return packet[:-1] + bytes([-sum(packet[1:-1]) & 0xFF])
    if name == "vectornav":
        return packet[:-2] + crc_hqx(packet[1:-2], 0).to_bytes(2, "big")
    return packet[:-2] + mip.check(packet[:-2])


def test_a_board_that_starts_anew(name: str) -> None:
    driver, emulator = made(name)
    before, after = moving(50, start_s=100.0), moving(50, start_s=0.0)
    data = b"".join(emulator.packets(before)) + b"".join(BOARDS[name][1]().packets(after))
    got = decoded(driver, to_chunks(data))
    assert (driver.counters.restarts, driver.counters.lost, driver.counters.crc_errors) == (1, 1, 0)
    later = got.rows(50 - SILENT[name], len(got))
    assert len(later) == 49  # the first one was set aside until the second confirmed it
    assert later.sequence[0] - got.sequence[49 - SILENT[name]] == 2
    same(later.rows(1, 49), after)


def test_two_boards_on_one_line_do_not_mix(name: str) -> None:
    driver, first = made(name)
    second = BOARDS[name][1]()
    one, other = moving(200, start_s=1000.0), moving(200, start_s=3.0)
    other.dtheta[:] += 0.005
    pairs = zip(first.packets(one), second.packets(other), strict=True)
    got = decoded(driver, to_chunks(b"".join(a + b for a, b in pairs)))
    same(got, one)
    assert len(got) == 200 - SILENT[name]
    assert driver.counters.crc_errors == 199  # the last one is still aside
    assert driver.counters.restarts == driver.counters.lost == 0


def test_another_make_on_the_same_line_is_skipped(name: str) -> None:
    driver, emulator = made(name)
    other = BOARDS[next(key for key in BOARDS if key != name)][1]()
    pairs = zip(emulator.packets(moving(100)), other.packets(moving(100)), strict=True)
    got = decoded(driver, to_chunks(b"".join(a + b for a, b in pairs) + bytes(300)))
    assert len(got) == 100 - SILENT[name]
    assert driver.counters.lost == 0


def test_a_repeated_packet_is_a_duplicate(name: str) -> None:
    driver, emulator = made(name)
    packets = emulator.packets(moving(20))
    got = decoded(driver, to_chunks(b"".join(packet + packet for packet in packets)))
    assert len(got) == 20 - SILENT[name]
    assert driver.counters.duplicated == 20


def test_more_samples_in_a_batch_than_ever_before(name: str) -> None:
    driver, emulator = made(name)
    got = decoded(driver, to_chunks(b"".join(emulator.packets(moving(3000)))))
    assert len(got) == 3000 - SILENT[name]
    assert len(driver.arrivals()) == len(got)


def test_frames_of_a_bus_are_foreign(name: str) -> None:
    driver, _ = made(name)
    assert len(driver.decode(frames(3))) == 0
    assert driver.counters.foreign == 3


FLAGS: dict[str, dict[str, int]] = {
    "xsens-xbus": {"status": 0x0003 | 1 << 12},
    "vectornav": {"saturation": 1 << 4},
    "microstrain-mip": {"overrange": 1 << 0},
}


def test_a_saturated_sensor_makes_its_samples_suspect(name: str) -> None:
    driver, emulator = made(name)
    sent = moving(40)
    data = b"".join(emulator.packets(sent.rows(0, 20)) + emulator.packets(sent.rows(20, 40), **FLAGS[name]))
    got = decoded(driver, to_chunks(data))
    first = 20 - SILENT[name]
    assert (got.validity[:first] == 0).all()
    assert (got.validity[first:] == Validity.SENSOR).all()


def test_the_driver_is_installed(name: str) -> None:
    if name not in driver_names():
        pytest.skip("the package was installed before this board was added: pip install -e .")
    assert isinstance(make_driver(name), SerialDriver)


def test_unplugged_and_back_on_a_real_port(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples of a port that is pulled out in the middle of a packet: what was sent meanwhile is lost, by number."""
    monkeypatch.setattr("drivers.serial.port.REOPEN_S", 0.02)
    driver, emulator = made(name)
    sent, path, batch = moving(300), tmp_path / "imu", frames(64)
    packets, taken = emulator.packets(sent), 0

    def take(port: SerialPort, until: int) -> None:
        nonlocal taken
        deadline = time.monotonic() + 10.0
        while taken < until and time.monotonic() < deadline:
            taken += len(driver.decode(batch[: port.receive(batch, 0.05)]))
        assert taken == until

    with Plugged(emulator, path) as board:
        port = SerialPort(f"serial:{path}:921600")
        board.send(b"".join(packets[:100]))
        take(port, 100 - SILENT[name])
        board.send(packets[100][:20])
        while driver.stream.waiting < 20:
            driver.decode(batch[: port.receive(batch, 0.05)])
    with closing(port):
        driver.decode(batch[: port.receive(batch, 0.05)])
        assert port.failures == 1
        with Plugged(emulator, path) as board:
            while port._port is None:
                port.receive(batch, 0.02)
            board.send(b"".join(packets[150:]))
            take(port, 250 - SILENT[name])
    assert driver.counters.lost == 50
    assert driver.counters.restarts == 0


def test_configured_on_a_real_port(name: str, tmp_path: Path) -> None:
    if name not in driver_names():
        pytest.skip("the package was installed before this board was added: pip install -e .")
    emulator = BOARDS[name][1]()
    url = f"serial:{tmp_path / 'imu'}:921600"
    with Plugged(emulator, tmp_path / "imu") as board:
        board.send(b"".join(emulator.packets(moving(10))))  # it streams while it is spoken to
        said = set_up(name, url, 100.0)
        assert said["rate_hz"] == 100.0
        assert emulator.measuring
        with pytest.raises(HilError, match=r"not the|not 800|grants|whole number"):
            set_up(name, url, 100.5 if name == "xsens-xbus" else 333.0)
        assert emulator.measuring, "what is refused leaves no board silent"
        for rate in (float("inf"), float("nan"), 0.0, -100.0):
            with pytest.raises(HilError):
                set_up(name, url, rate)
        assert emulator.measuring
        with pytest.raises(HilError, match="baud"):
            set_up(name, url.replace("921600", "9600"), 100.0)


def test_the_line_is_judged_by_the_packet_that_is_sent(name: str) -> None:
    driver, emulator = made(name)
    assert {len(packet) for packet in emulator.packets(moving(3))} == {sys.modules[type(driver.board).__module__].SIZE}


def test_a_board_that_does_not_answer(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if name not in driver_names():
        pytest.skip("the package was installed before this board was added: pip install -e .")
    monkeypatch.setattr("drivers.serial.dialog.ANSWER_S", 0.05)
    with Plugged(None, tmp_path / "imu"), pytest.raises(HilError, match=r"does not answer.*baud rate.*wired"):
        set_up(name, f"serial:{tmp_path / 'imu'}:921600", 100.0)
