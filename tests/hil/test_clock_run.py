"""The clocks of a run: in the loop, in its summary, in a recording and its plot."""

import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import hil

from drivers.can.dtg_head_emulator import SIMULATED, HeadEncoder
from drivers.can.frames import FrameArray
from drivers.logs.recording import RecordingWriter
from hil.bridge import EVENTS, Loop, LoopOrder, Outlets
from hil.clock import HostClock, clock_reading, clock_summary
from hil.control import Control
from hil.pytest_plugin import StartBridge
from hil.scenario import Scenario
from hil.session import Session
from hil.stats import Stats
from hil.world.head import SimulatedHead, feed

SCENARIO = Scenario.model_validate(
    {"bus": "unix:none", "head": {"rate_hz": 100}, "navigation": {"alignment": "truth"}, "mavlink": {"links": ()}}
)
START = 1_700_000_000_000_000_000
DRIFT = 150e-6


def stamped(seconds: float) -> FrameArray:
    """Frames of a head whose clock gains 150 ppm, with stamps of their arrival."""
    batch = np.concatenate(
        [part for _, *parts in SimulatedHead(SCENARIO).chunks(round(100 * seconds)) for part in parts]
    )
    sample = batch["length"] == 64
    device = np.cumsum(sample) * 0.01
    late = np.random.default_rng(2).exponential(150e-6, len(batch))
    host = device / (1.0 + DRIFT) + late
    batch["time_ns"] = START + np.rint(host * 1e9).astype(np.int64)
    return batch


def through_loop(batch: FrameArray) -> tuple[Outlets, dict[str, Any], list[str]]:
    outlets = Outlets.make(recording=False, readers=1)
    loop = Loop(LoopOrder(SCENARIO, own_world=True), outlets)
    for start in range(0, len(batch), 10):
        loop.take(batch[start : start + 10])
    notes = np.zeros(64, EVENTS)
    copied, _ = outlets.events.pull(notes, 0)
    return outlets, loop.result(), [note["text"].decode() for note in notes[:copied]]


def test_the_loop_knows_the_clock_of_its_device() -> None:
    batch = stamped(40.0)
    outlets, result, texts = through_loop(batch)
    said = clock_summary(outlets.stats)
    assert said is not None
    assert said["drift_ppm"] == pytest.approx(1e6 * DRIFT, abs=1.0)
    true = START * 1e-9 + 40.0 / (1.0 + DRIFT) - 40.0
    assert abs(said["offset_s"] - true) * 1e6 <= said["bound_us"] + 0.5 < 100.0  # a double holds such times to 0.24 us
    assert (said["steps"], said["host_steps"]) == (0, 0)
    assert not [text for text in texts if "clock" in text]
    other = batch.copy()
    other["time_ns"] = 0
    assert through_loop(other)[1]["navigation_digest"] == result["navigation_digest"], (
        "times of the host do not navigate"
    )


def test_a_step_of_the_device_is_told() -> None:
    batch = stamped(40.0)
    batch["time_ns"][2500:] -= 250_000_000
    outlets, _, texts = through_loop(batch)
    said = clock_summary(outlets.stats)
    assert said is not None
    assert said["steps"] == 1
    (text,) = [text for text in texts if "clock" in text]
    assert text.startswith("clock step: device less host changed by +0.2")


def test_without_a_bound_nothing_is_said() -> None:
    outlets = Outlets.make(recording=False, readers=1)
    assert clock_summary(outlets.stats) is None
    assert clock_reading(outlets.stats) is None
    outlets, *_ = through_loop(stamped(0.5))
    assert clock_summary(outlets.stats) == {
        "offset_s": None, "drift_ppm": None, "bound_us": None, "steps": 0, "host_steps": 0,
    }  # fmt: skip


def test_a_clock_of_the_day_that_is_set_is_the_hosts_step() -> None:
    """The monotonic clock goes on: the fit does, and frames from before the step are not put to it."""
    host, second = HostClock(), 1_000_000_000
    ahead, clear = host.look(0, START, 200)
    assert clear
    assert ahead == START - 100
    assert host.look(second, START + second + 50_000, second + 200)[0] == ahead, "noise of reading"
    slow = host.look(2 * second, START + 3 * second, 3 * second)
    assert slow[0] == ahead, "the reading was interrupted"
    assert host.steps == 0
    moved, clear = host.look(4 * second, START + 7 * second, 4 * second + 200)
    assert moved == START + 3 * second - 100
    assert not clear
    assert (host.steps, host.step_s) == (1, pytest.approx(3.0))
    assert host.look(6 * second, START + 9 * second, 6 * second + 200) == (moved, True)
    assert host.steps == 1


def test_the_hosts_clocks_go_alike_here() -> None:
    host = HostClock()
    for _ in range(200):
        host.look(time.monotonic_ns(), time.time_ns(), time.monotonic_ns())
        time.sleep(0.001)
    assert host.steps == 0


