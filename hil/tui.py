"""A run in the terminal, for those who come by ssh: what the window shows in words and numbers, and keys for its orders."""

import contextlib
import math
import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from typing import Any

from rich.console import Console, Group
from rich.layout import Layout
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from hil.dashboard.view import Sources, View
from hil.session import Session
from nav.errors import HilError
from nav.state import Mode

_SEVERITIES = {"info": "green", "notice": "cyan", "warning": "yellow", "error": "bold red"}
_HORIZON_ROWS, _HORIZON_COLUMNS, _DEGREES_PER_ROW = 9, 27, 5.0
_MESSAGES = 8


def check_terminal() -> None:
    """Refuse where keys and a screen are not to be had.

    Raises
    ------
    HilError
        Standard input or standard error is no terminal.
    """
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise HilError("--tui needs a terminal: over ssh give -t, and redirect neither input nor standard error")


class TerminalView:
    """Shows a session on the terminal's other screen; use as a context manager and call `refresh` often.

    Parameters
    ----------
    session : Session
        What is shown.
    stop : callable
        Called on the key q.
    """

    def __init__(self, session: Session, stop: Callable[[], None]) -> None:
        self._session, self._stop = session, stop
        self._view = View(Sources(session.order, session.outlets, session.links))
        self._console = Console(stderr=True, highlight=False)
        self._live = Live(console=self._console, screen=True, auto_refresh=False)
        self._keys = contextlib.ExitStack()
        self._fast: dict[str, Any] | None = None

    def __enter__(self) -> "TerminalView":
        self._keys.enter_context(_single_keys())
        self._live.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._live.__exit__(*error)
        self._keys.close()

    def show_compiling(self) -> None:
        """Say how far the compilation is."""
        done, total = self._session.compiling()
        self._obey()
        self._live.update(Text(f"preparing the kernels (the first run compiles them) {done}/{total}"), refresh=True)

    def show_events(self) -> None:
        """Print what happened; on the terminal's own screen, once the run is over."""
        if not self._live.is_started:
            for time, severity, text in self._session.events():
                self._console.print(f"{time:10.3f} s  {text}", style=_SEVERITIES.get(severity), markup=False)

    def refresh(self, now_s: float) -> None:
        """Obey the keys and draw anew."""
        del now_s  # the view looks at its own clock
        self._obey()
        if self._view.look():
            self._fast = self._view.fast()
        self._live.update(self._drawn(self._view.slow()), refresh=True)

    def _obey(self) -> None:
        while select.select([sys.stdin], [], [], 0.0)[0]:
            key = os.read(sys.stdin.fileno(), 1)
            if key in (b"q", b""):
                self._stop()
                return
            if (order := {b"a": "align", b"m": "mark"}.get(key)) is not None:
                self._view.order(order)

    def _drawn(self, slow: dict[str, Any]) -> Layout:
        layout = Layout()
        layout.split_column(
            Layout(self._head(slow), name="head", size=3),
            Layout(name="middle", size=_HORIZON_ROWS + 5),
            Layout(name="counts", size=9),
            Layout(Panel(self._messages(), title="messages", title_align="left"), minimum_size=4),
            Layout(Text(" a align   m mark   q quit", style="dim"), size=1),
        )
        fast = self._fast
        if fast is None or "losses" not in slow:
            layout["middle"].update(Panel(Text(f"waiting for samples on {self._session.order.scenario.bus}")))
            layout["counts"].update(Panel(""))
            return layout
        layout["middle"].split_row(
            Layout(Panel(_attitude(fast), title="attitude", title_align="left"), size=_HORIZON_COLUMNS + 6),
            Layout(Panel(_motion(fast), title="position and rates", title_align="left")),
        )
        layout["counts"].split_row(
            Layout(Panel(_losses(slow["losses"]), title="losses", title_align="left"), size=_HORIZON_COLUMNS + 6),
            Layout(Panel(_links(slow), title="bus and links", title_align="left")),
        )
        return layout

    def _head(self, slow: dict[str, Any]) -> Panel:
        text = Text(self._session.order.scenario.name, style="bold")
        mode = slow.get("mode", slow["state"])
        colour = {"NAVIGATE": "green", "DEGRADED": "bold red"}.get(mode, "yellow")
        text.append(f"   {mode}", colour)
        if mode == Mode.ALIGN.name:
            text.append(f" {100 * (slow['progress'] or 0.0):.0f} %", colour)
        for one in slow.get("health", ()):
            text.append(f"  {one['name'].lower()}", "bold red" if one["bad"] else "yellow")
        if "device_s" in slow:
            text.append(f"   {slow['device_s']:.1f} s   {slow['rate_hz']:.0f} Hz   age {slow['age_us'] / 1e3:.2f} ms")
        return Panel(text)

    def _messages(self) -> Group:
        return Group(
            *(
                Text(f"{one['t']:10.3f} s  {one['text']}", style=_SEVERITIES.get(one["severity"], ""), no_wrap=True)
                for one in list(self._view.events)[-_MESSAGES:]
            )
        )


