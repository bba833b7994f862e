"""Another autopilot's MAVLink as an IMU: bytes through the port and the driver, its attitude beside ours."""

import contextlib
import math
import re
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.can.bus import check_url, open_port
from drivers.can.frames import frames
from drivers.mavlink.imu import mavlink_imu
from drivers.mavlink.signing import EPOCH_S, TICKS
from drivers.serial.chunks import to_chunks
from hil.other_attitude import Estimator, OtherAttitude
from nav.errors import HilError
from nav.rotation import quaternion_from_euler
from nav.state import NAV_STATE, Mode

RATE, FORCE = (0.1, -0.2, 0.3), (0.5, -0.7, -9.7)
G = 9.80665
STEP_S = 0.01


def highres(k: int, updated: int = 0b111111) -> Any:
    return mav.MAVLink_highres_imu_message(5_000_000 + round(1e6 * STEP_S) * k, *FORCE, *RATE, *[0.0] * 7, updated)


def scaled(k: int) -> Any:
    force, rate = [round(1000.0 * f / G) for f in FORCE], [round(1000.0 * w) for w in RATE]
    return mav.MAVLink_scaled_imu_message(5_000 + round(1e3 * STEP_S) * k, *force, *rate, 0, 0, 0)


def raw(k: int) -> Any:
    force, rate = [round(1000.0 * f / G) for f in FORCE], [round(1000.0 * w) for w in RATE]
    return mav.MAVLink_raw_imu_message(5_000_000 + round(1e6 * STEP_S) * k, *force, *rate, 0, 0, 0)


def attitude(k: int) -> Any:
    return mav.MAVLink_attitude_message(5_000 + round(1e3 * STEP_S) * k, 0.1, -0.2, 2.0, *RATE)


def stream(*messages: Any, system: int = 7, **how: Any) -> bytes:
    packer, data = mav.MAVLink(None, system, 1), b""
    for message in messages:
        data += bytes(message.pack(packer, **how))
        packer.seq = (packer.seq + 1) % 256
    return data


@pytest.mark.parametrize("old", [False, True], ids=["MAVLink 2", "MAVLink 1"])
@pytest.mark.parametrize(("kind", "make", "close"), [("", highres, 1e-6), ("", scaled, 6e-3), ("RAW_IMU", raw, 6e-3)])
def test_increments_are_those_of_the_autopilot(kind: str, make: Any, close: float, old: bool) -> None:
    driver = mavlink_imu(kind)
    data = stream(*(make(k) for k in range(200)), force_mavlink1=old)
    imu = driver.decode(to_chunks(data, 123))
    assert len(imu) == 199  # the first one has no step
    assert imu.step == pytest.approx(STEP_S)
    assert imu.dtheta / STEP_S == pytest.approx(np.tile(RATE, (199, 1)), abs=close)
    assert imu.dvel / STEP_S == pytest.approx(np.tile(FORCE, (199, 1)), abs=close * G)
    assert (driver.counters.lost, driver.counters.crc_errors) == (0, 0)
    assert set(driver.arrivals()) == {123}
    assert driver.identity()["system"] == 7


def test_one_sender_and_one_kind_are_followed() -> None:
    driver = mavlink_imu()
    mixed = b"".join(
        stream(raw(k), highres(k), scaled(k), mav.MAVLink_heartbeat_message(2, 3, 0, 0, 0, 3))
        + stream(highres(k), system=8)
        for k in range(50)
    )
    imu = driver.decode(to_chunks(mixed))
    assert len(imu) == 49
    assert driver.counters.foreign == 200
    assert driver.identity()["message"] == "HIGHRES_IMU"


def test_what_is_missing_is_lost_and_what_says_so_is_short() -> None:
    driver = mavlink_imu()
    kept = [k for k in range(100) if k not in (20, 40, 41)]
    imu = driver.decode(to_chunks(stream(*(highres(k, 0b111 if k == 50 else 0b111111) for k in kept))))
    assert (driver.counters.lost, driver.counters.short) == (4, 1)
    assert np.sum(imu.step <= 1.5 * STEP_S) >= 90


