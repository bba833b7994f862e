"""The feeds of a run: what the session needs of them."""

from collections.abc import Callable, Mapping
from typing import Any

from hil.control import Control
from hil.feed.common import ACTUATORS, Socket
from hil.feed.process import run_feed
from hil.feed.tap import Gate
from hil.ring import Ring, Wake
from hil.scenario import Scenario
from nav.errors import HilError


class FeedGroup:
    """All feeds of a scenario.

    Parameters
    ----------
    scenario : Scenario
        Names them.
    paced : bool
        Real time.

    Attributes
    ----------
    names : list of str
        Of their processes.
    gate : Gate or None
        In simulated time.
    actuators : list of Ring
        Of `hil.feed.common.ACTUATORS`: what each autopilot commands.

    Raises
    ------
    HilError
        A feed needs real time.
    """

    def __init__(self, scenario: Scenario, *, paced: bool) -> None:
        self._scenario = scenario
        feeds = scenario.feed
        if not paced and any(feed.kind == "vectornav" for feed in feeds):
            raise HilError("a vectornav feed needs real time, for its wire cannot hold the time: use --speed 1")
        self.names = [f"feed {number}" for number in range(len(feeds))]
        self.gate = Gate(len(feeds)) if feeds and not paced else None
        self.actuators = [Ring(ACTUATORS, 64, 0) for _ in feeds]
        self._stops = [Wake() for _ in feeds]

    def launch(self, launch: Callable[..., None], states: Ring, first_reader: int, control: Control) -> None:
        """Start their processes by ``launch(name, target, *args)``; they have the wake-ups from `first_reader` on."""
        for number, feed in enumerate(self._scenario.feed):
            joint = Socket(states, first_reader + number, self.actuators[number], self.gate, number, control)
            launch(self.names[number], run_feed, feed, self._scenario, joint, self._stops[number])

    def stop(self, name: str) -> None:
        """Tell one to end."""
        self._stops[self.names.index(name)].call()

    def gone(self, name: str) -> None:
        """One has ended: simulated time no longer waits for it."""
        if self.gate is not None:
            self.gate.open(self.names.index(name))

    def summary(self, answers: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
        """What each has counted, of the answers of all processes by name."""
        return [
            {"kind": feed.kind, **{key: value for key, value in answers.get(name, {}).items() if key != "failed"}}
            for feed, name in zip(self._scenario.feed, self.names, strict=True)
        ]
