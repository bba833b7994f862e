"""Gaps in what a bridge hears, live, and in the replay of its recording: the same navigation, bit for bit, in each regime.

A process of the test sends a simulated head's samples in real time and leaves some out: fewer than are interpolated, more,
and more than are bridged. What else the loop does by the clock of the host, silence, stands as an event in the recording.
"""

import json
import multiprocessing as mp
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import hil

from drivers.can.bus import open_port
from drivers.can.frames import FrameArray
from drivers.logs.recording import EVENT, SILENCE, RecordingReader
from hil.bridge import LoopOrder
from hil.scenario import Scenario
from hil.session import Session
from hil.world.head import SimulatedHead

RATE_HZ = 200
ALIGN_S, GAP_AT_S, END_S = 1.0, 2.5, 7.0
INTERPOLATE_S, REALIGN_S = 0.1, 1.0


def scenario(silence_s: float, *, sways: bool) -> Scenario:
    """A head that stands for the alignment, and then sways or stands on."""
    roll = {"sines": [{"amplitude": 10.0, "period_s": 1.5}]}
    return Scenario.model_validate(
        {
            "name": "gaps",
            "bus": f"unix:gaps-{time.monotonic_ns():x}",
            "duration_s": END_S,
            "head": {"rate_hz": RATE_HZ},
            "motion": {"rest_s": 1.5, "ramp_s": 0.5, "heading": {"offset": 20.0}, "roll": roll if sways else {}},
            "navigation": {
                "alignment": "level",
                "align_s": ALIGN_S,
                "start": {"heading_deg": 20.0},
                "gap_interpolate_s": INTERPOLATE_S,
                "gap_realign_s": REALIGN_S,
                "silence_s": silence_s,
            },
            "mavlink": {"links": []},
        }
    )


def feed(table: dict[str, Any], missing: int) -> None:
    """Send the head's samples at their times, without `missing` of them."""
    chosen = Scenario.model_validate(table)
    head = SimulatedHead(chosen)
    sent = [part for _, *parts in head.chunks(int(END_S * RATE_HZ)) for part in parts]
    port = open_port(chosen.bus, listen=False)
    try:
        _in_time(port, np.concatenate(sent), missing)
    finally:
        port.close()


def _in_time(port: Any, batch: FrameArray, missing: int) -> None:
    samples = np.cumsum(batch["length"] == 64)
    due = samples / RATE_HZ
    gap = (samples > GAP_AT_S * RATE_HZ) & (samples <= GAP_AT_S * RATE_HZ + missing) & (batch["length"] == 64)
    while port.listeners == 0:
        time.sleep(0.01)
    began = time.monotonic()
    for row in np.flatnonzero(~gap):
        if (wait := began + due[row] - time.monotonic()) > 0.0:
            time.sleep(wait)
        port.send(batch[row : row + 1].copy())


def events_of(path: Path) -> int:
    """Silences in a recording."""
    reader, count = RecordingReader.open(path), 0
    while len(block := reader.read()):
        mark = block[block["reserved"][:, 0] == EVENT]
        count += int((mark["data"][:, 0] == SILENCE).sum())
    reader.close()
    return count


@pytest.mark.slow
@pytest.mark.parametrize(
    ("missing", "silence_s", "told", "mode", "interpolated"),
    [
        (int(0.05 * RATE_HZ), 5.0, None, "navigate", True),
        (int(0.5 * RATE_HZ), 0.2, "bridged, attitude and velocity are no longer exact", "degraded", True),
        (int(1.5 * RATE_HZ), 0.2, "aligning: gap of 1.500 s", "navigate", False),
    ],
    ids=["interpolated", "bridged", "aligned anew"],
)
def test_live_and_replayed_alike(
    tmp_path: Path, missing: int, silence_s: float, told: str | None, mode: str, interpolated: bool
) -> None:
    chosen, path = scenario(silence_s, sways=interpolated), tmp_path / "gaps.dhil"
    feeder = mp.get_context("spawn").Process(target=feed, args=(chosen.model_dump(mode="json"), missing), daemon=True)
    with Session(LoopOrder(chosen), record=path, publish=False) as session:
        session.wait_ready()
        feeder.start()
        feeder.join(90.0)
        assert feeder.exitcode == 0
        while session.running:
            time.sleep(0.05)
        texts = [text for _, _, text in session.events()]
    live = session.summary()
    out, err = hil("replay", path, "--speed", "max", "--mavlink", "none", "--json")
    again = json.loads(out)
    assert again["navigation_digest"] == live["navigation_digest"]
    for name in ("samples", "lost", "interpolated", "silences", "mode", "gyro_bias_deg_h"):
        assert again[name] == live[name], name
    assert live["lost"] == missing
    assert live["interpolated"] == (missing if interpolated else 0)
    assert live["mode"] == mode
    if told is None:
        assert len([text for text in texts if "align" in text]) == 2, "begun and done, and nothing of the gap"
        assert live["silences"] == 0
    else:
        assert any(told in text for text in texts), texts
        assert told in " ".join(err.split()), "the replay tells the same"
        assert live["silences"] >= 1
    assert events_of(path) == live["silences"]


@pytest.mark.parametrize("speed", ["1", "max"])
def test_limits_of_another_scenario_change_a_replay(tmp_path: Path, speed: str) -> None:
    """The policy is the scenario's, also of a recording: what was interpolated live is bridged by a stricter one."""
    chosen, path = scenario(5.0, sways=True), tmp_path / "gaps.dhil"
    from drivers.logs.recording import RecordingWriter

    frames = np.concatenate(
        [part for _, *parts in SimulatedHead(chosen).chunks(int(END_S * RATE_HZ)) for part in parts]
    )
    kept = np.delete(frames, np.flatnonzero(frames["length"] == 64)[500:515])
    kept["time_ns"] = np.arange(len(kept)) * 1_000_000
    writer = RecordingWriter(path, {"scenario": chosen.model_dump(mode="json")})
    writer.write(kept)
    writer.close()
    strict = tmp_path / "strict.toml"
    strict.write_text(
        f'[head]\nrate_hz = {RATE_HZ}\n[navigation]\nalignment = "level"\n'
        f"align_s = {ALIGN_S}\ngap_interpolate_s = 0.05\nstart = {{ heading_deg = 20.0 }}\n"
    )
    own = json.loads(hil("replay", path, "--speed", speed, "--mavlink", "none", "--json")[0])
    other = json.loads(hil("replay", path, "--speed", speed, "--mavlink", "none", "--scenario", strict, "--json")[0])
    assert (own["mode"], other["mode"]) == ("navigate", "degraded")
    assert own["interpolated"] == other["interpolated"] == 15
