"""The parts from the simulated head to the solutions in the ring."""

import statistics
import time
from functools import partial
from typing import Any

import numpy as np

from drivers.can.codec import load_database
from drivers.can.dtg_head import DtgHead, head_database_text
from hil.bench.timing import Row, Sizes, Work, row, rows_in_turns
from hil.bridge import Loop, LoopOrder, Outlets
from hil.scenario import Scenario, load
from hil.world.head import SimulatedHead
from hil.world.instruments import head_model
from nav.increments import ImuIncrements
from nav.instruments.head import HeadCombiner
from nav.navigator import Navigator, Settings

SAMPLES = 20_000


def rows(sizes: Sizes) -> list[Row]:
    """Rows of the parts of the chain."""
    scenario = load("flight").with_changes(navigation={"alignment": "truth"}, bus="unix:none")
    head = SimulatedHead(scenario)
    chunks = list(head.chunks(SAMPLES))
    slow, batch = chunks[0][1], np.concatenate([part for _, _, part in chunks])
    works = [
        Work("head", "simulated head, ideal: motion, increments, frames", partial(_draw, head), 2000),
        *_dtg_head(scenario),
        *_driver(slow, batch),
        *_codec(batch),
        *_navigation(slow, batch),
    ]
    return [*rows_in_turns(works, sizes.repeats), *_loop(scenario, slow, batch, sizes.repeats)]


def _dtg_head(scenario: Scenario) -> list[Work]:
    """The head by its physics, and all that the core does about it."""
    dtg = scenario.with_changes(head={"instruments": "dtg", "grade": "dtg"})
    head, combiner, driver = SimulatedHead(dtg), HeadCombiner(head_model(dtg.head)), DtgHead()
    chunks = list(head.chunks(SAMPLES))
    driver.decode(chunks[0][1])
    samples = driver.decode(np.concatenate([part for _, _, part in chunks]))

    def compensate() -> None:
        combiner.renew()
        for i in range(0, len(samples), 1000):
            combiner.combine(samples.rows(i, i + 1000))

    what = "lag, tests, combination, size effect of all axes, batches of 1000"
    return [
        Work("head-dtg", "simulated head, rotors and pendulums at 8 kHz, DTG grade", partial(_draw, head), 2000),
        Work("compensation", what, compensate, len(samples)),
    ]


def _draw(head: SimulatedHead) -> None:
    for _ in head.chunks(2000):
        pass


def _driver(slow: Any, batch: Any) -> list[Work]:
    works = []
    for size, name in ((1024, "batch of 1024"), (1, "one frame at a time")):
        pieces = [batch[i : i + size] for i in range(0, 2000 * min(size, 10), size)]
        driver = DtgHead()
        driver.decode(slow)
        what = f"driver: check, decode, order ({name})"
        works.append(Work(f"driver-{size}", what, partial(_decode, driver, pieces), sum(map(len, pieces))))
    return works


def _decode(driver: DtgHead, pieces: list[Any]) -> None:
    for piece in pieces:
        driver.decode(piece)


def _codec(batch: Any) -> list[Work]:
    import cantools

    text = head_database_text()
    codec = load_database(text)["HEAD_SAMPLE"]
    database: Any = cantools.database.load_string(text, "dbc")
    peer = database.get_message_by_name("HEAD_SAMPLE")
    data = np.ascontiguousarray(batch["data"][:1024])
    out = np.empty((1024, len(codec.signals)))
    singles = [(data[k : k + 1], out[k : k + 1]) for k in range(200)]
    payloads = [row.tobytes() for row in data[:200]]
    decode, cantools_id = codec.decode, "codec-cantools"
    return [
        Work(
            "codec-1024",
            "decode HEAD_SAMPLE, 17 signals, batch",
            partial(codec.decode, data, out),
            1024,
            "cantools",
            cantools_id,
        ),
        Work(
            "codec-1",
            "decode HEAD_SAMPLE, one frame",
            lambda: [decode(*single) for single in singles],
            len(singles),
            "cantools",
            cantools_id,
        ),
        Work(
            cantools_id,
            "decode HEAD_SAMPLE by cantools, one frame",
            lambda: [peer.decode(payload) for payload in payloads],
            len(payloads),
        ),
    ]


def _navigation(slow: Any, batch: Any) -> list[Work]:
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
        Work("core-1000", "navigation core, batches of 1000", partial(core, 1000, SAMPLES), SAMPLES),
        Work("core-1", "navigation core, one sample a call", partial(core, 1, 2000), 2000),
    ]


def _loop(scenario: Any, slow: Any, batch: Any, repeats: int) -> list[Row]:
    found = []
    for size, count in ((1000, SAMPLES), (1, 2000)):
        times = []
        for _ in range(repeats):
            loop = Loop(LoopOrder(scenario, paced=False), Outlets.make(recording=False, readers=1))
            loop.take(slow)
            loop.take(batch[:size])
            began = time.perf_counter_ns()
            for i in range(size, count, size):
                loop.take(batch[i : i + size])
            times.append((time.perf_counter_ns() - began) / (count - size))
        found.append(
            row(f"loop-{size}", f"frames to solutions in the ring, {size} at a time", statistics.median(times))
        )
    return found
