"""What a person sees of `hil monitor`: tables that renew themselves in a terminal, lines elsewhere."""

from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

REFRESH_S = 0.25
PLAIN_S = 2.0
"""Time between lines where the output is no terminal."""
PLAIN_WIDTH = 180
SHOWN = 16
"""Bytes of a frame that are shown."""


class MonitorView:
    """Shows reports of a `hil.monitor.Monitor` on standard output; use as a context manager."""

    def __init__(self) -> None:
        self._console = Console(highlight=False)
        if not self._console.is_terminal:
            self._console = Console(highlight=False, width=PLAIN_WIDTH)
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self.period_s = REFRESH_S if self._console.is_terminal else PLAIN_S

    def __enter__(self) -> "MonitorView":
        if self._console.is_terminal:
            self._live.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        if self._console.is_terminal:
            self._live.__exit__(*error)

    def show(self, report: dict[str, Any]) -> None:
        """Renew what is seen."""
        if self._console.is_terminal:
            self._live.update(tables(report), refresh=True)
        else:
            self._console.print(headline(report), markup=False)

    def end(self, report: dict[str, Any]) -> None:
        """Print the whole, to stay."""
        self._console.print(tables(report))


def headline(report: dict[str, Any]) -> str:
    """Time, frames, load, board and losses in a line."""
    load = report["load"]
    parts = [
        f"{report['seconds']:.1f} s",
        f"{report['frames_hz']:.0f} frames/s",
        "load ?" if load is None else f"load {100 * load['least']:.1f}..{100 * load['most']:.1f} %",
        report["driver"] or "no known board",
        *(f"{name} {count}" for name, count in report["losses"].items() if count),
    ]
    return "  ".join([*parts, *(f"{name}: {text}" for name, text in report["lacking"].items())])


def tables(report: dict[str, Any]) -> RenderableType:
    """Signals and frames as tables."""
    parts: list[RenderableType] = [Text(headline(report))]
    identity = {name: value for name, value in report["identity"].items() if value is not None}
    if identity:
        parts.append(Text("  ".join(f"{name} {value}" for name, value in identity.items())))
    if report["signals"]:
        parts.append(_signals(report["signals"]))
    if report["ids"]:
        parts.append(_identifiers(report["ids"]))
    return Group(*parts)


def _signals(rows: list[dict[str, Any]]) -> Table:
    table = Table()
    for name in ("signal", "unit", "last", "mean", "noise", "density", "Hz", "min", "max", "age s"):
        table.add_column(name, justify="left" if name in {"signal", "unit"} else "right", no_wrap=True)
    for row in rows:
        density = "" if row["density"] is None else f"{row['density']:.4g} {row['density_unit']}"
        numbers = [f"{row[name]:.6g}" for name in ("last", "mean")]
        ends = [f"{row[name]:.6g}" for name in ("min", "max")]
        texts = (escape(row["name"]), escape(row["unit"]), *numbers, f"{row['std']:.4g}", density)
        table.add_row(*texts, f"{row['rate_hz']:.1f}", *ends, f"{row['age_s']:.1f}")
    return table


def _identifiers(rows: list[dict[str, Any]]) -> Table:
    table = Table()
    for name in ("id", "message", "frames", "Hz", "bytes", "age s", "last data"):
        table.add_column(name, justify="left" if name in {"id", "message", "last data"} else "right", no_wrap=True)
    for row in rows:
        numbers = (str(row["count"]), f"{row['rate_hz']:.1f}", str(row["length"]), f"{row['age_s']:.1f}")
        data = row["data"][: 3 * SHOWN - 1] + (" ..." if row["length"] > SHOWN else "")
        table.add_row(row["id"], escape(row["name"]), *numbers, data)
    return table
