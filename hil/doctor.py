"""`hil doctor`: what this machine can do, and the command that mends each lack."""

import importlib.util
import os
import platform
import shutil
import socket
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from drivers import driver_names
from drivers.can.interface import Link, link
from drivers.can.socketcan import CANFD_MTU
from drivers.utc import PULSES
from hil.realtime import refused
from nav.errors import HilError

ARPHRD_CAN = "280"
WANTED_RMEM = 4 << 20
LISTEN_S = 2.0
"""How long a CAN interface is listened to: boards say some things once a second."""
TROUBLED = ("ERROR-WARNING", "ERROR-PASSIVE", "BUS-OFF")
"""States of a CAN controller that hears errors."""
Verdict = Literal["ok", "lack", "info"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at."""

    what: str
    verdict: Verdict
    found: str
    mend: str = ""

    def as_dict(self) -> dict[str, str]:
        """For ``--json``."""
        return asdict(self)


def examine(*, probe: bool = False) -> list[Finding]:
    """All findings; `probe`: also who speaks on CAN interfaces and serial ports, which takes seconds and opens them."""
    return [*_python(), *_can(probe=probe), *_real_time(), *_network(), *_serial(probe=probe), *_extras()]


def _python() -> Iterator[Finding]:
    version = platform.python_version()
    good = sys.version_info >= (3, 11)
    yield Finding("python", "ok" if good else "lack", version, "" if good else "install Python 3.11 or newer")
    yield Finding("drivers", "info", ", ".join(driver_names()))


def can_interfaces() -> list[str]:
    """Names of the CAN interfaces of this machine."""
    found = []
    for entry in sorted(Path("/sys/class/net").glob("*")):
        try:
            if (entry / "type").read_text().strip() == ARPHRD_CAN:
                found.append(entry.name)
        except OSError:
            continue
    return found


def _can(*, probe: bool) -> Iterator[Finding]:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
        kernel = True
    except (OSError, AttributeError):
        kernel = False
    yield Finding(
        "SocketCAN",
        "ok" if kernel else "lack",
        "the kernel has it" if kernel else "this kernel has no AF_CAN",
        ""
        if kernel
        else "sudo modprobe can_raw; without it use unix: or udp_multicast:, or user-mode Linux (make vcan)",
    )
    interfaces = can_interfaces()
    yield Finding(
        "CAN interfaces",
        "ok" if interfaces else "lack",
        ", ".join(interfaces) or "none",
        "" if interfaces else "sudo sh -c 'modprobe vcan; ip link add vcan0 type vcan && ip link set vcan0 mtu 72 up'",
    )
    for name in interfaces:
        yield _interface(name)
        if probe:
            yield _board_on_can(name)
    if not kernel:
        uml = shutil.which("linux.uml")
        mend = "" if uml else "sudo apt-get install user-mode-linux (make vcan does it)"
        yield Finding("user-mode Linux (SocketCAN for tests)", "ok" if uml else "lack", uml or "not installed", mend)


def _interface(name: str) -> Finding:
    """State of a CAN interface: of the network's side, and of its controller where it has one."""
    flags, mtu = ((Path("/sys/class/net") / name / what).read_text() for what in ("flags", "mtu"))
    return judged(name, link(name), up=bool(int(flags, 16) & 1), mtu=int(mtu))


def judged(name: str, known: Link, *, up: bool, mtu: int) -> Finding:
    """What is to be said of the CAN interface `name`; `mtu` is that of CAN FD, or of classic CAN."""
    parts = ["up" if up else "down", f"mtu {mtu}", known.state]
    parts += [f"{rate} bit/s" for rate in (known.bitrate, known.data_bitrate) if rate]
    classic = mtu < CANFD_MTU
    parts += [f"classic CAN only: FD layouts need mtu {CANFD_MTU}"] if classic else []
    verdict: Verdict = "info" if classic else "ok"
    mend = ""
    if not up:
        verdict, mend = "lack", f"sudo ip link set {name} up"
    if known.state in TROUBLED:
        verdict = "lack"
        mend = f"mend wiring, termination or bit rate; then: sudo ip link set {name} down; sudo ip link set {name} up"
    return Finding(name, verdict, ", ".join(part for part in parts if part), mend)


def _board_on_can(name: str) -> Finding:
    """Who speaks on an interface."""
    from hil.monitor import Monitor
    from hil.watch import watch_bus

    url = f"socketcan:{name}"
    try:
        report = watch_bus(Monitor(None), url, LISTEN_S, lambda: False, quiet=True)
    except HilError as error:
        return Finding(name, "lack", str(error))
    if report["driver"] is None:
        return Finding(name, "info", f"no board that is known; {report['frames']} frames in {LISTEN_S:g} s")
    return Finding(name, "ok", f"hil run --imu {report['driver']} --bus {url}")


def _real_time() -> Iterator[Finding]:
    lacking = refused()
    found = (
        "; ".join(lack.partition(":")[0] for lack in lacking) or "priority, locked memory and a processor are granted"
    )
    mend = "" if not lacking else lacking[0].partition(": ")[2]
    yield Finding("hil run --realtime", "lack" if lacking else "ok", found, mend)
    kernel = Path("/sys/kernel/realtime")
    text = "PREEMPT_RT" if kernel.is_file() and kernel.read_text().strip() == "1" else "not PREEMPT_RT"
    yield Finding("kernel", "info", f"{platform.release()}, {text}")
    clock = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    source = clock.read_text().strip() if clock.is_file() else "unknown"
    slow = source in {"hpet", "acpi_pm", "jiffies"}
    mend = "choose tsc (kernel parameter clocksource=tsc): every look at the clock costs microseconds" if slow else ""
    yield Finding("clock source", "lack" if slow else "ok", source, mend)
    yield Finding("pulse lines (PPS)", "info", ", ".join(sorted(line.name for line in PULSES.glob("pps*"))) or "none")
    yield Finding("processors", "info", f"{len(os.sched_getaffinity(0))} usable of {os.cpu_count()}")


def _network() -> Iterator[Finding]:
    limit = Path("/proc/sys/net/core/rmem_max")
    if limit.is_file():
        size = int(limit.read_text())
        good = size >= WANTED_RMEM or os.geteuid() == 0
        mend = "" if good else f"sudo sysctl -w net.core.rmem_max={WANTED_RMEM}"
        yield Finding("socket receive buffer", "ok" if good else "lack", f"rmem_max {size >> 10} KiB", mend)
    for port in (14550,):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", port))
                found = "free (no ground station listens yet)"
            except OSError:
                found = "in use: a ground station listens, or another bridge"
        yield Finding(f"UDP port {port}", "info", found)


def _serial(*, probe: bool) -> Iterator[Finding]:
    from serial.tools import list_ports

    ports = sorted(list_ports.comports(), key=lambda port: port.device)
    yield Finding("serial ports", "info", ", ".join(f"{port.device} ({port.description})" for port in ports) or "none")
    for port in ports:
        if not os.access(port.device, os.R_OK | os.W_OK):
            yield Finding(port.device, "lack", "no permission", "sudo usermod -aG dialout $USER, then log in again")
        elif probe:
            yield _board(port.device)


def _board(device: str) -> Finding:
    from drivers.serial.probe import options_of, probe

    try:
        heard = probe(device)
    except HilError as error:
        return Finding(device, "lack", str(error))
    if heard is None:
        return Finding(device, "info", "no board that is known, at any usual rate")
    return Finding(device, "ok", f"hil run {options_of(heard, device)}")


def _extras() -> Iterator[Finding]:
    for module, what, extra in (
        ("pyulog", "PX4 logs", "logs"),
        ("matplotlib", "plots", "plot"),
        ("pyarrow", "Parquet tables", "parquet"),
        ("mcap", "MCAP files", "mcap"),
    ):
        there = importlib.util.find_spec(module) is not None
        mend = "" if there else f"pip install 'dtg-hil[{extra}]'"
        yield Finding(what, "ok" if there else "lack", module if there else f"{module} is not installed", mend)
