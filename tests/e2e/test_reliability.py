"""Every fault of the wire in one flight: counted to the frame, told, over when it is over, and recorded whole."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rows import COUNTERS, note, recorded

from drivers.can.dtg_head import DtgHead
from drivers.can.frames import FrameArray
from hil.pytest_plugin import Bridge, StartBridge
from nav.state import NAV_STATE, Mode

RATE_HZ, FIRST_S, EVERY_S = 200, 2.0, 2.0
FAULTS: dict[str, dict[str, Any]] = {
    "drop": {"share": 0.05, "for_s": 0.5},
    "duplicate": {"share": 0.05, "for_s": 0.5},
    "reorder": {"share": 0.05, "for_s": 0.5},
    "delay": {"delay_s": 0.3, "for_s": 0.5},
    "jitter": {"delay_s": 0.02, "for_s": 0.5},
    "bit-flip": {"share": 0.05, "for_s": 0.5},
    "crc-off": {"for_s": 0.05},
    "counter-freeze": {"for_s": 0.05},
    "babble": {"rate_hz": 2000, "for_s": 0.5},
    "clock-step": {"step_s": 0.5, "for_s": 0.5},
    "clock-drift": {"drift_ppm": -200, "for_s": 0.5},
    "silence": {"for_s": 0.5},
}
"""Silence comes last: what is bridged leaves the navigator DEGRADED until it aligns anew."""
SAYS = {
    "drop": "`share` of the frames do not arrive",
    "duplicate": "`share` of the frames come twice",
    "reorder": "`share` of the samples come behind the next one",
    "delay": "all frames come `delay_s` later",
    "jitter": "all frames come up to `delay_s` later",
    "bit-flip": "one bit of `share` of the payloads",
    "crc-off": "the check of all frames stays 0",
    "counter-freeze": "the sample counter stands still",
    "babble": "another node sends `rate_hz` frames a second",
    "clock-step": "the head's clock jumps by `step_s`, and back",
    "clock-drift": "the head's clock runs at `drift_ppm`",
    "silence": "nothing comes",
}
UNITS = {"delay_s": " s", "step_s": " s", "drift_ppm": " ppm"}
FLIGHT = """
name = "reliability"
[motion]
attitude = "coordinated"
north = { rate = 30 }
east = { sines = [{ amplitude = 20, period_s = 20 }] }
[head]
rate_hz = 200
[navigation]
alignment = "truth"
"""


def begins(kind: str) -> float:
    return FIRST_S + EVERY_S * list(FAULTS).index(kind)


def scenario(folder: Path) -> Path:
    file = folder / "reliability.toml"
    tables = [
        "[[wire]]\n"
        + "\n".join(f"{key} = {value!r}" for key, value in ({"kind": kind, "at_s": begins(kind)} | fault).items())
        for kind, fault in FAULTS.items()
    ]
    file.write_text("\n".join([FLIGHT, *tables]).replace("'", '"'))
    return file


def solutions(bridge: Bridge) -> Any:
    """All solutions of the run, the filled ones too."""
    ring = bridge.session.outlets.states
    rows = np.zeros(ring.capacity, NAV_STATE)
    copied, first = ring.pull(rows, 0)
    assert first == 0, "none was overwritten"
    return rows[:copied]


def counted_until(frames: FrameArray, times: list[float]) -> list[dict[str, int]]:
    """What the driver has counted before the first of `frames`, and by the device times `times`."""
    driver = DtgHead()
    marks = [driver.counters.as_dict()]
    for k in range(len(frames)):
        raw = driver.decode(frames[k : k + 1])
        if len(raw) and len(marks) <= len(times) and raw.time[0] > times[len(marks) - 1]:
            marks.append(driver.counters.as_dict())
    marks += [driver.counters.as_dict()] * (len(times) + 1 - len(marks))
    return [{name: mark[name] for name in COUNTERS if name in mark} for mark in marks]


def injected(kind: str) -> str:
    keys = {key: value for key, value in FAULTS[kind].items() if key != "for_s"}
    said = SAYS[kind]
    for key, value in keys.items():
        said = said.replace(f"`{key}`", f"{value:g}{UNITS.get(key, '')}" if "_" in key else f"{100 * value:g} %")
    return f"{said}, for {FAULTS[kind]['for_s']:g} s"


def test_every_fault_of_the_wire_is_counted_told_and_over(hil_bridge: StartBridge, tmp_path: Path) -> None:
    path, end_s = tmp_path / "run.dhil", FIRST_S + EVERY_S * len(FAULTS)
    bridge = hil_bridge(scenario(tmp_path), record=path, duration_s=end_s, mavlink={"links": ()})
    summary = bridge.wait_end(120)
    wire, rows, events, (frames, _) = summary["wire"], solutions(bridge), bridge.events(), recorded(path)

    assert {name: summary[name] for name in wire["expected"]} == wire["expected"], "counted to the frame"
    received = summary["samples"] + summary["late"] + sum(wire["lost"].values())
    assert wire["samples"] == summary["feeder"]["sent"] == received == end_s * RATE_HZ
    assert set(wire["injected"]) | {"clock-drift", "clock-step"} == set(FAULTS)
    assert summary["restarts"] == 0
    assert len(frames) == summary["frames"] == summary["recorder"]["frames"] - summary["silences"]
    assert summary["recorder"]["lost"] == 0

    clean = rows["time"] < FIRST_S
    marks = counted_until(frames, [begins(kind) + EVERY_S - 0.1 for kind in FAULTS])
    offset = np.min(rows["solution_ns"][clean] * 1e-9 - rows["time"][clean])
    for number, kind in enumerate(FAULTS):
        start, end = begins(kind), begins(kind) + FAULTS[kind]["for_s"]
        after = np.flatnonzero(rows["time"] > end + 1e-6)[0]
        back_s = rows["solution_ns"][after] * 1e-9 - rows["time"][after] - offset
        mode = Mode(int(rows["mode"][np.flatnonzero(rows["time"] < start + EVERY_S - 0.1)[-1]])).name
        assert mode == ("DEGRADED" if kind == "silence" else "NAVIGATE"), kind
        told = [text for moment, _, text in events if start - 0.1 <= moment < start + EVERY_S - 0.1]
        moved = {name: marks[number + 1][name] - marks[number][name] for name in marks[0]}
        moved["silences"] = told.count("no samples: the sensor is silent")
        assert bool(told) == any(moved.values()), (kind, told)
        back = f"{max(back_s, 0.0):.3f}, {mode}"
        note(number, f"`{kind}`", injected(kind), moved, told, back, "0")


@pytest.mark.parametrize("kind", ["drop", "bit-flip"])
def test_what_is_lost_on_the_wire_moves_the_vehicle_by_millimetres(
    hil_bridge: StartBridge, tmp_path: Path, kind: str
) -> None:
    wire = [{"kind": kind, "at_s": 0.5, "share": 0.02}]
    summary = hil_bridge(scenario(tmp_path), wire=wire, duration_s=20, paced=False, mavlink={"links": ()}).wait_end(60)
    assert summary["lost"] > 50
    assert summary["error"]["position_m"]["max"] < 0.01
