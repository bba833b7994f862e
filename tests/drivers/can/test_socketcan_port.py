"""SocketCAN without python-can: what it costs beside python-can, filters, overflow, stamps; on a real kernel."""

import statistics
import time
from contextlib import closing

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.can import socketcan
from drivers.can.bus import open_port
from drivers.can.frames import EFF, frames
from drivers.can.socketcan import SocketCanPort, parse_filters
from drivers.can.stamps import AdapterClock
from hil.bench.receive import LAYOUTS, costs, of_layout
from hil.bench.timing import paired_ratio
from hil.source import BusSource
from nav.errors import HilError

BUS = "vcan1"


@pytest.mark.socketcan
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_frame_is_twenty_times_cheaper_than_by_python_can(layout):
    """The same frames on the same interface in the same run, in turns; what one turn disturbs the median forgets."""
    ours, theirs = costs(layout, 41, BUS)
    ratio = paired_ratio(theirs, ours)
    print(f"{layout}: {statistics.median(ours):.0f} ns, python-can {ratio:.0f} times that")
    assert ratio >= 20.0


@pytest.mark.socketcan
@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_is_sent_comes_with_the_kernels_stamp(layout):
    sent, batch = of_layout(layout), frames(1024)
    with closing(SocketCanPort(BUS)) as port, closing(SocketCanPort(BUS, listen=False)) as sender:
        before = time.time_ns()
        sender.send(sent)
        n = port.receive(batch, 1.0)
        after = time.time_ns()
    assert n == len(sent)
    for name in ("can_id", "length", "flags", "data"):
        np.testing.assert_array_equal(batch[:n][name], sent[name])
    stamps = batch["time_ns"][:n]
    assert (np.diff(stamps) >= 0).all()
    assert before <= stamps[0]
    assert stamps[-1] <= after


@pytest.mark.socketcan
def test_the_kernel_keeps_back_what_no_filter_names():
    sent, batch = frames(5), frames(64)
    sent["can_id"] = [0x120, 0x125, 0x130, 0x18F02AE2 | EFF, 0x120 | EFF]
    chosen = open_port(f"socketcan:{BUS}?filter=120:7F0,18F02A00:1FFFFF00")
    with closing(chosen) as port, closing(open_port(f"socketcan:{BUS}")) as other:
        other.send(sent)
        n = port.receive(batch, 1.0)
    assert batch["can_id"][:n].tolist() == [0x120, 0x125, 0x18F02AE2 | EFF]


@pytest.mark.socketcan
def test_what_does_not_fit_the_buffer_is_counted_and_told(monkeypatch):
    monkeypatch.setattr(socketcan, "RECEIVE_BUFFER", 1 << 16)
    batch, total = frames(1024), 0
    with (
        closing(BusSource(f"socketcan:{BUS}", paced=True)) as source,
        closing(open_port(f"socketcan:{BUS}", listen=False)) as sender,
    ):
        for _ in range(10):
            sender.send(of_layout("fd"))
        while n := source.receive(batch, 0.1):
            total += n
        assert total < 1920
        sender.send(of_layout("fd")[:1])  # the count comes with the next frame
        total += source.receive(batch, 1.0)
        assert source.overflowed == 1921 - total
        assert f"{source.overflowed} frames were lost because the receive buffer was full" in source.problem()


@pytest.mark.parametrize("text", ["", "120", "120:", "x:7FF", "120:7F0,", "800:7FF", "-1:7FF", "20000000:1FFFFFFF"])
def test_filters_that_mean_nothing(text):
    with pytest.raises(HilError, match="expected ID:MASK"):
        parse_filters(text)


@given(st.integers(-200, 200), st.integers(0, 2**60), st.integers(0, 2**32 - 1))
def test_arrivals_by_an_adapters_clock_are_those_of_the_wire(ppm, begin, seed):
    """The stamps of the kernel are late by up to 5 ms, every tenth by nothing; the adapter's clock begins anywhere and drifts."""
    rng, clock = np.random.default_rng(seed), AdapterClock()
    wire = 1_700_000_000_000_000_000 + 1_000_000 * np.arange(2000)
    late = rng.integers(0, 5_000_000, 2000) * (np.arange(2000) % 10 > 0)
    adapter = begin + 1 + ((wire - wire[0]) * (1.0 + ppm * 1e-6)).astype(np.int64)
    got = np.concatenate(
        [clock.arrivals(*pair) for pair in zip(np.split(wire + late, 40), np.split(adapter, 40), strict=True)]
    )
    error = np.abs(got - wire)[100:]
    assert error.max() < 50e6 * 400e-6 + 2, "what both clocks may part by within a batch"
    assert got.dtype == np.int64


def test_a_frame_without_the_adapters_stamp_has_the_kernels():
    kernel, adapter = np.array([1000, 2000, 3000]) * 10**6, np.array([0, 70, 0]) * 10**6
    assert AdapterClock().arrivals(kernel, adapter).tolist() == kernel.tolist()


def test_an_adapter_that_starts_anew():
    clock, kernel = AdapterClock(), np.array([10**18])
    clock.arrivals(kernel, np.array([5 * 10**9]))
    assert clock.arrivals(kernel + 10**9, np.array([1])).tolist() == [10**18 + 10**9]