def test_a_live_run_shows_its_clock(hil_bridge: StartBridge, tmp_path: Path) -> None:
    """The simulated head keeps the host's time."""
    path = tmp_path / "live.dhil"
    summary = hil_bridge(navigation={"alignment": "truth"}, head={"rate_hz": 200}, duration_s=6, record=path).wait_end(
        30
    )
    said = summary["clock"]
    assert abs(said["drift_ppm"]) < 1000.0
    assert said["bound_us"] > 0.0
    assert said["host_steps"] == 0
    assert abs(said["offset_s"] + 6.0 - time.time()) < 60.0
    log = json.loads(hil("clock", path, "--json")[0])
    assert log["samples"] == 1200
    assert log["offset_s"] == pytest.approx(said["offset_s"], abs=0.02)


def fast_head(scenario: Scenario, control: Control, _: Stats, answer: Any) -> None:
    """A simulated head in a process of its own whose clock gains 2000 ppm."""
    head = SimulatedHead(scenario)
    head.step /= 1.002  # its frames keep their times and go out earlier
    while not (control.go or control.stop):
        time.sleep(0.005)
    answer.send(feed(head, scenario, paced=True, cancelled=lambda: control.stop))


def test_a_head_that_gains_is_seen_through_a_real_bus() -> None:
    scenario = SCENARIO.with_changes(bus=f"unix:clock-{os.getpid()}", head={"rate_hz": 200}, duration_s=8.0)
    with Session(LoopOrder(scenario, own_world=True), feeder=(fast_head, (scenario,)), publish=False) as session:
        session.wait_ready()
        while session.running:
            time.sleep(0.05)
    summary = session.summary()
    assert summary["samples"] == 1600
    assert summary["clock"]["drift_ppm"] == pytest.approx(2000.0, rel=0.2)


def recorded(path: Path, batch: FrameArray) -> Path:
    writer = RecordingWriter(path, {"scenario": SCENARIO.model_dump(mode="json")})
    writer.write(batch)
    writer.close()
    return path


def test_a_recording_shows_drift_and_delay(tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.dhil", stamped(40.0))
    said = json.loads(hil("clock", path, "--json")[0])
    assert said["samples"] == 4000
    assert said["drift_ppm"] == pytest.approx(1e6 * DRIFT, abs=1.0)
    assert said["age_us"]["p50"] == pytest.approx(150.0 * np.log(2.0), rel=0.1)
    assert said["steps"] == []


@pytest.mark.parametrize("step", [-0.5, 0.5])
def test_a_recording_tells_a_step_of_the_host(tmp_path: Path, step: float) -> None:
    batch = stamped(40.0)
    batch["time_ns"][2500:] += round(step * 1e9)
    said = json.loads(hil("clock", recorded(tmp_path / "h.dhil", batch), "--json")[0])
    assert [(s["clock"], s["step_s"]) for s in said["steps"]] == [("host", pytest.approx(-step, abs=2e-3))]


def test_a_device_whose_clock_jumps_alone_is_mended_by_its_driver(tmp_path: Path) -> None:
    """Its counter goes on, and time with it: the driver counts the jump, and none is left for the fit."""
    numbers, encoder = (
        np.arange(4000),
        HeadEncoder("fd", 10_000, serial=1, world_id=0, hardware=SIMULATED, rotor_hz=0.0),
    )
    ends = (numbers + 1) * 10_000 + np.where(numbers >= 2500, 300_000, 0)
    slow, zeros = encoder.slow(), np.zeros((4000, 4))
    samples = encoder.samples(numbers, ends, zeros, zeros[:, :3], np.zeros(4000, np.int64), zeros)
    batch = np.concatenate([slow, samples])
    late = np.random.default_rng(2).exponential(150e-6, len(samples))
    batch["time_ns"] = START
    batch["time_ns"][len(slow) :] += np.rint((numbers * 0.01 + late) * 1e9).astype(np.int64)
    path = recorded(tmp_path / "d.dhil", batch)
    assert json.loads(hil("clock", path, "--json")[0])["steps"] == []
    counters = json.loads(hil("decode", "dtg-head", path)[1].splitlines()[-1])
    assert (counters["clock_steps"], counters["lost"]) == (1, 0)


def test_a_plot_is_drawn(tmp_path: Path) -> None:
    batch = stamped(30.0)
    batch["time_ns"][1500:] -= 20_000_000
    path, plot = recorded(tmp_path / "a.dhil", batch), tmp_path / "clock.svg"
    hil("clock", path, "--plot", plot)
    text = plot.read_text()
    assert text.startswith("<?xml")
    assert len(text) > 5000
    assert "unknown ending" in hil("clock", path, "--plot", tmp_path / "clock.xyz", code=2)[1]


def test_arrivals_of_simulated_time_are_refused(tmp_path: Path) -> None:
    batch = stamped(20.0)
    batch["time_ns"] = START + np.arange(len(batch)) * 1000
    path = recorded(tmp_path / "fast.dhil", batch)
    assert "not of real time" in hil("clock", path, code=2)[1]
    assert "no samples" in hil("clock", path, "--imu", "sbg", code=2)[1]
