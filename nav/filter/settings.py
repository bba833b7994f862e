"""How an aided navigator is run."""

import math
from dataclasses import dataclass

from nav.errors import HilError


@dataclass(frozen=True, slots=True)
class Settings:
    """How the filter is run.

    Attributes
    ----------
    predict_s : float
        Length of an interval, s.
    buffer_s : float
        How late a measurement may come, s.
    gate : float
        Probability that a right measurement is accepted.
    restart_s : float
        A position source that is rejected for so long, s, is right and the filter has diverged: it restarts there. `inf`: never.
    lever_arm : (3,) float
        From the navigated point (the sensor, if it is not moved) to the GNSS antenna, b, m, as first known.
    antennas : tuple of (int, (3,) float)
        Sources of GNSS that have antennas of their own, and where, likewise. An estimated lever arm moves all of them.
    delay : float
        How much older GNSS is than it says, s, as far as known: it is taken at that time. The estimated delay is what is left.
    field_n : (3,) float, optional
        Magnetic flux in n, T; without it no magnetic row is taken.
    magnetic_heading : bool
        Take of a magnetic row nothing but where its level part points: on a scale of its own, or where the field is disturbed.
    """

    predict_s: float = 0.02
    buffer_s: float = 2.0
    gate: float = 0.999
    restart_s: float = 30.0
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antennas: tuple[tuple[int, tuple[float, float, float]], ...] = ()
    delay: float = 0.0
    field_n: tuple[float, float, float] | None = None
    magnetic_heading: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        if not (0.0 < self.predict_s <= 1.0 and self.predict_s <= self.buffer_s < math.inf):
            raise HilError("filter: predict_s must be in (0, 1] and buffer_s finite and not shorter")
        if not (0.5 <= self.gate < 1.0 and self.restart_s > 0.0):
            raise HilError("filter: gate must be in [0.5, 1) and restart_s positive")
