"""Fuzz targets: recordings, flight logs, and the files that people write. Each input is a file in memory."""

import io
import json
import struct
import tempfile
import zlib
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import can
import numpy as np
from pty_board import moving
from test_dataflash import NEW, OLD, Writer
from test_ulog import base, made

from drivers import make_emulator
from drivers.can.convert import to_message
from drivers.can.dtg_head import DtgHead
from drivers.can.dtg_head_emulator import HeadEncoder
from drivers.can.frames import FRAME, FrameArray
from drivers.can.j1939 import J1939Imu
from drivers.logs.dataflash import read_dataflash
from drivers.logs.imu_log import ImuLog
from drivers.logs.recording import EVENT, MAGIC, RecordingWriter, event_record
from drivers.logs.ulog import read_ulog
from drivers.serial.chunks import to_chunks
from hil.aid_file import AID_HEADER, read_aiding
from hil.calibration import NO_HEAD
from hil.calibration import read as read_calibration
from hil.calibration import validated as validated_calibration
from hil.calibration_sequence import read_sequence
from hil.offline import IMU_HEADER, NAV_HEADER, read_init, steps
from hil.scenario import built_in_names, load
from hil.settings import settings_of
from hil.source import FileSource, is_own, scenario_table
from hil.tables import read_table
from nav.increments import FloatArray

Take = Callable[[bytes], None]
Made = tuple[Take, list[bytes]]
_FOLDER = tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)


def _file(name: str) -> Path:
    return Path(_FOLDER.name) / name


def _reader(name: str, read: Callable[[Path], object]) -> Take:
    """Writes its argument into a file and reads that."""
    path = _file(name)

    def take(data: bytes) -> None:
        path.write_bytes(data)
        read(path)

    return take


def _some_frames(kind: str) -> FrameArray:
    if kind == "j1939-imu":
        return make_emulator(kind, 10_000).samples(moving(6))
    encoder, k = HeadEncoder("fd", 1000), np.arange(1, 6)
    return np.concatenate([encoder.slow(), encoder.samples(k, 1000 * k, np.zeros((5, 4)), np.ones((5, 3)))])


def recording() -> Made:
    """Our own; the first byte says whether its checks are made right."""
    path = _file("own.dhil")

    def take(data: bytes) -> None:
        path.write_bytes(_mended(data[1:]) if data[:1] == b"\x01" else data[1:])
        source, driver, count = FileSource(path, paced=False), DtgHead(), 0
        for batch in source.batches(64):
            assert (batch["reserved"][:, 0] != EVENT).all()
            driver.decode(batch)
            count += len(batch)
        assert source.exhausted
        assert count * FRAME.itemsize <= len(data)
        if is_own(path):
            table = scenario_table(path)
            assert table is None or json.dumps(table)

    with RecordingWriter(path, {"scenario": load("rest").model_dump(mode="json")}) as writer:
        writer.write(_some_frames("dtg-head"))
        writer.write(event_record(1, 5))
        writer.flush()
        writer.write(to_chunks(b"\xfa\xff" * 50))
    whole = path.read_bytes()
    with RecordingWriter(path, {}) as writer:
        writer.write(_some_frames("dtg-head"))
    return take, [b"\x01" + path.read_bytes(), b"\x00" + path.read_bytes(), b"\x01" + whole]


def _mended(data: bytes) -> bytes:
    """`data` with the checks of header and blocks made right."""
    at = len(MAGIC) + 8
    if len(data) < at:
        return data
    length = int.from_bytes(data[at - 8 : at - 4], "little")
    out = data[: at - 4] + struct.pack("<I", zlib.crc32(data[at : at + length])) + data[at : at + length]
    rest = data[at + length :]
    while len(rest) >= 12:
        size = 12 + FRAME.itemsize * int.from_bytes(rest[4:8], "little")
        out += rest[:8] + struct.pack("<I", zlib.crc32(rest[12:size])) + rest[12:size]
        rest = rest[size:]
    return out + rest


