"""A recording replays bit for bit, whatever its kind and speed; damaged and foreign files say what is wrong."""

import json
import os
import time
from pathlib import Path
from typing import Any

import can
import commands
import numpy as np
import pytest

from drivers.can.convert import to_message
from drivers.can.frames import FrameArray
from drivers.logs.recording import EVENT, RecordingReader, RecordingWriter
from hil.pytest_plugin import StartBridge

DURATION_S = 5.0
CHANGES: dict[str, Any] = {
    "duration_s": DURATION_S,
    "head": {"rate_hz": 500, "lever_arm_m": (0.5, -0.2, 0.1)},
    "motion": {"rest_s": 1, "ramp_s": 2},
    "navigation": {"align_s": 0.8},
}


def replay(*arguments: object, code: int = 0) -> tuple[dict[str, Any], str]:
    """``hil replay``: its summary and what it said."""
    out, err = commands.hil("replay", *arguments, "--mavlink", "none", "--json", code=code)
    return (json.loads(out) if out else {}), err


def read(path: Path) -> tuple[FrameArray, dict[str, Any], str]:
    reader, blocks = RecordingReader.open(path), []
    while len(block := reader.read()):
        blocks.append(block)
    reader.close()
    return np.concatenate(blocks), reader.header, reader.problem


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A paced run with its own head, recorded; the summary."""
    from hil.bridge import LoopOrder
    from hil.scenario import load
    from hil.session import Session, simulated_head

    file = tmp_path_factory.mktemp("live") / "live.dhil"
    bus = f"unix:replay-{os.getpid()}"
    order = LoopOrder(load(None).with_changes(**CHANGES, bus=bus, mavlink={"links": ()}))
    with Session(order, feeder=simulated_head(order), record=file) as session:
        session.wait_ready()
        while session.running:
            time.sleep(0.05)
    return file, session.summary()


@pytest.mark.parametrize("speed", ["max", "1"])
def test_replay_is_bit_identical(recorded: tuple[Path, dict[str, Any]], speed: str) -> None:
    file, live = recorded
    summary, _ = replay(file, "--speed", speed)
    assert live["samples"] == 500 * DURATION_S == summary["samples"]
    assert live["mode"] == summary["mode"] == "navigate"
    assert summary["navigation_digest"] == live["navigation_digest"]
    for name, spread in live["error"].items():  # sums depend on the batches in their last bit
        assert summary["error"][name] == pytest.approx(spread, rel=1e-12)
    assert summary["gyro_bias_deg_h"] == live["gyro_bias_deg_h"]
    assert live["recorder"]["frames"] == summary["frames"]
    if speed == "1":
        assert DURATION_S - 0.5 < summary["wall_s"] < DURATION_S + 5.0  # it keeps the pace; a busy machine ends it late


def test_simulated_time_gives_the_same_frames(recorded: tuple[Path, dict[str, Any]], hil_bridge: StartBridge) -> None:
    """The head's bytes, and with them the navigation, do not depend on the speed."""
    summary = hil_bridge(**CHANGES, paced=False).wait_end(60)
    assert summary["navigation_digest"] == recorded[1]["navigation_digest"]


