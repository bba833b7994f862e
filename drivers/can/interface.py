"""What the kernel says of a CAN interface: bit rates and the state of its controller, by `ip -details -json link`."""

import json
import shutil
import subprocess
from dataclasses import dataclass

WAIT_S = 2.0


@dataclass(frozen=True, slots=True)
class Link:
    """An interface; 0 and empty where it does not say.

    Attributes
    ----------
    state : str
        Of the controller: ``ERROR-ACTIVE`` is a good one; ``ERROR-PASSIVE``, ``BUS-OFF``, ``STOPPED``.
    bitrate, data_bitrate : int
        Bits a second, of the arbitration and of the data of CAN FD.
    """

    state: str = ""
    bitrate: int = 0
    data_bitrate: int = 0


def link(name: str) -> Link:
    """What is known of the interface `name`; nothing where `ip` is not there or does not know it."""
    program = shutil.which("ip")
    if program is None:
        return Link()
    command = [program, "-details", "-json", "link", "show", "dev", name]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return Link()
    return read_link(done.stdout)


def read_link(text: str) -> Link:
    """What `ip` printed."""
    try:
        (entry, *_) = json.loads(text)
        data = entry.get("linkinfo", {}).get("info_data", {})
        rates = (int(data.get(name, {}).get("bitrate", 0)) for name in ("bittiming", "data_bittiming"))
        return Link(str(data.get("state", "")), *rates)
    except (ValueError, AttributeError, TypeError):
        return Link()
