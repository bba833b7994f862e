"""Recorded samples as tables: what `hil export` writes, and what `hil allan` looks at."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers import make_driver
from drivers.logs.imu_log import ImuLog
from hil.flight_log import is_flight_log, read_flight_log
from hil.offline import IMU_HEADER
from hil.source import FileSource, is_own, scenario_table
from hil.tables import TABLES, read_table
from nav.earth import STANDARD_GRAVITY
from nav.errors import HilError
from nav.increments import FloatArray, HeadIncrements, ImuIncrements
from nav.instruments.allan import AllanFit, allan
from nav.instruments.redundancy import GYRO_AXES

_SPACE = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class Samples:
    """Samples of a recording.

    Attributes
    ----------
    columns : dict of str to (n,) float
        ``time_s``, ``step_s``, ``sequence``, ``validity``, then increments by axis, rad and m/s, and what else the board sends.
    problem : str
        What was wrong with the recording; empty when nothing.
    """

    columns: dict[str, FloatArray]
    problem: str

    def __len__(self) -> int:
        return len(self.columns["time_s"])

    @property
    def axes(self) -> list[str]:
        """Names of the columns with increments."""
        return [name for name in self.columns if name.startswith(("dtheta_", "dvel_"))]


def read_samples(path: Path, driver_name: str | None = None) -> Samples:
    """Decode the samples in a recording, or read the IMU table of `hil navigate`.

    Parameters
    ----------
    path : Path
        A recording of frames, a flight log (``.ulg``, ``.bin``), or a table (``.csv``, ``.npz``, ``.parquet``) with the header of
        `hil navigate`.
    driver_name : str, optional
        Of the board; left out: that of the scenario in our own recording.

    Raises
    ------
    HilError
        The file cannot be read, holds no samples, or needs a driver's name.
    """
    if is_flight_log(path):
        return Samples(_columns(log_increments(read_flight_log(path))), "")
    if path.suffix.lower() in TABLES and not is_own(path):
        table = read_table(path, IMU_HEADER)
        step = np.diff(table[:, 0], prepend=2.0 * table[0, 0] - table[min(1, len(table) - 1), 0])
        order = {"sequence": np.arange(len(table), dtype=float), "validity": np.zeros(len(table))}
        named = dict(zip(IMU_HEADER, table.T, strict=True))
        return Samples({"time_s": named.pop("time_s"), "step_s": step, **order, **named}, "")
    driver, source = make_driver(driver_name or driver_of(path)), FileSource(path, paced=False)
    parts = [_columns(samples) for batch in source.batches(1024) if len(samples := driver.decode(batch))]
    if not parts:
        raise HilError(
            f"{path}: no samples of {driver_name or driver_of(path)} in it: give the board's driver with --imu"
        )
    return Samples({name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, source.problem())


def deviations(samples: Samples, shortest_s: float = 0.0) -> tuple[dict[str, AllanFit], int, float]:
    """Allan deviation of every axis from `shortest_s` on, in the longest stretch without a gap; its samples and period, s.

    Raises
    ------
    HilError
        The stretch is too short.
    """
    gaps = np.flatnonzero(np.diff(samples.columns["sequence"]) != 1.0) + 1
    edges = np.concatenate([[0], gaps, [len(samples)]])
    longest = int(np.argmax(np.diff(edges)))
    here = slice(int(edges[longest]), int(edges[longest + 1]))
    period = float(np.mean(samples.columns["step_s"][here]))
    return (
        {name: allan(samples.columns[name][here], period, shortest_s) for name in samples.axes},
        here.stop - here.start,
        period,
    )


def coefficients(axis: str, fit: AllanFit) -> dict[str, float]:
    """The coefficients of an axis in the units of data sheets; zero where the record does not show one."""
    if axis.startswith("dtheta"):
        deg = math.degrees(1.0)
        return {
            "rounding_arcsec": fit.rounding * deg * 3600.0,
            "white_deg_sqrt_h": fit.white * deg * 60.0,
            "flicker_deg_h": fit.flicker * deg * 3600.0,
            "walk_deg_h_sqrt_h": fit.walk * deg * 3600.0 * 60.0,
            "ramp_deg_h_h": fit.ramp * deg * 3600.0**2,
        }
    micro_g = 1e-6 * STANDARD_GRAVITY
    return {
        "rounding_ms": fit.rounding,
        "white_ug_sqrt_hz": fit.white / micro_g,
        "flicker_ug": fit.flicker / micro_g,
        "walk_ug_sqrt_s": fit.walk / micro_g,
        "ramp_ug_s": fit.ramp / micro_g,
    }


def log_increments(log: ImuLog) -> ImuIncrements:
    """The samples of a flight log."""
    step = np.asarray(log.step_us * 1e-6, np.float64)
    turn, push = log.rate * step[:, None], log.force * step[:, None]
    time = np.asarray(1e-6 * log.time_us, np.float64)
    return ImuIncrements(time, step, turn, push, np.zeros(len(step), np.int64), log.counter)


def driver_of(path: Path) -> str:
    """Driver of the board in our own recording.

    Raises
    ------
    HilError
        It is a recording of another kind, which does not say it.
    """
    if not is_own(path):
        raise HilError(f"{path}: it does not say what board is in it: give the driver with --imu")
    return str((scenario_table(path) or {}).get("driver", "dtg-head"))


def _columns(samples: HeadIncrements | ImuIncrements) -> dict[str, FloatArray]:
    columns: dict[str, Any] = {
        "time_s": samples.time,
        "step_s": samples.step,
        "sequence": samples.sequence,
        "validity": samples.validity,
    }
    head = isinstance(samples, HeadIncrements)
    columns |= {f"dtheta_{axis}": samples.dtheta[:, i] for i, axis in enumerate(GYRO_AXES if head else _SPACE)}
    columns |= {f"dvel_{axis}": samples.dvel[:, i] for i, axis in enumerate(_SPACE)}
    if isinstance(samples, HeadIncrements):
        columns |= {f"rotor_{axis}": samples.rotor[:, i] for i, axis in enumerate(GYRO_AXES)}
        columns |= {f"spin_g{i + 1}_hz": samples.spin[:, i] for i in range(2)}
        columns |= {f"temperature_{name}": samples.temperature[:, i] for i, name in enumerate(("g1", "g2", "a"))}
    return {name: np.array(values, float) for name, values in columns.items()}  # copies: they hold until the next batch
