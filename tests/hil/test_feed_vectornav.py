"""The feed to ArduPilot's ExternalAHRS: its VectorNav driver, older and newer, sets the emulated VN-300 up and reads it."""

import math
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from autopilots import NEW, OLD, ArduPilotAhrs, on_tcp, on_terminal
from feeding import RunningFeed, running_feed
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.serial.vectornav_ahrs import Ahrs
from hil.geoid import undulation
from hil.magnetic import magnetic_field
from nav.errors import HilError
from nav.rotation import conjugate, euler_from_quaternion, rotated

VN = {"kind": "vectornav"}


@pytest.fixture
def terminal() -> Iterator[RunningFeed]:
    with running_feed(**VN, address="pty") as feed:
        yield feed


def device(feed: RunningFeed) -> str:
    return feed.place.removeprefix("pty ")


def told(ahrs: ArduPilotAhrs, header: str) -> list[tuple[float, ...]]:
    return [values for one, values in ahrs.packets if one.hex() == header]


def flown(feed: RunningFeed, ahrs: ArduPilotAhrs, seconds: float) -> Any:
    """Push solutions of so much device time and hear what comes of them; all rows."""
    rows = []
    for _ in range(round(seconds / 0.01)):
        rows.append(feed.push(10))
        ahrs.listen(0.02, len(ahrs.packets) + 1)
    ahrs.listen(0.3)
    return np.concatenate(rows)


def test_older_firmware_reads_what_it_asked_for(terminal: RunningFeed) -> None:
    read, write, close = on_terminal(device(terminal))
    ahrs = ArduPilotAhrs(read, write, old=True)
    ahrs.initialize()
    assert ahrs.model == "VN-300"
    rows = flown(terminal, ahrs, 1.0)
    close()
    first, second = (header.hex() for header in OLD)
    assert len(told(ahrs, first)) == pytest.approx(50, abs=3)
    assert len(told(ahrs, second)) == pytest.approx(5, abs=1)
    assert ahrs.stray == 0
    packet, rest = told(ahrs, first)[-1], told(ahrs, second)[-1]
    mag, force, rate, pressure = packet[0:3], packet[3:6], packet[6:9], packet[9]
    ypr, q, place, velocity = packet[19:22], packet[22:26], packet[29:32], packet[32:35]
    state = rows[np.abs(np.degrees(rows["lat"]) - place[0]).argmin()]
    mean = rows[rows["time"] > state["time"] - 0.02 + 1e-9]
    mean = mean[mean["time"] <= state["time"] + 1e-9]
    assert len(mean) == 20
    assert packet[16:19] == pytest.approx(mean["w_ib_b"].mean(axis=0), rel=1e-6)
    assert rate == pytest.approx(mean["w_ib_b"].mean(axis=0) + state["gyro_bias"], rel=1e-6)
    assert force == packet[13:16] == pytest.approx(mean["f_b"].mean(axis=0), rel=1e-6)
    assert (*q[3:], *q[:3]) == pytest.approx(state["q_nb"], abs=1e-6)
    heading, pitch, roll = np.degrees(euler_from_quaternion(state["q_nb"]))
    assert ypr == pytest.approx(((heading + 180.0) % 360.0 - 180.0, pitch, roll), abs=1e-4)
    altitude = state["height"] - undulation(state["lat"], state["lon"])
    assert place[1:] == pytest.approx((math.degrees(state["lon"]), altitude), abs=1e-6)
    assert velocity == pytest.approx(state["vel_n"], rel=1e-6)
    assert packet[35:37] == pytest.approx((1.0, 0.1))
    assert pressure == pytest.approx(101.325 * (1.0 - 2.25577e-5 * altitude) ** 5.25588, rel=1e-4)
    field_n = magnetic_field("dipole", state["lat"], state["lon"], state["height"], 2026.0)
    assert mag == packet[10:13] == pytest.approx(rotated(conjugate(state["q_nb"]), field_n) * 1e4, abs=1e-5)
    assert rest[1] == pytest.approx(15.0 - 6.5e-3 * altitude, abs=0.01)
    assert rest[3] == rest[-1] == 3, "both receivers have a fix"
    week, seconds = divmod(rest[0] * 1e-9, 604800)
    assert (week, seconds) == pytest.approx(divmod(1_790_000_000 - 315_964_800 + 18, 604800), abs=2.0)
    assert terminal.end()["commands"] >= 7


