"""`hil bench`: what each part costs on this machine, in one run, beside its peers.

Every figure is the median of repeated measurements of the same work; a part and its peer are measured in turns.
"""

import ctypes
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np

from drivers.can.codec import load_database
from drivers.can.dtg_head import DtgHead, head_database_text
from hil.bridge import Loop, LoopOrder, Outlets
from hil.scenario import load
from hil.world.head import SimulatedHead
from hil.world.motion import Motion
from nav.increments import FloatArray, ImuIncrements
from nav.instruments.dtg_compensation import LagCompensator
from nav.mechanization import geographic
from nav.navigator import Navigator, Settings
from nav.rotation import euler_angles
from nav.strapdown import Strapdown

REPEATS = 9
SAMPLES = 20_000
STRAPDOWN_SAMPLES, STRAPDOWN_STEP_S = 200_000, 0.005
Row = dict[str, Any]


def measure(say: Callable[[str], None]) -> list[Row]:
    """Rows ``{"id", "what", "ns", "ratio_to_c", "peer", "peer_ns"}``, ns a sample or a frame.

    `ratio_to_c` is our time over that of the same arithmetic in C, where there is such a reference and a C compiler.
    """
    say("compiling and measuring, about half a minute")
    scenario = load("flight").with_changes(navigation={"alignment": "truth"}, bus="unix:none")
    head = SimulatedHead(scenario)
    chunks = list(head.chunks(SAMPLES))
    slow, batch = chunks[0][1], np.concatenate([part for _, _, part in chunks])
    return [
        *_simulation(head),
        *_driver(slow, batch),
        *_compensation(slow, batch),
        *_codec(batch),
        *_strapdown(),
        *_navigation(slow, batch),
        *_loop(scenario, slow, batch),
    ]


def _row(
    name: str, what: str, ns: float, peer: str = "", peer_ns: float | None = None, ratio_to_c: float | None = None
) -> Row:
    return {"id": name, "what": what, "ns": ns, "ratio_to_c": ratio_to_c, "peer": peer, "peer_ns": peer_ns}


def _median_ns(work: Callable[[], object], count: int) -> float:
    return statistics.median(_times_ns([work], count)[0])


def _times_ns(works: list[Callable[[], object]], count: int) -> list[list[float]]:
    """Times of each work, ns, `REPEATS` of them, taken in turns."""
    times: list[list[float]] = [[] for _ in works]
    for work in works:
        work()
    for _ in range(REPEATS):
        for work, found in zip(works, times, strict=True):
            began = time.perf_counter_ns()
            work()
            found.append((time.perf_counter_ns() - began) / count)
    return times


def _simulation(head: SimulatedHead) -> list[Row]:
    return [_row("head", "simulated head: motion, increments, frames", _median_ns(lambda: _draw(head), 2000))]


def _draw(head: SimulatedHead) -> None:
    for _ in head.chunks(2000):
        pass


def _driver(slow: Any, batch: Any) -> list[Row]:
    rows = []
    for size, name in ((1024, "batch of 1024"), (1, "one frame at a time")):
        pieces = [batch[i : i + size] for i in range(0, 2000 * min(size, 10), size)]
        driver = DtgHead()
        driver.decode(slow)
        ns = _median_ns(partial(_decode, driver, pieces), sum(map(len, pieces)))
        rows.append(_row(f"driver-{size}", f"driver: check, decode, order ({name})", ns))
    return rows


def _decode(driver: DtgHead, pieces: list[Any]) -> None:
    for piece in pieces:
        driver.decode(piece)


def _compensation(slow: Any, batch: Any) -> list[Row]:
    driver = DtgHead()
    driver.decode(slow)
    head = driver.decode(batch)
    rows, out = [], np.empty((len(head), 4))
    for name, what, angle in (("wire", "rotor angles on the wire", 0.0), ("cubic", "increments alone", np.nan)):
        compensator, sent = LagCompensator(), replace(head, rotor=np.full_like(head.rotor, angle))
        ns = _median_ns(partial(compensator.compensate, sent, out), len(head))
        rows.append(_row(f"lag-{name}", f"lag compensation of both gyros, batch: {what}", ns))
    return rows


def _codec(batch: Any) -> list[Row]:
    import cantools

    text = head_database_text()
    codec = load_database(text)["HEAD_SAMPLE"]
    database: Any = cantools.database.load_string(text, "dbc")
    peer = database.get_message_by_name("HEAD_SAMPLE")
    data = np.ascontiguousarray(batch["data"][:1024])
    out = np.empty((1024, len(codec.signals)))
    payloads = [row.tobytes() for row in data[:200]]
    peer_ns = _median_ns(lambda: [peer.decode(payload) for payload in payloads], len(payloads))
    many = _median_ns(lambda: codec.decode(data, out), 1024)
    one = _median_ns(lambda: codec.decode(data[:1], out[:1]), 1)
    return [
        _row("codec-1024", "decode HEAD_SAMPLE, 17 signals, batch", many, "cantools", peer_ns),
        _row("codec-1", "decode HEAD_SAMPLE, one frame", one, "cantools", peer_ns),
    ]


