"""The live chain, whole: a head's process, the loop, the recorder and the publisher with its links, each in real time.

Every condition is a run of its own of `seconds`. The time of a sample counts from the `send` of its last frame: to its
solution in the ring, and to the ATTITUDE of it on a link.
"""

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.bench.timing import Row, row
from hil.bridge import LoopOrder
from hil.dashboard import open_window
from hil.scenario import Scenario, load
from hil.session import Session, simulated_head

RATES_HZ = (1000.0, 2000.0, 4000.0, 5000.0, 8000.0, 10000.0)
"""Rates at which loss is looked for."""
WARM_S = 1.0
"""Device time before anything is stopped."""
_SPIN = "while True: pass"
_CLIENT = (
    "import socket, sys\nsock = socket.create_connection((sys.argv[1], int(sys.argv[2])))\nwhile sock.recv(65536): pass"
)


@dataclass(frozen=True)
class Condition:
    """One run.

    Attributes
    ----------
    id, what : str
        Of its rows.
    realtime, busy : bool
        Claim real-time priority; a process that never rests beside it on every processor.
    readers : bool
        A dashboard, a recorder, and three links (UDP, and two clients over TCP) instead of one.
    stopped : bool
        One of the TCP clients is stopped (SIGSTOP) while it runs.
    """

    id: str
    what: str
    realtime: bool = False
    busy: bool = False
    readers: bool = False
    stopped: bool = False


CONDITIONS = (
    Condition("quiet", "1 kHz, one link"),
    Condition("busy", "the same beside a busy process on every processor", busy=True),
    Condition("realtime", "1 kHz, --realtime", realtime=True),
    Condition("realtime-busy", "the same beside a busy process on every processor", realtime=True, busy=True),
    Condition("readers", "1 kHz, dashboard, recorder and three links", readers=True),
    Condition("stopped", "the same, a client stopped", readers=True, stopped=True),
)


def rows(say: Callable[[str], None], seconds: float) -> list[Row]:
    """Two rows for every condition, and one for the largest rate.

    `ns` is the median; beside the keys of every row there are `p99_ns`, `samples` and `lost`, and `rate_hz` in the last.
    """
    found = []
    for condition in CONDITIONS:
        say(f"live {condition.id}: {seconds:g} s")
        summary = run(_scenario(1000.0, seconds, instruments="dtg"), condition)
        for part, times in (("ring", summary["latency_us"]), ("datagram", summary["publisher"].get("latency_us"))):
            end = "to the solution in the ring" if part == "ring" else "to the ATTITUDE on a link"
            found.append(_row(f"live-{condition.id}-{part}", f"{condition.what}: {end}", times, summary))
    return [*found, _largest(say, min(seconds, 10.0))]


def run(scenario: Scenario, condition: Condition) -> dict[str, Any]:
    """The summary of a run of `scenario`."""
    with ExitStack() as stack:
        record, window = None, None
        links = [f"udpout:127.0.0.1:{stack.enter_context(_sink())}"]
        ports = [_free_port(), _free_port()] if condition.readers else []
        if condition.readers:
            record = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "run.dhil"
            window = open_window(None, lambda _: None)
            links += [f"tcpin:127.0.0.1:{port}" for port in ports]
        for _ in range(os.cpu_count() or 1 if condition.busy else 0):
            stack.enter_context(_process(_SPIN))
        order = LoopOrder(scenario.with_changes(mavlink={"links": links}), own_world=True, realtime=condition.realtime)
        session = stack.enter_context(Session(order, feeder=simulated_head(order), record=record, window=window))
        session.wait_ready()
        clients = [stack.enter_context(_process(_CLIENT, "127.0.0.1", str(port))) for port in ports]
        while session.running and session.outlets.stats["covered_us"] < 1e6 * WARM_S:
            session.wait(0.05)
        if condition.stopped:
            clients[0].send_signal(signal.SIGSTOP)
        while session.running:
            session.wait(0.1)
        session.__exit__(None, None, None)
        return session.summary()


def _largest(say: Callable[[str], None], seconds: float) -> Row:
    """The largest rate of `RATES_HZ` at which nothing is lost."""
    best: tuple[float, dict[str, Any]] | None = None
    for rate in RATES_HZ:
        say(f"live at {rate:g} Hz: {seconds:g} s")
        summary = run(_scenario(rate, seconds, instruments="ideal"), CONDITIONS[0])
        late = summary["wall_s"] > seconds + 0.05 * seconds + 1.0  # the chain, or the head, fell behind
        if summary["lost"] or summary["feeder"]["dropped"] or late:
            break
        best = rate, summary
    if best is None:
        return row("live-largest-rate", "no rate without loss", 0.0) | {"rate_hz": 0.0}
    what = f"largest rate without loss, FD samples: {best[0]:g} Hz; frame to solution"
    return _row("live-largest-rate", what, best[1]["latency_us"], best[1]) | {"rate_hz": best[0]}


def _row(name: str, what: str, times: dict[str, float] | None, summary: dict[str, Any]) -> Row:
    times = times or {"p50": 0.0, "p99": 0.0}
    more = {"p99_ns": 1e3 * times["p99"], "samples": summary["samples"], "lost": summary["lost"]}
    return row(name, what, 1e3 * times["p50"]) | more


def _scenario(rate_hz: float, seconds: float, *, instruments: str) -> Scenario:
    return load(None).with_changes(
        bus=f"unix:bench-{os.getpid()}-{time.monotonic_ns():x}",
        duration_s=seconds,
        head={"rate_hz": rate_hz, "instruments": instruments},
        navigation={"alignment": "truth"},
        mavlink={"rates_hz": {"ATTITUDE": 200.0}},
    )


@contextmanager
def _process(code: str, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen([sys.executable, "-c", code, *arguments])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextmanager
def _sink() -> Iterator[int]:
    """A port on which everything is taken and nothing read."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(("127.0.0.1", 0))
        yield sink.getsockname()[1]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