def test_replay_of_a_replay(recorded: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    file, live = recorded
    copy = tmp_path / "copy.dhil"
    replay(file, "--speed", "max", "--record", copy)
    np.testing.assert_array_equal(read(copy)[0], read(file)[0])
    assert replay(copy, "--speed", "max")[0]["navigation_digest"] == live["navigation_digest"]


def test_replay_over_a_bus(recorded: tuple[Path, dict[str, Any]]) -> None:
    """A player sends the recording to the bridge as the head did."""
    file, live = recorded
    summary, _ = replay(file, "--speed", "max", "--bus", f"unix:over-{os.getpid()}")
    assert summary["feeder"] == {"sent": live["frames"], "dropped": 0}
    assert summary["navigation_digest"] == live["navigation_digest"]


@pytest.mark.parametrize("speed", ["max", pytest.param("1", marks=pytest.mark.slow)])
def test_silence_loss_and_restart_replay_alike(hil_bridge: StartBridge, tmp_path: Path, speed: str) -> None:
    """A live run with a lossy head that falls silent and starts anew; events are part of the recording."""
    from drivers.can.bus import open_port
    from hil.scenario import load
    from hil.world.head import SimulatedHead

    file = tmp_path / "rough.dhil"
    bridge = hil_bridge(**CHANGES, simulate_head=False, record=file)
    scenario = load(None).with_changes(**CHANGES)
    port = open_port(bridge.bus, listen=False)
    sent = np.concatenate([part for _, *parts in SimulatedHead(scenario).chunks(2500) for part in parts])
    good = np.ones(len(sent), bool)
    good[np.r_[400:405, 900:1000, 1300:1420]] = False  # short, longer than is interpolated, at a batch's edge
    lossy = sent[good].copy()
    lossy["data"][600, 20] ^= 0x10

    def send(part: FrameArray) -> None:
        for start in range(0, len(part), 37):
            port.send(part[start : start + 37].copy())

    send(lossy[:1500])
    bridge.wait_mode("degraded", timeout_s=5)
    while not any("silent" in text for *_, text in bridge.events()):
        time.sleep(0.01)
    send(lossy[1500:1700])
    send(sent)  # a head that starts anew
    port.close()
    live = bridge.wait_end(20)
    assert (live["restarts"], live["silences"], live["crc_errors"]) == (1, 1, 1)
    assert live["lost"] > 200
    assert live["interpolated"] > 0

    summary, said = replay(file, "--speed", speed)
    for name in ("samples", "lost", "restarts", "silences", "crc_errors", "interpolated", "mode", "navigation_digest"):
        assert summary[name] == live[name], name
    for *_, text in bridge.events():
        # how long a wire was bad is told from one look at the counters to another, once a batch
        assert text.endswith("no more") or text[:40] in " ".join(said.split())


def test_truncated_recording_is_used_up_to_the_damage(recorded: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    file, live = recorded
    part = tmp_path / "part.dhil"
    part.write_bytes(file.read_bytes()[: file.stat().st_size * 6 // 10])
    frames, _, problem = read(part)
    summary, _ = replay(part, "--speed", "max")
    assert summary["frames"] == len(frames)
    assert 0.5 * live["frames"] < summary["frames"] < 0.62 * live["frames"]
    assert summary["problem"] == problem
    offset = int(problem.split("truncated or damaged at offset ")[1].split(";")[0])
    assert 0 <= part.stat().st_size - offset < 12 + 4096 * frames.itemsize


def test_flipped_bit_is_found(recorded: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    file, live = recorded
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "bad.dhil").write_bytes(data)
    summary, _ = replay(tmp_path / "bad.dhil", "--speed", "max")
    assert "damaged at offset" in summary["problem"]
    assert 0.4 * live["samples"] < summary["samples"] < 0.6 * live["samples"]


def test_damaged_header_is_refused(recorded: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    data = bytearray(recorded[0].read_bytes())
    data[60] ^= 1
    (tmp_path / "bad.dhil").write_bytes(data)
    _, said = replay(tmp_path / "bad.dhil", code=2)
    assert "damaged header at offset" in said


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        (
            "x.dat",
            b"something else",
            "unknown kind; there is: our own recordings, .ulg, .bin, candump .log, .blf, .asc",
        ),
        ("x.bin", b"something else", "not a readable DataFlash log"),
        ("x.dhil", b"something else", "not a recording of ours at offset 0"),
        ("x.ulg", b"something else", "not a readable ULog"),
        ("x.log", b"something else\n", "no frames in it"),
        ("x.blf", b"something else", "no frames in it"),
        ("x.dhil", b"", "not a recording of ours at offset 0"),
    ],
)
def test_foreign_file_is_a_wrong_request(tmp_path: Path, name: str, content: bytes, says: str) -> None:
    (tmp_path / name).write_bytes(content)
    _, said = replay(tmp_path / name, "--speed", "max", code=2)
    assert says in said
    assert name in said


def test_recording_of_another_version_is_named(tmp_path: Path) -> None:
    """A scenario that this version does not understand is refused with the key."""
    file = tmp_path / "future.dhil"
    with RecordingWriter(file, {"scenario": {"name": "x", "warp": 9}}):
        pass
    _, said = replay(file, code=2)
    assert f"hil: scenario in recording {file}: warp = 9: unknown key" in said
    with RecordingWriter(tmp_path / "bare.dhil", {}):
        pass
    _, said = replay(tmp_path / "bare.dhil", code=2)
    assert "bare.dhil: its header holds no scenario; give one with --scenario" in said


def test_all_kinds_of_frame_logs_replay_alike(recorded: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    file, live = recorded
    frames, _, _ = read(file)
    frames = frames[frames["reserved"][:, 0] != EVENT]
    scenario = tmp_path / "same.toml"
    scenario.write_text(
        f"duration_s = {DURATION_S}\n[motion]\nrest_s = 1\nramp_s = 2\nattitude = 'coordinated'\nnorth = {{rate = 1}}\n"
        "[head]\nrate_hz = 500\ninstruments = 'dtg'\nlever_arm_m = [0.5, -0.2, 0.1]\n[navigation]\nalign_s = 0.8\n"
    )
    digests = {}
    for ending in (".log", ".blf", ".asc"):
        log = tmp_path / f"frames{ending}"
        with can.Logger(log) as writer:
            for row in frames:
                writer.on_message_received(to_message(row, "can0"))
        summary, _ = replay(log, "--scenario", scenario, "--speed", "max")
        assert summary["samples"] == live["samples"], ending
        assert summary["crc_errors"] == summary["foreign"] == summary["short"] == 0, ending
        digests[ending] = summary["navigation_digest"]
    assert set(digests.values()) == {live["navigation_digest"]}, "neither kind nor the truth's motion matters"


def test_a_flight_board(hil_data: Path) -> None:
    """PX4's own attitude against ours from its raw IMU and magnetometer; no start value is PX4's."""
    summary, _ = replay(hil_data / "px4_board.ulg", "--speed", "max")
    difference, baseline = summary["difference"], summary["baseline"]["total_deg"]
    print(f"difference {difference}, plain integration {baseline}, lost {summary['lost']}")
    assert difference["tilt_deg"]["rms"] <= 0.3
    assert difference["heading_deg"]["rms"] <= 2.0
    assert 8.0 <= baseline["rms"] <= 11.0
    assert summary["feeder"]["dropped"] == 0
    assert summary["lost"] > 0, "the log has gaps"
    assert summary["interpolated"] > 0
    assert summary["aiding"]["MAGNETIC"] > 1000
    assert not any(summary["aiding_faults"].values())
    again, _ = replay(hil_data / "px4_board.ulg", "--speed", "max")
    assert again["navigation_digest"] == summary["navigation_digest"]


def test_a_flight(hil_data: Path, tmp_path: Path) -> None:
    """ArduPilot's own attitude and the receiver's track against ours, aided by all that the log has; and from its recording."""
    file = tmp_path / "flight.dhil"
    summary, _ = replay(hil_data / "ardupilot_copter.bin", "--speed", "max", "--record", file)
    difference = summary["difference"]
    print(f"difference {difference}, plain integration {summary['baseline']}")
    assert difference["tilt_deg"]["rms"] <= 1.0
    assert difference["heading_deg"]["rms"] <= 5.0
    assert np.hypot(difference["horizontal_m"]["rms"], difference["vertical_m"]["rms"]) <= 2.0
    assert summary["device_s"] > 360.0
    assert summary["lost"] == summary["foreign"] == summary["feeder"]["dropped"] == 0
    assert summary["aiding"].keys() == {"GNSS", "BARO", "MAGNETIC"}
    assert not any(summary["aiding_faults"].values())
    assert summary["frames"] == summary["feeder"]["sent"], "all of it, though the player ended long before the loop"
    again, _ = replay(file, "--speed", "max")
    assert (again["aiding"], again["navigation_digest"]) == (summary["aiding"], summary["navigation_digest"])


@pytest.mark.parametrize("start_s", [50, pytest.param(230, marks=pytest.mark.study)])
def test_a_flight_whose_receiver_falls_silent(hil_data: Path, start_s: int) -> None:
    """GPS withheld for 20 s: the filter knows how far off it may be."""
    outage = f"gnss:{start_s}:{start_s + 20}"
    summary, _ = replay(hil_data / "ardupilot_copter.bin", "--speed", "max", "--withhold", outage)
    difference = summary["difference"]
    print(difference)
    assert summary["withheld"] >= 90
    assert difference["horizontal_m"]["max"] > 3.0, "it does drift"
    assert difference["position_sigma"]["max"] <= 3.0


def test_plot_needs_an_attitude_to_compare_with(recorded: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    _, said = replay(recorded[0], "--speed", "max", "--plot", tmp_path / "x.svg", code=2)
    assert "carries no attitude to compare with" in said
