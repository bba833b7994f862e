"""What the commands share: how they answer, how they are stopped, how they fail."""

import json
import signal
import sys
from collections.abc import Iterable
from itertools import product
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer

from nav.errors import HilError

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output and nothing else.")]


class RunFailed(HilError):
    """The request was right and the run failed."""


class StopSignal:
    """Ctrl-C, SIGTERM or a terminal that closes asks for a clean stop; a second one ends at once."""

    def __init__(self) -> None:
        self.wanted = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if (
                number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN
            ):  # which is how nohup lets it go on
                signal.signal(number, self._take)

    def call(self) -> None:
        """Ask for it."""
        self.wanted = True

    def _take(self, _number: int, _frame: FrameType | None) -> None:
        if self.wanted:
            raise SystemExit(130)
        self.wanted = True


def say(text: str) -> None:
    """Tell the user, beside what is printed."""
    print(text, file=sys.stderr)


def report(result: dict[str, Any], *, as_json: bool) -> None:
    """Print the answer, as one JSON object or a line for each of its keys."""
    if as_json:
        print(json.dumps(result))
        return
    for key, value in result.items():
        print(f"{key}: {value}")


def check_outputs(sources: Iterable[Path | None], outputs: Iterable[Path | None]) -> None:
    """Refuse (`HilError`) to write over what is read."""
    for source, out in product(filter(None, sources), filter(None, outputs)):
        if source.exists() and out.exists() and source.samefile(out):
            raise HilError(f"{out} is what is read: give another file to write")
