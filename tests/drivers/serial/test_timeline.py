"""Order of samples by clock and counter, where a board lies."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers import Counters
from drivers.serial.timeline import LONGEST_NS, Timeline

PERIOD_NS = 10**7


def placed(timeline: Timeline, times: list[int]) -> list[int]:
    return [timeline.place(time, 0, PERIOD_NS) for time in times]


def test_a_leap_of_the_clock_is_a_new_start_and_loses_its_first_sample() -> None:
    """Of 2^63 ns at a time, samples are not counted as lost: their number would leave 64 bits."""
    counters = Counters()
    timeline = Timeline(counters, 1 << 64, 0)
    leaps = [k << 62 for k in range(4)]
    for base in leaps * 3:
        placed(timeline, [base, base + PERIOD_NS])
    assert counters.lost == counters.restarts == 3 * len(leaps) - 1
    assert timeline.sequence < 100


def test_a_long_gap_is_counted() -> None:
    counters = Counters()
    timeline = Timeline(counters, 1 << 64, 0)
    placed(timeline, [0, PERIOD_NS, PERIOD_NS + LONGEST_NS])
    assert counters.lost == LONGEST_NS // PERIOD_NS - 1
    assert counters.restarts == 0


@given(
    seed=st.integers(0, 2**32 - 1),
    rate_hz=st.sampled_from([50, 200, 1000]),
    drift_ppm=st.floats(-200.0, 200.0),
    step_s=st.sampled_from([0.0, 0.4, 0.7, 100.0]),
)
@example(seed=11877, rate_hz=1000, drift_ppm=179.0, step_s=0.4)  # what was the fastest has faded behind a stall
def test_arrivals_tell_a_clock_that_was_set_from_gaps(seed: int, rate_hz: int, drift_ppm: float, step_s: float) -> None:
    """A board without a counter, a host that stalls, adapters that hold bytes up, clocks that drift: every gap is one."""
    rng, n = np.random.default_rng(seed), 6 * rate_hz
    true_s = np.arange(1, n + 1) / rate_hz
    latency_s = 0.0005 + rng.exponential(0.0005, n)
    for start in rng.uniform(1.5, 5.2, 3):  # nothing is read for a while, then all at once
        stalled = (true_s > start) & (true_s < start + rng.uniform(0.01, 0.5))
        latency_s[stalled] += true_s[stalled].max(initial=0.0) - true_s[stalled]
    arrivals = np.maximum.accumulate(np.rint(1e9 * (true_s + latency_s)).astype(np.int64))
    there = np.ones(n, bool)
    for start in rng.uniform(1.5, 5.0, 4):
        there[(true_s > start) & (true_s < start + rng.choice([1.5 / rate_hz, 0.05, 0.6]))] = False
    there[-1] = True
    device_s = true_s * (1.0 + 1e-6 * drift_ppm)
    stepped = 5.8  # no gap and no stall is there
    there[np.abs(true_s - stepped) < 2.0 / rate_hz] = True
    device_s[true_s > stepped] += step_s
    counters = Counters()
    timeline = Timeline(counters, 1 << 64, 0)
    for time_s, arrival in zip(device_s[there], arrivals[there], strict=True):
        timeline.place(round(1e9 * time_s), 0, 10**9 // rate_hz, int(arrival))
    assert counters.clock_steps == (step_s > 0.0)
    assert counters.lost == n - there.sum()
    assert counters.restarts == counters.crc_errors == 0


@pytest.mark.parametrize(("missing", "earlier_s"), [(10, 0.029), (5, 0.05), (60, 0.25)])
def test_bytes_that_come_sooner_behind_a_gap_do_not_hide_it(missing: int, earlier_s: float) -> None:
    """An adapter that held bytes up lets go, or the host's clock is set back a little."""
    counters, period_s = Counters(), 0.01
    timeline = Timeline(counters, 1 << 64, 0)
    for k in [*range(300), *range(300 + missing, 400)]:
        arrival_s = k * period_s + (0.0 if k < 300 else -earlier_s) + 0.3
        timeline.place(round(1e9 * k * period_s), 0, round(1e9 * period_s), round(1e9 * arrival_s))
    assert (counters.lost, counters.clock_steps) == (missing, 0)


