"""The command `hil`. Exit code 2 for a wrong request, 1 for a failed run, 0 otherwise; ``--json`` prints one object."""

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from hil import cli_files, cli_version, cli_watch
from hil.cli_common import Json, RunFailed, StopSignal, check_outputs, report, say
from nav.errors import HilError

if TYPE_CHECKING:
    from hil.bridge import LoopOrder
    from hil.dashboard import Window
    from hil.scenario import Scenario
    from hil.session import Session

COMMON_BUS = "unix:dtg-hil"
"""Where `hil imu` and `hil run --imu` meet when no bus is named."""

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


app.callback(help=__doc__)(cli_version.root)
app.command()(cli_watch.check_axes)
app.command()(cli_watch.monitor)


Bus = Annotated[str | None, typer.Option(help="Bus URL: unix:NAME, socketcan:vcan0, serial:/dev/ttyUSB0:921600, ...")]
Duration = Annotated[float | None, typer.Option(min=0.0, help="Seconds of device time, then stop.")]
Speed = Annotated[str, typer.Option(help="1: real time; max: simulated time, as fast as it goes.")]
Seed = Annotated[int | None, typer.Option(min=0, help="Seed of the simulated errors.")]
Links = Annotated[
    list[str] | None,
    typer.Option("--mavlink", help="udpout:HOST:PORT, udpin:, tcp:, tcpin:, serial:DEV:BAUD, or none."),
]
Feeds = Annotated[
    list[str] | None,
    typer.Option("--feed", help="Autopilot: ardupilot-json:HOST:PORT, px4:HOST:PORT, vectornav:pty or :tcp:HOST:PORT."),
]
Key = Annotated[
    Path | None, typer.Option("--mavlink-key", help="Sign MAVLink with the key in this file, take nothing unsigned.")
]
Tlog = Annotated[Path | None, typer.Option(help="Log the first MAVLink link to this file (.tlog).")]
Mcap = Annotated[Path | None, typer.Option(help="Write solutions and events for Foxglove to this file (.mcap).")]
Record = Annotated[Path | None, typer.Option(help="Write what comes in to this recording (.dhil).")]
Realtime = Annotated[
    bool, typer.Option("--realtime", help="Priority, locked memory and a processor for the loop, where permitted.")
]
Asserts = Annotated[
    list[str] | None, typer.Option("--assert", help="'error.position_m.max < 0.5'; exit code 1 if not.")
]
Junit = Annotated[Path | None, typer.Option(help="Write the assertions as JUnit XML.")]
Dashboard = Annotated[
    str | None,
    typer.Option(metavar="HOST:PORT", help="Where the window is served; 127.0.0.1:8765 or the next free port."),
]
NoDashboard = Annotated[bool, typer.Option("--no-dashboard", help="Serve no window.")]
Tui = Annotated[
    bool, typer.Option("--tui", help="Show the run in the terminal; no window unless --dashboard is given.")
]
ScenarioName = Annotated[str | None, typer.Argument(help="TOML file or built-in name; left out: the embedded default.")]


@app.command()
def run(
    scenario: ScenarioName = None,
    bus: Bus = None,
    imu: Annotated[str | None, typer.Option(help="Driver of the board on the bus; then no head is simulated.")] = None,
    gnss: Annotated[
        list[str] | None, typer.Option(help="Port of a satellite receiver, serial:/dev/ttyACM0:115200; repeatable.")
    ] = None,
    mavlink: Links = None,
    feed: Feeds = None,
    duration: Duration = None,
    speed: Speed = "1",
    seed: Seed = None,
    record: Record = None,
    realtime: Realtime = False,
    mavlink_key: Key = None,
    tlog: Tlog = None,
    mcap: Mcap = None,
    assertion: Asserts = None,
    junit: Junit = None,
    dashboard: Dashboard = None,
    no_dashboard: NoDashboard = False,
    tui: Tui = False,
    as_json: Json = False,
) -> None:
    """Run the bridge: IMU in, navigation, MAVLink out. Without a bus it brings its own simulated head."""
    from hil.bridge import LoopOrder
    from hil.cli_wires import look_before
    from hil.scenario import load
    from hil.session import private_bus, simulated_head

    chosen = load(scenario).with_changes(
        **_changes(bus=bus, driver=imu, duration_s=duration, seed=seed, mavlink=mavlink, feed=feed)
    )
    if gnss:
        chosen = chosen.with_receivers(gnss)
    chosen = _links(chosen, mavlink_key, tlog)
    outside = bool(chosen.bus) or imu is not None
    if outside and not _paced(speed):
        raise HilError(
            "--speed max needs the simulated head of `hil run`: leave --bus, --imu and the scenario's bus out"
        )
    if chosen.receiver and not _paced(speed):
        raise HilError("--speed max has no time in which a receiver could speak: leave it or the receivers out")
    for warning in look_before(chosen):
        say(warning)
    order = LoopOrder(
        chosen.with_changes(bus=chosen.bus or (COMMON_BUS if outside else private_bus())),
        paced=_paced(speed),
        own_world=not outside,
        realtime=realtime,
    )
    screen = _Screen(dashboard, no_dashboard, tui)
    feeder = None if outside else simulated_head(order)
    _run(order, feeder, record, assertion, junit, screen=screen, mcap=mcap, as_json=as_json)


