"""`hil navigate`: strapdown navigation of logged increments, from file to file, as docs/cli.md lays out."""

import math
import sys
from pathlib import Path

import numpy as np

from hil.offline_filter import FilterConfig, read_filter
from hil.toml import read_toml
from nav.errors import HilError
from nav.increments import FloatArray
from nav.rotation import euler_from_quaternion, quaternion_from_euler
from nav.strapdown import Strapdown

IMU_HEADER = ("time_s", "dtheta_x", "dtheta_y", "dtheta_z", "dvel_x", "dvel_y", "dvel_z")
NAV_HEADER = (
    *("time_s", "lat_deg", "lon_deg", "height_m", "vel_north", "vel_east", "vel_down"),
    *("roll_deg", "pitch_deg", "heading_deg"),
)


def read_init(path: Path) -> tuple[dict[str, float], FilterConfig | None]:
    """The start in INIT.toml: the keys of `NAV_HEADER`, numbers; and its table ``[filter]``, if it has one.

    Raises
    ------
    HilError
        Missing file, not TOML, a key that is missing, unknown or of a wrong value.
    """
    table = read_toml(path, str(path))
    for name in table:
        if name not in (*NAV_HEADER, "filter"):
            raise HilError(f"{path}: unknown key {name!r}; expected {', '.join(NAV_HEADER)} and [filter]")
    start = {}
    for name in NAV_HEADER:
        value = table.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
            raise HilError(f"{path}: key {name} = {value!r}: expected a number")
        start[name] = float(value)
    if abs(start["lat_deg"]) > 90 or abs(start["pitch_deg"]) > 90:
        raise HilError(f"{path}: lat_deg and pitch_deg must lie in -90..90")
    return start, read_filter(table["filter"], f"{path}: filter") if "filter" in table else None


def navigate(
    table: FloatArray, start: dict[str, float], attitude: str, mechanization: str, gravity: str = "normal"
) -> FloatArray:
    """Navigation rows (n, 10: `NAV_HEADER`) of IMU rows (n, 7: `IMU_HEADER`) from `start`.

    Raises
    ------
    HilError
        Time does not increase, unknown method, or an increment is not a number.
    """
    step = steps(table, start)
    core = Strapdown(attitude, mechanization, gravity, whole_record=True)
    core.start(*start_of(start))
    n = len(table)
    position, velocity, quaternion = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
    dtheta, dvel = np.ascontiguousarray(table[:, 1:4]), np.ascontiguousarray(table[:, 4:7])
    core.advance(step, dtheta, dvel, np.zeros(3), position, velocity, quaternion)
    return nav_rows(table[:, 0], position, velocity, quaternion)


def steps(table: FloatArray, start: dict[str, float]) -> FloatArray:
    """Length of the step of each IMU row, s.

    Raises
    ------
    HilError
        Time does not increase.
    """
    time = table[:, 0]
    step: FloatArray = np.diff(time, prepend=start["time_s"])
    wrong = np.flatnonzero(step <= 0.0)
    if len(wrong):
        k = int(wrong[0])
        before = start["time_s"] if k == 0 else float(time[k - 1])
        raise HilError(f"row {k + 1}: time_s = {float(time[k])} does not come after {before}")
    return step


def start_of(start: dict[str, float]) -> tuple[float, float, float, FloatArray, FloatArray]:
    """lat, lon, height, vel_n, q_nb of a start."""
    return (
        math.radians(start["lat_deg"]),
        math.radians(start["lon_deg"]),
        start["height_m"],
        np.array([start["vel_north"], start["vel_east"], start["vel_down"]]),
        quaternion_from_euler(*np.radians([start["heading_deg"], start["pitch_deg"], start["roll_deg"]])),
    )


def nav_rows(time: FloatArray, position: FloatArray, velocity: FloatArray, attitude: FloatArray) -> FloatArray:
    """Rows of `NAV_HEADER` of solutions in rad, m, m/s, q_nb."""
    angles = np.degrees(euler_from_quaternion(attitude))
    place = np.column_stack([np.degrees(position[:, :2]), position[:, 2]])
    return np.column_stack([time, place, velocity, angles[:, ::-1]])


def thin(rows: FloatArray, every_s: float) -> FloatArray:
    """Rows at least `every_s` apart, on the grid of `every_s` from the first; the last row is kept."""
    slot = np.floor((rows[:, 0] - rows[0, 0]) / every_s + 1e-9)
    keep = np.concatenate(([True], np.diff(slot) > 0))
    keep[-1] = True
    return rows[keep]
