"""Order of samples by clock and counter, where a board lies."""

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