def foreign(suffix: str) -> Made:
    """Recordings of other programs, through python-can."""
    path = _file(f"foreign{suffix}")

    def read(path: Path) -> None:
        source, driver = FileSource(path, paced=False), J1939Imu()
        for batch in source.batches(7):
            assert batch["length"].max(initial=0) <= 64
            driver.decode(batch)

    seeds = []
    options: list[dict[str, int]] = [{"compression_level": 0}, {}] if suffix == ".blf" else [{}]
    for kind in ("j1939-imu", "dtg-head"):
        for option in options:
            with can.Logger(path, **option) as writer:
                for row in _some_frames(kind):
                    writer.on_message_received(to_message(row, "can0"))
            seeds.append(path.read_bytes())
    return _reader(path.name, read), seeds


def _is_whole(log: ImuLog) -> None:
    assert np.isfinite(log.rate).all()
    assert np.isfinite(log.force).all()
    assert np.isfinite(log.attitude).all()
    assert (np.diff(log.time_us) > 0).all()
    assert (log.step_us > 0).all()
    assert np.isfinite(log.aiding["value"]).all()
    assert (log.aiding["sigma"] > 0.0).all()
    assert np.isfinite([log.shake(log.rate), log.shake(log.force)]).all()


def ulog() -> Made:
    """PX4."""
    path = _file("seed.ulg")
    old = made(path, base(15), EKF2_BARO_DELAY=30.0).read_bytes()
    fixes = [(10**6 + 4000 * k, 500_000_000, 300_000_000, 1000, 0.1, 1.0, 2.0, 0.0, 0.0, 0.0, 3) for k in range(3)]
    aided = base(10) | {
        ("vehicle_gps_position", 0): fixes,
        ("vehicle_magnetometer", 1): [(1_004_000, 0.2, 0.0, 0.4)] * 2,
    }
    return _reader("fuzz.ulg", lambda path: _is_whole(read_ulog(path))), [old, made(path, aided).read_bytes()]


