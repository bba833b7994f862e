"""Which board speaks on a port, and at which baud rate: listens for good packets of every serial driver that is installed,
and of receivers of satellite navigation.
"""

import contextlib
import time
from dataclasses import dataclass

from drivers import driver_names, make_driver
from drivers.can.frames import FrameArray, frames
from drivers.serial.driver import SerialDriver
from drivers.serial.port import SerialPort
from drivers.serial.receiver import GnssFraming
from drivers.serial.stream import ByteStream
from nav.errors import HilError

RATES = (115200, 921600, 460800, 230400, 1000000, 2000000, 57600, 38400, 19200, 9600)
"""Usual baud rates, the likely ones first."""
LISTEN_S = 0.3
"""How long each rate is listened to."""
ENOUGH = 3
"""Good packets that settle it: one may be chance."""
GNSS = "gnss"
"""Name of what is no driver but a receiver; its rates, and how long each is listened to: it may speak once a second."""
GNSS_RATES, GNSS_S = (38400, 9600, 115200, 57600, 230400, 460800, 921600, 4800), 1.2


@dataclass(frozen=True, slots=True)
class Heard:
    """What was heard at one rate.

    Attributes
    ----------
    driver : str
        Whose packets, `GNSS` for a receiver; empty when nobody's.
    baud : int
        The rate.
    bytes : int
        Bytes that came.
    """

    driver: str
    baud: int
    bytes: int


def serial_drivers() -> list[str]:
    """Names of the installed drivers of serial boards."""
    names = []
    for name in driver_names():
        with contextlib.suppress(ImportError):  # a broken driver of another package
            if isinstance(make_driver(name), SerialDriver):
                names.append(name)
    return names


def listen(url: str, names: list[str], seconds: float) -> Heard:
    """Who of `names` is on the port at `url`, within `seconds`.

    Raises
    ------
    HilError
        The port cannot be opened.
    """
    streams: dict[str, ByteStream] = {}
    for name in names:
        driver = None if name == GNSS else make_driver(name)
        if driver is None:
            streams[name] = ByteStream(GnssFraming())
        elif isinstance(driver, SerialDriver):
            streams[name] = driver.stream
    batch, count = frames(256), 0
    with contextlib.closing(SerialPort(url)) as port:
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0 and not port.failures:
            n = port.receive(batch, left)
            count += int(batch["length"][:n].sum())
            if name := hear(streams, batch[:n]):
                return Heard(name, port.baud, count)
    return Heard("", port.baud, count)


def hear(streams: dict[str, ByteStream], batch: FrameArray) -> str:
    """Give `batch` to the stream of each driver; who has had enough good packets, or nobody."""
    for name, stream in streams.items():
        for _ in stream.take(batch):
            pass
        if stream.packets >= (1 if name == GNSS else ENOUGH):
            return name
    return ""


def probe(place: str, names: list[str] | None = None, listen_s: float = LISTEN_S) -> Heard | None:
    """Try the usual rates on the device `place`; the board or receiver that is found, or None.

    Where bytes come and no board is found, receivers are listened for once more and longer.

    Raises
    ------
    HilError
        The port cannot be opened.
    """
    chosen = [*serial_drivers(), GNSS] if names is None else names
    passes = [(baud, chosen, listen_s) for baud in RATES]
    if GNSS in chosen:
        passes += [(baud, [GNSS], GNSS_S) for baud in GNSS_RATES]
    came = 0
    for baud, whom, seconds in passes:
        if whom != chosen and not came:
            return None
        heard = listen(f"serial:{place}:{baud}", whom, seconds)
        came += heard.bytes
        if heard.driver:
            return heard
    return None


def place_of(url: str) -> str:
    """The device in the URL of a port."""
    return url.partition(":")[2].rpartition(":")[0]


def options_of(heard: Heard, place: str) -> str:
    """Options of `hil run` for what was heard on the device `place`."""
    port = f"serial:{place}:{heard.baud}"
    return f"--gnss {port}" if heard.driver == GNSS else f"--imu {heard.driver} --bus {port}"


def check_receiver(url: str, patience_s: float = GNSS_S) -> str:
    """Listen for a receiver before a run; a warning to print, empty when one is there.

    Raises
    ------
    HilError
        The port cannot be opened, another rate is the right one, or a board is there: says which.
    """
    heard, place = listen(url, [GNSS], patience_s), place_of(url)
    if heard.driver or "://" in url:
        return ""
    found = probe(place) if heard.bytes else None
    if found is not None:
        raise HilError(
            f"{url}: no packet of a receiver in {patience_s:g} s ({heard.bytes} bytes came), "
            f"but {found.driver} at {found.baud} baud: use {options_of(found, place)}"
        )
    if heard.bytes:
        return f"{url}: {heard.bytes} bytes in {patience_s:g} s, and no UBX or NMEA among them at the usual rates"
    return (
        f"{url}: nothing comes; is the receiver powered, its sending line wired, and set to send? hil configure ubx ..."
    )


def check_port(url: str, driver: str, patience_s: float = 1.0) -> str:
    """Listen before a run; a warning to print, empty when `driver` understands what comes.

    Raises
    ------
    HilError
        The port cannot be opened, or another rate or driver is the right one: says which.
    """
    heard = listen(url, [driver], patience_s)
    place = place_of(url)
    if heard.driver or "://" in url:
        return ""
    found = probe(place)
    if found is not None:
        raise HilError(
            f"{url}: no packet of {driver} in {patience_s:g} s ({heard.bytes} bytes came), "
            f"but {found.driver} at {found.baud} baud: use {options_of(found, place)}"
        )
    if driver.partition("@")[0] not in (boards := serial_drivers()):
        raise HilError(f"{url}: a {driver} is at no serial port: name the board that is, --imu {' | '.join(boards)}")
    if heard.bytes:
        return f"{url}: {heard.bytes} bytes in {patience_s:g} s, no packet of {driver}, and none of any board at the usual rates"
    return f"{url}: nothing comes; is the board powered, its sending line wired, and set to send? hil configure {driver} ..."