@given(st.data())
def test_damage_costs_what_it_touches(data: st.DataObject) -> None:
    """However the bytes are cut, and with bytes between them, the samples are the same."""
    good = [stream(highres(k)) for k in range(30)]
    junk = data.draw(st.binary(max_size=40).filter(lambda junk: b"\xfd" not in junk and b"\xfe" not in junk))
    whole = b"".join(good[:15]) + junk + b"".join(good[15:])
    cuts = sorted(data.draw(st.lists(st.integers(0, len(whole)), max_size=6)))
    driver, count = mavlink_imu(), 0
    for start, stop in zip([0, *cuts], [*cuts, len(whole)], strict=True):
        count += len(driver.decode(to_chunks(whole[start:stop])))
    assert count == 29


@given(st.binary(max_size=600))
def test_any_bytes_are_survived(junk: bytes) -> None:
    imu = mavlink_imu().decode(to_chunks(junk))
    assert np.isfinite(imu.dtheta).all()


def test_wrong_names_and_set_up_are_explained() -> None:
    with pytest.raises(HilError, match="expected one of HIGHRES_IMU, SCALED_IMU, RAW_IMU"):
        mavlink_imu("IMU")
    with pytest.raises(HilError, match="SR0_RAW_SENS"):
        mavlink_imu().board.configure(None, 100.0, 57600)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
def test_the_port_hands_the_bytes_over(kind: str) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        number = probe.getsockname()[1]
    port: Any = open_port(f"mavlink:{kind}:127.0.0.1:{number}")
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM if kind == "udpin" else socket.SOCK_STREAM)
    sender.connect(("127.0.0.1", number))
    driver, batch, count = mavlink_imu(), frames(1024), 0
    for k in range(100):
        sender.send(stream(highres(k)))
    deadline = time.monotonic() + 10.0
    while count < 99 and time.monotonic() < deadline:
        count += len(driver.decode(batch[: port.receive(batch, 0.1)]))
    assert count == 99
    sender.close()
    if kind == "tcpin":  # the next one is heard too
        for _ in range(3):
            port.receive(batch, 0.01)
        again = socket.create_connection(("127.0.0.1", number))
        again.send(stream(highres(200), highres(201)))
        while count < 101 and time.monotonic() < deadline:
            count += len(driver.decode(batch[: port.receive(batch, 0.1)]))
        assert count == 101
        again.close()
    port.close()


def signed_by(key: bytes) -> mav.MAVLink:
    """A packer of the autopilot's that signs, at the present time."""
    packer = mav.MAVLink(None, 7, 1)
    packer.signing.secret_key, packer.signing.sign_outgoing, packer.signing.link_id = key, True, 1
    packer.signing.timestamp = int((time.time() - EPOCH_S) * TICKS)
    return packer


KEY = bytes(range(32))


@pytest.fixture
def key_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that holds `KEY`, and no times of earlier tests."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    file = tmp_path / "mavlink.key"
    file.touch(0o600)
    file.write_text(KEY.hex())
    return file


