"""The file of measurements that `hil navigate --aid` takes, in units that people read, as docs/cli.md lays out."""

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drivers.can.aiding import AidingArray
from hil.tables import archived, parquet
from nav.aiding import AIDING, Kind
from nav.errors import HilError
from nav.increments import FloatArray
from nav.rotation import quaternion_from_euler

AID_HEADER = (
    *("time_s", "kind", "source"),
    *(f"value_{k}" for k in range(1, 7)),
    *(f"sigma_{k}" for k in range(1, 7)),
)
_FIRST_VALUE, _FIRST_SIGMA = 3, 9
_LAST_SOURCE = int(np.iinfo(AIDING["source"]).max)
_DEG = math.pi / 180.0


class _Units(NamedTuple):
    """What the numbers of a kind are multiplied by."""

    values: tuple[float, ...]
    sigmas: tuple[float, ...]


UNITS = {
    Kind.GNSS: _Units((_DEG, _DEG, 1.0, 1.0, 1.0, 1.0), (1.0,) * 6),
    Kind.BARO: _Units((1.0,), (1.0,)),
    Kind.MAGNETIC: _Units((1e-6,) * 3, (1e-6,) * 3),
    Kind.HEADING: _Units((_DEG,), (_DEG,)),
    Kind.ATTITUDE: _Units((_DEG,) * 3, (_DEG,) * 3),
    Kind.BODY_VELOCITY: _Units((1.0,) * 3, (1.0,) * 3),
    Kind.ZERO_RATE: _Units((), (_DEG,) * 3),
    Kind.GRAVITY: _Units((), (1.0,) * 2),
}
"""Degrees, metres, m/s, microtesla, degrees/s, m/s^2. An attitude is roll, pitch, heading."""


def read_aiding(path: Path) -> AidingArray:
    """Measurements of a ``.csv``, ``.npz`` or ``.parquet`` file with the columns `AID_HEADER`, in the order of their times.

    Raises
    ------
    HilError
        Missing file, wrong header, or a row that means nothing, with its line and column.
    """
    suffix = path.suffix.lower()
    try:
        lines = list(_archive(path) if suffix == ".npz" else _frame(path) if suffix == ".parquet" else _text(path))
    except OSError as error:
        raise HilError(f"{path}: {error.strerror or error}") from error
    except KeyError as error:
        raise HilError(f"{path}: no column {error}; expected {', '.join(AID_HEADER)}") from error
    except (ValueError, NotImplementedError, csv.Error) as error:  # no text, archive or table
        raise HilError(f"{path}: {error}") from error
    if not lines:
        raise HilError(f"{path}: no rows")
    rows = np.zeros(len(lines), AIDING)
    for row, (place, cells) in zip(rows, lines, strict=True):
        _Line(f"{path}: {place}", cells).fill(row)
    return rows[np.argsort(rows["time"], kind="stable")]


def _text(path: Path) -> Iterator[tuple[str, list[Any]]]:
    with path.open(encoding="utf-8", newline="") as file:
        lines = csv.reader(file)
        first = tuple(name.strip() for name in next(lines, []))
        if first != AID_HEADER:
            raise HilError(f"{path}: line 1: the header is {','.join(first)!r}, expected {','.join(AID_HEADER)!r}")
        for cells in lines:
            if len(cells) > len(AID_HEADER):
                raise HilError(f"{path}: line {lines.line_num}: {len(cells)} columns, expected {len(AID_HEADER)}")
            if any(cell.strip() for cell in cells):
                yield f"line {lines.line_num}", [cell.strip() for cell in cells]


def _archive(path: Path) -> Iterator[tuple[str, list[Any]]]:
    yield from _numbered([column.tolist() for column in archived(path, AID_HEADER)])


def _frame(path: Path) -> Iterator[tuple[str, list[Any]]]:
    frame = parquet().read_table(path, columns=list(AID_HEADER))
    yield from _numbered([frame[name].to_pylist() for name in AID_HEADER])


