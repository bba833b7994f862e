"""Aiding in the loop: a measurement is taken between the samples between which it came, however the frames are batched."""

from functools import cache
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.can.aiding import is_aiding
from drivers.can.frames import FrameArray
from hil.bridge import Loop, LoopOrder, Outlets
from hil.scenario import Scenario
from hil.world.aiding import SimulatedAiding
from hil.world.head import SimulatedHead
from nav.aiding import Kind

SCENARIO = Scenario.model_validate(
    {
        "bus": "unix:none",
        "head": {"rate_hz": 200},
        "motion": {"north": {"rate": 5.0}},
        "navigation": {"alignment": "truth", "aided": True},
        "aiding": {"gnss": [{"delay_s": 0.11}], "baro": [{}], "magnetometer": [{"rate_hz": 90}], "heading": [{}]},
    }
)
SAMPLES = 400


@cache
def sent() -> FrameArray:
    """Two seconds of the simulated head."""
    return np.concatenate([part for _, *parts in SimulatedHead(SCENARIO).chunks(SAMPLES) for part in parts])


class Watched(Loop):
    """Notes how many samples have been navigated when a measurement comes."""

    def __init__(self) -> None:
        super().__init__(LoopOrder(SCENARIO, paced=False), Outlets.make(recording=False, readers=1))
        self.places: list[int] = []
        self.aided: list[np.void] = []
        take = self.navigator.aid

        def aid(rows: np.ndarray) -> None:
            self.aided.extend(rows.copy())
            take(rows)

        self.navigator.aid = aid

    def _take(self, batch: FrameArray) -> bool:
        self.places += [self.samples] * (len(self.aided) - len(self.places))
        return super()._take(batch)


def run(cuts: list[int]) -> Watched:
    loop = Watched()
    for start, stop in pairwise([0, *sorted(cuts), len(sent())]):
        if stop > start:
            loop.take(sent()[start:stop])
    return loop


@cache
def whole() -> Watched:
    return run([])


@settings(max_examples=8)
@given(st.lists(st.integers(1, 550), max_size=8))
def test_batches_do_not_matter(cuts: list[int]) -> None:
    loop, reference = run(cuts), whole()
    np.testing.assert_array_equal(np.array(loop.aided), np.array(reference.aided))
    assert loop.places == reference.places
    assert loop.result()["navigation_digest"] == reference.result()["navigation_digest"]


def test_what_the_world_sent_is_taken_behind_its_sample() -> None:
    loop = whole()
    rows, arrivals = SimulatedAiding(SCENARIO).arrived(SAMPLES * 5000)
    np.testing.assert_allclose([row["time"] for row in loop.aided], rows["time"], atol=1e-9)
    assert [row["kind"] for row in loop.aided] == rows["kind"].tolist()
    ends = 5000 * np.arange(1, SAMPLES + 1)
    assert loop.places == [int(np.searchsorted(ends, arrival)) + 1 for arrival in arrivals]


def test_they_are_counted_by_kind_and_disturb_no_counter() -> None:
    result, stats = whole().result(), whole()._outlets.stats
    assert result["aiding"] == {"GNSS": 9, "BARO": 20, "MAGNETIC": 180, "HEADING": 10}
    assert not any(result["aiding_faults"].values())
    assert stats["foreign"] == stats["short"] == stats["lost"] == 0
    assert (stats["frames"], stats["samples"]) == (len(sent()), SAMPLES)
    assert is_aiding(sent()["can_id"]).sum() == len(whole().aided)


def test_a_wrong_frame_is_dropped_and_counted() -> None:
    bad = sent().copy()
    bad["data"][np.flatnonzero(is_aiding(bad["can_id"]))[5], 12] ^= 1
    loop = Watched()
    loop.take(bad)
    assert len(loop.aided) == len(whole().aided) - 1
    assert loop.result()["aiding_faults"]["crc_errors"] == 1
    assert loop.result()["navigation_digest"] != whole().result()["navigation_digest"]


def test_the_loop_navigates_by_them() -> None:
    """Free, a head of the tactical grade drifts from where it is; with a receiver it stays within the receiver's noise."""
    errors, estimates = {}, {}
    for aided in (False, True):
        scenario = SCENARIO.with_changes(
            head={"instruments": "dtg", "grade": "tactical"},
            aiding={"gnss": [{"delay_s": 0.11, "lever_arm_m": [1.0, 0.0, -2.0]}], "magnetometer": []},
            navigation={"aided": aided},
        )
        loop = Loop(LoopOrder(scenario, paced=False), Outlets.make(recording=False, readers=1))
        for _, *parts in SimulatedHead(scenario).chunks(12_000):
            for part in parts:
                loop.take(part)
        errors[aided], estimates[aided] = loop.result()["error"], loop.result().get("estimate")
    assert errors[True]["position_m"]["final"] < 3.0 < 0.2 * errors[False]["position_m"]["final"]
    assert errors[True]["velocity_ms"]["final"] < 0.1 < errors[False]["velocity_ms"]["final"]
    assert estimates[False] is None
    assert 0.1 < estimates[True]["sigma"]["position_m"] < 3.0
    assert 0.0 < estimates[True]["sigma"]["attitude_deg"] < 1.0
    assert all(0.1 < ratio < 3.0 for ratio in estimates[True]["ratio"].values())


def test_what_is_withheld_is_counted_and_not_given() -> None:
    withheld = [{"kind": "gnss", "start_s": 0.5, "end_s": 1.5}, {"kind": "baro", "start_s": 0.0, "end_s": 9.0}]
    scenario = SCENARIO.with_changes(navigation={"filter": {"withheld": withheld}})
    loop = Loop(LoopOrder(scenario, paced=False), Outlets.make(recording=False, readers=1))
    given: list[np.void] = []
    loop.navigator.aid = given.extend  # type: ignore[method-assign]
    loop.take(sent())
    whole = run([]).aided
    kept = [
        row for row in whole if row["kind"] != Kind.BARO and not (row["kind"] == Kind.GNSS and 0.5 <= row["time"] < 1.5)
    ]
    assert [row.tobytes() for row in given] == [row.tobytes() for row in kept]
    assert loop.result()["withheld"] == len(whole) - len(kept) > 20
