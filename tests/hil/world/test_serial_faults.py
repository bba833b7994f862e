"""Faults of a serial line: what the drivers of real boards count of them, packet by packet, and where time goes on."""

import time
from contextlib import closing
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import emulator_names, make_driver
from drivers.can.bus import open_port
from drivers.can.frames import frames
from drivers.serial.driver import SerialDriver
from drivers.serial.port import SerialPort
from hil.bridge import EVENTS, Loop, LoopOrder, Outlets
from hil.scenario import Scenario
from hil.wire_config import COUNTING, SERIAL
from hil.world.head import SimulatedHead, faulty, stream
from nav.errors import HilError
from nav.increments import FloatArray

RATE_HZ, SAMPLES = 200, 1000
LOSSES = {"drop", "bit-flip", "silence", "counter-freeze"}
KINDS = (*sorted(LOSSES), "duplicate", "reorder", "delay", "jitter", "babble", "clock-drift")
PERIOD_S = 1.0 / RATE_HZ

pytestmark = pytest.mark.skipif(
    not {*SERIAL} <= {*emulator_names()}, reason="installed before these boards were emulated: pip install -e ."
)
boards = pytest.mark.parametrize("board", SERIAL)


def scenario(board: str, *wire: dict[str, Any], **changes: Any) -> Scenario:
    return Scenario.model_validate({"driver": board, "wire": wire, "head": {"rate_hz": RATE_HZ}, "seed": 3} | changes)


def taken(chosen: Scenario, samples: int = SAMPLES) -> tuple[SerialDriver, dict[str, Any], FloatArray]:
    """The driver that has heard all that goes out, the wire's report, and the times of the samples."""
    head, driver = SimulatedHead(chosen), make_driver(chosen.driver)
    assert head.wire is not None
    assert isinstance(driver, SerialDriver)
    sent = np.concatenate([piece.copy() for _, piece in faulty(head, head.wire, samples)])
    times = [driver.decode(sent[start : start + 50]).time.copy() for start in range(0, len(sent), 50)]
    return driver, head.wire.report(), np.concatenate(times)


def counted(driver: SerialDriver) -> dict[str, int]:
    return driver.counters.as_dict() | {"skipped_bytes": driver.stream.skipped}


def unsaid(board: str) -> int:
    """Samples at the start that only set the clock."""
    return int(board != "vectornav")


@boards
@pytest.mark.parametrize("kind", KINDS)
def test_each_fault_is_counted_exactly(board: str, kind: str) -> None:
    fault = {"kind": kind, "at_s": 2.0, "for_s": 0.5, "share": 0.1, "rate_hz": 500}
    if kind == "counter-freeze" and board not in COUNTING:
        with pytest.raises(HilError, match="counts no samples"):
            SimulatedHead(scenario(board, fault))
        return
    driver, report, _ = taken(scenario(board, fault))
    counters, expected = counted(driver), report["expected"]
    assert {name: counters[name] for name in expected} == expected
    assert counters["samples"] + counters["late"] + sum(report["lost"].values()) == SAMPLES - unsaid(board)
    assert set(report["lost"]) == ({kind} & LOSSES)
    told = {name for name, count in counters.items() if count} - {"frames", "samples", "crc_errors"}
    own = {
        "duplicate": {"duplicated"},
        "reorder": {"late"},
        "babble": {"skipped_bytes"},
        "counter-freeze": {"frozen", "lost"},
        "bit-flip": {"skipped_bytes", "lost"},
    }
    assert told == own.get(kind, {"lost"} if kind in LOSSES else set())
    assert counters["crc_errors"] == 0 or kind in {"bit-flip", "babble"}


windows = st.fixed_dictionaries(
    {
        "kind": st.sampled_from(["drop", "bit-flip", "silence", "duplicate", "delay", "jitter", "babble"]),
        "at_s": st.floats(0.1, 4.0),
        "for_s": st.floats(0.01, 0.3),
        "share": st.floats(0.01, 1.0),
        "delay_s": st.floats(0.001, 0.3),
        "rate_hz": st.floats(10.0, 500.0),
    }
)


@boards
@settings(max_examples=10)
@given(wire=st.lists(windows, min_size=2, max_size=5))
def test_faults_at_the_same_time_are_counted_exactly(board: str, wire: list[dict[str, Any]]) -> None:
    """But for the bytes: among so many, noise may pass a check by chance and is foreign then."""
    driver, report, _ = taken(scenario(board, *wire))
    counters, expected = counted(driver), report["expected"]
    if not counters["foreign"]:
        assert {name: counters[name] for name in expected} == expected
    assert counters["samples"] + sum(report["lost"].values()) == SAMPLES - unsaid(board)


@boards
@pytest.mark.parametrize("step_s", [0.5, 30.0])
def test_a_clock_that_is_set_ahead_is_counted_once_and_time_goes_on(board: str, step_s: float) -> None:
    driver, report, times = taken(scenario(board, {"kind": "clock-step", "at_s": 2.0, "step_s": step_s}))
    counters = counted(driver)
    assert (counters["clock_steps"], counters["restarts"], counters["lost"]) == (1, 0, 0)
    assert counters["clock_steps"] == report["expected"]["clock_steps"]
    np.testing.assert_allclose(np.diff(times), PERIOD_S, atol=2e-9)


@boards
def test_a_small_step_ahead_is_a_gap_to_a_board_that_counts_nothing(board: str) -> None:
    driver, report, _ = taken(scenario(board, {"kind": "clock-step", "at_s": 2.0, "step_s": 0.1}))
    counters, counting = counted(driver), board in COUNTING
    assert (counters["clock_steps"], counters["lost"]) == ((1, 0) if counting else (0, round(0.1 / PERIOD_S)))
    assert {name: counters[name] for name in report["expected"]} == report["expected"]


