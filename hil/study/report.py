"""The one form of a study's result, and the one writer of it: JSON, one self-contained HTML file, SVG figures."""

import html
import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from nav.errors import HilError
from nav.increments import FloatArray


@dataclass(frozen=True, slots=True)
class Row:
    """One figure.

    Attributes
    ----------
    id : str
        Unique in the study, without blanks.
    what : str
        In words.
    published : float or None
        The source's figure.
    reference : float or None
        A closed form, or what a peer gets.
    ours : float
        What was measured.
    unit : str
        Of the figures and the limit.
    limit : float or None
        How far ours may be from the published figure (`near`, or from the reference where nothing is published), or how
        large ours may be (`at_most`).
    ok : bool
        Whether it is within; true where there is no limit.
    """

    id: str
    what: str
    published: float | None
    reference: float | None
    ours: float
    unit: str
    limit: float | None
    ok: bool

    def as_dict(self) -> dict[str, Any]:
        """For JSON: numbers that are not finite become null."""
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in asdict(self).items()}


def near(
    id: str,
    what: str,
    ours: float,
    unit: str,
    limit: float,
    *,
    published: float | None = None,
    reference: float | None = None,
) -> Row:
    """A row whose figure must be within `limit` of the published one, or of the reference where nothing is published."""
    target = published if published is not None else reference
    if target is None:
        raise ValueError(f"{id}: near what?")
    return Row(id, what, published, reference, float(ours), unit, float(limit), bool(abs(ours - target) <= limit))


def at_most(
    id: str,
    what: str,
    ours: float,
    unit: str,
    limit: float,
    *,
    published: float | None = None,
    reference: float | None = None,
) -> Row:
    """A row whose figure must not be larger than `limit`."""
    return Row(id, what, published, reference, float(ours), unit, float(limit), bool(ours <= limit))


def shown(
    id: str, what: str, ours: float, unit: str, *, published: float | None = None, reference: float | None = None
) -> Row:
    """A row without a limit."""
    return Row(id, what, published, reference, float(ours), unit, None, True)


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a figure."""

    label: str
    x: FloatArray
    y: FloatArray
    style: str = "-"


@dataclass(frozen=True, slots=True)
class Band:
    """A shaded band of a figure."""

    label: str
    x: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, slots=True)
class Plot:
    """A figure as data: drawn only where it is written."""

    id: str
    title: str
    x_label: str
    y_label: str
    lines: Sequence[Line]
    log: bool = False
    bands: Sequence[Band] = ()


@dataclass(frozen=True, slots=True)
class Study:
    """What a study found.

    Attributes
    ----------
    name, title, about : str
        Name, headline, and a paragraph that says what was done.
    rows : sequence of Row
    plots : sequence of Plot
    """

    name: str
    title: str
    about: str
    rows: Sequence[Row]
    plots: Sequence[Plot] = field(default_factory=tuple)

    @property
    def ok(self) -> bool:
        """Whether every row is within its limit."""
        return all(row.ok for row in self.rows)


def write(study: Study, out: Path) -> list[Path]:
    """Write ``NAME.json``, ``NAME-FIGURE.svg`` and ``NAME.html`` into the folder `out`; the paths.

    Raises
    ------
    HilError
        The folder cannot be written, or matplotlib is missing.
    """
    drawings = [_draw(plot) for plot in study.plots]
    rows = {"study": study.name, "rows": [row.as_dict() for row in study.rows]}
    files = {f"{study.name}.json": json.dumps(rows, indent=1) + "\n"}
    for plot, drawing in zip(study.plots, drawings, strict=True):
        files[f"{study.name}-{plot.id}.svg"] = drawing
    files[f"{study.name}.html"] = _page(study, drawings)
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (out / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise HilError(f"study {study.name}: cannot write into {out}: {error.strerror}") from error
    return [out / name for name in files]


def _draw(plot: Plot) -> str:
    """The figure as SVG, the same bytes for the same data."""
    try:
        import matplotlib
        from matplotlib.backends.backend_svg import FigureCanvasSVG
        from matplotlib.figure import Figure
    except ImportError as error:
        raise HilError("reports need matplotlib: pip install 'dtg-hil[plot]'") from error
    with matplotlib.rc_context({"svg.hashsalt": plot.id, "svg.fonttype": "none"}):
        figure = Figure(figsize=(8, 5), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.subplots()
        for i, line in enumerate(plot.lines):
            style = line.style.replace("-", ("-", "--", ":")[i // 10 % 3])  # after ten lines the colours come again
            axes.plot(line.x, line.y, style, label=line.label or None, linewidth=1.2, markersize=4)
        for band in plot.bands:
            axes.fill_between(band.x, band.low, band.high, alpha=0.2, label=band.label)
        if plot.log:
            axes.set_xscale("log")
            axes.set_yscale("log")
        axes.set_xlabel(plot.x_label)
        axes.set_ylabel(plot.y_label)
        axes.set_title(plot.title)
        axes.grid(alpha=0.3)
        if len(plot.lines) + len(plot.bands) > 1:
            figure.legend(fontsize="x-small", loc="outside right upper")
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _number(value: float | None) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value:.3g}"


_HEAD = """<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body {{ font: 15px/1.45 system-ui, sans-serif; max-width: 72em; margin: 2em auto; padding: 0 1em; }}
table {{ border-collapse: collapse; }} td, th {{ padding: .15em .7em; border-bottom: 1px solid #ddd; text-align: left; }}
td.n, th.n {{ text-align: right; font-variant-numeric: tabular-nums; }} tr.bad {{ background: #fdd; }}
svg {{ max-width: 100%; height: auto; }}
</style></head><body><h1>{title}</h1><p>{about}</p>
"""


def _page(study: Study, drawings: Sequence[str]) -> str:
    parts = [_HEAD.format(title=html.escape(study.title), about=html.escape(study.about))]
    numeric = ("published", "reference", "ours", "limit")
    heads = ("", *numeric, "unit", "within")
    parts.append(
        "<table><tr>" + "".join(f'<th class="{"n" if h in numeric else ""}">{h}</th>' for h in heads) + "</tr>\n"
    )
    for row in study.rows:
        cells = "".join(f'<td class="n">{_number(getattr(row, name))}</td>' for name in numeric)
        verdict = "" if row.limit is None else "yes" if row.ok else "no"
        parts.append(
            f'<tr id="{html.escape(row.id)}" class="{"" if row.ok else "bad"}"><td>{html.escape(row.what)}</td>{cells}'
            f"<td>{html.escape(row.unit)}</td><td>{verdict}</td></tr>\n"
        )
    parts.append("</table>\n")
    parts += [f"<figure>{drawing[drawing.index('<svg') :]}</figure>\n" for drawing in drawings]
    parts.append("</body></html>\n")
    return "".join(parts)
