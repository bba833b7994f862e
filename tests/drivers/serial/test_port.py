"""A serial port on pseudo-terminals: every byte value, partial writes, a port that is pulled out, and what errors say."""

import os
import socket
import time
from contextlib import closing
from pathlib import Path

import pytest
from pty_board import Plugged

from drivers.can.bus import open_port
from drivers.can.frames import frames
from drivers.serial.chunks import chunk_bytes, is_chunk, to_chunks
from drivers.serial.port import SerialPort
from nav.errors import HilError


@pytest.fixture
def port_file(tmp_path: Path) -> Path:
    return tmp_path / "ttyIMU"


def received(port: SerialPort, n: int, timeout: float = 5.0) -> bytes:
    """`n` bytes from the port."""
    data, batch, deadline = b"", frames(64), time.monotonic() + timeout
    while len(data) < n and time.monotonic() < deadline:
        data += chunk_bytes(batch[: port.receive(batch, 0.1)])
    return data


def opened(path: Path) -> SerialPort:
    port = open_port(f"serial:{path}:921600")
    assert isinstance(port, SerialPort)
    return port


def test_every_byte_goes_both_ways_as_it_is(port_file: Path) -> None:
    data = bytes(range(256)) * 40
    with Plugged(None, port_file) as board, closing(opened(port_file)) as port:
        for start in range(0, len(data), 1000):
            board.send(data[start : start + 1000])
            assert received(port, len(data[start : start + 1000])) == data[start : start + 1000]
        port.send(to_chunks(data))
        deadline = time.monotonic() + 5.0
        while len(board.heard) < len(data) and time.monotonic() < deadline:
            time.sleep(0.01)
        assert board.heard == data
        assert port.dropped == port.failures == 0


def test_chunks_carry_their_arrival_and_fill_no_more_than_the_batch(port_file: Path) -> None:
    with Plugged(None, port_file) as board, closing(opened(port_file)) as port:
        board.send(bytes(1000))
        batch, before = frames(64), time.time_ns()
        assert received(port, 0) == b""
        n = port.receive(batch[:3], 1.0)
        assert n == 3
        assert batch["length"][:3].tolist() == [64, 64, 64]
        assert is_chunk(batch[:3]).all()
        assert abs(int(batch["time_ns"][0]) - before) < 10 * 10**9
        assert len(received(port, 1000 - 192)) == 1000 - 192


def test_nothing_comes_in_the_time_given(port_file: Path) -> None:
    with Plugged(None, port_file), closing(opened(port_file)) as port:
        assert port.receive(frames(64), 0.0) == 0
        assert port.failures == 0


def test_a_board_that_does_not_read_costs_frames_and_not_the_run(
    port_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.serial.port.WRITE_S", 0.05)
    master, slave = os.openpty()
    port_file.symlink_to(os.ttyname(slave))
    with closing(opened(port_file)) as port:
        port.send(to_chunks(bytes(1 << 18)))
        assert 0 < port.dropped < 1 << 12
        port.send(frames(2))  # frames of a CAN bus have no place here
        assert port.dropped > 2
    os.close(master)
    os.close(slave)


def test_a_port_that_is_pulled_out_is_opened_again(port_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.serial.port.REOPEN_S", 0.05)
    with closing(SerialPort(f"serial:{port_file}:115200") if port_file.exists() else _first(port_file)) as port:
        for _ in range(2):
            batch = frames(64)
            assert port.receive(batch, 0.0) == 0  # gone, and no port there
            with Plugged(None, port_file) as board:
                deadline = time.monotonic() + 5.0
                while port._port is None and time.monotonic() < deadline:
                    port.receive(batch, 0.02)
                board.send(b"again")
                assert received(port, 5) == b"again"
            assert received(port, 1, 0.2) == b""
        assert port.failures == 3


def _first(path: Path) -> SerialPort:
    """A port whose board was pulled out."""
    with Plugged(None, path):
        port = opened(path)
    assert received(port, 1, 0.1) == b""
    return port


@pytest.mark.parametrize(
    ("url", "say"),
    [
        ("serial:/dev/ttyNOSUCH:115200", "no such port; there is: "),
        ("serial:/dev/ttyUSB0", "expected serial:/dev/NAME:BAUD"),
        ("serial:/dev/ttyUSB0:fast", "baud rate 'fast'"),
        ("serial:/dev/ttyUSB0:0", "baud rate '0'"),
        ("serial:socket://host", "expected serial:"),
        ("serial:rfc2217://host:1:115200", "expected serial:"),
        ("serial:", "expected INTERFACE:CHANNEL"),
    ],
)
def test_bad_urls_say_what_is_wrong(url: str, say: str) -> None:
    with pytest.raises(HilError) as refusal:
        open_port(url)
    assert say in str(refusal.value)


def test_a_port_in_use_and_a_file_that_is_none(port_file: Path, tmp_path: Path) -> None:
    with (
        Plugged(None, port_file),
        closing(opened(port_file)),
        pytest.raises(HilError, match=r"another program has it.*fuser"),
    ):
        opened(port_file)
    file = tmp_path / "file"
    file.write_bytes(b"")
    with pytest.raises(HilError, match="no serial port"):
        opened(file)


def test_no_permission_names_the_group(port_file: Path) -> None:
    user = os.geteuid()
    with Plugged(None, port_file):
        os.chmod(port_file.resolve(), 0)
        try:
            os.seteuid(user or 65534)  # root may open every port
            with pytest.raises(HilError, match=r"no permission; sudo usermod -aG dialout"):
                opened(port_file)
        finally:
            os.seteuid(user)


def test_a_port_server_on_the_network() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        closing(open_port(f"serial:socket://127.0.0.1:{server.getsockname()[1]}")) as port,
    ):
        assert isinstance(port, SerialPort)
        client, _ = server.accept()
        with client:
            client.sendall(b"from afar")
            assert received(port, 9) == b"from afar"
            port.send(to_chunks(b"back"))
            assert client.recv(10) == b"back"
        assert received(port, 1, 0.3) == b""
        assert port.failures == 1
