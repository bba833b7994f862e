"""What a simulated run knows better than the navigation: errors of the solution, gathered as it goes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.geometry import Spread, attitude_difference, position_error
from hil.scenario import Scenario
from hil.world.motion import Motion
from nav.increments import FloatArray
from nav.rotation import attitude_error
from nav.state import Mode

RATE_HZ = 100.0
"""Samples a second that are compared."""
SETTLE = 64
"""Takings that wait at most."""


class TruthKeeper:
    """Compares solutions with the analytic motion of the scenario."""

    def __init__(self, scenario: Scenario) -> None:
        self.motion = Motion(scenario.motion)
        self._every = max(1, round(scenario.head.rate_hz / RATE_HZ))
        self.position, self.velocity, self.attitude = Spread(), Spread(), Spread()
        self._normal = {name: Spread() for name in ("position", "velocity", "attitude")}
        self.tilt, self.heading = Spread(), Spread()
        self._waiting: list[NDArray[Any]] = []

    def compare(self, rows: NDArray[Any]) -> None:
        """Take solutions; those before the end of the alignment and those not of the grid are passed over.

        What they differ by is found out for `SETTLE` at a time, because one by one they take ten times as long.
        """
        if len(rows) == 1 and rows["sequence"][0] % self._every:
            return
        self._waiting.append(rows[(rows["sequence"] % self._every == 0) & (rows["mode"] >= Mode.NAVIGATE)])
        if len(self._waiting) >= SETTLE:
            self.settle()

    def settle(self) -> None:
        """Find out what the solutions taken so far differ by."""
        if not self._waiting:
            return
        chosen: Any = np.concatenate(self._waiting)
        self._waiting.clear()
        if len(chosen) == 0:
            return
        truth = self.motion.truth(np.ascontiguousarray(chosen["time"]))
        offset = position_error(chosen["lat"], chosen["lon"], chosen["height"], truth)
        errors = offset, chosen["vel_n"] - truth["vel_n"], attitude_error(chosen["q_nb"], truth["q_nb"])
        self.position.add(np.linalg.norm(errors[0], axis=1))
        self.velocity.add(np.linalg.norm(errors[1], axis=1))
        angles = attitude_difference(chosen["q_nb"], truth["q_nb"])
        for spread, angle in zip((self.attitude, self.tilt, self.heading), angles, strict=True):
            spread.add(angle)
        self._compare_sigmas(np.concatenate(errors, axis=1), chosen["sigma"])

    def _compare_sigmas(self, errors: FloatArray, sigmas: NDArray[np.float32]) -> None:
        known = np.isfinite(sigmas).all(axis=1) & (sigmas > 0.0).all(axis=1)
        normal = errors[known] / sigmas[known]
        for spread, part in zip(self._normal.values(), (normal[:, :3], normal[:, 3:6], normal[:, 6:]), strict=True):
            spread.add(part.ravel())

    def ratios(self) -> dict[str, float]:
        """Rms of error over sigma, of all axes: 1 where the estimate of the error is right; empty where there was none."""
        self.settle()
        return {name: spread.as_dict()["rms"] for name, spread in self._normal.items() if spread.count}

    def summary(self) -> dict[str, dict[str, float]] | None:
        """Errors by name, each rms, max, final; None when nothing was compared."""
        self.settle()
        if self.position.count == 0:
            return None
        return {
            "position_m": self.position.as_dict(),
            "velocity_ms": self.velocity.as_dict(),
            "attitude_deg": self.attitude.as_dict(180.0 / np.pi),
            "tilt_deg": self.tilt.as_dict(180.0 / np.pi),
            "heading_deg": self.heading.as_dict(180.0 / np.pi),
        }
