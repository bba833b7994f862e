"""What the feeds share: the order that makes one, what an autopilot commanded, and the protocol of a feed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from drivers.mavlink.solution import Solution, Vector
from drivers.mavlink.surroundings import Surroundings
from hil.control import Control
from hil.feed.config import FeedConfig
from hil.feed.tap import Gate, Rows, mean_row
from hil.geoid import undulation
from hil.magnetic import magnetic_field
from hil.ring import Ring
from hil.scenario import Scenario

ACTUATORS = np.dtype(
    [
        ("time", "<f8"),  # device time of the solution that the autopilot answered to, s
        ("count", "<i8"),  # frames so far
        ("channels", "<i4"),
        ("armed", "?"),
        ("values", "<f4", 32),  # pulse widths in us (ArduPilot), or -1 to 1 (PX4)
    ]
)
"""What an autopilot commanded last."""
_FIELD_S = 1.0
"""The magnetic field is worked out so often."""


@dataclass(frozen=True, slots=True)
class Socket:
    """Where a feed is joined to the run; picklable to a spawned process.

    Attributes
    ----------
    states : Ring
        Of `NAV_STATE`.
    reader : int
        Which of its wake-ups is ours.
    actuators : Ring
        Of `ACTUATORS`; ours to write.
    gate : Gate or None
        In simulated time.
    number : int
        Ours, there.
    control : Control
        Is told that we are at work.
    """

    states: Ring
    reader: int
    actuators: Ring
    gate: Gate | None
    number: int
    control: Control


class Feed(Protocol):
    """One feed at work."""

    place: str
    """Where the autopilot finds it."""
    heard_s: float
    """When the autopilot was last heard, host clock, s."""

    @property
    def hungry(self) -> bool:
        """It waits for the next solution."""

    def fileno(self) -> int:
        """Descriptor to wait on for reading; constant."""

    def step(self, now_s: float) -> float:
        """Do what is due; returns when to come again."""

    def counters(self) -> dict[str, Any]:
        """What was sent and received."""

    def close(self) -> None:
        """Give everything back."""


class Maker:
    """Solutions, and what surrounds them, for one feed."""

    def __init__(self, config: FeedConfig, scenario: Scenario) -> None:
        self._rates, self._aiding = config.rates, scenario.aiding
        self._flux: tuple[float, Vector] | None = None

    def solution(self, rows: Rows) -> Solution | None:
        """The newest of `rows`, with mean rate and force; None when there is no position in it."""
        solution = Solution.of(mean_row(rows, self._rates), undulation)
        return solution if solution.has_position else None

    def around(self, solution: Solution) -> Surroundings:
        """Air and field at a solution."""
        if self._flux is None or abs(solution.time - self._flux[0]) > _FIELD_S:
            place = solution.lat, solution.lon, solution.height
            north, east, down = magnetic_field(self._aiding.field, *place, self._aiding.year).tolist()
            self._flux = solution.time, (north, east, down)
        return Surroundings.of(solution, self._flux[1])


class Commanded:
    """The writer of `ACTUATORS`."""

    def __init__(self, ring: Ring) -> None:
        self._ring, self._row = ring, np.zeros(1, ACTUATORS)

    def tell(self, time_s: float, values: Sequence[float], *, armed: bool = True) -> None:
        """Note what the autopilot commands now."""
        row, n = self._row, len(values)
        row["time"], row["channels"], row["armed"] = time_s, n, armed
        row["count"] += 1
        row["values"][0, :n], row["values"][0, n:] = values, 0.0
        self._ring.push(row)

    def summary(self) -> dict[str, Any] | None:
        """The last one; None before the first."""
        row = self._row[0]
        if row["count"] == 0:
            return None
        values = [float(value) for value in row["values"][: row["channels"]]]
        return {"time_s": float(row["time"]), "armed": bool(row["armed"]), "values": values}
