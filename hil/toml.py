"""TOML files that people write: read whole, or refused with the reason."""

import tomllib
from pathlib import Path
from typing import Any

from nav.errors import HilError


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """The table in a text; `source` names it in errors.

    Raises
    ------
    HilError
        It is not TOML, is nested too deeply, or holds a number of too many digits.
    """
    try:
        table = tomllib.loads(text)
        repr(table)  # an integer of thousands of digits cannot be shown, not even in an error
    except (ValueError, RecursionError) as error:  # tomllib's own errors are ValueErrors
        raise HilError(f"{source}: not TOML: {error}") from error
    return table


def read_toml(path: Path, source: str) -> dict[str, Any]:
    """The table in a file, UTF-8; errors as in `parse_toml`, and for a file that cannot be read."""
    try:
        text = path.read_text("utf-8")
    except UnicodeDecodeError as error:
        raise HilError(f"{source}: not TOML: {error}") from error
    except OSError as error:
        raise HilError(f"{source}: {error.strerror or error}") from error
    return parse_toml(text, source)
