"""Every fault of the wire in one flight: counted to the frame, told, over when it is over, and recorded whole."""

from pathlib import Path
from typing import Any

import pytest
from rows import OF_FRAMES, each_fault, note, recorded, said

from drivers.can.dtg_head import DtgHead
from hil.pytest_plugin import StartBridge

RATE_HZ, FIRST_S, EVERY_S = 200, 2.0, 2.0
FAULTS: dict[str, dict[str, Any]] = {
    **OF_FRAMES,
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


def test_every_fault_of_the_wire_is_counted_told_and_over(hil_bridge: StartBridge, tmp_path: Path) -> None:
    path, end_s = tmp_path / "run.dhil", FIRST_S + EVERY_S * len(FAULTS)
    bridge = hil_bridge(scenario(tmp_path), record=path, duration_s=end_s, mavlink={"links": ()})
    summary = bridge.wait_end(120)
    wire, (frames, _) = summary["wire"], recorded(path)

    assert {name: summary[name] for name in wire["expected"]} == wire["expected"], "counted to the frame"
    received = summary["samples"] + summary["late"] + sum(wire["lost"].values())
    assert wire["samples"] == summary["feeder"]["sent"] == received == end_s * RATE_HZ
    assert set(wire["injected"]) | {"clock-drift", "clock-step"} == set(FAULTS)
    assert summary["restarts"] == 0
    assert len(frames) == summary["frames"] == summary["recorder"]["frames"] - summary["silences"]
    assert summary["recorder"]["lost"] == 0

    windows = {kind: (begins(kind), begins(kind) + fault["for_s"]) for kind, fault in FAULTS.items()}
    for number, found in enumerate(each_fault(bridge, frames, DtgHead(), windows, EVERY_S - 0.1)):
        assert found.mode == ("DEGRADED" if found.kind == "silence" else "NAVIGATE"), found.kind
        assert bool(found.told) == any(found.moved.values()), found
        note(
            number,
            f"`{found.kind}`",
            said(SAYS, found.kind, FAULTS[found.kind]),
            found.moved,
            found.told,
            found.back,
            "0",
        )


@pytest.mark.parametrize("kind", ["drop", "bit-flip"])
def test_what_is_lost_on_the_wire_moves_the_vehicle_by_millimetres(
    hil_bridge: StartBridge, tmp_path: Path, kind: str
) -> None:
    wire = [{"kind": kind, "at_s": 0.5, "share": 0.02}]
    summary = hil_bridge(scenario(tmp_path), wire=wire, duration_s=20, paced=False, mavlink={"links": ()}).wait_end(60)
    assert summary["lost"] > 50
    assert summary["error"]["position_m"]["max"] < 0.01
