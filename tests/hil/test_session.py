"""A run as a whole: its parts, its end, and what becomes of it when a part dies."""

import os
import signal
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.can.frames import FrameArray
from drivers.logs.recording import RecordingReader
from hil.bridge import Loop, LoopOrder, Outlets
from hil.pytest_plugin import StartBridge
from hil.scenario import HeadConfig, NavigationConfig, Scenario, load
from hil.session import Session, simulated_head
from hil.world.head import SimulatedHead
from nav.errors import HilError
from nav.state import Mode

TRUTH = {"alignment": "truth"}


def kill(session: Session, part: str) -> None:
    pid = session._parts[part].process.pid
    assert pid
    os.kill(pid, signal.SIGKILL)


def watch_until_failed(session: Session) -> None:
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        _ = session.running
        time.sleep(0.02)


def recorded_frames(path: Path) -> tuple[int, str]:
    reader, count = RecordingReader.open(path), 0
    while len(chunk := reader.read()):
        count += len(chunk)
    reader.close()
    return count, reader.problem


def test_every_sample_from_the_first_to_the_last(hil_bridge: StartBridge) -> None:
    bridge = hil_bridge("default", duration_s=18, paced=False)
    summary = bridge.wait_end(60)
    assert summary["samples"] == 18000 == summary["feeder"]["sent"]
    assert summary["frames"] == 18000 + 18 * 5
    for name in (
        "lost",
        "duplicated",
        "late",
        "crc_errors",
        "foreign",
        "short",
        "version_errors",
        "restarts",
        "silences",
    ):
        assert summary[name] == 0, name
    assert summary["device_s"] == pytest.approx(18.0)
    assert summary["rate_hz"] == pytest.approx(1000.0)
    assert summary["mode"] == "navigate"
    assert summary["error"]["position_m"]["max"] < 1e-3
    assert "problems" not in summary
    texts = [text for _, _, text in bridge.events()]
    assert texts[0].startswith("aligning")
    assert texts[1].startswith("aligned in 15.0 s")


def test_paced_run_keeps_time_and_measures_latency(hil_bridge: StartBridge) -> None:
    bridge = hil_bridge(navigation=TRUTH, head={"rate_hz": 200}, duration_s=2)
    state = bridge.wait_mode("navigate")
    first = float(state["time"])
    time.sleep(0.5)
    assert float(state["time"]) == first, "a state is a copy"
    later = bridge.state()
    assert later["time"] > first
    assert later["sequence"] > state["sequence"]
    summary = bridge.wait_end(20)
    assert summary["samples"] == 400
    assert summary["lost"] == 0
    assert 0.5 < summary["speed"] < 1.1
    latency = summary["latency_us"]
    assert 0 < latency["p50"] <= latency["p99"] <= latency["p999"] <= latency["max"]


def test_links_are_optional_and_counted(hil_bridge: StartBridge) -> None:
    bridge = hil_bridge(navigation=TRUTH, head={"rate_hz": 100}, duration_s=5)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground:
        assert bridge.mavlink_port
        ground.bind(("127.0.0.1", bridge.mavlink_port))
        sent = bridge.wait_end(20)["mavlink_sent"]
    assert sent["ATTITUDE"] > 20
    assert sent["HEARTBEAT"] >= 1
    silent = hil_bridge(navigation=TRUTH, duration_s=1, paced=False, mavlink={"links": ()})
    assert silent.mavlink_port is None
    summary = silent.wait_end(20)
    assert summary["mavlink_sent"] == {}
    assert "publisher" not in summary


@pytest.mark.parametrize("part", ["feeder", "loop"])
def test_death_of_an_organ_ends_the_run_and_is_named(hil_bridge: StartBridge, tmp_path: Path, part: str) -> None:
    bridge = hil_bridge(navigation=TRUTH, record=tmp_path / "run.dhil")
    bridge.wait_mode("navigate")
    time.sleep(0.3)
    kill(bridge.session, part)
    with pytest.raises(HilError, match=f"the {part} process died .exit code -9"):
        watch_until_failed(bridge.session)
    bridge.stop()
    count, problem = recorded_frames(tmp_path / "run.dhil")
    assert count > 250
    assert not problem, "what was recorded is whole"


