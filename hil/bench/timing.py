"""Works measured in turns, and the rows made of them."""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

Row = dict[str, Any]


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes
    ----------
    repeats : int
        Times that every work is measured.
    batch : int
        Samples of a whole record of increments.
    calls : int
        Samples of a work that takes one a call.
    """

    repeats: int = 9
    batch: int = 200_000
    calls: int = 1000


@dataclass(frozen=True)
class Work:
    """Something that is measured.

    Attributes
    ----------
    id, what : str
        Of its row.
    run : callable
        Does `count` samples or frames.
    count : int
        How many.
    peer, peer_id : str
        Name of the peer that it is compared with, and the id of the peer's work; empty where there is none.
    c_id : str
        Id of the work in C that it is compared with; empty where there is none.
    """

    id: str
    what: str
    run: Callable[[], object]
    count: int
    peer: str = ""
    peer_id: str = ""
    c_id: str = ""


def rows_in_turns(works: Sequence[Work], repeats: int) -> list[Row]:
    """Measure all works `repeats` times in turns, each once before; a row each.

    Time is the median. A ratio is the `paired_ratio`, and `peer_ns` our time by it.
    """
    times: dict[str, list[float]] = {work.id: [] for work in works}
    for work in works:
        work.run()
    for _ in range(repeats):
        for work in works:
            began = time.perf_counter_ns()
            work.run()
            times[work.id].append((time.perf_counter_ns() - began) / work.count)

    rows = []
    for work in works:
        ns = statistics.median(times[work.id])
        peer_ns = ns * paired_ratio(times[work.peer_id], times[work.id]) if work.peer_id in times else None
        to_c = paired_ratio(times[work.id], times[work.c_id]) if work.c_id in times else None
        rows.append(row(work.id, work.what, ns, work.peer if peer_ns is not None else "", peer_ns, to_c))
    return rows


def paired_ratio(times: Sequence[float], others: Sequence[float]) -> float:
    """Median of the ratios of one turn each: what slows the machine down for a while slows both."""
    return statistics.median(a / b for a, b in zip(times, others, strict=True))


def row(
    name: str, what: str, ns: float, peer: str = "", peer_ns: float | None = None, ratio_to_c: float | None = None
) -> Row:
    """A row of `hil.bench.measure`."""
    return {"id": name, "what": what, "ns": ns, "ratio_to_c": ratio_to_c, "peer": peer, "peer_ns": peer_ns}
