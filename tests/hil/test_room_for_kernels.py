"""Where compiled kernels lie when the installation is read-only."""

import os
from pathlib import Path

import pytest

import hil


def test_a_folder_that_others_may_fill_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home, temporary = tmp_path / "home", tmp_path / "tmp"
    monkeypatch.setenv("XDG_CACHE_HOME", str(home))
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    monkeypatch.setattr("os.access", lambda *_: False)

    def room() -> str:
        monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
        hil._find_room_for_kernels()
        return os.environ.get("NUMBA_CACHE_DIR", "")

    name = f"dtg-hil-{os.getuid()}"
    assert room() == str(home / name / "numba")
    (home / name / "numba").chmod(0o777)
    assert room() == str(temporary / name / "numba")
    (temporary / name).rename(tmp_path / "elsewhere")
    (temporary / name).symlink_to(tmp_path / "elsewhere")
    assert room() == ""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