@pytest.mark.parametrize("part", ["publisher", "recorder"])
def test_death_of_a_listener_is_said_and_the_run_goes_on(hil_bridge: StartBridge, tmp_path: Path, part: str) -> None:
    bridge = hil_bridge(navigation=TRUTH, record=tmp_path / "run.dhil")
    before = bridge.wait_mode("navigate")["sequence"]
    kill(bridge.session, part)
    time.sleep(0.5)
    assert bridge.session.running
    assert bridge.state()["sequence"] > before + 200
    summary = bridge.stop()
    assert summary["problems"] == [f"the {part} process died (exit code -9)"]
    assert summary["lost"] == 0


def test_simulated_time_waits_for_no_dead_recorder(hil_bridge: StartBridge, tmp_path: Path) -> None:
    bridge = hil_bridge(navigation=TRUTH, duration_s=400, paced=False, record=tmp_path / "run.dhil")
    kill(bridge.session, "recorder")
    summary = bridge.wait_end(120)
    assert summary["samples"] == 400_000
    assert summary["problems"] == ["the recorder process died (exit code -9)"]


def test_a_killed_run_leaves_a_usable_recording(hil_bridge: StartBridge, tmp_path: Path) -> None:
    bridge = hil_bridge(navigation=TRUTH, record=tmp_path / "run.dhil")
    bridge.wait_mode("navigate")
    time.sleep(1.0)
    taken = bridge.session.outlets.control.recorded
    kill(bridge.session, "recorder")
    count, problem = recorded_frames(tmp_path / "run.dhil")
    assert taken > 0
    assert count >= taken - 200, "no more than the last fraction of a second is missing"
    assert not problem or f"offset {(tmp_path / 'run.dhil').stat().st_size}" not in problem


def test_recording_that_cannot_be_written_stops_the_start(tmp_path: Path) -> None:
    order = LoopOrder(load(None).with_changes(bus="unix:t-norec", mavlink={"links": ()}))
    missing = tmp_path / "no" / "run.dhil"
    with (
        pytest.raises(HilError, match=f"{missing}: No such file or directory"),
        Session(order, feeder=simulated_head(order), record=missing) as session,
    ):
        session.wait_ready()


def test_error_in_the_block_ends_all_processes() -> None:
    order = LoopOrder(load(None).with_changes(bus="unix:t-error", mavlink={"links": ()}))
    with pytest.raises(RuntimeError, match="mine"), Session(order, feeder=simulated_head(order)) as session:
        raise RuntimeError("mine")
    parts = session._parts
    assert set(parts) == {"loop", "feeder"}
    assert all(not part.process.is_alive() for part in parts.values())
    assert not session.problems, "they ended on their own"


def test_nothing_listens_before_go_and_nothing_is_missed(hil_bridge: StartBridge) -> None:
    """The feeder waits for the loop: the first sample of the head is the first of the run."""
    bridge = hil_bridge(navigation=TRUTH, head={"rate_hz": 500}, duration_s=1)
    summary = bridge.wait_end(20)
    assert summary["samples"] == 500
    assert summary["device_s"] == pytest.approx(1.0)


def test_mode_that_cannot_come_ends_the_wait_with_the_run(hil_bridge: StartBridge) -> None:
    bridge = hil_bridge("rest", duration_s=1, paced=False)
    began = time.monotonic()
    with pytest.raises(HilError, match="mode navigate was not reached"):
        bridge.wait_mode(Mode.NAVIGATE, timeout_s=60)
    assert time.monotonic() - began < 20


def test_foreign_world_refuses_the_truth(hil_bridge: StartBridge) -> None:
    """A bridge may start from the truth only with the head of its own scenario."""
    listener = hil_bridge(navigation=TRUTH, simulate_head=False, seed=1)
    hil_bridge(bus=listener.bus, seed=2)
    with pytest.raises(HilError, match="the head there simulates another world"):
        watch_until_failed(listener.session)