@app.command()
def imu(
    scenario: ScenarioName = None,
    bus: Bus = None,
    duration: Duration = None,
    speed: Speed = "1",
    seed: Seed = None,
    realtime: Realtime = False,
    as_json: Json = False,
) -> None:
    """Run the simulated sensor head alone, for a bridge in another process or on another machine."""
    from drivers.can.bus import check_url
    from hil.realtime import claim
    from hil.scenario import load
    from hil.world.head import SimulatedHead, feed

    chosen = load(scenario).with_changes(**_changes(bus=bus, duration_s=duration, seed=seed))
    chosen = chosen.with_changes(bus=chosen.bus or COMMON_BUS)
    check_url(chosen.bus)
    stop = StopSignal()
    head = SimulatedHead(chosen)
    for lack in claim().lacking if realtime else ():
        say(lack)
    say(f"head {chosen.head.serial} of scenario {chosen.name} at {chosen.head.rate_hz:g} Hz on {chosen.bus}")
    result = feed(head, chosen, paced=_paced(speed), cancelled=lambda: stop.wanted)
    report({"scenario": chosen.name, **result}, as_json=as_json)


@app.command()
def replay(
    log: Annotated[Path, typer.Argument(help="Our recording, PX4 .ulg, ArduPilot .bin, candump .log, .blf, .asc.")],
    scenario: Annotated[str | None, typer.Option(help="Scenario instead of the one in the recording.")] = None,
    bus: Bus = None,
    mavlink: Links = None,
    feed: Feeds = None,
    speed: Speed = "1",
    record: Record = None,
    realtime: Realtime = False,
    mavlink_key: Key = None,
    tlog: Tlog = None,
    mcap: Mcap = None,
    plot: Annotated[Path | None, typer.Option(help="Plot the attitude difference to this file (.svg, .png).")] = None,
    withhold: Annotated[
        list[str] | None,
        typer.Option(help="KIND:START:END: keep this aiding from the navigator, gnss:120:140 (seconds)."),
    ] = None,
    smooth: Annotated[
        Path | None, typer.Option(help="Write the smoothed navigation to this file (.csv, .npz, .parquet).")
    ] = None,
    assertion: Asserts = None,
    junit: Junit = None,
    dashboard: Dashboard = None,
    no_dashboard: NoDashboard = False,
    tui: Tui = False,
    as_json: Json = False,
) -> None:
    """Send a recording through the same bridge."""
    from dataclasses import replace

    from hil.player import plan_replay, run_player

    check_outputs((log,), (record, mcap, tlog, plot, smooth, junit))
    order, over_bus = plan_replay(log, scenario, bus, paced=_paced(speed))
    changed = order.scenario.with_changes(**_changes(mavlink=mavlink, feed=feed or [], withhold=withhold))
    order = replace(order, scenario=_links(changed, mavlink_key, tlog), realtime=realtime)
    if plot is not None:
        if order.reference is None:
            raise HilError(f"--plot: {log} carries no attitude to compare with")
        from hil.plot import check_plot

        check_plot(plot)
        order = replace(order, keep_trace=True)
    feeder = (run_player, (log, order.scenario, order.paced)) if over_bus else None

    def smoothed() -> dict[str, Any]:
        if smooth is None:
            return {}
        from hil.smoothing import smooth_recording

        return {"smoothed": smooth_recording(log, order.scenario, smooth)}

    screen = _Screen(dashboard, no_dashboard, tui)
    summary = _run(order, feeder, record, assertion, junit, smoothed, screen=screen, mcap=mcap, as_json=as_json)
    if plot is not None and order.reference is not None:
        from hil.plot import plot_difference

        plot_difference(plot, order.reference, summary.pop("trace"), log.name)
        say(f"plot written to {plot}")