@pytest.mark.parametrize("tick_ns", [0, 100_000])
def test_arrivals_that_say_nothing_leave_a_leap_a_gap(tick_ns: int) -> None:
    """All bytes came in one read, or a recording stamps what was read by its place: nobody knows when they were sent."""
    counters = Counters()
    timeline = Timeline(counters, 1 << 64, 0)
    for at, k in enumerate([*range(300), *range(800, 1000)]):
        timeline.place(10_000_000 * k, 0, 10_000_000, tick_ns * at)
    assert (counters.lost, counters.clock_steps) == (500, 0)


@pytest.mark.parametrize("turn", [0, 1 << 16])
@pytest.mark.parametrize("later_ns", [PERIOD_NS // 4, PERIOD_NS, 4 * PERIOD_NS])
def test_a_board_that_comes_back_at_another_rate(turn: int, later_ns: int) -> None:
    """The steps behind a new start are those of the new rate, from the first on."""
    counters = Counters()
    timeline = Timeline(counters, 1 << 64, turn)
    for k in range(100):
        timeline.place(10**12 + k * PERIOD_NS, 5000 + k if turn else 0)
    steps = [timeline.place(k * later_ns, k if turn else 0) for k in range(100)]
    assert steps == [0] + [later_ns] * 99
    assert (counters.restarts, counters.lost, counters.clock_steps) == (1, 1, 0)


@pytest.mark.parametrize("times_slower", [0.25, 2, 4, 10])
def test_a_rate_that_is_changed_while_the_counter_goes_on(times_slower: float) -> None:
    """The first step that is much longer looks like a clock that was set; with the second it is the rate."""
    counters, later_ns = Counters(), round(times_slower * PERIOD_NS)
    timeline = Timeline(counters, 1 << 64, 1 << 16)
    times = [*range(0, 100 * PERIOD_NS, PERIOD_NS), *(99 * PERIOD_NS + k * later_ns for k in range(1, 101))]
    steps = [timeline.place(time, k) for k, time in enumerate(times) if k not in {110, 150, 151}]
    assert steps[101:] == [later_ns] * 96
    assert counters.clock_steps == (times_slower > 2)
    assert counters.lost == 3
    assert counters.restarts == counters.crc_errors == 0


COUNTED = pytest.mark.parametrize("turn", [0, 1 << 16])


def counted(turn: int, numbers: list[int], off_ns: int = 0, first: int = 65500) -> dict[str, int]:
    """What is counted for samples with these numbers; those that come behind later ones are off by `off_ns`."""
    counters, newest = Counters(), -1
    timeline = Timeline(counters, 1 << 64, turn)
    for k in numbers:
        time_ns = 10**12 + k * PERIOD_NS + (off_ns if k < newest else 0)
        timeline.place(time_ns, (first + k) % turn if turn else 0)
        newest = max(newest, k)
    return {name: count for name, count in counters.as_dict().items() if count}


@COUNTED
def test_older_packets_that_come_again_are_duplicates(turn: int) -> None:
    assert counted(turn, [*range(100), 97, 98, 100, 40, 97, 101, 101, *range(102, 200)]) == {"duplicated": 5}


@COUNTED
def test_what_was_missing_is_late_once_and_then_a_duplicate(turn: int) -> None:
    numbers = [*range(50), *range(55, 80), 52, 52, 54, 49, 55, *range(80, 100)]
    assert counted(turn, numbers) == {"lost": 3, "late": 2, "duplicated": 3}


@COUNTED
@pytest.mark.parametrize("numbers", [[*range(10, 30), 5, *range(30, 40)], [*range(200), 120, *range(200, 210)]])
def test_what_was_before_the_start_or_is_long_ago_is_no_duplicate(turn: int, numbers: list[int]) -> None:
    assert counted(turn, numbers) == {"crc_errors": 1}


def test_without_a_counter_an_older_one_must_lie_on_the_grid() -> None:
    numbers = [*range(40), *range(45, 80), 60, 80, 42, *range(81, 100)]
    assert counted(0, numbers, PERIOD_NS // 2) == {"lost": 5, "crc_errors": 2}


@pytest.mark.parametrize("back", [20, 63])
def test_a_clock_set_back_by_whole_steps_is_soon_told_from_packets_that_come_again(back: int) -> None:
    told = counted(0, [*range(100), *range(100 - back, 300)])
    assert told.pop("duplicated") < 10
    assert told == {"restarts": 1, "lost": 1}
