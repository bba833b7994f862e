"""Tables of numbers in files: ``.csv``, ``.npz`` or ``.parquet`` by their ending, a column a name."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from nav.errors import HilError
from nav.increments import FloatArray

TABLES = (".csv", ".npz", ".parquet")
"""Endings of such files."""


def read_table(path: Path, header: tuple[str, ...]) -> FloatArray:
    """The columns `header` of a ``.csv``, ``.npz`` or ``.parquet`` file as (n, len(header)) floats.

    Raises
    ------
    HilError
        Missing file, wrong header, a row that is not numbers (with its line), no rows.
    """
    suffix = path.suffix.lower()
    try:
        if suffix == ".npz":
            table = np.stack([np.asarray(column, float) for column in archived(path, header)], axis=1)
        elif suffix == ".parquet":
            frame = parquet().read_table(path, columns=list(header))
            table = np.stack([np.asarray(frame[name].to_numpy(), float) for name in header], axis=1)
        else:
            table = _read_csv(path, header)
    except OSError as error:
        raise HilError(f"{path}: {error.strerror or error}") from error
    except KeyError as error:
        raise HilError(f"{path}: no column {error}; expected {', '.join(header)}") from error
    except (ValueError, TypeError, NotImplementedError) as error:  # not text, unequal columns, no numbers in Parquet
        raise HilError(f"{path}: {error}") from error
    if len(table) == 0:
        raise HilError(f"{path}: no rows")
    bad = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if len(bad):
        raise HilError(f"{path}: row {bad[0] + 1} holds a value that is not a number")
    return table


def _read_csv(path: Path, header: tuple[str, ...]) -> FloatArray:
    with path.open(encoding="utf-8") as file:
        first = tuple(name.strip() for name in file.readline().split(","))
        if first != header:
            raise HilError(f"{path}: line 1: the header is {','.join(first)!r}, expected {','.join(header)!r}")
        try:
            table: FloatArray = np.loadtxt(file, delimiter=",", ndmin=2, comments=None)
        except ValueError:
            raise HilError(f"{path}: {_first_bad_line(path, len(header))}") from None
    if table.size and table.shape[1] != len(header):
        raise HilError(f"{path}: line 2: {table.shape[1]} columns, expected {len(header)}")
    return table.reshape(-1, len(header))


def _first_bad_line(path: Path, columns: int) -> str:
    with path.open(encoding="utf-8") as file:
        next(file)
        for number, line in enumerate(file, start=2):
            values = line.split(",")
            if line.strip() and len(values) != columns:
                return f"line {number}: {len(values)} columns, expected {columns}"
            for value in values:
                try:
                    float(value) if line.strip() else None
                except ValueError:
                    return f"line {number}: {value.strip()!r} is not a number"
    return "it cannot be read as numbers"


def write_table(path: Path, header: tuple[str, ...], table: FloatArray) -> None:
    """Write columns as ``.csv`` (full double precision), ``.npz`` or ``.parquet`` by file ending.

    Raises
    ------
    HilError
        The file cannot be written.
    """
    try:
        if path.suffix.lower() == ".npz":
            np.savez(path, **{name: table[:, i] for i, name in enumerate(header)})  # type: ignore[arg-type]
        elif path.suffix.lower() == ".parquet":
            import pyarrow as pa

            parquet().write_table(pa.table({name: table[:, i] for i, name in enumerate(header)}), path)
        else:
            np.savetxt(path, table, fmt="%.17g", delimiter=",", header=",".join(header), comments="")
    except OSError as error:
        raise HilError(f"{path}: {error.strerror or error}") from error


def archived(path: Path, header: tuple[str, ...]) -> list[NDArray[Any]]:
    """The columns `header` (n,) of a ``.npz`` file.

    Raises
    ------
    OSError
        The file cannot be read.
    KeyError
        A column is missing.
    ValueError
        It is no archive, or a column is no array of one dimension.
    """
    try:
        found = np.load(path, allow_pickle=False)
        if not isinstance(found, NpzFile):  # a bare array
            raise ValueError("no archive of columns")
        with found as archive:
            columns = [archive[name] for name in header]
    except (OSError, KeyError):
        raise
    except Exception as error:  # numpy and zipfile raise whatever the bytes provoke
        raise ValueError(f"not a readable .npz file: {error}") from error
    if not all(isinstance(column, np.ndarray) and column.ndim == 1 for column in columns):
        raise ValueError("a column is no array of one dimension")  # numpy hands on the bytes of a member that is none
    return columns


def parquet() -> Any:
    """`pyarrow.parquet`.

    Raises
    ------
    HilError
        It is not installed.
    """
    try:
        from pyarrow import parquet as module
    except ImportError as error:
        raise HilError("parquet files need pyarrow: pip install 'dtg-hil[parquet]', or use .csv or .npz") from error
    return module
