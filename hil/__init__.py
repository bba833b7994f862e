"""The product: configuration, the real-time bridge, the simulated world, the command line."""

import os
import stat
import tempfile
from pathlib import Path

import nav


def _find_room_for_kernels() -> None:
    """Compiled kernels are cached beside the code; where that is read-only, in the user's cache or a temporary folder."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    if "NUMBA_CACHE_DIR" in os.environ or os.access(Path(nav.__file__).parent, os.W_OK):
        return
    for base in (home, Path(tempfile.gettempdir())):
        folder = base / f"dtg-hil-{os.getuid()}" / "numba"
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            mine = all(map(_is_mine, (folder.parent, folder)))
        except OSError:
            continue
        if not mine:  # what lies there is executed
            continue
        os.environ["NUMBA_CACHE_DIR"] = str(folder)
        return


def _is_mine(folder: Path) -> bool:
    found = folder.lstat()
    return found.st_uid == os.getuid() and not found.st_mode & stat.S_IWOTH


_find_room_for_kernels()
