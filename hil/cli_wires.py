"""What is looked at on the wires of a run before anything of it is started."""

from collections.abc import Iterator

from hil.scenario import Scenario


def look_before(scenario: Scenario) -> Iterator[str]:
    """Listen to the serial ports of a run; a warning for each that says nothing of use.

    Raises
    ------
    HilError
        The URL of the bus is malformed, a port cannot be opened, or another rate or driver is the right one.
    """
    if scenario.bus:
        from drivers.can.bus import check_url

        check_url(scenario.bus)
    if scenario.receiver:
        from drivers.serial.probe import check_receiver

        yield from filter(None, (check_receiver(receiver.port) for receiver in scenario.receiver))
    if scenario.bus.startswith("serial:"):
        from drivers.serial.probe import check_port

        yield from filter(None, (check_port(scenario.bus, scenario.driver),))
