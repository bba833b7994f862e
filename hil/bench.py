"""`hil bench`: what each part costs on this machine, in one run, beside its peers.

Every figure is the median of repeated measurements of the same work; a part and its peer are measured in turns.
"""

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from drivers.can.codec import load_database
from drivers.can.dtg_head import DtgHead, head_database_text
from hil.bridge import Loop, LoopOrder, Outlets
from hil.scenario import load
from hil.world.head import SimulatedHead
from nav.increments import ImuIncrements
from nav.navigator import Navigator, Settings

REPEATS = 9
SAMPLES = 20_000
Row = dict[str, Any]


def measure(say: Callable[[str], None]) -> list[Row]:
    """Rows ``{"id", "what", "ns", "ratio_to_c", "peer", "peer_ns"}``, ns a sample or a frame."""
    say("compiling and measuring, about half a minute")
    scenario = load("flight").with_changes(navigation={"alignment": "truth"}, bus="unix:none")
    head = SimulatedHead(scenario)
    chunks = list(head.chunks(SAMPLES))
    slow, batch = chunks[0][1], np.concatenate([part for _, _, part in chunks])
    return [
        *_simulation(head),
        *_driver(slow, batch),
        *_codec(batch),
        *_navigation(slow, batch),
        *_loop(scenario, slow, batch),
    ]


def _row(name: str, what: str, ns: float, peer: str = "", peer_ns: float | None = None) -> Row:
    return {"id": name, "what": what, "ns": ns, "ratio_to_c": None, "peer": peer, "peer_ns": peer_ns}


def _median_ns(work: Callable[[], object], count: int) -> float:
    work()
    times = []
    for _ in range(REPEATS):
        began = time.perf_counter_ns()
        work()
        times.append((time.perf_counter_ns() - began) / count)
    return statistics.median(times)


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
