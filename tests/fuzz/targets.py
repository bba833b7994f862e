"""Every parser of bytes that come from a wire or a file, as something that takes bytes, and valid input to start from.

Two programs run them: `test_fuzz.py` (hypothesis, in CI) and `run.py` (atheris, `make fuzz`). A target may raise `HilError`; any
other error, a sample that is not finite, a count that does not add up or memory that grows is a fault. Random bytes pass no
check: the lowest bit of the first byte of a wire's input says that checks are made right again before the parser sees them,
its other bits how the input is cut. `TARGETS` makes a target by name; making one loads its parser.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from fuzz import boards, files, network

Take = Callable[[bytes], None]


@dataclass(frozen=True)
class Target:
    """One parser.

    Attributes
    ----------
    take : callable
        Parses its argument.
    seeds : list of bytes
        Valid input.
    """

    take: Take
    seeds: list[bytes]


def _target(make: Callable[[], tuple[Take, list[bytes]]]) -> Callable[[], Target]:
    return lambda: Target(*make())


TARGETS: dict[str, Callable[[], Target]] = {
    name: _target(make)
    for name, make in {
        "dtg-head": boards.dtg_head,
        "aiding": boards.aiding,
        "sbg": partial(boards.classic, "sbg"),
        "xsens-can": partial(boards.classic, "xsens-can"),
        "j1939-imu": partial(boards.classic, "j1939-imu"),
        "xsens-xbus": partial(boards.serial, "xsens-xbus"),
        "vectornav": partial(boards.serial, "vectornav"),
        "microstrain-mip": partial(boards.serial, "microstrain-mip"),
        "serial-probe": boards.probe,
        "serial-answers": boards.answers,
        "mavlink": network.mavlink,
        "recording": files.recording,
        "candump": partial(files.foreign, ".log"),
        "blf": partial(files.foreign, ".blf"),
        "asc": partial(files.foreign, ".asc"),
        "ulog": files.ulog,
        "dataflash": files.dataflash,
        "scenario": files.scenario,
        "calibration": files.calibration,
        "sequence": files.sequence,
        "init": files.init,
        "imu-csv": partial(files.imu, ".csv"),
        "imu-npz": partial(files.imu, ".npz"),
        "aid-csv": partial(files.aid, ".csv"),
        "aid-npz": partial(files.aid, ".npz"),
    }.items()
}
