"""What a person sees of a run: events as they happen, a status line, the summary table."""

import math
import sys
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from hil.clock import clock_reading
from hil.session import Session
from nav.rotation import euler_from_quaternion
from nav.state import Health, Mode

REFRESH_S = 0.2
PLAIN_S = 5.0
"""Time between status lines where the output is no terminal."""
_COLOURS = {"info": "green", "notice": "cyan", "warning": "yellow", "error": "bold red"}


class RunView:
    """Shows a session on standard error; use as a context manager and call `refresh` often."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._console = Console(stderr=True, highlight=False)
        self._live = Live(console=self._console, refresh_per_second=1 / REFRESH_S, transient=True, auto_refresh=False)
        self._terminal = self._console.is_terminal
        self._last_samples = 0
        self._last_s = 0.0
        self._plain_s = 0.0
        self._said_compiling = False
        self._problems = 0

    def __enter__(self) -> "RunView":
        if self._terminal:
            self._live.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self.show_events()
        if self._terminal:
            self._live.__exit__(*error)

    def show_compiling(self) -> None:
        """Say how far the compilation is."""
        done, total = self._session.compiling()
        if self._terminal:
            filled = round(20 * done / total)
            bar = "#" * filled + "." * (20 - filled)
            self._live.update(
                Text(f"preparing the kernels (the first run compiles them) [{bar}] {done}/{total}"), refresh=True
            )
        elif not self._said_compiling:
            self._said_compiling = True
            self._console.print("preparing the kernels (the first run compiles them, up to a minute)")

    def show_events(self) -> None:
        """Print what happened."""
        for time, severity, text in self._session.events():
            self._console.print(f"[{_COLOURS.get(severity, 'white')}]{time:10.3f} s  {escape(text)}[/]")
        for problem in self._session.problems[self._problems :]:
            self._console.print(f"[{_COLOURS['error']}]{escape(problem)}[/]")
            self._problems += 1

    def refresh(self, now_s: float) -> None:
        """Print events and renew the status line."""
        self.show_events()
        if self._terminal:
            self._live.update(Text(self._line(now_s)), refresh=True)
        elif now_s - self._plain_s >= PLAIN_S:
            self._plain_s = now_s
            self._console.print(self._line(now_s), markup=False)

    def _line(self, now_s: float) -> str:
        stats, state = self._session.outlets.stats, self._session.state()
        if state is None:
            return f"waiting for samples on {self._session.order.scenario.bus}"
        samples = stats["samples"]
        rate = (samples - self._last_samples) / (now_s - self._last_s) if self._last_s else 0.0
        self._last_samples, self._last_s = samples, now_s
        mode, health = Mode(int(state["mode"])), Health(int(state["health"]))
        parts = [
            f"{state['time']:8.1f} s",
            f"{rate:6.0f} Hz",
            f"age {stats['age_us'] / 1000:.2f} ms",
            f"lost {stats['lost']}",
        ]
        if (clock := clock_reading(stats)) is not None:
            parts.append(f"clock {clock.drift_ppm:+.1f} ppm")
        if mode == Mode.ALIGN:
            parts.append(f"ALIGN {100 * float(state['progress']):.0f} %")
        else:
            parts.append(mode.name)
        if health:
            parts.append(str(health.name).lower().replace("|", "+"))
        if mode >= Mode.NAVIGATE:
            heading, pitch, roll = (math.degrees(angle) for angle in euler_from_quaternion(state["q_nb"]))
            parts.append(f"hdg {round(heading, 2) % 360:6.2f} pitch {pitch:6.2f} roll {roll:7.2f} deg")
            speed = math.hypot(*state["vel_n"])
            parts.append(f"{speed:.1f} m/s  {state['height']:.0f} m")
        if stats["position_error_mm"] >= 0:
            parts.append(f"pos. error {stats['position_error_mm'] / 1000:.3f} m")
        return "  ".join(parts)


def print_summary(summary: dict[str, Any]) -> None:
    """The summary as tables on standard output."""
    console = Console(highlight=False)
    table = Table(title=f"run {summary['scenario']}", show_header=False)
    latency = summary["latency_us"]
    for name, value in (
        ("mode at the end", summary.get("mode", "unknown")),
        ("samples", f"{summary['samples']} in {summary['device_s']:.3f} s ({summary['rate_hz']:.1f} Hz)"),
        ("speed", f"{summary['speed']:.2f} x real time ({summary['wall_s']:.2f} s)"),
        ("lost, duplicated, late", f"{summary['lost']}, {summary['duplicated']}, {summary['late']}"),
        (
            "bad check, foreign, short, other version",
            f"{summary['crc_errors']}, {summary['foreign']}, {summary['short']}, {summary['version_errors']}",
        ),
        (
            "head restarts, steps made up, silences",
            f"{summary['restarts']}, {summary['interpolated']}, {summary['silences']}",
        ),
        (
            "latency, frame to solution",
            f"p50 {latency['p50']:.0f} us, p99 {latency['p99']:.0f} us, max {latency['max']:.0f} us"
            if latency["max"]
            else "-",
        ),
        ("MAVLink messages sent", str(sum(summary["mavlink_sent"].values()))),
    ):
        table.add_row(name, value)
    if (clock := summary.get("clock", {})).get("bound_us") is not None:
        own = f"{clock['drift_ppm']:+.3f} ppm, known to {clock['bound_us']:.3g} us, {clock['steps']} steps"
        table.add_row("clock of the device", own)
    if "estimate" in summary:
        sigma = summary["estimate"]["sigma"]
        own = f"{sigma['position_m']:.3g} m, {sigma['velocity_ms']:.3g} m/s, {sigma['attitude_deg']:.3g} deg"
        table.add_row("own sigma at the end", own)
    if summary["frozen"] or summary["clock_steps"]:
        table.add_row("frozen counter, clock steps", f"{summary['frozen']}, {summary['clock_steps']}")
    if "bus_errors" in summary:
        table.add_row("CAN controller", ", ".join(f"{name} {count}" for name, count in summary["bus_errors"].items()))
    if summary.get("overflowed"):
        table.add_row("frames dropped by the kernel", str(summary["overflowed"]))
    for receiver in summary.get("receivers", []):
        refused = ", ".join(f"{count} {reason}" for reason, count in receiver.get("refused", {}).items())
        fixes = (
            f"{receiver.get('fixes', 0)} fixes by {receiver.get('speaks') or 'nothing'}; refused: {refused or 'none'}"
        )
        table.add_row(f"receiver at {escape(receiver.get('port', '?'))}", fixes)
    if "recorder" in summary:
        recorder = summary["recorder"]
        table.add_row("recorded", f"{recorder['frames']} frames to {recorder['file']}, {recorder['lost']} lost")
    if "smoothed" in summary:
        smoothed = summary["smoothed"]
        table.add_row("smoothed", f"{smoothed['rows']} rows to {smoothed['file']}")
    if "problem" in summary:
        table.add_row("problem", escape(summary["problem"]))
    console.print(table)
    for key, title in (
        ("error", "error against the simulated truth"),
        ("difference", "difference from the log's own attitude, from 10 s on"),
        ("baseline", "the same for plain integration of the raw gyro"),
    ):
        if summary.get(key):
            _print_spreads(console, title, summary[key])
    if "error" in summary.get("smoothed", {}):
        _print_spreads(console, "error of the smoothed navigation", summary["smoothed"]["error"])
    for problem in summary.get("problems", []):
        print(problem, file=sys.stderr)


def print_calibration(file: Any, rows: list[dict[str, Any]]) -> None:
    """A calibration as a table on standard output."""
    console = Console(highlight=False)
    table = Table(title=f"head {file.serial}, {file.date}")
    for column in ("", "axis", "value", "sigma"):
        table.add_column(column, justify="right" if column in {"value", "sigma"} else "left")
    for row in rows:
        known = row["sigma"] is not None
        value, sigma = (f"{row['value']:.6g}", f"{row['sigma']:.2g}") if known else ("-", "not determined")
        table.add_row(row["key"], row["axis"], value, sigma)
    console.print(table)
    if file.residual is not None:
        left = file.residual
        gyro, force = (", ".join(f"{one:.3g}" for one in part) for part in (left.gyro_deg_h, left.accelerometer_ug))
        print(f"left over, rms: gyros {gyro} deg/h; accelerometers {force} ug")
        print(
            f"positions {left.positions}, turns {left.turns}; outputs repeat {left.factor[0]:.2f} (gyros) and "
            f"{left.factor[1]:.2f} (accelerometers) times as their white noise"
        )


def _print_spreads(console: Console, title: str, spreads: dict[str, dict[str, float]]) -> None:
    table = Table(title=title)
    for column in ("", "rms", "max", "final"):
        table.add_column(column, justify="left" if not column else "right")
    for name, spread in spreads.items():
        table.add_row(name, *(f"{spread[part]:.6g}" for part in ("rms", "max", "final")))
    console.print(table)


def show_deviations(title: str, rows: list[dict[str, Any]], left_out: int) -> None:
    """Coefficients of the Allan deviation by axis, gyros and accelerometers each in a table of their own."""
    console = Console(highlight=False)
    for kind in ("dtheta_", "dvel_"):
        mine = [row for row in rows if row["axis"].startswith(kind)]
        table = Table(title=title if kind == "dtheta_" else None)
        for name in mine[0]:
            table.add_column(name.replace("_", "\n", 1))
        for row in mine:
            axis, *values = row.values()
            table.add_row(axis.removeprefix(kind), *(f"{value:.4g}" if value else "-" for value in values))
        console.print(table)
    if left_out:
        console.print(f"{left_out} samples beyond gaps are left out: the longest stretch without one counts")
