"""The quick lane of lone frames gives what batches give, to the last bit, whatever happens to the head or on the wire."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.can.dtg_head import head_database
from drivers.can.frames import FrameArray
from hil.bridge import Loop, LoopOrder, Outlets
from hil.lane import COMBINED, DECODED, DONE, OTHER
from hil.scenario import Scenario
from hil.world.head import SimulatedHead, faulty
from nav.state import NAV_STATE

SAMPLES = 1200
CALIBRATION = {
    "serial": 1,
    "date": "2026-11-22",
    "reference_c": [20, 20, 20],
    "range_c": [[0, 30]] * 3,
    "gyro": {"scale_ppm": [40, -30, 20, 10], "bias_temperature_deg_h_k": [[0.1] * 4]},
    "accelerometer": {"bias_ug": [10, 20, 30]},
}
CASES: dict[str, dict[str, Any]] = {
    "ideal": {},
    "dtg": {"head": {"instruments": "dtg", "grade": "dtg"}},
    "skewed": {"head": {"instruments": "dtg", "grade": "dtg", "skew_deg": 45.0, "mounting_deg": (10.0, 20.0, 30.0)}},
    "calibrated": {"head": {"instruments": "dtg", "grade": "dtg", "calibration": CALIBRATION}},
    "jump": {
        "head": {
            "instruments": "dtg",
            "grade": "dtg",
            "faults": ({"axis": "g1y", "kind": "jump", "at_s": 2.0, "size": 0.02},),
        }
    },
    "built-in": {"head": {"faults": ({"axis": "ay", "kind": "built-in", "at_s": 2.0},)}},
    "two": {
        "head": {
            "grade": "dtg",
            "faults": (
                {"axis": "g1y", "kind": "built-in", "at_s": 1.5},
                {"axis": "g2y", "kind": "noise", "at_s": 3.0},
            ),
        }
    },
    "wire": {
        "wire": [
            {"kind": kind, "at_s": 1.0 + 0.4 * k, "for_s": 0.3, "share": 0.1}
            for k, kind in enumerate(
                ("drop", "duplicate", "reorder", "bit-flip", "crc-off", "counter-freeze", "clock-step")
            )
        ]
    },
    "short": {"duration_s": 4.0},
    "aligned": {"navigation": {"alignment": "level", "align_s": 1.0, "start": {"heading_deg": 20.0}}},
    "pole": {"motion": {"latitude_deg": 89.9425, "heading": {"rate": 0.0}}},
    "arm": {"head": {"lever_arm_m": (1.0, 0.0, 0.0)}},
}


def scenario(**changes: Any) -> Scenario:
    base = {
        "head": {"rate_hz": 200.0},
        "navigation": {"alignment": "truth", "track_bias_at_rest": False},
        "motion": {"rest_s": 1.5, "ramp_s": 1.0, "north": {"rate": 20.0}, "heading": {"rate": 3.0}},
    }
    merged = {
        key: {**base.get(key, {}), **value} if isinstance(value, dict) else value for key, value in changes.items()
    }
    return Scenario.model_validate(base | merged)


def sent(chosen: Scenario) -> FrameArray:
    head = SimulatedHead(chosen)
    if head.wire is not None:
        return np.concatenate([piece.copy() for _, piece in faulty(head, head.wire, SAMPLES) if len(piece)])
    return np.concatenate([part.copy() for _, slow, batch in head.chunks(SAMPLES) for part in (slow, batch)])


class Flown:
    """What came of frames."""

    def __init__(self, chosen: Scenario, batch: FrameArray, cuts: list[int], *, lane: bool = True) -> None:
        outlets = Outlets.make(recording=False, readers=1)
        loop = Loop(LoopOrder(chosen, paced=False, own_world=True), outlets)
        self.stages: list[int] = []
        if not lane:
            loop._lane = None
        elif loop._lane is not None:
            take = loop._lane.take

            def watched(frame: FrameArray, until: float) -> int:
                self.stages.append(take(frame, until))
                return self.stages[-1]

            loop._lane.take = watched
        for start, stop in zip([0, *cuts], [*cuts, len(batch)], strict=True):
            loop.take(batch[start:stop])
        self.result = loop.result()
        self.samples, self.counters = loop.samples, loop.driver.counters.as_dict()
        self.covered_us, self.interpolated = outlets.stats["covered_us"], outlets.stats["interpolated"]
        self.states = everything(outlets.states.capacity, NAV_STATE, outlets.states)
        self.states["solution_ns"] = 0
        events = everything(256, outlets.events.dtype, outlets.events)
        self.events = sorted((float(e["time"]), e["severity"], e["text"]) for e in events)
        self.health = everything(16, outlets.health.dtype, outlets.health)


def everything(room: int, dtype: np.dtype[Any], ring: Any) -> NDArray[Any]:
    rows = np.zeros(room, dtype)
    copied, _ = ring.pull(rows, 0)
    return rows[:copied]


@pytest.mark.parametrize("case", CASES)
def test_the_lane_gives_what_batches_give(case: str) -> None:
    chosen = scenario(**CASES[case])
    batch = sent(chosen)
    if case == "calibrated":  # the head is warmer than what was calibrated, and says so in its second second
        early = np.arange(len(batch)) < 100
        batch = batch[~(early & (batch["can_id"] == head_database()["HEAD_TEMPERATURE"].can_id))]
    batch["time_ns"] = 1_000_000 * np.arange(1, len(batch) + 1)
    ones = list(range(1, len(batch)))
    rng = np.random.default_rng(7)
    some = sorted(rng.choice(np.arange(1, len(batch)), 40, replace=False).tolist())
    mixed = sorted({*some, *range(200, 700)})
    whole, alone = Flown(chosen, batch, some), Flown(chosen, batch, ones, lane=False)
    by_lane = Flown(chosen, batch, ones)
    assert by_lane.result == alone.result
    assert by_lane.events == alone.events
    np.testing.assert_array_equal(by_lane.states, alone.states)
    np.testing.assert_array_equal(by_lane.health, alone.health)
    for flown in (by_lane, Flown(chosen, batch, mixed)):
        assert flown.result["navigation_digest"] == whole.result["navigation_digest"]
        assert flown.counters == whole.counters
        assert (flown.samples, flown.covered_us, flown.interpolated) == (
            whole.samples,
            whole.covered_us,
            whole.interpolated,
        )
        for name in NAV_STATE.names or ():
            if name != "arrival_ns":
                np.testing.assert_array_equal(flown.states[name], whole.states[name])
    done = np.array(by_lane.stages)
    if case == "arm":
        assert (done == OTHER).all()
    else:
        assert (done == DONE).sum() > 300
        assert (done == DECODED).any() == (case in {"jump", "built-in", "two", "wire", "short"})
    assert (done == COMBINED).sum() == (case == "pole")
