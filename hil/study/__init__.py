"""Studies: the published tables and figures beside our own, each repeatable by its name."""

from importlib import import_module
from pathlib import Path
from typing import Any

from hil.study.report import Study, write
from nav.errors import HilError

_MODULES = {
    name: f"hil.study.{name}"
    for name in (
        "orientation",
        "navigation",
        "noise",
        "dtg",
        "pendulum",
        "redundancy",
        "drift",
        "alignment",
        "aiding",
        "tracking",
        "clock",
    )
}
"""Studies by name: modules with a function ``run() -> Study``."""


def study_names() -> tuple[str, ...]:
    """What there is."""
    return tuple(_MODULES)


def study(name: str, out: Path | None = None) -> list[dict[str, Any]]:
    """Run a study.

    Parameters
    ----------
    name : str
        Which; see `study_names`.
    out : Path, optional
        Folder for ``NAME.json``, ``NAME.html`` and the figures ``NAME-FIGURE.svg``; made where it is missing.

    Returns
    -------
    list of dict
        Rows with the keys of `hil.study.report.Row`. The study failed where one has ``ok`` false.

    Raises
    ------
    HilError
        There is no such study, the folder cannot be written, or matplotlib is missing and `out` is given.
    """
    if name not in _MODULES:
        raise HilError(f"unknown study {name!r}; there is: {', '.join(_MODULES)}")
    result: Study = import_module(_MODULES[name]).run()
    if out is not None:
        write(result, out)
    return [row.as_dict() for row in result.rows]
