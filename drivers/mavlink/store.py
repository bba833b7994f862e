"""A few numbers that outlive a run, in the user's state folder: signing times, parameters.

A file is replaced as a whole, so that a reader or a power cut finds the old one or the new one.
"""

import fcntl
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nav.errors import HilError


def state_folder() -> Path:
    """``$XDG_STATE_HOME/dtg-hil``, or what that is where the variable is not set."""
    base = os.environ.get("XDG_STATE_HOME", "")
    return (Path(base) if base.startswith("/") else Path.home() / ".local" / "state") / "dtg-hil"


class Store:
    """One JSON object in a file that only its owner can read; made when it is first written.

    Parameters
    ----------
    path : Path
        Its folder is made too.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> dict[str, Any]:
        """What is kept; empty where there is no file.

        Raises
        ------
        HilError
            The file cannot be read, or holds something else.
        """
        try:
            found = json.loads(self.path.read_text())
        except FileNotFoundError:
            return {}
        except (OSError, ValueError) as error:
            raise HilError(f"{self.path}: cannot be read ({error}); mend it or remove it") from error
        if not isinstance(found, dict):
            raise HilError(f"{self.path}: holds no JSON object; remove it")
        return found

    def update(self, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
        """Replace what is kept by ``change`` of it; programs that do so at the same time wait for each other.

        Raises
        ------
        HilError
            The file cannot be read or written.
        """
        part = self.path.with_suffix(f".{os.getpid()}")
        try:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with self.path.with_suffix(".lock").open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                text = json.dumps(change(self.read()))
                with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
                    file.write(text)
                part.replace(self.path)
        except OSError as error:
            raise HilError(f"{self.path}: cannot be written: {error.strerror}") from error
