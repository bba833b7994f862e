"""`hil navigate`: strapdown navigation of logged increments, from file to file, as docs/cli.md lays out."""

import math
import tomllib
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from nav.errors import HilError
from nav.increments import FloatArray
from nav.rotation import euler_from_quaternion, quaternion_from_euler
from nav.strapdown import Strapdown

IMU_HEADER = ("time_s", "dtheta_x", "dtheta_y", "dtheta_z", "dvel_x", "dvel_y", "dvel_z")
NAV_HEADER = (
    *("time_s", "lat_deg", "lon_deg", "height_m", "vel_north", "vel_east", "vel_down"),
    *("roll_deg", "pitch_deg", "heading_deg"),
)


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
            with np.load(path, allow_pickle=False) as archive:
                table = np.stack([np.asarray(archive[name], float) for name in header], axis=1)
        elif suffix == ".parquet":
            frame = _parquet().read_table(path, columns=list(header))
            table = np.stack([np.asarray(frame[name].to_numpy(), float) for name in header], axis=1)
        else:
            table = _read_csv(path, header)
    except OSError as error:
        raise HilError(f"{path}: {error.strerror or error}") from error
    except KeyError as error:
        raise HilError(f"{path}: no column {error}; expected {', '.join(header)}") from error
    except (ValueError, EOFError, BadZipFile) as error:  # not text, no archive, columns of unequal length
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
            parquet = _parquet()
            import pyarrow as pa

            parquet.write_table(pa.table({name: table[:, i] for i, name in enumerate(header)}), path)
        else:
            np.savetxt(path, table, fmt="%.17g", delimiter=",", header=",".join(header), comments="")
    except OSError as error:
        raise HilError(f"{path}: {error.strerror or error}") from error


def _parquet() -> Any:
    try:
        from pyarrow import parquet
    except ImportError as error:
        raise HilError("parquet files need pyarrow: pip install pyarrow, or use .csv or .npz") from error
    return parquet


def read_start(path: Path) -> dict[str, float]:
    """The start in INIT.toml: exactly the keys of `NAV_HEADER`, numbers.

    Raises
    ------
    HilError
        Missing file, not TOML, a key that is missing, unknown or no number.
    """
    try:
        table = tomllib.loads(path.read_text())
    except OSError as error:
        raise HilError(f"{path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise HilError(f"{path}: not TOML: {error}") from error
    for name in table:
        if name not in NAV_HEADER:
            raise HilError(f"{path}: unknown key {name!r}; expected {', '.join(NAV_HEADER)}")
    start = {}
    for name in NAV_HEADER:
        value = table.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise HilError(f"{path}: key {name} = {value!r}: expected a number")
        start[name] = float(value)
    if abs(start["lat_deg"]) > 90 or abs(start["pitch_deg"]) > 90:
        raise HilError(f"{path}: lat_deg and pitch_deg must lie in -90..90")
    return start


def navigate(
    table: FloatArray, start: dict[str, float], attitude: str, mechanization: str, gravity: str = "normal"
) -> FloatArray:
    """Navigation rows (n, 10: `NAV_HEADER`) of IMU rows (n, 7: `IMU_HEADER`) from `start`.

    Raises
    ------
    HilError
        Time does not increase, unknown method, or an increment is not a number.
    """
    time = table[:, 0]
    step = np.diff(time, prepend=start["time_s"])
    wrong = np.flatnonzero(step <= 0.0)
    if len(wrong):
        k = int(wrong[0])
        before = start["time_s"] if k == 0 else float(time[k - 1])
        raise HilError(f"row {k + 1}: time_s = {float(time[k])} does not come after {before}")
    core = Strapdown(attitude, mechanization, gravity, whole_record=True)
    core.start(
        math.radians(start["lat_deg"]),
        math.radians(start["lon_deg"]),
        start["height_m"],
        np.array([start["vel_north"], start["vel_east"], start["vel_down"]]),
        quaternion_from_euler(*np.radians([start["heading_deg"], start["pitch_deg"], start["roll_deg"]])),
    )
    n = len(table)
    position, velocity, quaternion = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
    dtheta, dvel = np.ascontiguousarray(table[:, 1:4]), np.ascontiguousarray(table[:, 4:7])
    core.advance(step, dtheta, dvel, np.zeros(3), position, velocity, quaternion)
    angles = np.degrees(euler_from_quaternion(quaternion))
    place = np.column_stack([np.degrees(position[:, :2]), position[:, 2]])
    return np.column_stack([time, place, velocity, angles[:, ::-1]])


def thin(rows: FloatArray, every_s: float) -> FloatArray:
    """Rows at least `every_s` apart, on the grid of `every_s` from the first; the last row is kept."""
    slot = np.floor((rows[:, 0] - rows[0, 0]) / every_s + 1e-9)
    keep = np.concatenate(([True], np.diff(slot) > 0))
    keep[-1] = True
    return rows[keep]
