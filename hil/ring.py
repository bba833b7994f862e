"""Shared memory between the loop and its readers: a ring of records with a sequence lock, and a wake-up for each reader.

The writer never waits: it overwrites the oldest slot. A reader that is too slow loses its own records and is told how
many. Memory and wake-ups are anonymous file descriptors, so that nothing is left behind when a process is killed.
"""

import mmap
import os
import weakref
from multiprocessing import reduction
from typing import Any

import numpy as np
from numba import types
from numba.core.extending import intrinsic
from numpy.typing import NDArray

from drivers.system import call
from nav.increments import IntArray
from nav.kernel import kernel

Bytes = NDArray[np.uint8]


@intrinsic  # type: ignore[untyped-decorator]
def _fence(typing_context: Any) -> Any:
    """A full memory barrier: the order of stores and loads that the sequence lock relies on, on every processor."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), generate


@kernel
def push(parts: tuple[IntArray, IntArray, Bytes, IntArray, IntArray], rows: Bytes) -> None:
    """`Ring.push` with the ring's `parts`; a slot's lock is odd while it changes and 2 * (number + 1) after."""
    head, locks, slots, wakes, room = parts
    capacity = locks.shape[0]
    number = head[0]
    for i in range(rows.shape[0]):
        k = number % capacity
        locks[k] = 2 * number + 1
        _fence()
        for j in range(rows.shape[1]):
            slots[k, j] = rows[i, j]
        _fence()
        number += 1
        locks[k] = 2 * number
    _fence()
    head[0] = number
    call(wakes, room)


@kernel
def _pull(head: IntArray, locks: IntArray, slots: Bytes, rows: Bytes, number: int) -> tuple[int, int]:
    """Copy records from `number` on into `rows`; returns (copied, number of the first one copied)."""
    capacity = locks.shape[0]
    newest = head[0]
    number = max(number, newest - capacity)
    copied = 0
    first = number
    while copied < rows.shape[0] and number < newest:
        k = number % capacity
        before = locks[k]
        _fence()
        for j in range(rows.shape[1]):
            rows[copied, j] = slots[k, j]
        _fence()
        if before != 2 * (number + 1) or locks[k] != before:  # overwritten under our hands: skip what is lost
            number = max(number + 1, head[0] - capacity + 1)
            first, copied = number, 0
            newest = head[0]
            continue
        copied += 1
        number += 1
    return copied, first


class Shared:
    """An anonymous block of shared memory that survives being passed to a spawned process."""

    def __init__(self, size: int, fd: int | None = None) -> None:
        if fd is None:
            fd = os.memfd_create("dtg-hil")
            os.ftruncate(fd, size)
        weakref.finalize(self, os.close, fd)
        self.fd = fd
        self.size = size
        self.memory = mmap.mmap(fd, size)

    def __reduce__(self) -> Any:
        return _reopen, (reduction.DupFd(self.fd), self.size)


def _reopen(fd: Any, size: int) -> Shared:
    return Shared(size, fd.detach())


class Wake:
    """A wake-up from a writer to one reader (eventfd): never blocks the writer, collapses repeated calls."""

    def __init__(self, fd: int | None = None) -> None:
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC) if fd is None else fd
        weakref.finalize(self, os.close, self.fd)

    def fileno(self) -> int:
        """The descriptor to wait on for reading."""
        return self.fd

    def call(self) -> None:
        """Wake the reader."""
        try:
            os.eventfd_write(self.fd, 1)
        except BlockingIOError:
            pass  # counter full: the reader has been called 2**64 - 2 times and will wake anyway

    def clear(self) -> None:
        """Forget calls made so far."""
        try:
            os.eventfd_read(self.fd)
        except BlockingIOError:
            pass

    def __reduce__(self) -> Any:
        return _rewake, (reduction.DupFd(self.fd),)


def _rewake(fd: Any) -> Wake:
    return Wake(fd.detach())


class Ring:
    """A ring of the last `capacity` records of `dtype`, written by one process and read by many.

    Parameters
    ----------
    dtype : numpy.dtype
        Layout of one record, without Python objects.
    capacity : int
        Number of slots.
    readers : int
        Number of wake-ups to make; a reader waits on ``wakes[i]``.
    """

    def __init__(self, dtype: np.dtype[Any], capacity: int, readers: int = 1) -> None:
        self._attach(dtype, capacity, Shared(64 + capacity * (8 + dtype.itemsize)), [Wake() for _ in range(readers)])

    def _attach(self, dtype: np.dtype[Any], capacity: int, shared: Shared, wakes: list[Wake]) -> None:
        self.dtype = dtype
        self.capacity = capacity
        self.wakes = wakes
        self._shared = shared
        memory = shared.memory
        self._head = np.frombuffer(memory, np.int64, 1, 0)
        self._locks = np.frombuffer(memory, np.int64, capacity, 64)
        slots = np.frombuffer(memory, np.uint8, capacity * dtype.itemsize, 64 + 8 * capacity)
        self._slots = slots.reshape(capacity, dtype.itemsize)
        called = np.array([wake.fileno() for wake in wakes], np.int64)
        self.parts = self._head, self._locks, self._slots, called, np.zeros(2, np.int64)
        """For kernels (`push`)."""

    def __reduce__(self) -> Any:
        return _reattach, (self.dtype, self.capacity, self._shared, self.wakes)

    @property
    def count(self) -> int:
        """Records written since the start."""
        return int(self._head[0])

    def push(self, rows: NDArray[Any]) -> None:
        """Write `rows` ((n,) of `dtype`, contiguous) and wake the readers."""
        push(self.parts, rows.view(np.uint8).reshape(len(rows), self.dtype.itemsize))

    def pull(self, rows: NDArray[Any], number: int) -> tuple[int, int]:
        """Copy records from number `number` on into `rows`.

        Returns
        -------
        copied : int
            How many rows were filled.
        first : int
            Number of the first one; more than `number` means that the difference was lost to this reader.
        """
        return _pull(
            self._head, self._locks, self._slots, rows.view(np.uint8).reshape(len(rows), self.dtype.itemsize), number
        )

    def latest(self, row: NDArray[Any]) -> bool:
        """Copy the newest record into `row` ((1,) of `dtype`); False when there is none yet."""
        copied, _ = self.pull(row, max(self.count - 1, 0))
        return copied == 1


def _reattach(dtype: np.dtype[Any], capacity: int, shared: Shared, wakes: list[Wake]) -> Ring:
    ring = Ring.__new__(Ring)
    ring._attach(dtype, capacity, shared, wakes)
    return ring