class StrapdownRecord:
    """Exact increments of the built-in flight, and room for what is made of them."""

    def __init__(self, count: int = STRAPDOWN_SAMPLES) -> None:
        motion = Motion(load("flight").motion.model_copy(update={"rest_s": 0.0, "ramp_s": 0.0}))
        truth = motion.truth([0.0])[0]
        self.start = truth["lat"], truth["lon"], truth["height"], truth["vel_n"], truth["q_nb"]
        self.step = np.full(count, STRAPDOWN_STEP_S)
        self.dtheta, self.dvel = np.empty((count, 3)), np.empty((count, 3))
        motion.increments(0, count, STRAPDOWN_STEP_S, self.dtheta, self.dvel)
        self.bias = np.zeros(3)
        self.out = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 4))

    def by(self, core: Strapdown) -> None:
        """All of it by a core of ours, answers in `out`."""
        core.start(*self.start)
        core.advance(self.step, self.dtheta, self.dvel, self.bias, *self.out)

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


def _strapdown() -> list[Row]:
    record = StrapdownRecord()
    count = len(record.step)
    names = [(a, m) for a in ("two-sample", "high-order:4") for m in ("geographic", "earth", "wander", "inertial")]
    works: list[Callable[[], object]] = [partial(record.by, Strapdown(a, m, whole_record=True)) for a, m in names]
    function = c_two_sample()
    if function is not None:
        works.insert(1, partial(record.by_c, function))  # right after what it is compared with
    times = _times_ns(works, count)
    c_times = times.pop(1) if function is not None else None
    peer_ns = _pyins_ns(record)
    rows = []
    for (attitude, mechanization), ours in zip(names, times, strict=True):
        same = (attitude, mechanization) == names[0]
        ratio = statistics.median([a / b for a, b in zip(ours, c_times, strict=True)]) if same and c_times else None
        rows.append(
            _row(
                f"strapdown-{2 if attitude == 'two-sample' else 4}-{mechanization}",
                f"strapdown, batch: {attitude}, {mechanization}",
                statistics.median(ours),
                "pyins" if same and peer_ns is not None else "",
                peer_ns if same else None,
                ratio,
            )
        )
    if c_times is not None:
        rows.append(_row("strapdown-c", "the first of these in C, cc -O3", statistics.median(c_times), ratio_to_c=1.0))
    return rows


def _pyins_ns(record: StrapdownRecord) -> float | None:
    """The peer, with its increments and its integration; None where it is not installed."""
    try:
        pandas: Any = import_module("pandas")
        strapdown: Any = import_module("pyins.strapdown")
        util: Any = import_module("pyins.util")
    except ImportError:
        return None
    lat, lon, height, vel_n, q = record.start
    angles = np.degrees(euler_angles(np.asarray(q)[None])[0])
    place = [np.degrees(lat), np.degrees(lon), height, *vel_n, angles[2], angles[1], angles[0]]
    start = pandas.Series(place, index=util.TRAJECTORY_COLS, name=0.0)
    index = pandas.Index(np.cumsum(record.step), name="time")
    columns = [*util.GYRO_COLS, *util.ACCEL_COLS]
    imu = pandas.DataFrame(np.hstack([record.dtheta, record.dvel]), index=index, columns=columns)

    def work() -> None:
        strapdown.Integrator(start).integrate(strapdown.compute_increments_from_imu(imu, "increment"))

    return _median_ns(work, len(record.step))


def _navigation(slow: Any, batch: Any) -> list[Row]:
    driver = DtgHead()
    driver.decode(slow)
    raw = driver.decode(batch)
    imu = ImuIncrements(
        raw.time.copy(),
        raw.step.copy(),
        raw.dtheta[:, :3].copy(),
        raw.dvel.copy(),
        raw.validity.copy(),
        raw.sequence.copy(),
    )

    def core(size: int, count: int) -> None:
        navigator = Navigator(Settings())
        navigator.begin(0.87, 0.63, 150.0, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), 0.0)
        for i in range(0, count, size):
            navigator.process(imu.rows(i, i + size))

    return [
        _row("core-1000", "navigation core, batches of 1000", _median_ns(lambda: core(1000, SAMPLES), SAMPLES)),
        _row("core-1", "navigation core, one sample a call", _median_ns(lambda: core(1, 2000), 2000)),
    ]


def _loop(scenario: Any, slow: Any, batch: Any) -> list[Row]:
    rows = []
    for size, count in ((1000, SAMPLES), (1, 2000)):
        times = []
        for _ in range(REPEATS):
            loop = Loop(LoopOrder(scenario, paced=False), Outlets.make(recording=False, readers=1))
            loop.take(slow)
            loop.take(batch[:size])
            began = time.perf_counter_ns()
            for i in range(size, count, size):
                loop.take(batch[i : i + size])
            times.append((time.perf_counter_ns() - began) / (count - size))
        rows.append(
            _row(f"loop-{size}", f"frames to solutions in the ring, {size} at a time", statistics.median(times))
        )
    return rows
