"""What a simulated run knows better than the navigation: errors of the solution, gathered as it goes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.geometry import Spread, attitude_difference, position_error
from hil.scenario import Scenario
from hil.world.motion import Motion
from nav.state import Mode

RATE_HZ = 100.0
"""Samples a second that are compared (the last one always is)."""


class TruthKeeper:
    """Compares solutions with the analytic motion of the scenario."""

    def __init__(self, scenario: Scenario) -> None:
        self.motion = Motion(scenario.motion)
        self._every = max(1, round(scenario.head.rate_hz / RATE_HZ))
        self.position, self.velocity, self.attitude = Spread(), Spread(), Spread()
        self.tilt, self.heading = Spread(), Spread()

    def compare(self, rows: NDArray[Any]) -> None:
        """Take solutions; those before the end of the alignment and those not of the grid are passed over."""
        if len(rows) == 1 and rows["sequence"][0] % self._every:
            return
        chosen = rows[(rows["sequence"] % self._every == 0) & (rows["mode"] >= Mode.NAVIGATE)]
        if len(chosen) == 0:
            return
        truth = self.motion.truth(np.ascontiguousarray(chosen["time"]))
        offset = position_error(chosen["lat"], chosen["lon"], chosen["height"], truth)
        self.position.add(np.linalg.norm(offset, axis=1))
        self.velocity.add(np.linalg.norm(chosen["vel_n"] - truth["vel_n"], axis=1))
        for spread, angle in zip(
            (self.attitude, self.tilt, self.heading),
            attitude_difference(chosen["q_nb"], truth["q_nb"]),
            strict=True,
        ):
            spread.add(angle)

    def summary(self) -> dict[str, dict[str, float]] | None:
        """Errors by name, each rms, max, final; None when nothing was compared."""
        if self.position.count == 0:
            return None
        return {
            "position_m": self.position.as_dict(),
            "velocity_ms": self.velocity.as_dict(),
            "attitude_deg": self.attitude.as_dict(180.0 / np.pi),
            "tilt_deg": self.tilt.as_dict(180.0 / np.pi),
            "heading_deg": self.heading.as_dict(180.0 / np.pi),
        }
