"""A long run with random faults of the wire: `make soak` (see docs/reliability.md).

The flight of the default scenario at 1 kHz on a bus, recorded, with faults drawn by a seed. At the end every sample that was
sent is accounted for: received, or lost by a fault that was put there; every frame on the bus was taken and recorded; and the
memory of no process grew. Exit code 1 says which of these failed.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from drivers.logs.recording import EVENT, RecordingReader
from hil.bridge import LoopOrder
from hil.scenario import Scenario, load
from hil.session import Session, simulated_head
from nav.errors import HilError

KINDS = (
    *("drop", "duplicate", "reorder", "delay", "jitter", "bit-flip"),
    *("counter-freeze", "crc-off", "silence", "babble", "clock-step", "clock-drift"),
)
EVERY_S, LEAST_S, MOST_S = 5.0, 0.01, 2.0
"""A fault begins so often, and lasts so long."""
WATCH_S = 1.0
WARM_S = 60.0
"""Memory is judged from here on, or from a third of a shorter run: buffers and caches fill first."""
GROWTH_KIB_MIN = 64.0
"""A process whose memory grows faster than this leaks: 90 MiB a day."""
LEAST_KIB = 1024.0
"""Growth that says nothing: what larger batches touch for the first time."""
PAGE_KIB = os.sysconf("SC_PAGE_SIZE") / 1024


def drawn(seed: int, duration_s: float) -> list[dict[str, Any]]:
    """Faults one after another; losses by frames of one sample in twenty, clocks that step back and forth."""
    rng, faults = np.random.default_rng(seed), []
    for begin in np.arange(EVERY_S, duration_s - EVERY_S, EVERY_S):
        faults.append(
            {
                "kind": str(rng.choice(KINDS)),
                "at_s": round(float(begin + rng.uniform(0.0, EVERY_S - MOST_S)), 3),
                "for_s": round(float(np.exp(rng.uniform(np.log(LEAST_S), np.log(MOST_S)))), 3),
                "share": round(float(rng.uniform(0.001, 0.1)), 4),
                "delay_s": round(float(rng.uniform(0.001, 0.2)), 4),
                "step_s": round(float(rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 5.0)), 3),
                "drift_ppm": float(rng.choice([-200.0, 200.0])),
                "rate_hz": round(float(rng.uniform(100.0, 4000.0))),
            }
        )
    return faults


def resident_kib(pid: int) -> float:
    """Resident memory of a process that is its own: without what it shares with others."""
    resident, shared = Path(f"/proc/{pid}/statm").read_text().split()[1:3]
    return (int(resident) - int(shared)) * PAGE_KIB


def slope_kib_min(sizes: list[tuple[float, float]]) -> float:
    """Growth of the floor of a process's memory, KiB a minute: least of ten stretches, a line through them."""
    pieces = [piece for piece in np.array_split(np.array(sizes), 10) if len(piece)]
    floor = np.array([piece[np.argmin(piece[:, 1])] for piece in pieces])
    return float(np.polyfit(floor[:, 0], floor[:, 1], 1)[0] * 60.0) if len(floor) > 1 else 0.0


def grown(name: str, sizes: list[tuple[float, float]], duration_s: float) -> tuple[str, bool]:
    """What the memory of a process did, in words, and whether it is flat."""
    warm = [row for row in sizes if row[0] > min(WARM_S, duration_s / 3)] or sizes
    slope, minutes = slope_kib_min(warm), (warm[-1][0] - warm[0][0]) / 60.0
    text = f"{name}: {warm[-1][1] / 1024:.1f} MiB of its own, {slope:+.1f} KiB/min"
    return text, slope * minutes < max(GROWTH_KIB_MIN * minutes, LEAST_KIB)


def recorded(path: Path) -> int:
    """Frames in a recording, the events left out."""
    reader, count = RecordingReader.open(path), 0
    while len(block := reader.read()):
        count += int((block["reserved"][:, 0] != EVENT).sum())
    reader.close()
    return -1 if reader.problem else count


