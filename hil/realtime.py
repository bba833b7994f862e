"""What ``--realtime`` asks of the kernel: a priority above all ordinary processes, locked memory, a processor for the loop.

Each is taken where it is permitted; what is not is said with the command that mends it. The garbage collector is frozen in
every run. On a processor of its own the loop does not wait to be woken for the next sample: it looks for it (`rest`).
"""

import ctypes
import os
import time
from dataclasses import dataclass, field
from typing import Any

PRIORITY = 50
"""Of the loop under SCHED_FIFO: below the kernel's own threads that serve interrupts."""
_LOCK_ALL = 3  # MCL_CURRENT | MCL_FUTURE
REST, SHORTEST_S = 0.25, 0.0005
LIMITS = (
    "put '@realtime - rtprio 90' and '@realtime - memlock unlimited' into /etc/security/limits.d and join that group"
)


@dataclass(slots=True)
class Granted:
    """What a process got.

    Attributes
    ----------
    priority : int
        Under SCHED_FIFO; 0: an ordinary process.
    locked : bool
        Its memory is never paged out.
    processor : int
        That it has for itself; -1: it shares all.
    lacking : list of str
        What was refused, and the mend.
    """

    priority: int = 0
    locked: bool = False
    processor: int = -1
    lacking: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """For the summary."""
        return {name: getattr(self, name) for name in self.__slots__}


def claim() -> Granted:
    """Make this process the one that keeps its deadlines: the last of the usable processors is its own."""
    granted = Granted()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        granted.priority = PRIORITY
    except OSError as error:
        granted.lacking.append(f"no real-time priority ({error.strerror}): {LIMITS}")
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_LOCK_ALL) == 0:
        granted.locked = True
    else:
        granted.lacking.append(f"memory is not locked ({os.strerror(ctypes.get_errno())}): {LIMITS}")
    usable = sorted(os.sched_getaffinity(0))
    if len(usable) > 1:
        os.sched_setaffinity(0, usable[-1:])
        granted.processor = usable[-1]
    else:
        granted.lacking.append("one processor only: the loop shares it with all others")
    return granted


def rest(period_s: float | None) -> int:
    """Sleep for `REST` of the period, as the kernel wants of those that have priority; until when to look for the next sample.

    Waking costs more than a sample does. The answer is in ns of the monotonic clock, 0 where looking does not pay: the period
    is not known, or samples come so fast that the loop has no rest.
    """
    if period_s is None or period_s < SHORTEST_S:
        return 0
    began = time.monotonic_ns()
    time.sleep(REST * period_s)
    return began + round(2e9 * period_s)


def step_aside() -> None:
    """Leave the loop's processor to the loop."""
    usable = sorted(os.sched_getaffinity(0))
    if len(usable) > 1:
        os.sched_setaffinity(0, usable[:-1])


def refused() -> list[str]:
    """What `claim` would not get, found out in a process of its own."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:  # pragma: no cover - another process
        os.write(write, "\n".join(claim().lacking).encode())
        os._exit(0)
    os.close(write)
    with os.fdopen(read) as answer:
        lines = answer.read().splitlines()
    os.waitpid(child, 0)
    return lines
