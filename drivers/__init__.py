"""Every wire: CAN, serial, MAVLink, recordings. Bytes to samples, solutions to bytes.

A board is one module with one class that satisfies `FrameDriver`, found by the entry-point group `dtg_hil.drivers`.
"""

from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Protocol

from drivers.can.frames import FrameArray
from nav.errors import HilError
from nav.increments import HeadIncrements, ImuIncrements, IntArray


@dataclass(slots=True)
class Counters:
    """What became of the frames that came in. Samples sent from the first to the last are ``samples + lost + late``."""

    frames: int = 0
    """Frames of any kind."""
    samples: int = 0
    """Good samples handed on."""
    lost: int = 0
    """Samples missing by the counter, for whatever reason."""
    duplicated: int = 0
    """Samples or frames that came again; dropped."""
    late: int = 0
    """Samples that came after a later one; dropped, and counted here and no longer in `lost`."""
    crc_errors: int = 0
    """Frames whose check failed; dropped."""
    foreign: int = 0
    """Frames with an id that is not the board's; ignored."""
    short: int = 0
    """Frames of the board's id with the wrong length or kind; dropped."""
    version_errors: int = 0
    """Frames of another protocol version; dropped."""
    restarts: int = 0
    """Times the board started anew."""

    def as_list(self) -> list[int]:
        """The counts in the order of the fields."""
        return [getattr(self, name) for name in self.__slots__]

    def as_dict(self) -> dict[str, int]:
        """Name to count."""
        return dict(zip(self.__slots__, self.as_list(), strict=True))


class FrameDriver(Protocol):
    """A board on a bus or a port."""

    counters: Counters
    period_s: float | None
    """Nominal sample period, s, once known."""
    world_id: int
    """Fingerprint of the simulated world behind the board; 0 for a real one or while unknown."""

    def decode(self, batch: FrameArray) -> HeadIncrements | ImuIncrements:
        """The samples in `batch`; views that are valid until the next call."""

    def arrivals(self) -> IntArray:
        """Arrival (ns, host clock) of the last frame of each sample of the last `decode`."""

    def identity(self) -> dict[str, object]:
        """What the board says of itself: serial, temperatures, built-in test."""


def driver_names() -> list[str]:
    """Names of the drivers that are installed."""
    return sorted(point.name for point in entry_points(group="dtg_hil.drivers"))


def make_driver(name: str) -> FrameDriver:
    """A new driver by name.

    Raises
    ------
    HilError
        No driver of that name; names what there is.
    """
    for point in entry_points(group="dtg_hil.drivers"):
        if point.name == name:
            driver: FrameDriver = point.load()()
            return driver
    raise HilError(f"no driver {name!r}; there is: {', '.join(driver_names())}")
