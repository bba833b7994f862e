"""What the options of the command line change in a scenario's MAVLink, and what they have to be told."""

from pathlib import Path
from typing import Any
from urllib.parse import quote

from drivers.mavlink.link import listens_beyond
from hil.scenario import LinkConfig, Scenario
from nav.errors import HilError


def with_mavlink(scenario: Scenario, key: Path | None, tlog: Path | None) -> Scenario:
    """`scenario` with signatures by the key in a file, and a log of its first link.

    Raises
    ------
    HilError
        There is no link to log.
    """
    changes: dict[str, Any] = {}
    if key is not None:
        changes["signing_key"] = str(key)
    if tlog is not None:
        if not scenario.mavlink.links:
            raise HilError("--tlog logs the first MAVLink link, and there is none")
        first, *others = scenario.mavlink.links
        if isinstance(first, LinkConfig):
            logged: str | LinkConfig = first.model_copy(update={"tlog": str(tlog)})
        else:
            logged = first + ("&" if "?" in first else "?") + f"tlog={quote(str(tlog))}"
        changes["links"] = [one.model_dump() if isinstance(one, LinkConfig) else one for one in (logged, *others)]
    return scenario.with_changes(mavlink=changes) if changes else scenario


def open_doors(scenario: Scenario) -> list[str]:
    """A line for each link and each feed that other machines can reach."""
    urls = ((link if isinstance(link, str) else link.url).partition("?")[0] for link in scenario.mavlink.links)
    lines = [door("MAVLink", url, signed=bool(scenario.mavlink.signing_key)) for url in urls]
    lines += [door(f"feed {feed.kind}", feed.listens, signed=False) for feed in scenario.feed]
    return [line for line in lines if line]


def door(what: str, url: str, *, signed: bool) -> str:
    """What to tell of the link `url`; empty where it is of this machine alone."""
    how = "signed messages alone are taken" if signed else "nothing is signed"
    return f"{what} on {url} can be reached from other machines; {how}" if listens_beyond(url) else ""
