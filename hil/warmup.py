"""Compiling the kernels before the run starts: a miniature run through the very code that follows.

The first time on a machine this takes up to a minute; afterwards the compiled kernels come from numba's cache.
"""

from collections.abc import Callable

import numpy as np

from drivers import emulator_names
from hil.scenario import Scenario
from nav.state import NAV_STATE

STEPS = 5
"""Steps that each of the two functions here reports."""
Report = Callable[[int], None]


def _miniature(scenario: Scenario) -> Scenario:
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
            "navigation": {"align_s": 0.5},
        }
    )


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
    loop = Loop(LoopOrder(small), outlets)
    for _, slow, batch in chunks:
        if len(slow):
            loop.take(slow)
        loop.take(batch)
        report(3)
    outlets.states.latest(np.zeros(1, NAV_STATE))
    report(4)
    outlets.frames.push(chunks[0][2])
    report(STEPS)
