"""A few numbers that the processes of a run tell each other: one block of shared memory, nobody waits on it.

Orders (stop, go, align, mark, record, faults) come from the session, the publisher and the dashboard, the loss of samples from
the loop, the count of recorded frames from the recorder. The readers of the rings give a beat; nobody waits for it.
"""

import multiprocessing as mp
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from multiprocessing.connection import wait
from threading import Thread
from typing import Any

import numpy as np

from hil.realtime import step_aside
from hil.ring import Shared

_STOP, _GO, _ALIGN_REQUESTS, _LOST, _SAMPLES, _RECORDED, _LOOP_PID, _LOOP_DONE, _PUBLISHER, _RECORDER, *_REST = range(
    16
)
_MARKS, _RECORDING, _RECORD_SINCE, _FAULT, _FAULTS, _FIELDS = _REST
FEEDS = 16
"""Most feeds of a run."""
READERS = {"publisher": _PUBLISHER, "recorder": _RECORDER, **{f"feed {k}": _FIELDS + k for k in range(FEEDS)}}
"""Processes that say with a beat that they are at work."""

ENDINGS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
"""Signals that a terminal, `timeout` or a service manager may send to all processes of a run; the session ends them."""

ORPHAN_S = 10.0
"""Longest time for a process to end on its own when the one that started it is gone."""


class Injected(IntEnum):
    """A fault that the simulated head can be told to have for a second."""

    SILENCE = 1
    """It sends nothing."""
    LOSS = 2
    """One sample of ten does not arrive."""
    STUCK = 3
    """g2y goes on giving the same number."""
    BUILT_IN = 4
    """Its own test says that gyro 1 has failed."""


class Control:
    """Shared numbers; survives being passed to a spawned process."""

    def __init__(self, shared: Shared | None = None) -> None:
        self._shared = Shared(8 * (_FIELDS + FEEDS)) if shared is None else shared
        self._values = np.frombuffer(self._shared.memory, np.int64, _FIELDS + FEEDS)

    def __reduce__(self) -> Any:
        return Control, (self._shared,)

    @property
    def stop(self) -> bool:
        """The loop and its feeder shall end."""
        return bool(self._values[_STOP])

    def order_stop(self) -> None:
        """Tell the loop and its feeder to end."""
        self._values[_STOP] = 1

    @property
    def go(self) -> bool:
        """The loop listens: whoever feeds it may begin."""
        return bool(self._values[_GO])

    def order_go(self) -> None:
        """Let the feeder begin."""
        self._values[_GO] = 1

    @property
    def align_requests(self) -> int:
        """How many times an alignment has been asked for."""
        return int(self._values[_ALIGN_REQUESTS])

    def request_align(self) -> None:
        """Ask the loop to align."""
        self._values[_ALIGN_REQUESTS] += 1

    @property
    def marks(self) -> int:
        """How many marks have been asked for."""
        return int(self._values[_MARKS])

    def request_mark(self) -> None:
        """Ask the loop to mark the present moment."""
        self._values[_MARKS] += 1

    @property
    def recording(self) -> bool:
        """The loop hands its frames to the recorder."""
        return bool(self._values[_RECORDING])

    @recording.setter
    def recording(self, on: bool) -> None:
        self._values[_RECORDING] = on

    @property
    def record_since(self) -> int:
        """UTC second at which a recording was asked for while running; 0: none is wanted."""
        return int(self._values[_RECORD_SINCE])

    @record_since.setter
    def record_since(self, second: int) -> None:
        self._values[_RECORD_SINCE] = second

    @property
    def injected(self) -> tuple[int, int]:
        """(how many faults have been asked for, code of the newest)."""
        return int(self._values[_FAULTS]), int(self._values[_FAULT])

    def inject(self, fault: Injected) -> None:
        """Ask the simulated head for a fault."""
        self._values[_FAULT] = fault
        self._values[_FAULTS] += 1

    @property
    def lost(self) -> int:
        """Sensor samples lost since the start."""
        return int(self._values[_LOST])

    @property
    def samples(self) -> int:
        """Sensor samples received since the start."""
        return int(self._values[_SAMPLES])

    def set_loss(self, lost: int, samples: int) -> None:
        """Tell how many sensor samples were lost and received since the start."""
        self._values[_LOST], self._values[_SAMPLES] = lost, samples

    @property
    def loop_pid(self) -> int:
        """Process of the loop; 0 before it is at work, and when it has ended as it should."""
        return 0 if self._values[_LOOP_DONE] else int(self._values[_LOOP_PID])

    def loop_begins(self) -> None:
        """Say that the loop is this process."""
        self._values[_LOOP_PID] = os.getpid()

    def loop_ends(self) -> None:
        """Say that the loop ends as it should."""
        self._values[_LOOP_DONE] = 1

    def beat(self, reader: str) -> None:
        """A reader (`READERS`) is at work."""
        self._values[READERS[reader]] = time.monotonic_ns()

    def beat_age_s(self, reader: str) -> float:
        """Time since a reader's last beat, s; 0 before its first."""
        beat = int(self._values[READERS[reader]])
        return (time.monotonic_ns() - beat) * 1e-9 if beat else 0.0

    def forget_beat(self, reader: str) -> None:
        """A new reader of this name begins; that of the old one says nothing of it."""
        self._values[READERS[reader]] = 0

    @property
    def recorded(self) -> int:
        """Frames that the recorder has taken over."""
        return int(self._values[_RECORDED])

    @recorded.setter
    def recorded(self, count: int) -> None:
        self._values[_RECORDED] = count

    def recorder_is_gone(self) -> None:
        """Nobody need wait for the recorder to take over frames."""
        self._values[_RECORDED] = 1 << 62


def run_part(control: Control, nice: int, aside: bool, target: Callable[..., None], *args: Any) -> None:
    """Target of every process of a run: calls ``target(*args)``, and has it stopped when the session is gone.

    `nice` is how far it steps back behind the loop and the sensor where processors are few; `aside`: it leaves the loop's
    processor to the loop.

    A session that is killed cannot order anything: without this a simulated head would go on sending for ever.
    """
    for number in ENDINGS:
        signal.signal(number, signal.SIG_IGN)
    os.nice(nice)
    if aside:
        step_aside()
    parent = mp.parent_process()
    if parent is not None:
        Thread(target=_outlive, args=(control, parent.sentinel), daemon=True).start()
    try:
        target(*args)
    except BrokenPipeError:
        if parent is None or parent.is_alive():
            raise


@contextmanager
def undisturbed() -> Iterator[None]:
    """What is started herein takes none of `ENDINGS`."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDINGS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _outlive(control: Control, sentinel: int) -> None:
    wait([sentinel])
    control.order_stop()
    time.sleep(ORPHAN_S)
    os._exit(1)