@boards
def test_a_clock_that_is_set_back_is_counted_once(board: str) -> None:
    """A counter tells it from a new start; without one it is a new start, whose first sample only shows that it is one."""
    driver, report, times = taken(scenario(board, {"kind": "clock-step", "at_s": 2.0, "step_s": -0.5}))
    counters, counting = counted(driver), board in COUNTING
    assert (counters["clock_steps"], counters["restarts"]) == ((1, 0) if counting else (0, 1))
    assert counters["lost"] == (0 if counting else 1)
    assert {name: counters[name] for name in report["expected"]} == report["expected"]
    assert sum(report["lost"].values()) == counters["lost"]
    steps = np.diff(times)
    assert np.sum(np.abs(steps - PERIOD_S) > 2e-9) == (0 if counting else 1)
    assert steps.min() == pytest.approx(PERIOD_S if counting else -0.5 + 2 * PERIOD_S, abs=2e-9)


@boards
@pytest.mark.parametrize("drift_ppm", [200.0, -200.0])
def test_drift_loses_nothing_and_shows_in_the_time(board: str, drift_ppm: float) -> None:
    driver, _, times = taken(scenario(board, {"kind": "clock-drift", "at_s": 0.0, "drift_ppm": drift_ppm}), 6000)
    counters = counted(driver)
    assert counters["samples"] == 6000 - unsaid(board)
    assert not any(count for name, count in counters.items() if name not in {"frames", "samples"})
    tick_s = 1e-4 if board == "xsens-xbus" else 1e-6
    elapsed_s = (len(times) - 1) * PERIOD_S
    assert times[-1] - times[0] == pytest.approx(elapsed_s * (1.0 + 1e-6 * drift_ppm), abs=tick_s)


@boards
@pytest.mark.parametrize("for_s", [0.3, 3.0])
def test_a_gap_is_no_step_of_the_clock(board: str, for_s: float) -> None:
    """Also where all comes late just before it, so that what comes behind it is the fastest for a while."""
    wire = (
        {"kind": "delay", "at_s": 1.5, "for_s": 0.5, "delay_s": 0.1},
        {"kind": "silence", "at_s": 2.0, "for_s": for_s},
    )
    driver, report, _ = taken(scenario(board, *wire), SAMPLES + 200)
    assert driver.counters.clock_steps == driver.counters.restarts == 0
    assert driver.counters.lost == report["lost"]["silence"] == round(for_s * RATE_HZ)


@boards
@pytest.mark.parametrize(
    ("wire", "mode"),
    [
        ({"kind": "clock-step", "at_s": 3.0, "step_s": 5.0}, "navigate"),
        ({"kind": "clock-step", "at_s": 3.0, "step_s": -0.5}, None),
        ({"kind": "silence", "at_s": 3.0, "for_s": 1.0}, "degraded"),
    ],
)
def test_navigation_goes_on_by_the_gap_policy(board: str, wire: dict[str, Any], mode: str | None) -> None:
    chosen = scenario(
        board, wire, duration_s=5.0, navigation={"alignment": "level", "align_s": 1.0, "start": {"heading_deg": 0.0}}
    )
    outlets, notes = Outlets.make(recording=False, readers=1), np.zeros(64, EVENTS)
    head, loop = SimulatedHead(chosen), Loop(LoopOrder(chosen, paced=False), outlets)
    assert head.wire is not None
    for _, piece in faulty(head, head.wire, 5 * RATE_HZ):
        loop.take(piece.copy())
    told = notes["text"][: outlets.events.pull(notes, 0)[0]].tolist()
    realigned = mode is None and board not in COUNTING
    assert loop.result()["mode"] == (mode or "navigate")
    assert sum(b"aligned in" in text for text in told) == 1 + realigned, told


@boards
def test_the_same_on_a_real_port_that_is_pulled_out(board: str, tmp_path: Path) -> None:
    """In real time on a pseudo-terminal: real arrivals tell the step, and what was lost with the port is counted."""
    wire = (
        {"kind": "drop", "at_s": 0.5, "for_s": 0.5, "share": 0.1},
        {"kind": "clock-step", "at_s": 1.5, "step_s": 0.5},
        {"kind": "unplugged", "at_s": 2.0, "for_s": 0.2},
    )
    head = SimulatedHead(scenario(board, *wire, bus=f"pty:{tmp_path / 'imu'}"))
    driver, batch, samples = make_driver(board), frames(256), 3 * RATE_HZ + 100
    with (
        closing(open_port(f"pty:{tmp_path / 'imu'}")) as pty,
        closing(SerialPort(f"serial:{tmp_path / 'imu'}:921600")) as port,
    ):
        sender = Thread(target=stream, args=(head, pty, samples), kwargs={"paced": True, "cancelled": lambda: False})
        sender.start()
        deadline = time.monotonic() + 20.0
        while driver.counters.samples + driver.counters.lost < samples - unsaid(board) and time.monotonic() < deadline:
            driver.decode(batch[: port.receive(batch, 0.05)])
        sender.join()
    assert head.wire is not None
    report, counters = head.wire.report(), driver.counters
    assert {name: counters.as_dict()[name] for name in report["expected"]} == report["expected"]
    assert (counters.clock_steps, counters.restarts, port.failures) == (1, 0, 1)
    assert counters.samples + counters.lost == samples - unsaid(board), "no sample is lost uncounted"
    assert counters.lost >= report["lost"]["drop"] + report["lost"]["unplugged"]
