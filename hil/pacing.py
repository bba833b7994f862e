"""Keeping time: a sender that is due at given moments of the host's monotonic clock."""

import time
from collections.abc import Callable


class Pacer:
    """Sleeps until each due moment; a late one is not waited for, and lateness does not add up."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def wait(self, due_s: float, cancelled: Callable[[], bool]) -> bool:
        """Sleep until `due_s` after the start; False when cancelled meanwhile (looked at every 50 ms)."""
        while (remaining := self._start + due_s - time.monotonic()) > 0:
            if cancelled():
                return False
            time.sleep(min(remaining, 0.05))
        return True
