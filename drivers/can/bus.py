"""Opening a bus by URL: the bulk interface that the bridge, the head and the tools use on every CAN back end.

``unix:NAME`` (:mod:`drivers.can.unix_bus`), ``socketcan:vcan0`` (:mod:`drivers.can.socketcan`) and
``serial:/dev/ttyUSB0:921600`` (:mod:`drivers.serial.port`) are our own (``socketcan:can0?filter=120:7F0`` has the kernel keep
other frames back), as are ``pty:PATH``, a port that is made there (:mod:`drivers.serial.pty`), and ``mavlink:LINK``
(:mod:`drivers.mavlink.port`); anything else is python-can: ``virtual:NAME``, ``udp_multicast:239.74.163.2``, or
``INTERFACE:CHANNEL?bitrate=500000&fd=true``.
"""

import contextlib
import errno
import socket
import time
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import parse_qsl

import can

from drivers.can.convert import from_message, to_message
from drivers.can.frames import FrameArray
from drivers.can.socketcan import SocketCanPort, explain, parse_filters
from drivers.can.unix_bus import UnixPort, check_name
from nav.errors import HilError

RECEIVE_BUFFER = 8 << 20
REOPEN_S = 0.5
"""Time between tries to reopen a bus that failed."""


class Port(Protocol):
    """A bus, opened."""

    dropped: int
    """Frames that this end could not hand on."""

    def receive(self, batch: FrameArray, timeout: float) -> int:
        """Fill `batch` (at least 64 long) with what is there, waiting up to `timeout` s for the first; the number."""

    def send(self, batch: FrameArray) -> None:
        """Send all of `batch`."""

    def close(self) -> None:
        """Leave the bus."""


def open_port(url: str, *, listen: bool = True, lossless: bool = False) -> Port:
    """Open the bus at `url`.

    Parameters
    ----------
    url : str
        See the module.
    listen : bool
        False for a pure sender.
    lossless : bool
        `send` waits for slow listeners where the back end can (``unix:``).

    Raises
    ------
    HilError
        The URL is malformed or the bus cannot be opened; the message says how to make it.
    """
    check_url(url)
    interface, channel, words = _parts(url)
    if interface == "unix":
        return UnixPort(channel, listen=listen, lossless=lossless)
    if interface == "serial":
        from drivers.serial.port import SerialPort

        return SerialPort(url)
    if interface == "pty":
        from drivers.serial.pty import PtyPort

        return PtyPort(Path(channel))
    if interface == "mavlink":
        from drivers.mavlink.port import MavlinkPort

        return MavlinkPort(url.partition(":")[2])
    if interface == "socketcan" and words.keys() <= {"filter"}:
        filters = parse_filters(words["filter"]) if words else ()
        return SocketCanPort(channel, listen=listen, filters=filters)
    options = {key: _typed(value) for key, value in words.items()}
    return PythonCanPort(url, interface, channel, options)


def check_url(url: str) -> None:
    """Refuse a malformed URL; nothing is opened.

    Raises
    ------
    HilError
        The URL is malformed; the message says what was expected.
    """
    interface, channel, words = _parts(url)
    if not channel:
        raise HilError(f"bus {url!r}: expected INTERFACE:CHANNEL, as unix:dtg-hil or socketcan:vcan0")
    if interface == "unix":
        if "?" in url:
            raise HilError(f"bus {url!r}: unix: takes no options")
        check_name(channel)
    elif interface == "serial":
        from drivers.serial.port import parts_of

        parts_of(url)
    elif interface == "mavlink":
        from drivers.mavlink.port import input_of

        input_of(url.partition(":")[2])
    elif interface == "pty" and "?" in url:
        raise HilError(f"bus {url!r}: pty: takes no options")
    elif interface not in {"pty", *can.VALID_INTERFACES}:
        known = ", ".join(sorted({"serial", "pty", "mavlink", *can.VALID_INTERFACES}))
        raise HilError(f"bus {url!r}: nobody knows an interface {interface!r}; there is: {known}")
    elif interface == "socketcan" and "filter" in words:
        parse_filters(words["filter"])


