"""`hil monitor`: signals with their noise, frames by id, load and losses, of buses, ports and recordings; nobody is disturbed."""

import json
import os
import pty
import select
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest
from beside import beside
from commands import hil
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

sys.path.append(str(Path(__file__).parents[1] / "drivers" / "serial"))
from pty_board import BOARDS, Plugged, moving

from drivers import driver_names, make_emulator
from drivers.can.bus import open_port
from drivers.can.convert import to_message
from drivers.can.dtg_head_emulator import HeadEncoder
from drivers.can.frames import EFF, ERR, FDF, FrameArray, frames
from drivers.can.interface import Link, read_link
from drivers.can.wire import bits
from drivers.logs.recording import RecordingWriter
from hil.monitor import Monitor
from hil.pytest_plugin import StartBridge
from hil.runs import Scatter
from hil.watch import bitrates_of
from nav.errors import HilError
from nav.increments import ImuIncrements

RATE_HZ, G = 100, 9.80665
GYRO_NOISE, FORCE_NOISE = 0.02, 0.2
"""Standard deviation of the samples, rad/s and m/s^2: many steps of every board."""


def noisy(n: int) -> ImuIncrements:
    """A level board at rest with white noise."""
    rng, imu = np.random.default_rng(5), ImuIncrements.empty(n)
    imu.step[:] = 1.0 / RATE_HZ
    imu.time[:] = np.arange(1, n + 1) / RATE_HZ
    imu.sequence[:] = np.arange(n)
    imu.dtheta[:] = GYRO_NOISE * rng.standard_normal((n, 3)) / RATE_HZ
    imu.dvel[:] = (np.array([0.0, 0.0, -G]) + FORCE_NOISE * rng.standard_normal((n, 3))) / RATE_HZ
    return imu


