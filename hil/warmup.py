"""Compiling the kernels before the run starts: a miniature run through the very code that follows.

The first time on a machine this takes up to a minute; afterwards the compiled kernels come from numba's cache.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from drivers import emulator_names
from hil.ring import Ring
from hil.scenario import Scenario
from nav.aiding import Kind, aiding_rows
from nav.state import NAV_STATE, Mode

if TYPE_CHECKING:
    from hil.bridge import Loop

STEPS = 5
"""Steps that each of the two functions here reports."""
ALONE = 6
"""Frames of a batch that are taken one by one: a sample at least."""
Report = Callable[[int], None]


def _miniature(scenario: Scenario) -> Scenario:
    """A second and a half with the sensors of `scenario`, in the way of aligning that any of them can go."""
    head = {**scenario.head.model_dump(), "rate_hz": 200.0}
    driver = scenario.driver if scenario.driver.partition("@")[0] in emulator_names() else "dtg-head"
    if driver != "dtg-head":
        head |= {"instruments": "ideal", "faults": ()}
    return Scenario.model_validate(
        {
            "bus": "unix:none",
            "driver": driver,
            "duration_s": 1.5,
            "head": head,
            "aiding": scenario.aiding.model_dump(),
            "motion": {"rest_s": 1.0, "ramp_s": 0.5, "north": {"rate": 1.0}},
            "navigation": {
                "alignment": "level",
                "align_s": 0.5,
                "start": {"heading_deg": 0.0},
                "aided": scenario.navigation.aided,
                "assume": scenario.navigation.assume.model_dump(),
                "filter": scenario.navigation.filter.model_dump(),
            },
        }
    )


def _aid(loop: "Loop", states: Ring) -> None:
    """A measurement of every kind, true of no matter what."""
    row = np.zeros(1, NAV_STATE)
    if not states.latest(row) or row["mode"][0] != Mode.NAVIGATE:
        return
    time, place, q_nb = float(row["time"][0]), row[["lat", "lon", "height"]][0], row["q_nb"][0]
    values = {Kind.GNSS: (*place, 0.0, 0.0, 0.0), Kind.MAGNETIC: (2e-5, 0.0, 4e-5), Kind.ATTITUDE: tuple(q_nb)}
    for kind in Kind:
        loop.navigator.aid(aiding_rows([time], kind, [values.get(kind, (0.0, 0.0, 0.0))], [100.0] * 6))


def warm_head(scenario: Scenario, report: Report) -> None:
    """Compile what the simulated head uses."""
    from hil.world.head import SimulatedHead

    report(1)
    head = SimulatedHead(_miniature(scenario))
    report(2)
    for done, _ in zip(range(3, STEPS + 1), head.chunks(200), strict=False):
        report(done)
    report(STEPS)


def warm_loop(scenario: Scenario, report: Report) -> None:
    """Compile what the loop uses: driver, alignment, navigation, truth, ring."""
    from hil.bridge import Loop, LoopOrder, Outlets
    from hil.world.head import SimulatedHead
    from hil.world.motion import Motion

    small = _miniature(scenario)
    Motion(small.motion).truth(np.zeros(1))
    report(1)
    chunks = list(SimulatedHead(small).chunks(300))
    report(2)
    outlets = Outlets.make(recording=False, readers=1)
    ways = [small]
    if scenario.navigation.alignment in ("swaying", "moving"):  # both by optimisation
        ways.append(small.with_changes(navigation={"alignment": "moving"}))
    for chosen in ways:
        loop = Loop(LoopOrder(chosen), outlets)
        for _, slow, batch in chunks:
            if len(slow):
                loop.take(slow)
            loop.take(batch[:-ALONE])
            for k in range(len(batch))[-ALONE:]:  # as they come in real time
                loop.take(batch[k : k + 1])
            _aid(loop, outlets.states)
            report(3)
    outlets.states.latest(np.zeros(1, NAV_STATE))
    report(4)
    outlets.frames.push(chunks[0][2])
    report(STEPS)
