"""Plots, through matplotlib (extra ``plot``)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hil.clock_log import ClockLog
from hil.reference import Reference
from nav.earth import STANDARD_GRAVITY
from nav.errors import HilError
from nav.instruments.allan import AllanFit
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
    _save(figure, path)


def plot_deviations(path: Path, fits: Mapping[str, AllanFit], title: str) -> None:
    """Allan deviations of gyros and accelerometers, and the fitted curves.

    Raises
    ------
    HilError
        The file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 8), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    for axes, kind, scale, unit in (
        (upper, "dtheta_", np.degrees(3600.0), "gyros, deg/h"),
        (lower, "dvel_", 1e6 / STANDARD_GRAVITY, "accelerometers, ug"),
    ):
        for number, (name, fit) in enumerate((n, f) for n, f in fits.items() if n.startswith(kind)):
            axes.loglog(fit.tau, fit.deviation * scale, ".", color=f"C{number}", label=name.removeprefix(kind))
            axes.loglog(fit.tau, fit.curve(fit.tau) * scale, "-", color=f"C{number}", linewidth=0.8)
        axes.set_ylabel(unit)
        axes.legend(fontsize="small")
        axes.grid(alpha=0.3, which="both")
    upper.set_title(f"Allan deviation, {title}")
    lower.set_xlabel("tau, s")
    _save(figure, path)


def plot_clock(path: Path, log: ClockLog, title: str) -> None:
    """What each arrival lies above the line of the clock's fit and the line's bound, and the drift, over device time.

    Raises
    ------
    HilError
        The file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 7), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    upper.plot(log.time, 1e6 * log.age, ",", color="C0", rasterized=True, label="arrival over the line")
    known = np.isfinite(log.bound)
    upper.plot(log.time[known], 1e6 * log.bound[known], color="C1", linewidth=1.0, label="bound of the line")
    upper.set_yscale("symlog", linthresh=1.0)
    upper.set_ylim(bottom=0.0)
    upper.set_ylabel("us")
    upper.set_title(title)
    lower.plot(log.time[known], 1e6 * log.drift[known], color="C0", linewidth=1.0)
    lower.set_ylabel("drift of the device, ppm")
    lower.set_xlabel("device time, s")
    for axes in (upper, lower):
        for number, step in enumerate(log.steps):
            axes.axvline(step.time_s, color="C3", linestyle="--", label="" if number else "step")
        axes.grid(alpha=0.3)
    upper.legend(fontsize="small")
    _save(figure, path)


def _save(figure: Any, path: Path) -> None:
    try:
        figure.savefig(path)
    except OSError as error:
        raise HilError(f"--plot {path}: {error.strerror}") from error