def test_lever_arm_and_mounting_do_not_show(hil_bridge: StartBridge) -> None:
    head: dict[str, Any] = {"mounting_deg": (90, 5, -170), "lever_arm_m": (1.5, -0.4, 0.7), "rate_hz": 200}
    summary = hil_bridge("turns", head=head, duration_s=30, paced=False, navigation=TRUTH).wait_end(60)
    assert summary["error"]["position_m"]["max"] < 0.1
    assert summary["error"]["attitude_deg"]["max"] < 1e-3


def test_lever_arm_does_not_show_after_an_alignment(hil_bridge: StartBridge) -> None:
    head = {"lever_arm_m": (1.5, -0.4, 0.7), "rate_hz": 200}
    bridge = hil_bridge(head=head, duration_s=25, paced=False, navigation={"align_s": 5})
    assert bridge.wait_end(60)["error"]["position_m"]["max"] < 0.1


def test_silence_does_not_move_the_vehicle(hil_bridge: StartBridge) -> None:
    """The row that tells of the silence is the last one but for mode and health."""
    bridge = hil_bridge(navigation=TRUTH, head={"lever_arm_m": (3.0, 2.0, -1.0), "rate_hz": 100}, duration_s=None)
    bridge.wait_mode("navigate")
    pid = bridge.session._parts["feeder"].process.pid
    assert pid
    os.kill(pid, signal.SIGSTOP)
    try:
        silent = bridge.wait_mode("degraded", timeout_s=5)
        rows = np.zeros(2, silent.dtype)
        ring = bridge.session.outlets.states
        copied, _ = ring.pull(rows, ring.count - 2)
    finally:
        os.kill(pid, signal.SIGCONT)
    assert copied == 2
    assert rows[1]["mode"] == Mode.DEGRADED
    for name in ("time", "sequence", "arrival_ns", "lat", "lon", "height"):
        assert rows[0][name] == rows[1][name], name
    np.testing.assert_array_equal(rows[0]["vel_n"], rows[1]["vel_n"])
    np.testing.assert_array_equal(rows[0]["q_nb"], rows[1]["q_nb"])
    bridge.wait_mode("navigate", timeout_s=5)


def test_scenario_object_is_taken_as_it_is(hil_bridge: StartBridge) -> None:
    scenario = Scenario(name="mine", duration_s=1.0)
    bridge = hil_bridge(scenario, paced=False)
    assert bridge.wait_end(20)["scenario"] == "mine"


def a_head(scenario: Scenario) -> FrameArray:
    """All frames of the scenario's head."""
    head = SimulatedHead(scenario)
    assert scenario.duration_s
    chunks = [part for _, *parts in head.chunks(round(scenario.duration_s / head.step)) for part in parts]
    return np.concatenate(chunks)


def a_loop(scenario: Scenario, tmp_path: Path) -> Loop:
    return Loop(LoopOrder(scenario, file=tmp_path / "none"), Outlets.make(recording=False, readers=1))


def test_duration_that_ends_in_a_gap(tmp_path: Path) -> None:
    scenario = Scenario(duration_s=2.0, head=HeadConfig(rate_hz=100))
    sent = a_head(scenario)
    loop = a_loop(scenario.with_changes(duration_s=1.0), tmp_path)
    loop.take(sent[:95])
    loop.take(sent[160:])
    assert loop.finished


@pytest.mark.parametrize("size", [1, 7, 1024])
def test_result_does_not_depend_on_batching(tmp_path: Path, size: int) -> None:
    """A head that loses samples, starts anew and stands when the duration is over."""
    scenario = Scenario(duration_s=3.0, head=HeadConfig(rate_hz=100), navigation=NavigationConfig(align_s=0.5))
    sent = a_head(scenario)
    stream = np.concatenate([sent[:90], sent[95:160], sent[200:270], sent])

    def digest(size: int) -> tuple[Any, ...]:
        loop = a_loop(scenario.with_changes(duration_s=2.8), tmp_path)
        for start in range(0, len(stream), size):
            if not loop.finished:
                loop.take(stream[start : start + size].copy())
        assert loop.driver.counters.restarts == 1
        return loop.result()["navigation_digest"], loop.finished

    assert digest(size) == digest(1)