app.command()(cli_files.navigate)
app.command()(cli_files.decode)
app.command()(cli_files.export)
app.command()(cli_files.allan)
app.command()(cli_files.clock)
app.command()(cli_files.calibrate)


@app.command()
def record(
    file: Annotated[Path, typer.Argument(help=".dhil, or .log, .blf, .asc for other tools.")],
    bus: Annotated[str, typer.Option(help="Bus URL.")],
    imu: Annotated[str | None, typer.Option(help="Driver of the board, for those who use the recording.")] = None,
    scenario: Annotated[str | None, typer.Option(help="Scenario that a replay of this recording shall use.")] = None,
    duration: Annotated[float | None, typer.Option(min=0.0, help="Seconds, then stop.")] = None,
    as_json: Json = False,
) -> None:
    """Record what is on the bus."""
    from hil.decoder import record_bus
    from hil.scenario import load

    stop = StopSignal()
    chosen = load(scenario).with_changes(**_changes(bus=bus, driver=imu))
    report(record_bus(chosen, file, duration, lambda: stop.wanted, say), as_json=as_json)


@app.command()
def configure(
    driver: Annotated[
        str, typer.Argument(help="xsens-xbus, vectornav, microstrain-mip, or ubx for a receiver of u-blox.")
    ],
    bus: Annotated[str, typer.Option(help="serial:/dev/ttyUSB0:921600")],
    rate: Annotated[float, typer.Option(min=0.0, help="Samples a second, Hz.")],
    as_json: Json = False,
) -> None:
    """Make a board on a serial port send what its driver wants; it forgets it when it is switched off, but an Xsens keeps it."""
    from drivers.serial.setup import set_up

    report(set_up(driver, bus, rate), as_json=as_json)


@app.command()
def doctor(
    probe: Annotated[bool, typer.Option("--probe", help="Listen on CAN and serial ports for known boards.")] = False,
    as_json: Json = False,
) -> None:
    """Say what this machine can do, and the command that mends each lack."""
    from hil.doctor import examine

    findings = examine(probe=probe)
    if as_json:
        print(json.dumps({"findings": [finding.as_dict() for finding in findings]}))
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(show_header=False)
    colours = {"ok": "green", "lack": "yellow", "info": "cyan"}
    for finding in findings:
        words = (escape(text) for text in (finding.what, finding.found, finding.mend))
        table.add_row(f"[{colours[finding.verdict]}]{finding.verdict}[/]", *words)
    Console(highlight=False).print(table)


@app.command()
def study(
    names: Annotated[list[str], typer.Argument(help="Names of studies, or all.")],
    out: Annotated[Path | None, typer.Option(help="Folder for the report (HTML, SVG, JSON).")] = None,
    as_json: Json = False,
) -> None:
    """Reproduce the published tables and figures beside our own; exit code 1 when a limit is not kept."""
    from hil.study import study as run_study
    from hil.study import study_names

    chosen = study_names() if names == ["all"] else names
    for name in set(chosen) - set(study_names()):
        raise HilError(f"unknown study {name!r}; there is: all, {', '.join(study_names())}")
    failed = []
    for name in chosen:
        rows = run_study(name, out)
        failed += [f"{name}: {row['id']}" for row in rows if not row["ok"]]
        if as_json:
            print(json.dumps({"study": name, "rows": rows}))
            continue
        for row in rows:
            mark = "  " if row["ok"] else "! "
            print(
                f"{mark}{row['id']:34} published {row['published']!s:>10}  ours {row['ours']!s:>24} {row['unit']}  {row['what']}"
            )
    if failed:
        raise RunFailed("not within its limit: " + ", ".join(failed))


@app.command()
def bench(
    live: Annotated[
        bool, typer.Option("--live", help="The live chain with its processes instead of its parts.")
    ] = False,
    seconds: Annotated[float, typer.Option(min=2.0, help="Of each run of --live.")] = 20.0,
    as_json: Json = False,
) -> None:
    """Measure the speed of each part on this machine, or of the live chain."""
    from hil.bench import measure
    from hil.bench.live import rows as live_rows

    rows = live_rows(say, seconds) if live else measure(say)
    if as_json:
        print(json.dumps({"rows": rows}))
        return
    for row in rows:
        ratio = "" if row["ratio_to_c"] is None else f"   {row['ratio_to_c']:.2f} of C"
        if row["peer_ns"] is not None:
            ratio += f"   {row['peer']}: {row['peer_ns']:.0f} ns ({row['peer_ns'] / row['ns']:.1f} x)"
        if "p99_ns" in row:
            ratio += f"   p99 {row['p99_ns']:.0f} ns   lost {row['lost']} of {row['samples']}"
        print(f"{row['id']:36} {row['what']:58} {row['ns']:10.0f} ns{ratio}")