@pytest.mark.parametrize("rate_hz", [50, 200])
def test_newer_firmware_reads_what_it_asked_for(rate_hz: int) -> None:
    with running_feed(**VN, address="tcp:127.0.0.1:0") as feed:
        read, write, close = on_tcp(feed.port)
        ahrs = ArduPilotAhrs(read, write, old=False, rate_hz=rate_hz)
        ahrs.initialize()
        rows = flown(feed, ahrs, 1.0)
        close()
        imu, ekf, gnss = (header.hex() for header in NEW)
        assert len(told(ahrs, imu)) == pytest.approx(rate_hz, rel=0.05)
        assert len(told(ahrs, ekf)) == pytest.approx(50, abs=3)
        assert len(told(ahrs, gnss)) == pytest.approx(5, abs=1)
        by_time = {round(row["time"] * 1e9): row for row in rows}
        for packet in told(ahrs, imu):
            assert packet[4:7] == pytest.approx(by_time[packet[0]]["f_b"], abs=2e-3)
        steps = np.diff([packet[0] for packet in told(ahrs, imu)][1:])
        assert set(steps) == {10**9 // rate_hz}
        for packet in told(ahrs, ekf):
            state = by_time[packet[0]]
            assert packet[11] & 0x7 == 0b110, "mode 2: tracking; a fix"
            assert packet[15:18] == pytest.approx(state["vel_n"], rel=1e-6)
        assert told(ahrs, gnss)[-1][3] == 3
        assert feed.end()["dropped"] == 0


def test_a_degraded_solution_is_no_fix(terminal: RunningFeed) -> None:
    read, write, close = on_terminal(device(terminal))
    ahrs = ArduPilotAhrs(read, write, old=True)
    ahrs.initialize()
    rows = terminal.push(1)
    for _ in range(40):
        rows["time"] += 0.01
        rows["mode"] = 3
        terminal.ring.push(rows)
        ahrs.listen(0.02, len(ahrs.packets) + 1)
    ahrs.listen(0.3)
    close()
    packet = told(ahrs, list(OLD)[1].hex())[-1]
    assert packet[3] == packet[-1] == 2


def test_a_path_of_ones_own_and_a_driver_that_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "vn300"
    with running_feed(**VN, address=f"pty:{path}") as feed:
        assert feed.place == f"pty {path}"
        for _ in range(2):
            read, write, close = on_terminal(str(path))
            ahrs = ArduPilotAhrs(read, write, old=False)
            ahrs.initialize()
            flown(feed, ahrs, 0.2)
            assert len(ahrs.packets) > 10
            close()
            feed.push(500)  # nobody listens
            time.sleep(0.1)
        feed.end()
        assert not path.is_symlink()


def test_a_file_in_the_way_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "precious"
    path.write_text("mine")
    with running_feed(**VN, address=f"pty:{path}") as feed:
        assert "File exists; give a path where nothing is" in feed.said["failed"]
    assert path.read_text() == "mine"


def test_a_second_autopilot_is_turned_away() -> None:
    with running_feed(**VN, address="tcp:127.0.0.1:0") as feed:
        read, write, close = on_tcp(feed.port)
        ArduPilotAhrs(read, write, old=False).initialize()
        second, _, close_second = on_tcp(feed.port)
        assert second(2.0) == b""
        close()
        close_second()
        read, write, close = on_tcp(feed.port)
        ArduPilotAhrs(read, write, old=False).initialize()
        close()
        assert feed.end()["refused"] == 1


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        (b"$VNWRG,76,3,80,4E,0002,0010,20B8,0018*63\r\n", b"$VNWRG,76,3,80,4E,0002,0010,20B8,0018*"),
        (b"$VNWRG,75,3,16,01,0721*D415\r\n", b"$VNWRG,75,3,16,01,0721*"),
        (b"$VNRRG,01*73\r\n", b"$VNERR,03*"),
    ],
)
def test_the_lines_in_the_drivers_source(line: bytes, answer: bytes) -> None:
    """With the checks that stand there, one of 8 and one of 16 bits; the last line has a wrong one."""
    assert Ahrs().answer(line).startswith(answer)


def framed(text: str) -> bytes:
    check = 0
    for byte in text.encode():
        check ^= byte
    return f"${text}*{check:02X}\r\n".encode()


@pytest.mark.parametrize(
    "value",
    ["", "3", "3,8", "3,8,34", "3,8,34,072E", "3,0,01,0721", "3,8,01,8000", "3,8,00", "4,8,01,0721", "x,8,01,0721",
     "3,8,81,0721,0001", "3,8,01,10721", "3,8,01,-1", "3,8,01,0000", "-1,8,01,0721"],
)  # fmt: skip
def test_an_output_that_cannot_be_served_is_refused(value: str) -> None:
    board = Ahrs()
    assert board.answer(framed(f"VNWRG,75,{value}")).startswith(b"$VNERR,07*")
    assert not board.measuring


def test_registers_that_are_not_there_and_the_model_are_not_written() -> None:
    board = Ahrs()
    assert board.answer(framed("VNRRG,99")).startswith(b"$VNERR,08*")
    assert board.answer(framed("VNWRG,01,VN-100")).startswith(b"$VNERR,07*")
    assert board.answer(framed("VNRRG,01")).startswith(b"$VNRRG,01,VN-300*")


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.binary(max_size=60) | st.text("$VNWRG,0123456789ABCDEF*\r\n", max_size=60), max_size=12))
def test_whatever_comes_the_board_answers_the_next_command(pieces: list[bytes | str]) -> None:
    board = Ahrs()
    for piece in pieces:
        board.answer(piece if isinstance(piece, bytes) else piece.encode())
    for output in board.outputs:
        assert output.period_s > 0.0
    assert framed("VNRRG,01,VN-300") in board.answer(b"\r\n" + framed("VNRRG,01"))


def test_random_bytes_on_the_terminal_are_counted(terminal: RunningFeed) -> None:
    read, write, close = on_terminal(device(terminal))
    write(os.urandom(3000))
    ahrs = ArduPilotAhrs(read, write, old=False)
    ahrs.initialize()
    flown(terminal, ahrs, 0.1)
    close()
    assert ahrs.packets
    assert terminal.end()["bad_data"] > 2000


def test_simulated_time_has_no_vectornav() -> None:
    from hil.feed.group import FeedGroup
    from hil.scenario import load

    with pytest.raises(HilError, match="needs real time"):
        FeedGroup(load(None).with_changes(feed=[VN]), paced=False)
