"""Device time to host time: the lower envelope of arrival minus device time.

A frame can arrive late but not early, so the smallest difference seen is the best offset. It may rise by `DRIFT`, so that
a device clock that runs slow is followed. The map is for ages and logs only: the mathematics uses device time.
"""

DRIFT = 200e-6
"""Largest relative drift of the two clocks that is followed."""


class ClockMap:
    """Host time of device time, s and ns."""

    def __init__(self) -> None:
        self._offset = 0.0
        self._last = 0.0
        self._base_ns: int | None = None

    def update(self, device_s: float, arrival_ns: int) -> float:
        """Take a sample's device time and arrival; the age of the sample on arrival beyond the fastest one, s."""
        if self._base_ns is None:
            self._base_ns = arrival_ns
            self._offset, self._last = -device_s, device_s
        difference = (arrival_ns - self._base_ns) * 1e-9 - device_s
        self._offset = min(self._offset + DRIFT * max(0.0, device_s - self._last), difference)
        self._last = device_s
        return difference - self._offset

    def host_ns(self, device_s: float) -> int:
        """Host clock (ns) at which the device's clock showed `device_s`, late by the fastest transport."""
        return (self._base_ns or 0) + round((device_s + self._offset) * 1e9)

    def reset(self) -> None:
        """Forget: the device was restarted."""
        self._base_ns = None
