"""Setting a board up: `hil configure`."""

import contextlib

from drivers import make_driver
from drivers.serial import ubx
from drivers.serial.dialog import Dialog
from drivers.serial.driver import SerialDriver
from drivers.serial.port import SerialPort
from drivers.serial.receiver import GnssFraming
from nav.errors import HilError


def set_up(driver_name: str, url: str, rate_hz: float) -> dict[str, object]:
    """Make the board on the port `url` send what its driver takes, `rate_hz` times a second; what it said of itself.

    ``ubx`` is a receiver of u-blox.

    Raises
    ------
    HilError
        The driver is not one of a serial board, the port cannot be opened, or the board does not do it.
    """
    if driver_name == "ubx":
        with contextlib.closing(SerialPort(url)) as port:
            return ubx.configure(Dialog(port, GnssFraming()), rate_hz, port.baud)
    driver = make_driver(driver_name)
    if not isinstance(driver, SerialDriver):
        raise HilError(f"{driver_name} is no board on a serial port: there is nothing to configure")
    with contextlib.closing(SerialPort(url)) as port:
        return driver.board.configure(Dialog(port, driver.board), rate_hz, port.baud)
