"""Plots, through matplotlib (extra ``plot``)."""

from pathlib import Path
from typing import Any

import numpy as np

from hil.reference import Reference
from nav.errors import HilError
from nav.rotation import euler_from_quaternion


def check_plot(path: Path) -> None:
    """Refuse a plot that cannot be drawn, before the run.

    Raises
    ------
    HilError
        matplotlib is missing, or the ending is not one that it writes.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise HilError("plots need matplotlib: pip install 'dtg-hil[plot]'") from error
    kinds = FigureCanvasAgg(Figure()).get_supported_filetypes()
    if path.suffix.lstrip(".") not in kinds:
        raise HilError(f"--plot {path}: unknown ending; there is: {', '.join(sorted(kinds))}")


def plot_difference(path: Path, reference: Reference, trace: Any, title: str) -> None:
    """Attitude of the log and ours over time, and their difference.

    Raises
    ------
    HilError
        The file cannot be written.
    """
    from matplotlib.figure import Figure

    times, attitudes = trace
    start = reference.start
    figure = Figure(figsize=(9, 7), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    for values, at, style in ((attitudes, times, "-"), (reference.q_nb, reference.time, ":")):
        angles = np.degrees(euler_from_quaternion(values))
        angles[:, 0] = (angles[:, 0] + 180.0) % 360.0 - 180.0
        for i, (name, colour) in enumerate((("heading", "C0"), ("pitch", "C1"), ("roll", "C2"))):
            upper.plot(at - start, angles[:, i], style, color=colour, label=f"{name}{'' if style == '-' else ' (log)'}")
    upper.set_ylabel("attitude, deg")
    upper.legend(ncols=2, fontsize="small")
    upper.set_title(title)
    at, total, tilt, heading = reference.errors(times, attitudes)
    for name, difference in (("total", total), ("tilt", tilt), ("heading", heading)):
        lower.plot(at - start, np.degrees(difference), label=name)
    lower.set_ylabel("ours less the log's, deg")
    lower.set_xlabel("time from the start of the log, s")
    lower.legend()
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
    try:
        figure.savefig(path)
    except OSError as error:
        raise HilError(f"--plot {path}: {error.strerror}") from error
