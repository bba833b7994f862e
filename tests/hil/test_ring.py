"""The shared-memory ring between real processes: nothing torn, nothing lost in silence, nobody waits."""

import gc
import multiprocessing
import os
import select
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.ring import Ring

ROW = np.dtype([("number", "<i8"), ("copies", "<i8", 40)])
"""A record whose parts all say the same number, so that a torn one shows."""


def rows(start, n):
    out = np.zeros(n, ROW)
    out["number"] = np.arange(start, start + n)
    out["copies"] = out["number"][:, None]
    return out


def write(ring, total, chunk, pause):
    for start in range(0, total, chunk):
        ring.push(rows(start, min(chunk, total - start)))
        if pause:
            time.sleep(pause)


def read(ring, total, pause, answer):
    """Follow the ring to its end; (rows seen, rows lost, torn rows, rows out of order)."""
    ring.pull(np.zeros(64, ROW), 0)  # compiled and warm before the writer starts
    answer.put("ready")
    batch, number, seen, lost, torn, wrong = np.zeros(64, ROW), 0, 0, 0, 0, 0
    deadline = time.monotonic() + 30.0
    while number < total and time.monotonic() < deadline:
        select.select([ring.wakes[0]], [], [], 0.1)
        ring.wakes[0].clear()
        while number < total:
            copied, first = ring.pull(batch, number)
            lost += first - number
            got = batch[:copied]
            torn += int((got["copies"] != got["number"][:, None]).any(axis=1).sum())
            wrong += int((got["number"] != first + np.arange(copied)).sum())
            seen += copied
            number = first + copied
            if not copied:
                break
            if pause:
                time.sleep(pause)
    answer.put((seen, lost, torn, wrong))


@pytest.mark.parametrize(
    ("capacity", "total", "chunk", "write_pause", "read_pause", "loses"),
    [(4096, 20_000, 10, 1e-4, 0.0, False), (64, 200_000, 7, 0.0, 0.0, None), (128, 60_000, 16, 1e-4, 2e-3, True)],
    ids=["paced", "racing", "slow reader"],
)
def test_writer_and_reader_processes(capacity, total, chunk, write_pause, read_pause, loses):
    context = multiprocessing.get_context("spawn")
    ring, answer = Ring(ROW, capacity), context.Queue()
    reader = context.Process(target=read, args=(ring, total, read_pause, answer))
    writer = context.Process(target=write, args=(ring, total, chunk, write_pause))
    reader.start()
    assert answer.get(timeout=40) == "ready"
    writer.start()
    seen, lost, torn, wrong = answer.get(timeout=40)
    writer.join(10)
    reader.join(10)
    assert torn == wrong == 0
    assert seen + lost == total == ring.count
    if loses is not None:
        assert (lost > 0) == loses


def test_the_writer_does_not_wait_for_anybody():
    ring = Ring(ROW, 16, readers=3)
    start = time.monotonic()
    write(ring, 100_000, 100, 0)
    assert time.monotonic() - start < 5.0
    assert all(select.select([wake], [], [], 0)[0] for wake in ring.wakes)
    batch = np.zeros(64, ROW)
    copied, first = ring.pull(batch, 0)
    assert first + copied == 100_000
    assert copied <= 16


def test_latest_and_an_empty_ring():
    ring, row = Ring(ROW, 8), np.zeros(1, ROW)
    assert not ring.latest(row)
    assert ring.pull(row, 0) == (0, 0)
    ring.push(rows(0, 3))
    assert ring.latest(row)
    assert row["number"][0] == 2
    assert ring.pull(row, 3) == (0, 3)
    ring.push(rows(3, 20))  # more than the ring holds
    assert ring.latest(row)
    assert row["number"][0] == 22


def test_nothing_to_push_is_nothing():
    ring = Ring(ROW, 8)
    ring.push(rows(0, 0))
    assert ring.count == 0


@settings(max_examples=60)
@given(st.lists(st.tuples(st.booleans(), st.integers(1, 40)), max_size=40), st.integers(1, 32))
def test_as_a_list_that_forgets(steps, capacity):
    ring, written, number = Ring(ROW, capacity), 0, 0
    for push, n in steps:
        if push:
            ring.push(rows(written, n))
            written += n
            continue
        batch = np.zeros(n, ROW)
        copied, first = ring.pull(batch, number)
        assert first == max(number, written - capacity)
        assert copied == min(n, written - first)
        assert batch["number"][:copied].tolist() == list(range(first, first + copied))
        number = first + copied


def test_what_nobody_holds_any_more_gives_its_descriptors_back():
    """A test suite makes hundreds of bridges in one process."""
    gc.collect()
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(50):
        Ring(ROW, 16, 2)
    gc.collect()
    assert len(os.listdir("/proc/self/fd")) <= before