@contextlib.contextmanager
def heard_at(options: str) -> Iterator[tuple[Any, Any, Callable[[bytes], None]]]:
    """An opened bus, its driver, and what sends a packet there and has it taken."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", 0))
        number = sender.getsockname()[1]
    with (
        contextlib.closing(open_port(f"mavlink:udpin:127.0.0.1:{number}{options}")) as port,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        driver, batch = mavlink_imu(), frames(1024)

        def tell(packet: bytes) -> None:
            sender.sendto(packet, ("127.0.0.1", number))
            driver.decode(batch[: port.receive(batch, 1.0)])

        yield port, driver, tell


def test_with_a_key_only_what_is_signed_with_it_goes_further(key_file: Path) -> None:
    good, forger = signed_by(KEY), signed_by(KEY[::-1])
    with heard_at(f"?signing_key={key_file}") as (port, driver, tell):
        for k in range(20):
            packet = bytes(highres(k).pack(good))
            tell(packet)
            tell(packet)  # a replay
            tell(bytes(highres(k + 1000).pack(forger)))
            tell(stream(highres(k + 2000)))
            tell(stream(highres(k + 3000), force_mavlink1=True))
            tell(packet[:20] + bytes([packet[20] ^ 1]) + packet[21:])
        damaged = port.refused["damaged"]
        assert damaged >= 20  # the signature of such a packet, which depends on the time, may hold a marker of its own
        refused = {"replayed": 20, "wrong signature": 20, "unsigned": 40, "damaged": damaged}
        assert port.refused == refused
        assert all(reason in port.trouble for reason in refused)
        counters = driver.counters
        assert (driver.board.identity()["system"], counters.foreign, counters.crc_errors, counters.lost) == (7, 0, 0, 0)
        (sample,) = driver.decode(to_chunks(bytes(highres(20).pack(good)))).time
        assert sample == pytest.approx(5.0 + 20 * STEP_S), "nothing of the others was navigated"
    with heard_at(f"?signing_key={key_file}") as (port, driver, tell):
        tell(packet)
        assert port.refused == {"replayed": 1}, "an earlier run's packet"


def test_without_a_key_signed_packets_are_taken_as_others_are(key_file: Path) -> None:
    with heard_at("") as (port, driver, tell):
        packer = signed_by(KEY)
        for k in range(20):
            tell(bytes(highres(k).pack(packer)))
        assert driver.counters.samples == 19  # the first one has no step
        assert (port.refused, port.trouble) == ({}, "")


def test_a_signed_stream_that_is_cut_anywhere_is_whole_again(key_file: Path) -> None:
    """Over TCP packets come in pieces, with others' bytes between them."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        number = probe.getsockname()[1]
    packer, rng = signed_by(KEY), np.random.default_rng(5)
    data = b"".join(bytes(highres(k).pack(packer)) + b"\xfd\x00noise"[: k % 8] for k in range(100))
    driver, batch, taken = mavlink_imu(), frames(64), 0
    with (
        contextlib.closing(open_port(f"mavlink:tcpin:127.0.0.1:{number}?signing_key={key_file}")) as port,
        socket.create_connection(("127.0.0.1", number)) as sender,
    ):
        while data:
            size = int(rng.integers(1, 300))
            sender.send(data[:size])
            data = data[size:]
            taken += len(driver.decode(batch[: port.receive(batch, 0.05)]))
        deadline = time.monotonic() + 10.0
        while taken < 99 and time.monotonic() < deadline:
            taken += len(driver.decode(batch[: port.receive(batch, 0.05)]))
    assert taken == 99


@pytest.mark.parametrize(
    ("options", "say"),
    [
        ("?sign=true", "unknown option 'sign'; expected signing_key=FILE"),
        ("?signing_key=/nowhere/key", "signing key /nowhere/key: No such file"),
    ],
)
def test_wrong_options_of_the_bus_are_refused(options: str, say: str) -> None:
    with pytest.raises(HilError, match=re.escape(say)):
        check_url(f"mavlink:udpin:127.0.0.1:14560{options}")


def test_a_key_that_others_can_read_is_refused(key_file: Path) -> None:
    key_file.chmod(0o644)
    with pytest.raises(HilError, match="chmod 600") as refused:
        check_url(f"mavlink:udpin:127.0.0.1:14560?signing_key={key_file}")
    assert KEY.hex() not in str(refused.value)


def test_the_other_attitude_is_compared_where_both_are() -> None:
    driver = mavlink_imu()
    assert isinstance(driver, Estimator)
    other = OtherAttitude(driver)
    driver.decode(to_chunks(stream(*(message(k) for k in range(20) for message in (highres, attitude)))))
    rows = np.zeros(20, NAV_STATE)
    rows["time"], rows["mode"] = 5.0 + STEP_S * np.arange(20), Mode.NAVIGATE
    rows["q_nb"] = quaternion_from_euler(2.0 + math.radians(0.5), -0.2, 0.1)
    rows["mode"][:5] = Mode.ALIGN
    other.compare(rows)
    found = other.summary()
    assert found is not None
    assert found["compared"] == 15
    assert found["heading_deg"]["max"] == pytest.approx(0.5, abs=1e-6)
    assert found["tilt_deg"]["max"] == pytest.approx(0.0, abs=1e-4)
    rows["time"] += 100.0
    driver.decode(to_chunks(stream(attitude(30))))
    other.compare(rows)
    summary = other.summary()
    assert summary is not None
    assert summary["compared"] == 15
    assert OtherAttitude(mavlink_imu()).summary() is None