def flown(
    scenario: Scenario, path: Path, minutes: float
) -> tuple[dict[str, Any], dict[str, list[tuple[float, float]]]]:
    """The summary of the run, and (time, own memory in KiB) of each of its processes."""
    head = simulated_head(LoopOrder(scenario))
    order = LoopOrder(scenario.with_changes(duration_s=None), own_world=True)  # a fast clock must not end it early
    memory: dict[str, list[tuple[float, float]]] = {}
    with Session(order, feeder=head, record=path) as session:
        session.wait_ready()
        began = said = time.monotonic()
        while session.running:
            now = time.monotonic()
            for name, part in session._parts.items():
                if part.process.is_alive() and part.process.pid and (own := resident_kib(part.process.pid)) > 0.0:
                    memory.setdefault(name, []).append((now - began, own))
            session.events()
            if now - said > 60.0:
                said = now
                stats = session.outlets.stats
                print(
                    f"{(now - began) / 60:5.1f} of {minutes:g} min: {stats['samples']} samples, {stats['lost']} lost",
                    file=sys.stderr,
                )
            time.sleep(WATCH_S)
    return session.summary(), memory


def judged(summary: dict[str, Any], frames: int) -> list[tuple[str, bool]]:
    """What must hold, in words with its numbers, and whether it does."""
    wire, expected, feeder = summary["wire"], summary["wire"]["expected"], summary["feeder"]
    received, lost = summary["samples"] + summary["late"], sum(wire["lost"].values())
    overflowed = summary.get("overflowed", 0)
    sent, refused = expected["frames"], feeder["dropped"] + overflowed
    on_bus, bus = sent - refused, summary["lost"] - expected["lost"]
    rows = [
        (
            f"sent {wire['samples']} = received {received} + lost by faults {lost} + by the bus {bus}",
            wire["samples"] == received + lost + bus and 0 <= bus <= refused,
        ),
        (
            f"frames sent {sent} = taken {summary['frames']} + refused {feeder['dropped']} + overflown {overflowed}",
            on_bus == summary["frames"],
        ),
        (
            f"frames taken {summary['frames']} = recorded {frames}, lost to the recording {summary['recorder']['lost']}",
            summary["frames"] == frames and summary["recorder"]["lost"] == 0,
        ),
        (
            "no restart was seen, and no problem",
            summary["restarts"] == 0 and "problem" not in summary and "problems" not in summary,
        ),
    ]
    rows += [
        (f"{name} {summary[name]} = {count}", summary[name] == count)
        for name, count in expected.items()
        if name != "frames" and not refused
    ]
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(prog="soak", description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--bus", default="socketcan:vcan0")
    parser.add_argument("--rate", type=float, default=1000.0, help="samples a second")
    parser.add_argument("--layout", choices=("fd", "classic"), default="fd")
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    duration_s = 60.0 * chosen.minutes
    scenario = load(None).with_changes(
        bus=chosen.bus,
        duration_s=duration_s,
        wire=drawn(chosen.seed, duration_s),
        head={"rate_hz": chosen.rate, "layout": chosen.layout, "instruments": "ideal"},
        navigation={"alignment": "truth", "gap_realign_s": 100.0},
        mavlink={"links": ("udpout:127.0.0.1:24560",)},
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "soak.dhil"
        summary, memory = flown(scenario, path, chosen.minutes)
        rows = judged(summary, recorded(path))
    rows += [grown(name, sizes, duration_s) for name, sizes in memory.items()]
    failed = [text for text, good in rows if not good]
    if chosen.json:
        own = {name: [round(size) for _, size in sizes[:: max(len(sizes) // 20, 1)]] for name, sizes in memory.items()}
        print(json.dumps({"failed": failed, "rows": [text for text, _ in rows], "own_kib": own, "summary": summary}))
    else:
        print(
            f"{chosen.minutes:g} min at {chosen.rate:g} Hz on {chosen.bus}, seed {chosen.seed}: {len(scenario.wire)} faults"
        )
        print("injected: " + ", ".join(f"{name} {count}" for name, count in summary["wire"]["injected"].items()))
        for text, good in rows:
            print(f"{'ok  ' if good else 'FAIL'} {text}")
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except HilError as error:
        sys.exit(f"soak: {error}")
