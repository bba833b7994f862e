"""The attitude that a board computes itself, compared with ours while both run."""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hil.geometry import Spread, attitude_difference
from nav.state import Mode

NEAR_S = 0.02
"""A solution as near as this in time is compared."""


@runtime_checkable
class Estimator(Protocol):
    """A driver whose board tells its own attitude."""

    def attitudes(self) -> list[tuple[float, Any]]:
        """(device time, s, q_nb) since the last call."""


class OtherAttitude:
    """Total, tilt and heading difference of ours from the board's."""

    def __init__(self, driver: Estimator) -> None:
        self._driver = driver
        self._spreads = {name: Spread() for name in ("total_deg", "tilt_deg", "heading_deg")}

    def compare(self, rows: NDArray[Any]) -> None:
        """Take solutions, rows of `NAV_STATE`, and what the board has told up to them."""
        for time, q_nb in self._driver.attitudes():
            row = rows[int(np.argmin(np.abs(rows["time"] - time)))]
            if row["mode"] < Mode.NAVIGATE or abs(row["time"] - time) > NEAR_S:
                continue
            parts = attitude_difference(row["q_nb"][None], np.asarray(q_nb)[None])
            for spread, values in zip(self._spreads.values(), parts, strict=True):
                spread.add(values)

    def summary(self) -> dict[str, Any] | None:
        """Spread of each; None when nothing was compared."""
        if not self._spreads["total_deg"].count:
            return None
        degrees = 180.0 / np.pi
        found: dict[str, Any] = {name: spread.as_dict(degrees) for name, spread in self._spreads.items()}
        return found | {"compared": self._spreads["total_deg"].count}
