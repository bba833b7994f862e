"""The link of a pseudo-terminal: one that was left behind is replaced, nothing of anybody else is touched."""

import os
from contextlib import closing
from pathlib import Path

import pytest

from drivers.serial.pty import PtyLink, PtyPort
from nav.errors import HilError


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return tmp_path / "ttyIMU"


def test_a_link_to_anything_else_is_left_alone(place: Path, tmp_path: Path) -> None:
    for target in (tmp_path, tmp_path / "not there yet", Path("/dev/null")):
        place.symlink_to(target)
        with pytest.raises(HilError, match=f"a link to {target}: remove it .* give a path where nothing is"):
            PtyPort(place)
        assert place.readlink() == target
        place.unlink()


def test_of_two_boards_at_one_path_the_second_is_refused(place: Path) -> None:
    with closing(PtyLink(place)) as first:
        terminal = place.readlink()
        with pytest.raises(HilError, match=f"File exists .a link to {terminal}: remove it"):
            PtyLink(place)
        descriptor = os.open(place, os.O_RDWR | os.O_NOCTTY)
        first.send(b"still here")
        assert os.read(descriptor, 10) == b"still here"
        os.close(descriptor)
    assert not place.is_symlink()


@pytest.mark.parametrize("same_number", [True, False])
def test_a_link_that_was_left_behind_is_replaced(
    place: Path, same_number: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program that was killed removes nothing, and the kernel gives its number to the next."""
    ours, theirs = os.openpty()
    place.symlink_to(os.ttyname(theirs) if same_number else "/dev/pts/1000000")
    monkeypatch.setattr(os, "openpty", lambda: (ours, theirs))
    with closing(PtyLink(place)):
        assert place.readlink() == Path(os.ttyname(theirs))
    assert not place.is_symlink()


def test_what_has_taken_the_path_meanwhile_stays(place: Path, tmp_path: Path) -> None:
    port = PtyPort(place)
    place.unlink()
    place.symlink_to(tmp_path)
    port.plug(False)
    assert place.readlink() == tmp_path
    with pytest.raises(HilError, match="remove it"):
        port.plug(True)
    port.close()
