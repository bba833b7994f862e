"""Arrival of frames by the clock of a CAN adapter, on the host's clock, in integer ns.

An adapter stamps a frame when it is on the wire, the kernel when it comes in: later by transport and load, never earlier. The
adapter's clock begins anywhere and drifts. So the smallest difference seen is its offset, which may rise by `drivers.clock.DRIFT`
to follow a slow clock. What comes out is evenly spaced as the wire was, and late by the fastest transport.
"""

import numpy as np

from drivers.clock import DRIFT
from nav.increments import IntArray

_LEAP_NS = 1_000_000_000
"""An adapter whose clock leaves the host's by more was started anew."""


class AdapterClock:
    """The offset of one adapter's clock."""

    def __init__(self) -> None:
        self._offset = self._last = 0
        self._known = False

    def arrivals(self, kernel: IntArray, adapter: IntArray) -> IntArray:
        """Arrivals (n,) of frames in their order, by their stamps (n,); the kernel's where the adapter's is zero."""
        there = adapter != 0
        stamps = adapter[there]
        if not len(stamps):
            return kernel
        differences = kernel[there] - stamps
        least, newest = int(differences.min()), int(stamps[-1])
        risen = self._offset + round(DRIFT * max(0, newest - self._last))
        if not self._known or abs(least - self._offset) > _LEAP_NS:
            self._known, risen = True, least
        self._offset, self._last = min(risen, least), newest
        return np.where(there, adapter + self._offset, kernel)