def _attitude(fast: dict[str, Any]) -> Group:
    if fast["att"] is None:
        return Group(Text("no attitude yet", style="dim"))
    heading, pitch, roll = fast["att"]
    words = f"hdg {heading:6.2f}  pitch {pitch:6.2f}  roll {roll:7.2f}"
    return Group(horizon(pitch, roll), Text(words, style="bold"))


def horizon(pitch_deg: float, roll_deg: float) -> Text:
    """The artificial horizon in letters: sky, ground, and our own wings in the middle."""
    text, tangent = Text(), math.tan(math.radians(max(-85.0, min(85.0, roll_deg if abs(roll_deg) <= 90.0 else 0.0))))
    upside_down = abs(roll_deg) > 90.0
    middle, centre = _HORIZON_ROWS // 2, _HORIZON_COLUMNS // 2
    for row in range(_HORIZON_ROWS):
        for column in range(_HORIZON_COLUMNS):
            # A letter is about twice as high as wide.
            edge = middle + pitch_deg / _DEGREES_PER_ROW - (column - centre) * 0.5 * tangent
            ground = (row > edge) != upside_down
            wings = row == middle and 3 <= abs(column - centre) <= 6
            nose = row == middle and column == centre
            letter = "+" if nose else "=" if wings else " "
            text.append(letter, f"bold yellow on {'#7a4a21' if ground else '#2f6fb0'}")
        text.append("\n")
    return text


def _motion(fast: dict[str, Any]) -> Table:
    table = Table.grid(padding=(0, 2))
    lat, lon, height = fast["place"]
    north, east, down = fast["vel"]
    table.add_row("position", f"{lat:.6f}", f"{lon:.6f} deg", f"{height:.1f} m")
    table.add_row("velocity", f"{math.hypot(north, east):.2f} m/s", f"{_track(north, east)} deg", f"up {-down:.2f} m/s")
    table.add_row("", "[dim]x, north[/]", "[dim]y, east[/]", "[dim]z, down[/]")
    table.add_row("rate deg/s", *(f"{value:.3f}" for value in fast["w"]))
    table.add_row("force m/s2", *(f"{value:.3f}" for value in fast["f"]))
    if fast["err"] is not None:
        parts = (("position m", slice(0, 3)), ("velocity m/s", slice(3, 6)), ("attitude deg", slice(6, 9)))
        for name, part in parts:
            table.add_row(f"error {name}", *("-" if one is None else f"{one:.3g}" for one in fast["err"][part]))
    return table


def _track(north: float, east: float) -> str:
    return f"{math.degrees(math.atan2(east, north)) % 360.0:.1f}" if math.hypot(north, east) > 0.1 else "-"


def _losses(losses: dict[str, list[Any]]) -> Table:
    table = Table.grid(padding=(0, 2))
    cells = [
        Text(f"{name.replace('_', ' ')} {count}", style="bold red" if new else "" if count else "dim")
        for name, (count, new) in losses.items()
    ]
    for k in range(0, len(cells), 2):
        table.add_row(*cells[k : k + 2])
    return table


def _links(slow: dict[str, Any]) -> Table:
    table = Table.grid(padding=(0, 2))
    bus = slow["bus"]
    load = f"{bus['frames_s']:.0f} frames/s   {bus['bytes_s'] / 1e3:.1f} kB/s   load {100 * bus['load']:.0f} %"
    table.add_row("bus", load)
    for one in slow["links"]:
        counts = (
            f"{one['sent_hz']:.0f}/s sent   {one['received']} received   {one['bad']} bad   {one['dropped']} dropped"
        )
        table.add_row(one["url"], counts)
    return table


@contextlib.contextmanager
def _single_keys() -> Iterator[None]:
    """Keys come one by one and are not shown; Ctrl-C goes on working."""
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