def sent_by(driver: str, n: int = 3000) -> FrameArray:
    """Frames of a board of that driver."""
    imu = noisy(n)
    if driver == "dtg-head":
        encoder = HeadEncoder("fd", 1_000_000 // RATE_HZ)
        ends = np.rint(imu.time * 1e6).astype(np.int64)
        batch = np.concatenate(
            [encoder.slow(), encoder.samples(imu.sequence, ends, imu.dtheta[:, (0, 1, 1, 2)], imu.dvel)]
        )
        batch["time_ns"] = np.concatenate([np.full(len(batch) - n, ends[0]), ends]) * 1000
        return batch
    emulator = make_emulator(driver, 1_000_000 // RATE_HZ)
    return np.concatenate([emulator.slow(), emulator.samples(imu)])


def recorded(path: Path, batch: FrameArray) -> Path:
    writer = RecordingWriter(path, {"scenario": None})
    writer.write(batch)
    writer.close()
    return path


def monitored(*arguments: object, code: int = 0) -> dict[str, Any]:
    report: dict[str, Any] = json.loads(hil("monitor", *arguments, "--json", code=code)[0])
    return report


def by_name(report: dict[str, Any]) -> dict[str, Any]:
    return {row["name"]: row for row in report["signals"]}


@given(
    hnp.arrays(float, st.integers(1, 60), elements=st.floats(-1e6, 1e6)),
    st.lists(st.integers(1, 60), max_size=5),
)
def test_a_run_knows_what_numpy_knows(values: Any, cuts: list[int]) -> None:
    run, times = Scatter(), np.arange(len(values), dtype=np.int64) * 10_000_000
    for part in np.split(np.arange(len(values)), sorted(cuts)):
        if len(part):
            run.take(values[part], times[part])
    assert run.count == len(values)
    assert run.mean == pytest.approx(values.mean(), abs=1e-6)
    assert (run.low, run.high) == (values.min(), values.max())
    assert run.sigma == pytest.approx(values.std(ddof=1) if len(values) > 1 else 0.0, abs=1e-4)
    assert run.rate_hz == (pytest.approx(100.0) if len(values) > 1 else 0.0)


def stuffed_length(row: Any) -> int:
    """Bits of a classic data frame, stuff bits by its content, with the three between frames."""
    extended, n = bool(row["can_id"] & EFF), int(row["length"])
    number = int(row["can_id"]) & 0x1FFFFFFF
    ident = f"{number >> 18:011b}11{number & 0x3FFFF:018b}000" if extended else f"{number:011b}000"
    stream = "0" + ident + f"{n:04b}" + "".join(f"{byte:08b}" for byte in row["data"][:n])
    crc = 0
    for bit in stream:  # ISO 11898-1: x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1
        flip = (crc >> 14) ^ int(bit)
        crc = ((crc << 1) & 0x7FFF) ^ (0x4599 if flip else 0)
    stream += f"{crc:015b}"
    count, run, last = 0, 0, ""
    for bit in stream:
        run = run + 1 if bit == last else 1
        count, last = count + 1, bit
        if run == 5:
            count, run, last = count + 1, 1, "1" if bit == "0" else "0"
    return count + 1 + 2 + 7 + 3


@given(st.integers(0, 0x1FFFFFFF), st.booleans(), st.binary(max_size=8))
def test_a_frame_is_as_long_as_the_bounds_say(number: int, extended: bool, data: bytes) -> None:
    batch = frames(1)
    batch["can_id"] = number | EFF if extended else number & 0x7FF
    batch["length"], batch["data"][0, : len(data)] = len(data), list(data)
    low, high = bits(batch).nominal[0]
    assert low <= stuffed_length(batch[0]) <= high


def test_the_longest_frames_are_those_of_the_literature() -> None:
    """Davis et al. 2007: 135 bits of 8 bytes with 11-bit, 160 with 29-bit identifiers; a remote frame holds no data."""
    batch = frames(3)
    batch["can_id"], batch["length"] = [0x123, 0x123 | EFF, 0x123 | 0x40000000], 8
    assert bits(batch).nominal[:, 1].tolist() == [135, 160, 55]
    assert bits(batch).seconds(1e6, 1e6)[1] == pytest.approx(350e-6)


def test_the_data_of_fd_frames_goes_at_its_own_rate() -> None:
    batch = frames(2)
    batch["can_id"], batch["length"], batch["flags"] = 0x120, 64, [FDF, FDF | 1]
    slow, fast = bits(batch).nominal, bits(batch).data
    assert slow[0].tolist() == (slow[1] + fast[1]).tolist()
    assert fast[0].tolist() == [0, 0]
    assert 512 < fast[1, 0] < fast[1, 1] < 512 * 1.4


@pytest.mark.parametrize("driver", ["dtg-head", "sbg", "xsens-can", "j1939-imu"])
def test_a_board_is_recognised_and_its_noise_measured(tmp_path: Path, driver: str) -> None:
    path = recorded(tmp_path / "rest.dhil", sent_by(driver))
    report = monitored(path)
    assert report["driver"] == driver
    axes = ("g1x", "g1y", "g2z") if driver == "dtg-head" else ("x", "y", "z")
    signals = by_name(report)
    # The boards send rates at the ends of steps: their means make 3/4, 1/2, -1/4 of three samples of white noise.
    factor = 1.0 if driver == "dtg-head" else np.sqrt(9 + 4 + 1) / 4.0
    for axis in axes:
        rate = signals[f"rate_{axis}"]
        assert (rate["unit"], rate["density_unit"]) == ("deg/s", "deg/s/sqrt(Hz)")
        assert rate["rate_hz"] == pytest.approx(RATE_HZ, rel=1e-3)
        assert rate["std"] == pytest.approx(np.degrees(GYRO_NOISE) * factor, rel=0.06)
        assert rate["density"] == pytest.approx(rate["std"] / np.sqrt(rate["rate_hz"]))
        assert rate["min"] < rate["mean"] < rate["max"]
    force = signals["force_z"]
    assert force["mean"] == pytest.approx(-G, abs=0.02)
    assert force["density"] == pytest.approx(force["std"] / np.sqrt(RATE_HZ) / G * 1e6, rel=1e-3)
    assert report["losses"]["lost"] == 0
    assert report["load"] is None, "a recording does not say the bit rate"
    assert monitored(path, "--imu", driver)["signals"][0]["name"] == report["signals"][0]["name"]


def test_losses_are_told_by_kind(tmp_path: Path) -> None:
    batch = sent_by("dtg-head", 500)
    batch["data"][100, 30] ^= 0xFF
    wrong = frames(4)
    wrong["can_id"], wrong["time_ns"] = [ERR | 4, 0x7FF, 0x120, 0x120], batch["time_ns"][-1]
    wrong["length"] = 8
    kept = np.concatenate([np.delete(batch, slice(200, 210)), wrong])
    losses = monitored(recorded(tmp_path / "bad.dhil", kept), "--imu", "dtg-head")["losses"]
    assert (losses["crc_errors"], losses["short"], losses["error_frames"]) == (1, 2, 1)
    assert losses["lost"] == 11


def test_signals_of_a_dbc_are_those_of_cantools(tmp_path: Path) -> None:
    path = files("fixtures") / "can" / "sbgCan.dbc"
    batch = sent_by("sbg", 300)
    batch["length"][-1] -= 1
    stranger = frames(2)
    stranger["can_id"], stranger["time_ns"], stranger["length"] = 0x7FE, batch["time_ns"][-1], 3
    report = monitored(recorded(tmp_path / "x.dhil", np.concatenate([batch, stranger])), "--dbc", path)
    peer = cantools.database.load_string(path.read_text("cp1252"), "dbc")
    signals, seen = by_name(report), 0
    for can_id in np.unique(batch["can_id"]):
        message = peer.get_message_by_frame_id(int(can_id))
        row = batch[:-1][batch["can_id"][:-1] == can_id][-1]
        for name, value in message.decode(row["data"][: row["length"]].tobytes(), decode_choices=False).items():
            found = signals[f"{message.name}.{name}"]
            assert found["last"] == pytest.approx(value, rel=1e-12, abs=1e-12)
            assert found["unit"] == (message.get_signal_by_name(name).unit or "")
            seen += 1
    assert seen > 5
    assert (report["losses"]["unknown"], report["losses"]["dbc_short"]) == (2, 1)
    rows = {row["id"]: row for row in report["ids"]}
    assert rows["7FE"]["data"] == "00 00 00"
    assert rows["7FE"]["name"] == ""
    assert sum(row["count"] for row in report["ids"]) == report["frames"] == len(batch) + 2


@pytest.mark.parametrize("ending", ["log", "blf", "asc"])
def test_recordings_of_other_tools(tmp_path: Path, ending: str) -> None:
    batch = sent_by("xsens-can", 200)
    batch["time_ns"] += 1_700_000_000_000_000_000
    with can.Logger(tmp_path / f"x.{ending}") as log:
        for row in batch:
            log.on_message_received(to_message(row, "can0"))
    report = monitored(tmp_path / f"x.{ending}")
    assert (report["driver"], report["frames"], report["problem"]) == ("xsens-can", len(batch), "")
    assert by_name(report)["rate_x"]["rate_hz"] == pytest.approx(RATE_HZ, rel=0.01)


def test_nobody_knows_the_board(tmp_path: Path) -> None:
    batch = frames(50)
    batch["can_id"], batch["length"], batch["data"][:, 0] = 0x18FF1234 | EFF, 8, np.arange(50)
    batch["time_ns"] = 1 + np.arange(50) * 10_000_000
    report = monitored(recorded(tmp_path / "raw.dhil", batch))
    assert report["driver"] is None
    assert report["signals"] == []
    (row,) = report["ids"]
    assert (row["id"], row["count"], row["data"][:5]) == ("18FF1234", 50, "31 00")
    assert row["rate_hz"] == pytest.approx(100.0)
    assert "no known board" in hil("monitor", tmp_path / "raw.dhil")[0]


def test_a_flight_log(hil_data: Path) -> None:
    pytest.importorskip("pyulog", reason="reading ULog needs the extra 'logs'")
    report = monitored(hil_data / "px4_board.ulg")
    force = by_name(report)["force_z"]
    assert force["mean"] == pytest.approx(-G, rel=0.1)
    assert force["rate_hz"] > 50.0


def test_a_bridge_does_not_notice(hil_bridge: StartBridge) -> None:
    """A second listener on the bus of a bridge at work: it loses nothing, and both see the same samples."""
    bridge = hil_bridge(navigation={"alignment": "truth"}, head={"rate_hz": 500}, duration_s=None)
    bridge.wait_mode("navigate")
    report = monitored("--bus", bridge.bus, "--duration", 1.5, "--bitrate", 500_000, "--data-bitrate", 2_000_000)
    summary = bridge.stop()
    assert report["driver"] == "dtg-head"
    assert report["identity"]["world_id"] == bridge.scenario.world_id()
    assert report["losses"]["lost"] == 0 == summary["lost"]
    assert summary["feeder"]["dropped"] == 0
    assert by_name(report)["rate_g1x"]["rate_hz"] == pytest.approx(500, rel=0.1)
    assert 0.0 < report["load"]["least"] < report["load"]["most"] < 0.5


@contextmanager
def sending(url: str, batch: FrameArray) -> Iterator[None]:
    """A board on a bus, ten samples at a time, as long as it is wanted."""

    def feed(ended: threading.Event) -> None:
        port = open_port(url, listen=False)
        try:
            for start in range(0, len(batch), 20):
                port.send(batch[start : start + 20].copy())
                if ended.wait(0.02):
                    return
        finally:
            port.close()

    with beside(feed):
        yield


def test_lines_where_there_is_no_terminal() -> None:
    url = f"unix:mon-{time.monotonic_ns():x}"
    with sending(url, sent_by("sbg", 1500)):
        out, err = hil("monitor", "--bus", url, "--duration", 2.6)
    first = out.splitlines()[0]
    assert "frames/s" in first
    assert "load ?" in first
    assert "sbg" in first
    assert "rate_x" in out
    assert "\x1b" not in out
    assert f"hil run --imu sbg --bus {url}" in err


def test_what_is_compiled_at_the_first_frames_is_not_listened(tmp_path: Path) -> None:
    """On a machine that has compiled nothing yet, two seconds tell the board as well."""
    url = f"unix:mon-{time.monotonic_ns():x}"
    command = [sys.executable, "-c", "from hil.cli import main; main()", "monitor", "--bus", url, "--json"]
    fresh = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    with sending(url, sent_by("sbg", 60_000)):
        found = subprocess.run([*command, "--duration", "1"], capture_output=True, env=fresh, timeout=300, check=True)
    assert any(tmp_path.rglob("*.nbk"))
    assert json.loads(found.stdout)["driver"] == "sbg"


def test_a_table_that_renews_itself_in_a_terminal() -> None:
    url = f"unix:mon-{time.monotonic_ns():x}"
    command = [sys.executable, "-c", "from hil.cli import main; main()", "monitor", "--bus", url, "--duration", "2"]
    ours, theirs = pty.openpty()
    with sending(url, sent_by("sbg", 6000)):
        with subprocess.Popen(
            command, stdout=theirs, stderr=subprocess.DEVNULL, env={**os.environ, "TERM": "xterm", "COLUMNS": "150"}
        ) as process:
            os.close(theirs)
            seen = b""
            while select.select([ours], [], [], 60.0)[0]:
                try:
                    seen += os.read(ours, 65536)
                except OSError:
                    break
        os.close(ours)
    assert process.returncode == 0
    assert seen.count(b"force_z") >= 3, "the table was drawn again and again"
    assert b"\x1b[" in seen


@pytest.fixture
def port_file(tmp_path: Path) -> Path:
    if "xsens-xbus" not in driver_names():
        pytest.skip("installed before these boards were added: pip install -e .")
    return tmp_path / "ttyIMU"


@contextmanager
def plugged(name: str, path: Path, baud: int) -> Iterator[None]:
    """A board on a port that sends a hundred packets a second."""
    emulator = BOARDS[name][1]()
    with Plugged(None, path, only_baud=baud) as board:

        def feed(ended: threading.Event) -> None:
            for k in range(5000):
                for packet in emulator.packets(moving(1, start_s=5.0 + 0.01 * k)):
                    board.send(packet)
                if ended.wait(0.01):
                    return

        with beside(feed):
            yield


@pytest.mark.parametrize("name", BOARDS)
def test_a_serial_board(port_file: Path, name: str) -> None:
    with plugged(name, port_file, 921600):
        report = monitored("--bus", f"serial:{port_file}:921600", "--duration", 1.0)
    assert report["driver"] == name
    assert by_name(report)["force_z"]["unit"] == "m/s^2"
    assert report["identity"]["packets"] > 20
    (row,) = report["ids"]
    assert row["name"] == "serial bytes"
    assert 0.0 < report["load"]["least"] == report["load"]["most"] < 0.5


def test_a_wrong_baud_rate_is_told_with_the_right_one(port_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.serial.probe.RATES", (460800,))
    url = f"serial:{port_file}:115200"
    with plugged("vectornav", port_file, 460800):
        out, err = hil("monitor", "--bus", url, "--duration", 0.5)
        assert f"vectornav speaks here at 460800 baud: hil monitor --bus serial:{port_file}:460800" in err
        assert "no known board" in out
        assert "use --imu vectornav" in hil("monitor", "--bus", url, "--imu", "vectornav", code=2)[1]


def test_a_port_has_one_reader(port_file: Path) -> None:
    with plugged("xsens-xbus", port_file, 921600):
        port = open_port(f"serial:{port_file}:921600")
        try:
            said = hil("monitor", "--bus", f"serial:{port_file}:921600", "--duration", 0.5, code=2)[1]
        finally:
            port.close()
    assert "another program has it" in said


def test_bit_rates_are_given_or_stated() -> None:
    assert bitrates_of("unix:x", None, None) == (0.0, 0.0)
    assert bitrates_of("unix:x", 5e5, 2e6) == (5e5, 2e6)
    assert bitrates_of("slcan:/dev/ttyACM0?bitrate=250000", None, None) == (250000.0, 0.0)
    assert bitrates_of("serial:/dev/ttyUSB0:921600", None, None) == (921600.0, 0.0)
    assert bitrates_of("serial:socket://localhost:4001", None, None) == (0.0, 0.0)
    with pytest.raises(HilError, match="--bitrate -1"):
        bitrates_of("unix:x", -1.0, None)
    with pytest.raises(HilError, match="bitrate"):
        bitrates_of("slcan:/dev/ttyACM0?bitrate=fast", None, None)


def test_what_the_kernel_says_of_an_interface() -> None:
    """The shape is that of iproute2 6.1; a virtual interface has neither state nor rates."""
    real = {"state": "ERROR-PASSIVE", "bittiming": {"bitrate": 500000}, "data_bittiming": {"bitrate": 2000000}}
    text = json.dumps([{"ifname": "can0", "linkinfo": {"info_kind": "can", "info_data": real}}])
    assert read_link(text) == Link("ERROR-PASSIVE", 500000, 2000000)
    assert read_link('[{"ifname": "vcan0", "linkinfo": {"info_kind": "vcan"}}]') == Link()
    for nothing in ("", "[]", "[3]", "{}", "no"):
        assert read_link(nothing) == Link()


def test_requests_that_cannot_be_met(tmp_path: Path) -> None:
    assert "give a recording, or --bus" in hil("monitor", code=2)[1]
    assert "no driver 'nosuch'" in hil("monitor", "--bus", "unix:x", "--imu", "nosuch", code=2)[1]
    assert "cannot be read as a DBC" in hil("monitor", "--bus", "unix:x", "--dbc", tmp_path / "no.dbc", code=2)[1]
    assert "No such file" in hil("monitor", tmp_path / "no.dhil", code=2)[1]
    assert "expected INTERFACE:CHANNEL" in hil("monitor", "--bus", "foo", code=2)[1]


def test_batches_do_not_matter() -> None:
    batch = sent_by("sbg", 400)
    reports = []
    for size in (1, 37, len(batch)):
        one = Monitor("sbg")
        for start in range(0, len(batch), size):
            one.take(batch[start : start + size].copy())
        reports.append(one.report(one.last_ns))
    for report in reports[1:]:
        assert report["ids"] == reports[0]["ids"]
        for row, first in zip(report["signals"], reports[0]["signals"], strict=True):
            assert row["count"] == first["count"]
            assert row["std"] == pytest.approx(first["std"], rel=1e-9)
