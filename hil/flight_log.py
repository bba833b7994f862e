"""Which files are flight logs, and how they are read."""

from collections.abc import Callable
from pathlib import Path

from drivers.logs.dataflash import read_dataflash
from drivers.logs.imu_log import ImuLog
from drivers.logs.ulog import read_ulog
from hil.geoid import undulation
from hil.source import is_own

_READERS: dict[str, Callable[[Path], ImuLog]] = {
    ".ulg": read_ulog,
    ".bin": lambda path: read_dataflash(path, undulation),
}
"""By file ending."""


def is_flight_log(path: Path) -> bool:
    """Whether `path` is a flight log, which holds no frames.

    Raises
    ------
    HilError
        The file cannot be read.
    """
    return path.suffix.lower() in _READERS and not is_own(path)


def read_flight_log(path: Path) -> ImuLog:
    """The log in `path`, for which `is_flight_log` holds.

    Raises
    ------
    HilError
        It cannot be read, or holds no samples.
    """
    return _READERS[path.suffix.lower()](path)