app.command()(cli_version.version)


class _Screen(NamedTuple):
    """How a run is shown besides its status line."""

    address: str | None
    off: bool
    tui: bool

    def open(self, *, paced: bool) -> "Window | None":
        """The window, where one is wanted: by default, in real time, and not beside the terminal's."""
        from hil.dashboard import open_window

        if self.off and self.address is not None:
            raise HilError("--dashboard and --no-dashboard exclude each other")
        if self.off or (self.address is None and (self.tui or not paced)):
            return None
        return open_window(self.address, say)


def _run(
    order: "LoopOrder",
    feeder: Any,
    record_to: Path | None,
    assertions: list[str] | None,
    junit: Path | None,
    more: Callable[[], dict[str, Any]] = dict,
    *,
    screen: _Screen,
    mcap: Path | None = None,
    as_json: bool,
) -> dict[str, Any]:
    """Run a session to its end, show it with what `more` adds, check the assertions; the summary."""
    from hil.assertions import parse, write_junit
    from hil.console import RunView, print_summary
    from hil.session import Session
    from hil.tui import TerminalView, check_terminal

    checks = [parse(text) for text in assertions or []]
    if junit is not None and not checks:
        raise HilError("--junit needs at least one --assert")
    if screen.tui:
        check_terminal()
    stop = StopSignal()
    session = Session(order, feeder=feeder, record=record_to, mcap=mcap, window=screen.open(paced=order.paced))
    with session, TerminalView(session, stop.call) if screen.tui else RunView(session) as view:
        while not (session.ready or stop.wanted):
            view.show_compiling()
            time.sleep(0.1)
        for place in session.feed_places():
            say(f"an autopilot finds its feed at {place}")
        try:
            _follow(session, stop, view)
        except HilError as error:
            if session.outlets.stats["samples"] == 0:  # nothing was ever navigated: the request was wrong
                raise
            raise RunFailed(str(error)) from error
    view.show_events()
    try:
        summary = session.summary() | more()
    except HilError as error:
        raise RunFailed(str(error)) from error
    shown = {key: value for key, value in summary.items() if key != "trace"}
    if as_json:
        print(json.dumps(shown))
    else:
        print_summary(shown)
    outcome = [(check, check.failure(shown)) for check in checks]
    if junit is not None:
        write_junit(junit, order.scenario.name, outcome, shown["wall_s"])
    failures = [failure for _, failure in outcome if failure]
    if failures:
        raise RunFailed("\n".join(f"assertion failed: {failure}" for failure in failures))
    return summary


def _follow(session: "Session", stop: "StopSignal", view: Any) -> None:
    while session.running:
        if stop.wanted:
            session.stop()
        view.refresh(time.monotonic())
        session.wait(0.1)


def _paced(speed: str) -> bool:
    if speed not in {"1", "max"}:
        raise HilError(f"--speed {speed}: expected 1 or max")
    return speed == "1"


def _links(scenario: "Scenario", key: Path | None, tlog: Path | None) -> "Scenario":
    from hil.cli_mavlink import open_doors, with_mavlink

    chosen = with_mavlink(scenario, key, tlog)
    for line in open_doors(chosen):
        say(line)
    return chosen


def _changes(
    mavlink: list[str] | None = None,
    withhold: list[str] | None = None,
    feed: list[str] | None = None,
    **options: Any,
) -> dict[str, Any]:
    changes = {key: value for key, value in options.items() if value is not None}
    if feed is not None:
        from hil.feed.config import parse_feed

        changes["feed"] = [parse_feed(text) for text in feed]
    if withhold:
        changes["navigation"] = {"filter": {"withheld": [_outage(text) for text in withhold]}}
    if mavlink:
        changes["mavlink"] = {"links": () if mavlink == ["none"] else tuple(mavlink)}
    return changes


def _outage(text: str) -> dict[str, Any]:
    parts = text.split(":")
    if len(parts) != 3:
        raise HilError(f"--withhold {text}: give KIND:START:END, as gnss:120:140")
    return dict(zip(("kind", "start_s", "end_s"), parts, strict=True))


def main() -> None:
    """Entry point."""
    try:
        if os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"}:
            raise HilError("NUMBA_DISABLE_JIT is set, and there is nothing but compiled kernels: unset it")
        app()
    except HilError as error:
        for line in str(error).splitlines():
            say(f"hil: {line}")
        raise SystemExit(1 if isinstance(error, RunFailed) else 2) from None
