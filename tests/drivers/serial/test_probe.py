"""A wrong baud rate, a wrong driver, a silent port: what is said."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from beside import beside
from pty_board import BOARDS, Plugged, moving

from drivers import driver_names
from drivers.serial.probe import Heard, check_port, listen, probe
from nav.errors import HilError

pytestmark = pytest.mark.skipif(
    "xsens-xbus" not in driver_names(), reason="installed before these boards were added: pip install -e ."
)


@contextmanager
def sending(name: str, path: Path, baud: int) -> Iterator[None]:
    """A board that sends without end at a rate of its own."""
    emulator = BOARDS[name][1]()
    with Plugged(None, path, only_baud=baud) as board:

        def feed(ended: threading.Event) -> None:
            for _ in range(20_000):
                for packet in emulator.packets(moving(1)):
                    board.send(packet)
                if ended.wait(0.01):
                    return

        with beside(feed):
            yield


@pytest.mark.parametrize("name", BOARDS)
def test_the_rate_and_the_board_are_found(name: str, tmp_path: Path) -> None:
    with sending(name, tmp_path / "imu", 921600):
        found = probe(str(tmp_path / "imu"))
        assert found is not None
        assert (found.driver, found.baud) == (name, 921600)


def test_a_wrong_rate_names_the_right_one(tmp_path: Path) -> None:
    path = tmp_path / "imu"
    with sending("xsens-xbus", path, 460800):
        with pytest.raises(HilError) as refusal:
            check_port(f"serial:{path}:115200", "xsens-xbus", 0.2)
        assert f"use --imu xsens-xbus --bus serial:{path}:460800" in str(refusal.value)
        assert check_port(f"serial:{path}:460800", "xsens-xbus", 5.0) == ""


def test_a_wrong_driver_names_the_right_one(tmp_path: Path) -> None:
    path = tmp_path / "imu"
    with sending("vectornav", path, 115200), pytest.raises(HilError, match="use --imu vectornav"):
        check_port(f"serial:{path}:115200", "xsens-xbus", 0.2)


def test_silence_is_said_and_no_refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.serial.probe.LISTEN_S", 0.01)
    path = tmp_path / "imu"
    with Plugged(None, path):
        assert "nothing comes" in check_port(f"serial:{path}:115200", "xsens-xbus", 0.05)
        assert probe(str(path), listen_s=0.01) is None
        for driver in ("dtg-head", "dronecan-imu@7"):
            with pytest.raises(HilError, match=f"a {driver} is at no serial port: .*--imu .*vectornav"):
                check_port(f"serial:{path}:115200", driver, 0.05)


def test_rubbish_is_nobody(tmp_path: Path) -> None:
    path = tmp_path / "imu"
    with Plugged(None, path) as board:
        board.send(bytes(100))  # before it is opened: a terminal keeps it, pyserial drops it
        heard = listen(f"serial:{path}:115200", list(BOARDS), 0.05)
    assert isinstance(heard, Heard)
    assert heard.driver == ""
