"""Which version this is: `hil --version`, `hil version`."""

from typing import Annotated

import typer


def version() -> None:
    """Print the version, and the number by which AUTOPILOT_VERSION tells it."""
    from drivers.mavlink.version import software_version, version_number

    print(f"dtg-hil {software_version() or 'not installed'} (flight_sw_version {version_number():#010x})")


def _ended_by(wanted: bool) -> None:
    if wanted:
        version()
        raise typer.Exit


def root(
    _: Annotated[
        bool, typer.Option("--version", callback=_ended_by, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    """Options of `hil` itself."""
