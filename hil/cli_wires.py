"""What is looked at on the wires of a run before anything of it is started."""

from collections.abc import Iterator

from hil.cli_mavlink import door
from hil.scenario import Scenario


def look_before(scenario: Scenario) -> Iterator[str]:
    """Look at the bus of a run and listen to its serial ports; a warning for each that other machines can reach or is of no use.

    Raises
    ------
    HilError
        The URL of the bus is malformed, a port cannot be opened, or another rate or driver is the right one.
    """
    if scenario.bus:
        from drivers.can.bus import check_url

        check_url(scenario.bus)
    kind, _, link = scenario.bus.partition(":")
    if kind == "mavlink" and (line := door("MAVLink", link.partition("?")[0], signed="signing_key=" in link)):
        yield line
    if scenario.receiver:
        from drivers.serial.probe import check_receiver

        yield from filter(None, (check_receiver(receiver.port) for receiver in scenario.receiver))
    if scenario.bus.startswith("serial:"):
        from drivers.serial.probe import check_port

        yield from filter(None, (check_port(scenario.bus, scenario.driver),))
