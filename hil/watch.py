"""Feeds a `Monitor`: from a bus, beside whoever listens there, or from a recording."""

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import numpy as np

from drivers.can.bus import open_port
from drivers.can.frames import frames
from drivers.can.interface import link
from drivers.serial.probe import check_port, listen, place_of, probe, serial_drivers
from hil.flight_log import is_flight_log, read_flight_log
from hil.monitor import Monitor
from hil.monitor_view import MonitorView
from hil.samples import log_increments
from hil.source import FileSource
from nav.errors import HilError

TICK_S = 0.05
COMPILING_S = 0.2
"""Taking a batch does not last so long, unless it compiles what decodes it: the first time on a machine."""
LISTEN_S = 1.0
"""How long a serial port is listened to before another baud rate is tried."""


def watch_file(monitor: Monitor, path: Path, driver: str | None) -> dict[str, Any]:
    """What is in a recording or a flight log.

    Raises
    ------
    HilError
        The file cannot be read.
    """
    if is_flight_log(path):
        log = read_flight_log(path)
        monitor.add(log_increments(log), 1000 * np.asarray(log.time_us, np.int64))
        return monitor.report(monitor.last_ns) | {"problem": ""}
    source = FileSource(path, paced=False)
    for batch in source.batches(1024):
        monitor.take(batch)
    return monitor.report(monitor.last_ns) | {"problem": source.problem()}


def watch_bus(
    monitor: Monitor, url: str, duration_s: float | None, cancelled: Callable[[], bool], *, quiet: bool
) -> dict[str, Any]:
    """What is on a bus, shown on standard output unless `quiet`, until cancelled or the time is over.

    Raises
    ------
    HilError
        The bus cannot be opened.
    """
    port, batch = open_port(url), frames(1024)
    view = None if quiet else MonitorView()
    with contextlib.closing(port), view or contextlib.nullcontext():
        began = shown = time.monotonic()
        while not cancelled() and (duration_s is None or time.monotonic() - began < duration_s):
            heard = batch[: port.receive(batch, TICK_S)]
            before = time.monotonic()
            monitor.take(heard)
            if (took := time.monotonic() - before) > COMPILING_S:
                began += took  # this was no listening
            if view is not None and time.monotonic() - shown >= view.period_s:
                shown = time.monotonic()
                view.show(monitor.report(time.time_ns(), recent=True, port=port))
        failures = getattr(port, "failures", 0)
        problem = f"the bus failed {failures} times and was reopened" if failures else ""
        return monitor.report(time.time_ns(), port=port) | {"problem": problem}


def look_first(url: str, driver: str | None) -> str:
    """What to say of a serial port before it is shown; of another bus nothing.

    Raises
    ------
    HilError
        The port cannot be opened, or another rate or driver is the right one for the `driver` that was asked for.
    """
    if not url.startswith("serial:"):
        return ""
    if driver is not None:
        return check_port(url, driver)
    if "://" in url or listen(url, serial_drivers(), LISTEN_S).driver:
        return ""
    place = place_of(url)
    found = probe(place)
    if found is None:
        return f"{url}: no board that is known, at any usual rate; its bytes are shown as they come"
    return f"{url}: {found.driver} speaks here at {found.baud} baud: hil monitor --bus serial:{place}:{found.baud}"


def bitrates_of(url: str | None, bitrate: float | None, data_bitrate: float | None) -> tuple[float, float]:
    """Bit rates of a bus, of the data of CAN FD too: as given, as the URL says, or as the interface does; 0: not known.

    Raises
    ------
    HilError
        A rate is none.
    """
    given = (_rate(bitrate, "--bitrate"), _rate(data_bitrate, "--data-bitrate"))
    if url is None or given[0]:
        return given
    interface, _, rest = url.partition(":")
    channel, _, query = rest.partition("?")
    if interface == "serial":
        return (0.0 if "://" in url else _rate(float(url.rpartition(":")[2]), url)), 0.0
    if interface == "socketcan" and not query:
        known = link(channel)
        return float(known.bitrate), given[1] or float(known.data_bitrate)
    said = {key: values[-1] for key, values in parse_qs(query).items()}
    try:
        return float(said.get("bitrate", 0.0)), given[1] or float(said.get("data_bitrate", 0.0))
    except ValueError as error:
        raise HilError(f"bus {url}: bitrate: {error}") from error


def _rate(value: float | None, what: str) -> float:
    if value is not None and not 1.0 <= value <= 2e7:
        raise HilError(f"{what} {value:g}: expected bits a second up to 20000000, as 500000")
    return value or 0.0
