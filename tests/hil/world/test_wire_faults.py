"""Faults of the wire: what they do to the frames, what they leave alone, and that the driver counts them one by one."""

from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import make_driver
from drivers.can.dtg_head import DtgHead
from drivers.can.frames import FrameArray
from hil.scenario import Scenario, parse
from hil.wire_config import WireFault
from hil.world.head import SimulatedHead, faulty, stream
from nav.errors import HilError

RATE_HZ, SAMPLES = 200, 600
KINDS = tuple(kind for kind in get_args(WireFault.model_fields["kind"].annotation) if kind != "unplugged")
"""On a CAN bus."""
LOSSES = {"drop", "bit-flip", "crc-off", "silence", "counter-freeze"}


def scenario(*wire: dict[str, Any], layout: str = "fd", driver: str = "dtg-head", seed: int = 3) -> Scenario:
    return Scenario.model_validate(
        {"wire": wire, "head": {"rate_hz": RATE_HZ, "layout": layout}, "driver": driver, "seed": seed}
    )


def sent(chosen: Scenario) -> tuple[list[tuple[float, FrameArray]], dict[str, Any]]:
    """(when due, frames) of all that goes out, and the wire's report."""
    head = SimulatedHead(chosen)
    assert head.wire is not None
    pieces = [(due, piece.copy()) for due, piece in faulty(head, head.wire, SAMPLES) if len(piece)]
    return pieces, head.wire.report()


def joined(pieces: list[tuple[float, FrameArray]]) -> FrameArray:
    return np.concatenate([piece for _, piece in pieces])


def counted(frames: FrameArray, driver: str = "dtg-head") -> dict[str, int]:
    board = make_driver(driver)
    for start in range(0, len(frames), 50):
        board.decode(frames[start : start + 50])
    return board.counters.as_dict()


@pytest.mark.parametrize("kind", ["silence", "drop"])
def test_samples_lost_at_the_end_are_in_the_balance(kind: str) -> None:
    pieces, report = sent(scenario({"kind": kind, "at_s": 2.0}))
    assert report["samples"] == SAMPLES
    assert counted(joined(pieces))["samples"] + report["lost"][kind] == SAMPLES


@pytest.mark.parametrize("layout", ["fd", "classic"])
@pytest.mark.parametrize("kind", KINDS)
def test_each_fault_is_counted_exactly(kind: str, layout: str) -> None:
    pieces, report = sent(scenario({"kind": kind, "at_s": 1.0, "for_s": 0.5, "share": 0.1}, layout=layout))
    counters, expected = counted(joined(pieces)), report["expected"]
    assert {name: counters[name] for name in expected} == expected
    assert counters["restarts"] == counters["short"] == counters["version_errors"] == 0
    assert counters["samples"] + counters["late"] + sum(report["lost"].values()) == SAMPLES
    assert set(report["lost"]) == ({kind} & LOSSES)
    told = {name for name, count in counters.items() if count} - {"frames", "samples"}
    own = {
        "duplicate": {"duplicated"},
        "reorder": {"late"},
        "babble": {"foreign"},
        "clock-step": {"clock_steps"},
        "counter-freeze": {"frozen", "lost"},
        "bit-flip": {"crc_errors", "lost"},
        "crc-off": {"crc_errors", "lost"},
    }
    assert told == own.get(kind, {"lost"} if kind in LOSSES else set())


windows = st.fixed_dictionaries(
    {
        "kind": st.sampled_from([kind for kind in KINDS if kind not in {"counter-freeze", "clock-step"}]),
        "at_s": st.floats(0.1, 2.5),
        "for_s": st.floats(0.01, 0.3),
        "share": st.floats(0.01, 1.0),
        "delay_s": st.floats(0.001, 0.3),
        "rate_hz": st.floats(10.0, 5000.0),
    }
)


@settings(max_examples=15)
@given(wire=st.lists(windows, min_size=2, max_size=5), layout=st.sampled_from(["fd", "classic"]))
def test_faults_at_the_same_time_are_counted_exactly(wire: list[dict[str, Any]], layout: str) -> None:
    pieces, report = sent(scenario(*wire, layout=layout))
    counters, expected = counted(joined(pieces)), report["expected"]
    assert {name: counters[name] for name in expected} == expected
    assert counters["samples"] + counters["late"] + sum(report["lost"].values()) == SAMPLES
    due = [moment for moment, _ in pieces]
    assert due == sorted(due), "nothing overtakes"


class Taken:
    """A port that keeps what it is given."""

    dropped = 0

    def __init__(self) -> None:
        self.batches: list[FrameArray] = []

    def receive(self, batch: FrameArray, timeout: float) -> int:
        return 0

    def send(self, batch: FrameArray) -> None:
        self.batches.append(batch.copy())

    def close(self) -> None:
        pass


def test_the_same_bytes_at_any_speed_and_others_by_another_seed() -> None:
    wire = [{"kind": kind, "at_s": 0.05, "for_s": 0.1, "share": 0.3} for kind in KINDS]

    def bytes_of(seed: int, *, paced: bool) -> bytes:
        port = Taken()
        assert stream(SimulatedHead(scenario(*wire, seed=seed)), port, 60, paced=paced, cancelled=lambda: False) == 60
        return np.concatenate(port.batches).tobytes()

    assert bytes_of(1, paced=True) == bytes_of(1, paced=False)
    assert bytes_of(1, paced=False) != bytes_of(2, paced=False)


