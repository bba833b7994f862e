"""What one link does differently from the others: its rates, what goes out on it, whether it is heard, signed, logged.

On the command line the options stand behind the URL: ``udpout:10.0.0.2:14550?rates_hz=ATTITUDE:100,VFR_HUD:0&hear=false``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from urllib.parse import parse_qsl

from drivers.mavlink.messages import KINDS, check_rates
from nav.errors import HilError

OPTIONS = ("rates_hz", "only", "hear", "sign", "tlog")


@dataclass(frozen=True)
class LinkOptions:
    """One link.

    Attributes
    ----------
    url : str
        See `drivers.mavlink.link.FORMS`.
    rates_hz : mapping
        Message name to rate, over those of all links; parameters do not change it.
    only : tuple of str
        Messages of the table that may go out here, HEARTBEAT always among them; empty: all.
    hear : bool
        False: what comes in is counted, and neither answered nor obeyed.
    sign : bool
        False: an unsigned link where there is a key.
    tlog : str
        File for the frames sent and received; empty: none.
    """

    url: str
    rates_hz: Mapping[str, float] = field(default_factory=dict)
    only: tuple[str, ...] = ()
    hear: bool = True
    sign: bool = True
    tlog: str = ""

    def __post_init__(self) -> None:
        where = f"MAVLink link {self.url!r}"
        check_rates(self.rates_hz, f"{where}: rates_hz")
        for name in self.only:
            if name not in KINDS:
                raise HilError(f"{where}: only: unknown message {name!r}; expected one of {', '.join(KINDS)}")


def parse_options(text: str) -> LinkOptions:
    """The link of a URL with options behind it.

    Raises
    ------
    HilError
        An unknown option, or a wrong value.
    """
    url, _, query = text.partition("?")
    given = dict(parse_qsl(query, keep_blank_values=True))
    if unknown := sorted(set(given) - set(OPTIONS)):
        raise HilError(f"MAVLink link {text!r}: unknown option {unknown[0]!r}; expected one of {', '.join(OPTIONS)}")

    def switch(name: str) -> bool:
        value = given.get(name, "true")
        if value not in ("true", "false"):
            raise HilError(f"MAVLink link {text!r}: {name}={value}: expected true or false")
        return value == "true"

    rates_hz = {}
    for part in filter(None, given.get("rates_hz", "").split(",")):
        name, _, number = part.partition(":")
        try:
            rates_hz[name] = float(number)
        except ValueError as error:
            raise HilError(f"MAVLink link {text!r}: rates_hz={part}: expected MESSAGE:HZ") from error
    only = tuple(filter(None, given.get("only", "").split(",")))
    return LinkOptions(url, rates_hz, only, switch("hear"), switch("sign"), given.get("tlog", ""))
