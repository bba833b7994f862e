"""What ``--realtime`` asks of the kernel: a priority above all ordinary processes, locked memory, a processor for the loop.

Each is taken where it is permitted; what is not is said with the command that mends it. The garbage collector is frozen in
every run. Where there are two processors the loop does not wait to be woken for the next sample: it looks for it, a long
time on one of its own (`rest`), a short one on one that it shares (`doze`).
"""

import ctypes
import os
import select
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

PRIORITY = 50
"""Of the loop under SCHED_FIFO: below the kernel's own threads that serve interrupts."""
_LOCK_ALL = 3  # MCL_CURRENT | MCL_FUTURE
REST, SHORTEST_S = 0.25, 0.0005
LEAD_S = 150e-6
"""How long before its time a sample is looked for on a shared processor: sleep ends later than was asked, by 50 to 100 us."""
TURN_NS, PAUSES = 1_000_000, 20
"""Who gives way and gets the processor back later than this shares it with the busy, and sleeps for so many times as long."""
_TIMER_SLACK = 29  # PR_SET_TIMERSLACK
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


def doze(watched: Sequence[int], heard_ns: int, period_s: float | None) -> int:
    """Sleep until shortly before the next sample is expected, or until something comes; until when to look for the sample.

    Parameters
    ----------
    watched : sequence of int
        The descriptor on which samples come; empty: looking is of no use.
    heard_ns : int
        When the last sample came, ns of the monotonic clock.
    period_s : float, optional
        Of the samples, s.

    Returns
    -------
    int
        ns of the monotonic clock, 0 where looking does not pay: something has come, or as for `rest`.
    """
    if period_s is None or period_s < SHORTEST_S or not watched:
        return 0
    expected_ns = heard_ns + round(1e9 * period_s)
    left_s = 1e-9 * (expected_ns - time.monotonic_ns()) - LEAD_S
    if left_s > 0.0 and select.select(watched, (), (), left_s)[0]:
        return 0
    return expected_ns + round(1e9 * LEAD_S)


class SharedProcessor:
    """A processor that others may want. Beside the busy it is better to sleep: who wakes comes first, who looks takes turns."""

    def __init__(self) -> None:
        self._busy_until_ns = 0

    def give_way(self) -> None:
        """Let others run first."""
        before_ns = time.monotonic_ns()
        os.sched_yield()
        now_ns = time.monotonic_ns()
        if now_ns - before_ns > TURN_NS:
            self._busy_until_ns = now_ns + PAUSES * (now_ns - before_ns)

    @property
    def is_free(self) -> bool:
        """Nobody has wanted it for long of late."""
        return time.monotonic_ns() >= self._busy_until_ns


def wake_in_time() -> None:
    """Have the kernel end the sleep of this thread at its time; it may be 50 us late else, to wake several at once."""
    ctypes.CDLL(None).prctl(_TIMER_SLACK, 1, 0, 0, 0)


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
