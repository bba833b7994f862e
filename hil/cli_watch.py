"""The commands that look at a board without navigating: `hil check-axes`, `hil monitor`."""

import json
import time
from pathlib import Path
from typing import Annotated

import typer

from hil.cli_common import Json, RunFailed, StopSignal, say
from nav.errors import HilError

File = Annotated[Path | None, typer.Argument(help="A recording or flight log; left out: the bus.")]
Bus = Annotated[str | None, typer.Option(help="Bus URL: unix:NAME, socketcan:can0, serial:/dev/ttyUSB0:921600, ...")]
Imu = Annotated[str | None, typer.Option(help="Driver of the board.")]


def check_axes(
    file: File = None,
    bus: Bus = None,
    imu: Imu = None,
    scenario: Annotated[str | None, typer.Option(help="Scenario with rotors and layout of a DTG head.")] = None,
    as_json: Json = False,
) -> None:
    """Say which axis of a board looks swapped or has the wrong sign, and the head.axes that put it right."""
    from hil.axes_check import AxesCheck, guide, of_bus, of_recording

    _one_source(file, bus)
    check = AxesCheck()
    if file is not None:
        for samples in of_recording(file, imu):
            check.take(samples)
    else:
        if imu is None:
            raise HilError("--imu is missing: the driver of the board (hil monitor finds it)")
        from hil.watch import look_first

        if hint := look_first(bus or "", imu):
            say(hint)
        stop = StopSignal()
        try:
            guide(check, of_bus(bus or "", imu, scenario, lambda: stop.wanted), say, time.monotonic)
        except HilError as late:
            if not check.postures.found:
                raise RunFailed(str(late)) from late
            say(str(late))
    found = check.report()
    if as_json:
        print(json.dumps(found))
    else:
        for what in ("accelerometer", "gyro"):
            if (one := found[what]) is not None:
                print(f"{what + ':':15}{one['says']} (to {one['off_deg']:.1f} deg)")
        print(found["verdict"])
        if found["head_axes"] is not None:
            print(f"head.axes = {json.dumps(found['head_axes'])}")
        if found["head_mounting"] is not None:
            print("it stands askew; instead of head.axes, to a few degrees:")
            print(f"head.mounting = {json.dumps(found['head_mounting'])}")
    if not found["ok"]:
        raise RunFailed(f"axes: {found['verdict']}")


def monitor(
    file: File = None,
    bus: Bus = None,
    imu: Annotated[
        str | None, typer.Option(help="Driver of the board; left out: that of all which understands.")
    ] = None,
    dbc: Annotated[list[Path] | None, typer.Option(help="Show the signals of this DBC file too; repeatable.")] = None,
    duration: Annotated[float | None, typer.Option(min=0.0, help="Seconds, then stop.")] = None,
    bitrate: Annotated[float | None, typer.Option(help="Of the CAN bus, bits a second, where nothing says it.")] = None,
    data_bitrate: Annotated[float | None, typer.Option(help="Of the data of CAN FD frames.")] = None,
    as_json: Json = False,
) -> None:
    """Show raw signals with unit, rate and noise, frames by id, bus load and losses. Nothing is sent."""
    from drivers.can.codec import load_database
    from hil.monitor import Monitor
    from hil.watch import bitrates_of, look_first, watch_bus, watch_file

    _one_source(file, bus)
    databases = [load_database(path) for path in dbc or ()]
    for path, database in zip(dbc or (), databases, strict=True):
        for name, reason in database.refused.items():
            say(f"{path}: {name} is left out: {reason}")
    if bus is not None and (hint := look_first(bus, imu)):
        say(hint)
    watched = Monitor(imu, databases, bitrates_of(bus, bitrate, data_bitrate))
    if file is not None:
        report = watch_file(watched, file, imu) | {"source": str(file)}
    else:
        stop = StopSignal()
        report = watch_bus(watched, str(bus), duration, lambda: stop.wanted, quiet=as_json) | {"source": bus}
    if as_json:
        print(json.dumps(report))
        return
    from hil.monitor_view import MonitorView

    MonitorView().end(report)
    if report["driver"] is not None and imu is None:
        where = f" --bus {bus}" if bus is not None else ""
        say(f"the board is understood by {report['driver']}: hil run --imu {report['driver']}{where}")
    if report["problem"]:
        say(report["problem"])


def _one_source(file: Path | None, bus: str | None) -> None:
    if (file is None) == (bus is None):
        raise HilError("give a recording, or --bus URL, and not both")