def _parts(url: str) -> tuple[str, str, dict[str, str]]:
    """Interface, channel and options of a URL; empty where it does not say."""
    interface, _, rest = url.partition(":")
    channel, _, query = rest.partition("?")
    return interface, channel, dict(parse_qsl(query, keep_blank_values=True))


class PythonCanPort:
    """A bus of python-can as a `Port`; reopened when the interface fails (`failures` counts)."""

    def __init__(self, url: str, interface: str, channel: str, options: dict[str, Any]) -> None:
        self.url = url
        self.dropped = 0
        self.failures = 0
        self.trouble = ""
        """Why it cannot be used now."""
        self._arguments = {"interface": interface, "channel": channel, **options}
        if interface in {"socketcan", "virtual"}:
            self._arguments.setdefault("fd", True)
        self._bus: can.BusABC | None = self._open()
        self._retry = 0.0

    def _open(self) -> can.BusABC:
        try:
            bus = can.Bus(**self._arguments)
        except (can.CanError, OSError, ValueError, TypeError, ImportError) as error:
            raise HilError(f"bus {self.url}: {_reason(self._arguments, error)}") from error
        sock = getattr(bus, "socket", None) or getattr(getattr(bus, "_multicast", None), "_socket", None)
        if sock is not None:
            for option in (getattr(socket, "SO_RCVBUFFORCE", 33), socket.SO_RCVBUF):
                with contextlib.suppress(OSError):
                    sock.setsockopt(socket.SOL_SOCKET, option, RECEIVE_BUFFER)
        return bus

    def _failed(self) -> None:
        self.failures += 1
        self.trouble = f"bus {self.url}: the interface failed"
        if self._bus is not None:
            with contextlib.suppress(Exception):
                self._bus.shutdown()
        self._bus = None
        self._retry = time.monotonic() + REOPEN_S

    def _alive(self) -> can.BusABC | None:
        if self._bus is None and time.monotonic() >= self._retry:
            try:
                self._bus = self._open()
                self.trouble = ""
            except HilError as error:
                self.trouble = str(error)
                self._retry = time.monotonic() + REOPEN_S
        return self._bus

    def receive(self, batch: FrameArray, timeout: float) -> int:
        """See `Port.receive`."""
        bus = self._alive()
        if bus is None:
            time.sleep(min(timeout, REOPEN_S))
            return 0
        n = 0
        try:
            message = bus.recv(timeout)
            while message is not None:
                from_message(message, batch[n])
                n += 1
                message = bus.recv(0) if n < len(batch) else None
        except (can.CanError, OSError):
            self._failed()
        return n

    def send(self, batch: FrameArray) -> None:
        """See `Port.send`; a frame that the interface refuses is dropped and counted."""
        for row in batch:
            bus = self._alive()
            if bus is None:
                self.dropped += 1
                continue
            try:
                bus.send(to_message(row), timeout=0.1)
            except can.CanError as error:
                self.dropped += 1
                code = getattr(error, "error_code", None)
                if code in {errno.ENETDOWN, errno.ENODEV, errno.ENXIO}:
                    self._failed()
            except OSError:
                self.dropped += 1
                self._failed()

    def close(self) -> None:
        """See `Port.close`."""
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None


def _typed(text: str) -> Any:
    if text.lower() in {"true", "false"}:
        return text.lower() == "true"
    for convert in (int, float):
        with contextlib.suppress(ValueError):
            return convert(text)
    return text


def _reason(arguments: dict[str, Any], error: Exception) -> str:
    interface = arguments["interface"]
    if interface == "socketcan":
        return explain(arguments["channel"], error)
    if isinstance(error, can.CanInterfaceNotImplementedError):
        return f"python-can knows no interface {interface!r} (or its library is missing): {error}"
    return f"{error}"
