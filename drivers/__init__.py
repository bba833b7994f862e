"""Every wire: CAN, serial, MAVLink, recordings. Bytes to samples, solutions to bytes.

A board is one module with one class that satisfies `FrameDriver`, found by the entry-point group `dtg_hil.drivers`.
"""

from dataclasses import dataclass
from importlib.metadata import entry_points
from inspect import signature
from typing import Any, Protocol, runtime_checkable

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
    """Frames of the board's id with the wrong length or kind, or that for seconds make no sample; dropped."""
    version_errors: int = 0
    """Frames of another protocol version; dropped."""
    restarts: int = 0
    """Times the board started anew."""
    frozen: int = 0
    """Samples whose counter stood still while their time went on; dropped, and in `lost` once the counter goes on."""
    clock_steps: int = 0
    """Times the board's clock jumped while its samples went on, by their counter or their arrival; time goes on with them."""

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


@runtime_checkable
class Selective(Protocol):
    """A driver of a board whose messages are switched on one by one, so that one may be missing."""

    def lacking(self) -> str:
        """Why there are no samples though the board's frames come, and what to do; empty while there are."""


class BoardEmulator(Protocol):
    """The other end of a driver of `ImuIncrements`, found by the entry-point group `dtg_hil.emulators` under the driver's name.

    It is made with the sample period in us and, as ``option``, with what follows ``@`` in the driver's name.
    """

    frames_per_sample: int

    def samples(self, imu: ImuIncrements) -> FrameArray:
        """Frames of samples, in body axes, in the order in which the board sends them, stamped with simulated time (ns).

        The calls follow one another.
        """

    def slow(self) -> FrameArray:
        """What the board sends once a second."""


def driver_names() -> list[str]:
    """Names of the drivers that are installed."""
    return _names("dtg_hil.drivers")


def emulator_names() -> list[str]:
    """Names of the drivers whose boards can be emulated, the DTG head aside."""
    return _names("dtg_hil.emulators")


def make_driver(name: str) -> FrameDriver:
    """A new driver by name; what follows ``@`` in it is handed to the driver.

    Raises
    ------
    HilError
        No driver of that name; names what there is. Or the driver refuses what follows ``@``.
    """
    bare, at, option = name.partition("@")
    kind = _found("dtg_hil.drivers", bare)
    if kind is None:
        raise HilError(f"no driver {bare!r}; there is: {', '.join(driver_names())}")
    if not at:
        driver: FrameDriver = kind()
    elif signature(kind).parameters:
        driver = kind(option)
    else:
        raise _refused(bare, option)
    return driver


def make_emulator(name: str, period_us: int) -> BoardEmulator:
    """A new emulator of the board of the driver `name` with samples every `period_us`.

    Raises
    ------
    HilError
        The board cannot be emulated; names those that can. Or it has no such period, or takes no option.
    """
    bare, at, option = name.partition("@")
    kind = _found("dtg_hil.emulators", bare)
    if kind is None:
        raise HilError(f"no emulator of {name!r}; there is: dtg-head, {', '.join(emulator_names())}")
    if not at:
        emulator: BoardEmulator = kind(period_us)
    elif "option" in signature(kind).parameters:
        emulator = kind(period_us, option=option)
    else:
        raise _refused(bare, option)
    return emulator


def _found(group: str, name: str) -> Any:
    return next((point.load() for point in entry_points(group=group) if point.name == name), None)


def _refused(name: str, option: str) -> HilError:
    return HilError(f"driver {name!r} takes no option: leave @{option} out")


def _names(group: str) -> list[str]:
    return sorted(point.name for point in entry_points(group=group))