def dataflash() -> Made:
    """ArduPilot of two generations."""

    def undulation(lat: float, lon: float) -> float:
        assert abs(lat) < 1.6
        return 50.0

    new, old = Writer(NEW), Writer(OLD)
    new.write("PARM", b"GPS_DELAY_MS", 120.0)
    for k in range(4):
        us = 5_000_000 + 20_000 * k
        new.write("IMU", us, 0, 0.1, 0.2, 0.3, 0.1, -0.2, -9.8)
        new.write("ATT", us, 2.0, -3.0, 350.0)
        old.write("IMU", us // 1000, 0.1, 0.2, 0.3, 0.1, -0.2, -9.8)
        old.write("ATT", us // 1000, 2.0, -3.0, 350.0)
    new.write("GPS", us, 0, 3, 1000, 2200, 12, 0.9, 50.0, 36.0, 100.0, 10.0, 90.0, -0.5, 1)
    new.write("GPA", us, 0, 1.5, 2.5, 0.3)
    new.write("MAG", us, 0, 200, -50, 400)
    new.write("BARO", us, 0, 12.5)
    old.write("GPS", 3, 400_000_000, 1821, 9, 1.2, 50.0, 36.0, 100.0, 10.0, 90.0, -0.5, us // 1000)
    take = _reader("fuzz.bin", lambda path: _is_whole(read_dataflash(path, undulation)))
    return take, [new.data, old.data]


def scenario() -> Made:
    """Scenarios; what is accepted must be usable."""

    def read(path: Path) -> None:
        found = load(path)
        assert found.world_id() > 0
        settings_of(found)

    folder = files("fixtures") / "scenarios"
    return _reader("fuzz.toml", read), [(folder / f"{name}.toml").read_bytes() for name in built_in_names()]


CALIBRATION = b"""serial = 7
date = 2026-01-02
skew_deg = 0.5
reference_c = [40, 40, 35]
range_c = [[20, 60], [20, 60], [20, 60]]
undetermined = ["x"]
[gyro]
bias_deg_h = [0.1, 0.2, 0.3, 0.4]
bias_temperature_deg_h_k = [[0.1, 0.2, 0.3, 0.4]]
[accelerometer]
bias_ug = [10, 20, 30]
[[rotor]]
spin_hz = 228
[[rotor]]
spin_hz = 228
[magnetometer]
hard_iron_ut = [1, 2, 3]
matrix = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
"""
SEQUENCE = b"""latitude_deg = 50.0
[[position]]
recording = "a.dhil"
heading_deg = 0
pitch_deg = 0
roll_deg = 90
[[turn]]
recording = "b.dhil"
heading_deg = 0
pitch_deg = 0
roll_deg = 0
from_s = 1
to_s = 5
axis = [0, 0, 1]
angle_deg = 360
[magnetometer]
recording = "c.dhil"
known = "attitude"
field_ned_ut = [20, 1, 40]
"""
FILTER = """[filter]
grade = "tactical"
attitude_sigma_deg = [0.1, 0.1, 0.5]
lever_arm_m = [0.8, -0.3, -1.0]
field = "dipole"
gnss_delay_s = 0.05
estimate = ["gyro_bias"]
"""


def calibration() -> Made:
    """Calibration files."""

    def read(path: Path) -> None:
        found = read_calibration(path)
        validated_calibration(found.as_table(), "again")
        found.calibration()

    assert validated_calibration(NO_HEAD, "of no head")
    return _reader("calibration.toml", read), [CALIBRATION]


def sequence() -> Made:
    """Sequence files of a calibration."""

    def read(path: Path) -> None:
        for turn in read_sequence(path).turn:
            assert np.isfinite(turn.rate()).all()

    return _reader("sequence.toml", read), [SEQUENCE]


def init() -> Made:
    """INIT.toml of `hil navigate`."""

    def read(path: Path) -> None:
        start, _ = read_init(path)
        assert np.isfinite(list(start.values())).all()

    plain = "".join(f"{name} = 1.5\n" for name in NAV_HEADER)
    return _reader("INIT.toml", read), [plain.encode(), (plain + FILTER).encode()]


def imu(suffix: str) -> Made:
    """IMU tables of `hil navigate`."""

    def read(path: Path) -> None:
        table = read_table(path, IMU_HEADER)
        assert table.shape == (len(table), len(IMU_HEADER))
        assert np.isfinite(table).all()
        assert (steps(table, {"time_s": 0.0}) > 0.0).all()

    table = np.arange(1.0, 29.0).reshape(4, 7) / 7.0
    text = "\n".join([",".join(IMU_HEADER), *(",".join(map(repr, row)) for row in table.tolist()), ""])
    return _reader(f"imu{suffix}", read), [text.encode() if suffix == ".csv" else _archive(IMU_HEADER, table)]


def aid(suffix: str) -> Made:
    """Tables of measurements."""

    def read(path: Path) -> None:
        rows = read_aiding(path)
        assert (np.diff(rows["time"]) >= 0.0).all()
        assert np.isfinite(rows["value"]).all()
        assert (rows["sigma"] > 0.0).all()

    if suffix == ".csv":
        lines = (
            *(",".join(AID_HEADER), "1.5,gnss,0,50,30,100,1,2,3,5,5,8,0.1,0.1,0.1", "2.5,baro,1,100,,,,,,2"),
            *("3,heading,0,30,,,,,,1", "4,attitude,0,1,2,3,,,,1,1,2", "5,zero_rate,0,,,,,,,0.1,0.1,0.1", ""),
        )
        return _reader("aid.csv", read), ["\n".join(lines).encode()]
    table = np.full((2, len(AID_HEADER)), np.nan)
    table[:, [0, 3, 9]] = [(1.0, 100.0, 2.0), (2.0, 0.5, 0.1)]
    return _reader("aid.npz", read), [_archive(AID_HEADER, table, kind=["baro", "heading"], source=[0, 1])]


def _archive(header: tuple[str, ...], table: FloatArray, **columns: Any) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **dict(zip(header, table.T, strict=True)) | columns)
    return stream.getvalue()
