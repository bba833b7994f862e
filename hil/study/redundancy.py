"""Failed axes of the simulated head: how soon each test finds them, and that it cries no wolf in an hour of flight.

The head has the errors of the DTG grade. It turns with 30 degrees of bank and shakes at 0.7, 1.9 and 50 Hz; its raw samples go
through the core's compensation, tests and combination, in the orthogonal and in the skewed layout.
"""

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from hil.scenario import Channel, MotionConfig, Scenario, Sine
from hil.study.report import Line, Plot, Row, Study, at_most, shown
from hil.world.instruments import Instruments, head_model, instruments
from nav.increments import FloatArray, HeadIncrements
from nav.instruments.grades import GRADES
from nav.instruments.head import HeadCombiner, Note
from nav.instruments.redundancy import AXES, GYRO_AXES, layout, parity_vector

STEP = 1e-3
HOUR_S = 3600.0
FAIL_S, LOOK_S = 5.2345, 1.0
"""When an axis fails, and how long it is looked for."""
CHUNK = 1000
LAYOUTS = {"orthogonal": 0.0, "skewed": 45.0}
JUMP_SIGMAS, AVERAGE_S = 20.0, 0.05


_ABOUT = """A head with the errors of the DTG grade turns with 30 degrees of bank and shakes at 0.7, 1.9 and 50 Hz. An hour of it
must raise no alarm. Then an axis fails in flight: it jumps by twenty standard deviations of the parity residual's average over
50 ms, gives the same number for ever, or becomes a hundred times noisier."""


def motion() -> MotionConfig:
    """Turns and vibration."""
    return MotionConfig(
        attitude="coordinated",
        north=Channel(rate=100.0),
        east=Channel(sines=(Sine(amplitude=230.0, period_s=40.0),)),
        up=Channel(sines=(Sine(amplitude=50.0, period_s=90.0),)),
        heading=Channel(sines=(Sine(amplitude=math.degrees(0.2e-3), period_s=0.02, phase_deg=40.0),)),
        pitch=Channel(sines=(Sine(amplitude=0.3, period_s=1.0 / 0.7),)),
        roll=Channel(
            sines=(Sine(amplitude=0.2, period_s=1.0 / 1.9), Sine(amplitude=math.degrees(0.4e-3), period_s=0.02))
        ),
    )


def flown(skew_deg: float, duration: float, *faults: dict[str, object]) -> tuple[list[Note], FloatArray]:
    """What the core says of a head during a flight, and the parity residual averaged over each second, rad/s."""
    head = {"instruments": "dtg", "grade": "dtg", "skew_deg": skew_deg, "faults": faults}
    scenario = Scenario.model_validate({"seed": 1, "motion": motion().model_dump(), "head": head})
    source, combiner = instruments(scenario, STEP), HeadCombiner(head_model(scenario.head))
    notes: list[Note] = []
    means = []
    for batch in _batches(source, round(duration / STEP)):
        combiner.combine(batch)
        notes += combiner.notes()
        means.append(float(combiner.residual.sum()) / (CHUNK * STEP))
    return notes, np.array(means)


def _batches(source: Instruments, samples: int) -> Iterator[HeadIncrements]:
    batch = HeadIncrements.empty(CHUNK)
    for first in range(0, samples, CHUNK):
        sensed = source.sense(first, CHUNK)
        batch.sequence[:] = np.arange(first, first + CHUNK)
        batch.time[:], batch.step[:] = STEP * (batch.sequence + 1), STEP
        batch.dtheta[:], batch.dvel[:], batch.rotor[:] = sensed.dtheta, sensed.dvel, sensed.rotor
        batch.status[:] = sensed.status
        yield batch


def found_after(notes: list[Note], *words: str) -> float:
    """Time from the failure to the first bad note with all the words, s; infinite where there is none."""
    return min(
        (note.time - FAIL_S for note in notes if note.bad and all(word in note.text for word in words)),
        default=math.inf,
    )


def _jumps() -> list[Row]:
    rows = []
    for name, skew in LAYOUTS.items():
        parity = parity_vector(layout(math.radians(skew)))
        for k, axis in enumerate(GYRO_AXES):
            what = f"{name}: jump of {JUMP_SIGMAS:g} sigma on {axis}, found after"
            if abs(parity[k]) < 1e-9:
                notes, _ = flown(skew, FAIL_S + LOOK_S, {"axis": axis, "kind": "jump", "at_s": FAIL_S, "size": 1e-4})
                rows.append(
                    shown(f"jump-{name}-{axis}", f"{what} (nobody else measures this rate)", found_after(notes), "s")
                )
                continue
            size = JUMP_SIGMAS * GRADES["dtg"].gyro_white / math.sqrt(AVERAGE_S) / abs(parity[k])
            worst = 0.0
            for sign in (1.0, -1.0):
                fault = {"axis": axis, "kind": "jump", "at_s": FAIL_S, "size": sign * size}
                worst = max(worst, found_after(flown(skew, FAIL_S + LOOK_S, fault)[0], axis))
            rows.append(at_most(f"jump-{name}-{axis}", what, worst, "s", 0.05))
    return rows


def _own_signal() -> list[Row]:
    rows = []
    for axis in AXES:
        for kind in ("stuck", "noise"):
            notes, _ = flown(0.0, FAIL_S + LOOK_S, {"axis": axis, "kind": kind, "at_s": FAIL_S, "size": 100.0})
            what = f"{axis} {'gives the same number' if kind == 'stuck' else 'a hundred times noisier'}, named after"
            rows.append(at_most(f"{kind}-{axis}", what, found_after(notes, f"axis {axis}", kind), "s", 0.2))
    return rows


def run(hour_s: float = HOUR_S) -> Study:
    """All of it; about two minutes."""
    with ThreadPoolExecutor(2) as pool:
        flights = dict(zip(LAYOUTS, pool.map(lambda skew: flown(skew, hour_s), LAYOUTS.values()), strict=True))
    rows, lines = [], []
    for name, (notes, residual) in flights.items():
        what = f"{name}: alarms in {hour_s:g} s of turns and vibration"
        rows.append(at_most(f"alarms-{name}", what, sum(note.bad for note in notes), "", 0.0))
        lines.append(Line(name, np.arange(1.0, len(residual) + 1.0), np.degrees(residual) * 3600.0))
    plot = Plot("residual", "Parity residual, means over a second, DTG grade", "s", "deg/h", lines)
    return Study("redundancy", "Redundancy of the head", _ABOUT, [*rows, *_jumps(), *_own_signal()], [plot])
