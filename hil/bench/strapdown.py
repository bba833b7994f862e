"""The strapdown core: every mechanization, with two samples and high order, in batch and one sample a call.

Beside it the same arithmetic in C, and pyins with all that its interface does and with its kernel alone.
"""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from functools import partial
from importlib import import_module
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np

from hil.bench.timing import Row, Sizes, Work, rows_in_turns
from hil.scenario import load
from hil.world.motion import Motion
from nav.increments import FloatArray
from nav.mechanization import geographic
from nav.rotation import dcm_from_quaternion, euler_from_quaternion
from nav.strapdown import MECHANIZATIONS, Strapdown

STEP_S = 0.005
ATTITUDES = {"two-sample": 2, "high-order:4": 4, "high-order:6": 6}
"""By the number in the ids."""
CORES = (
    *((attitude, mechanization) for attitude in ATTITUDES for mechanization in MECHANIZATIONS[:-1]),
    ("two-sample", MECHANIZATIONS[-1]),
)
FIRST = "strapdown-2-geographic"
"""What C and pyins do."""
PYINS_CALLS = 20
CALLS = 20_000
"""Most samples of a work that takes one a call."""


def rows(sizes: Sizes) -> list[Row]:
    """Rows of every core, and of its peers."""
    record = StrapdownRecord(sizes.batch)
    whole, *others = _whole(record)
    peers = [*_in_c(record), *_pyins(record)]
    return [
        *rows_in_turns([whole, *peers, *others], sizes.repeats),
        *rows_in_turns(list(_single(record, sizes.calls)), sizes.repeats),
    ]


class StrapdownRecord:
    """Exact increments of the built-in flight, and room for what is made of them."""

    def __init__(self, count: int) -> None:
        motion = Motion(load("flight").motion.model_copy(update={"rest_s": 0.0, "ramp_s": 0.0}))
        truth = motion.truth([0.0])[0]
        self.start = truth["lat"], truth["lon"], truth["height"], truth["vel_n"], truth["q_nb"]
        self.step = np.full(count, STEP_S)
        self.dtheta, self.dvel = np.empty((count, 3)), np.empty((count, 3))
        motion.increments(0, count, STEP_S, self.dtheta, self.dvel)
        self.bias = np.zeros(3)
        self.out = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 4))
        self.samples = np.column_stack([self.step, self.dtheta, self.dvel])[:CALLS].tolist()
        """The first of them as numbers of Python."""

    def by(self, core: Strapdown) -> None:
        """All of it by a core of ours, answers in `out`."""
        core.start(*self.start)
        core.advance(self.step, self.dtheta, self.dvel, self.bias, *self.out)

    def one_by_one(self, core: Strapdown, calls: int) -> None:
        """The first `calls` samples of it, one a call from Python."""
        push = core.push
        for sample in self.samples[:calls]:
            push(*sample)

    def by_c(self, function: Any) -> None:
        """All of it by the C reference."""
        arrays: list[FloatArray] = [np.zeros(7), geographic.start(*self.start)]
        first = [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]
        rest = [
            array.ctypes.data_as(ctypes.c_void_p) for array in (self.step, self.dtheta, self.dvel, self.bias, *self.out)
        ]
        function(*first, ctypes.c_long(len(self.step)), *rest)


def c_two_sample() -> Any:
    """The C reference, compiled now with ``cc -O3``; None where there is no compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory() as folder, as_file(files("hil") / "c" / "two_sample.c") as source:
        library = Path(folder) / "two_sample.so"
        built = subprocess.run(
            [compiler, "-O3", "-shared", "-fPIC", str(source), "-o", str(library), "-lm"],
            capture_output=True,
            check=False,
        )
        if built.returncode:
            return None
        function = ctypes.CDLL(str(library)).two_sample
    function.restype = ctypes.c_long
    return function


def _whole(record: StrapdownRecord) -> Iterator[Work]:
    for attitude, mechanization in CORES:
        name = f"strapdown-{ATTITUDES[attitude]}-{mechanization}"
        run = partial(record.by, Strapdown(attitude, mechanization, whole_record=True))
        peer = ("pyins", "strapdown-pyins") if name == FIRST else ("", "")
        what = f"strapdown, batch: {attitude}, {mechanization}"
        yield Work(name, what, run, len(record.step), *peer, c_id="strapdown-c")


def _single(record: StrapdownRecord, calls: int) -> Iterator[Work]:
    for attitude, mechanization in CORES:
        core = Strapdown(attitude, mechanization)
        core.start(*record.start)
        record.one_by_one(core, 8)  # from then on `push` is compiled
        run = partial(record.one_by_one, core, calls)
        what = f"strapdown, one sample a call: {attitude}, {mechanization}"
        yield Work(f"strapdown-call-{ATTITUDES[attitude]}-{mechanization}", what, run, calls)


def _in_c(record: StrapdownRecord) -> list[Work]:
    function = c_two_sample()
    if function is None:
        return []
    what = "two-sample, geographic in C, cc -O3, batch"
    return [Work("strapdown-c", what, partial(record.by_c, function), len(record.step), c_id="strapdown-c")]


def _pyins(record: StrapdownRecord) -> list[Work]:
    """The peer; nothing where it is not installed."""
    try:
        pandas: Any = import_module("pandas")
        strapdown: Any = import_module("pyins.strapdown")
        util: Any = import_module("pyins.util")
    except ImportError:
        return []
    lat, lon, height, vel_n, q = record.start
    angles = np.degrees(euler_from_quaternion(q))
    place = [np.degrees(lat), np.degrees(lon), height, *vel_n, angles[2], angles[1], angles[0]]
    start = pandas.Series(place, index=util.TRAJECTORY_COLS, name=0.0)
    index = pandas.Index(np.cumsum(record.step), name="time")
    columns = [*util.GYRO_COLS, *util.ACCEL_COLS]
    imu = pandas.DataFrame(np.hstack([record.dtheta, record.dvel]), index=index, columns=columns)

    def batch() -> None:
        strapdown.Integrator(start).integrate(strapdown.compute_increments_from_imu(imu, "increment"))

    def single() -> None:
        integrator = strapdown.Integrator(start)
        for k in range(PYINS_CALLS):
            integrator.integrate(strapdown.compute_increments_from_imu(imu.iloc[k : k + 2], "increment"))

    made = strapdown.compute_increments_from_imu(imu, "increment").to_numpy()
    n = len(made)
    state = np.empty((n + 1, 3)), np.empty((n + 1, 3)), np.empty((n + 1, 3, 3))
    state[0][0], state[1][0] = (np.degrees(lat), np.degrees(lon), height), vel_n
    state[2][0] = dcm_from_quaternion(np.asarray(q))
    dt, theta, dv = (np.ascontiguousarray(made[:, columns]) for columns in (0, slice(1, 4), slice(4, 7)))
    kernel = partial(strapdown.integrate, dt, *state, theta, dv, 0, True)
    works = (
        Work("strapdown-pyins", "pyins, batch: increments and integration", batch, n + 1, c_id="strapdown-c"),
        Work("strapdown-pyins-kernel", "pyins, batch: its kernel alone", kernel, n, c_id="strapdown-c"),
        Work("strapdown-pyins-call", "pyins, one sample a call", single, PYINS_CALLS),
    )
    return list(works)