def test_outside_its_time_a_fault_leaves_the_frames_alone() -> None:
    clean = joined(sent(scenario({"kind": "drop", "at_s": 100.0}))[0])
    for kind in ("drop", "bit-flip", "crc-off", "silence", "counter-freeze", "reorder", "duplicate", "babble"):
        broken = joined(sent(scenario({"kind": kind, "at_s": 1.0, "for_s": 1.0, "share": 0.2}))[0])
        np.testing.assert_array_equal(broken[:204], clean[:204], kind)
        np.testing.assert_array_equal(broken[-200:], clean[-200:], kind)
        assert len(broken) != len(clean) or (broken != clean).any(), kind


@pytest.mark.parametrize("kind", ["drop", "duplicate", "bit-flip"])
def test_the_share_is_that_of_the_frames(kind: str) -> None:
    share, frames = 0.2, SAMPLES + 15
    report = sent(scenario({"kind": kind, "at_s": 0.0, "share": share}))[1]
    sigma = (frames * share * (1.0 - share)) ** 0.5
    assert abs(report["injected"][kind] - frames * share) < 4.0 * sigma


def test_delay_and_jitter_hold_up_and_keep_the_order() -> None:
    for kind in ("delay", "jitter"):
        pieces, _ = sent(scenario({"kind": kind, "at_s": 1.0, "for_s": 0.5, "delay_s": 0.1}))
        late = np.array([due for due, _ in pieces])
        numbers = [int(piece["data"][0, 2]) for _, piece in pieces if piece["can_id"][0] == 0x120]
        assert np.all(np.diff(np.unwrap(np.array(numbers), period=256)) > 0)
        assert np.all(np.diff(late) >= 0.0)
    due = np.array(
        [moment for moment, _ in sent(scenario({"kind": "delay", "at_s": 1.0, "for_s": 0.5, "delay_s": 0.1}))[0]]
    )
    assert not ((due > 1.001) & (due < 1.1)).any(), "nothing comes while the wire holds everything up"


def test_a_clock_that_drifts_shows_in_the_steps() -> None:
    pieces, _ = sent(scenario({"kind": "clock-drift", "at_s": 1.0, "for_s": 1.0, "drift_ppm": 20_000}))
    driver = DtgHead()
    steps = np.concatenate([driver.decode(piece).step.copy() for _, piece in pieces])
    assert steps[:200] == pytest.approx(1.0 / RATE_HZ)
    assert steps[200:400].sum() == pytest.approx(1.02, abs=2e-6)
    assert steps[400:] == pytest.approx(1.0 / RATE_HZ)


@pytest.mark.parametrize("step_s", [0.5, -0.5])
def test_time_goes_on_with_the_counter_where_the_clock_jumps(step_s: float) -> None:
    pieces, _ = sent(scenario({"kind": "clock-step", "at_s": 1.0, "step_s": step_s}))
    driver = DtgHead()
    times = np.concatenate([driver.decode(piece).time.copy() for _, piece in pieces])
    np.testing.assert_allclose(np.diff(times), 1.0 / RATE_HZ, atol=1e-9)
    assert driver.counters.clock_steps == 1


@pytest.mark.parametrize(
    ("driver", "kind"),
    [("sbg", "drop"), ("j1939-imu", "drop"), ("sbg", "silence"), ("j1939-imu", "silence"), ("xsens-can", "silence")],
)
def test_what_other_boards_lose_is_counted(driver: str, kind: str) -> None:
    pieces, report = sent(scenario({"kind": kind, "at_s": 1.0, "for_s": 0.5, "share": 0.05}, driver=driver))
    counters = counted(joined(pieces), driver)
    lost = sum(report["lost"].values())
    assert counters["lost"] == lost > 0
    assert counters["samples"] + lost == SAMPLES - 10, "ten samples tell the period"


def test_a_counter_tells_a_set_clock_from_a_new_start() -> None:
    wire = {"kind": "clock-step", "at_s": 1.0, "step_s": 7.0}, {"kind": "counter-freeze", "at_s": 2.0, "for_s": 0.2}
    pieces, _ = sent(scenario(*wire, driver="xsens-can"))
    counters = counted(joined(pieces), "xsens-can")
    assert (counters["clock_steps"], counters["frozen"], counters["restarts"]) == (1, 40, 0)
    assert counters["lost"] == 40


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(HilError, match=r"wire\.0\.kind = 'dorp'"):
        parse('[[wire]]\nkind = "dorp"\nat_s = 1', "x.toml")
    with pytest.raises(HilError, match="a clock step needs a step_s that is not 0"):
        parse('[[wire]]\nkind = "clock-step"\nat_s = 1\nstep_s = 0', "x.toml")
    with pytest.raises(HilError, match="the frames of sbg carry no check"):
        SimulatedHead(scenario({"kind": "crc-off", "at_s": 1.0}, driver="sbg"))
    with pytest.raises(HilError, match=r"only a port can be pulled out: hil imu SCENARIO --bus pty:PATH"):
        SimulatedHead(scenario({"kind": "unplugged", "at_s": 1.0}))
    for bus in ("pty:/tmp/x", "serial:/dev/x:115200"):
        for driver in ("dtg-head", "j1939-imu"):
            with pytest.raises(HilError, match=f"a {driver} sends CAN frames, and {bus} is a serial line.*'vectornav'"):
                SimulatedHead(scenario(driver=driver).with_changes(bus=bus))