def _numbered(columns: list[list[Any]]) -> Iterator[tuple[str, list[Any]]]:
    """Rows of columns; a value that is not there is NaN or null in them."""
    for number, cells in enumerate(zip(*columns, strict=True), start=1):
        yield f"row {number}", ["" if cell is None or cell != cell else cell for cell in cells]  # noqa: PLR0124


class _Line:
    """One line, and where it stands."""

    def __init__(self, place: str, cells: list[Any]) -> None:
        self.place, self.cells = place, [*cells, *[""] * (len(AID_HEADER) - len(cells))]

    def fill(self, row: np.void) -> None:
        """Fill a row of `AIDING`."""
        kind = self._kind()
        units, time, source = UNITS[kind], self._number(0), self._number(2)
        if time is None:
            raise self._refusal(0, "a time is needed")
        if source is None or source % 1.0 or not 0 <= source <= _LAST_SOURCE:
            raise self._refusal(2, f"expected a whole number in 0..{_LAST_SOURCE}")
        values = self._numbers(_FIRST_VALUE, units.values, kind)
        sigmas = self._numbers(_FIRST_SIGMA, units.sigmas, kind)
        self._check(kind, values, sigmas)
        row["time"], row["kind"], row["source"], row["sigma"] = time, kind, source, np.inf
        row["sigma"][: len(sigmas)] = np.where(np.isnan(sigmas), np.inf, sigmas)
        if kind == Kind.ATTITUDE:
            roll, pitch, heading = values
            row["value"][:4] = quaternion_from_euler(heading, pitch, roll)
        else:
            row["value"][: len(values)] = np.nan_to_num(values)

    def _kind(self) -> Kind:
        cell = self.cells[1]
        try:
            return Kind(cell) if isinstance(cell, int) else Kind[str(cell).upper()]
        except (KeyError, ValueError):
            raise self._refusal(1, f"expected {', '.join(kind.name.lower() for kind in Kind)}") from None

    def _numbers(self, first: int, units: tuple[float, ...], kind: Kind) -> FloatArray:
        """The numbers that a kind has, NaN where there is none; the cells behind them must be empty."""
        found = [self._number(first + k) for k in range(6)]
        for k in range(len(units), 6):
            if found[k] is not None:
                raise self._refusal(first + k, f"{kind.name.lower()} has {len(units)} of these: leave it empty")
        return np.array([math.nan if n is None else n * u for n, u in zip(found, units, strict=False)], float)

    def _check(self, kind: Kind, values: FloatArray, sigmas: FloatArray) -> None:
        used = np.isfinite(sigmas)
        if not used.any():
            raise self._refusal(_FIRST_SIGMA, f"{kind.name.lower()} needs a sigma: what has none is not used")
        for k in np.flatnonzero(used & ~(sigmas > 0.0)):
            raise self._refusal(_FIRST_SIGMA + int(k), "a sigma must be positive")
        needed = np.full(len(values), kind == Kind.ATTITUDE) | used[: len(values)]
        for k in np.flatnonzero(needed & np.isnan(values)):
            raise self._refusal(_FIRST_VALUE + int(k), "there is a sigma and no value")
        if kind == Kind.GNSS and abs(np.nan_to_num(values[0])) > 0.5 * math.pi:
            raise self._refusal(_FIRST_VALUE, "a latitude lies in -90..90")
        if kind == Kind.ATTITUDE and abs(values[1]) > 0.5 * math.pi:
            raise self._refusal(_FIRST_VALUE + 1, "a pitch lies in -90..90")

    def _number(self, column: int) -> float | None:
        cell = self.cells[column]
        if cell == "":
            return None
        try:
            number = float(cell)
        except (TypeError, ValueError):
            raise self._refusal(column, "not a number") from None
        if not math.isfinite(number):
            raise self._refusal(column, "not a finite number; leave a cell empty for what is not there")
        return number

    def _refusal(self, column: int, why: str) -> HilError:
        return HilError(f"{self.place}: {AID_HEADER[column]} = {self.cells[column]!r}: {why}")
