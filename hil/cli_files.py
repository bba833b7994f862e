"""The commands that take files and no bus: `hil navigate`, `decode`, `export`, `allan`, `clock`, `calibrate`."""

import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli_common import Json, RunFailed, check_outputs, report, say
from nav.errors import HilError


def navigate(
    imu_file: Annotated[Path, typer.Argument(metavar="IMU.csv", help="Increments: .csv, .npz or .parquet.")],
    init: Annotated[Path, typer.Option(help="TOML with the start.")],
    out: Annotated[Path, typer.Option(help="Where the navigation goes: .csv, .npz or .parquet.")],
    attitude: Annotated[str, typer.Option(help="Attitude method.")] = "two-sample",
    mechanization: Annotated[str, typer.Option(help="Mechanization.")] = "geographic",
    gravity: Annotated[str, typer.Option(help="Gravity model.")] = "normal",
    aid: Annotated[Path | None, typer.Option(help="Measurements that aid: .csv, .npz or .parquet.")] = None,
    smooth: Annotated[bool, typer.Option("--smooth", help="Use later measurements too; needs --aid.")] = False,
    every: Annotated[float | None, typer.Option(min=0.0, help="Seconds between rows of the output.")] = None,
    as_json: Json = False,
) -> None:
    """Navigate logged increments offline."""
    from hil.offline import IMU_HEADER, NAV_HEADER, read_init, thin
    from hil.offline import navigate as navigate_rows
    from hil.tables import read_table, write_table
    from nav.strapdown import Strapdown

    core = Strapdown(attitude, mechanization, gravity)  # refuses unknown names before the file is read
    if smooth and aid is None:
        raise HilError("--smooth needs measurements: give --aid FILE")
    check_outputs((imu_file, init, aid), (out,))
    table, (start, config) = read_table(imu_file, IMU_HEADER), read_init(init)
    header: tuple[str, ...] = NAV_HEADER
    extra: dict[str, Any] = {}
    if aid is None:
        began = time.perf_counter()
        rows = navigate_rows(table, start, attitude, mechanization, gravity)
    else:
        from hil.aid_file import read_aiding
        from hil.offline_aided import AIDED_HEADER, navigate_aided

        if config is None:
            raise HilError(f"{init}: --aid needs the table [filter] in it, with grade and attitude_sigma_deg")
        measurements, header = read_aiding(aid), AIDED_HEADER
        began = time.perf_counter()
        rows, extra = navigate_aided(table, start, config, measurements, core, smoothed=smooth)
    seconds = time.perf_counter() - began
    if every:
        rows = thin(rows, every)
    write_table(out, header, rows)
    final = dict(zip(header, rows[-1].tolist(), strict=True))
    report({"samples": len(table), "rows": len(rows), "seconds": seconds, "final": final, **extra}, as_json=as_json)


def decode(
    driver: Annotated[str, typer.Argument(help="Name of the driver, as dtg-head.")],
    file: Annotated[Path, typer.Argument(help="Recording of frames.")],
) -> None:
    """Decode recorded frames to JSON samples, one a line; the counters go to standard error."""
    from hil.decoder import decode_file

    lines, counters, problem = decode_file(driver, file)
    try:
        for line in lines:
            sys.stdout.write(line)
    except BrokenPipeError:
        return
    say(json.dumps(counters()))
    if problem():
        raise RunFailed(problem())


def export(
    file: Annotated[Path, typer.Argument(help="Recording of frames.")],
    out: Annotated[Path, typer.Argument(help="Table: .csv, .npz or .parquet; or .mcap.")],
    imu: Annotated[str | None, typer.Option(help="Driver of the board; left out: that of the recording.")] = None,
    as_json: Json = False,
) -> None:
    """Write the samples of a recording as a table, a column a signal; or its navigation for Foxglove (.mcap)."""
    import numpy as np

    check_outputs((file,), (out,))
    if out.suffix == ".mcap":
        from hil.mcap_recorder import export_mcap

        report(export_mcap(file, imu, out), as_json=as_json)
        return
    from hil.samples import read_samples
    from hil.tables import write_table

    samples = read_samples(file, imu)
    write_table(out, tuple(samples.columns), np.stack(list(samples.columns.values()), axis=1))
    report({"file": str(out), "samples": len(samples), "columns": list(samples.columns)}, as_json=as_json)
    if samples.problem:
        raise RunFailed(samples.problem)


def allan(
    file: Annotated[Path, typer.Argument(help="Recording at rest, or a table as for `hil navigate`.")],
    imu: Annotated[str | None, typer.Option(help="Driver of the board; left out: that of the recording.")] = None,
    shortest: Annotated[
        float, typer.Option("--from", min=0.0, help="Shortest time, s: above the lag of the rotors or of a filter.")
    ] = 0.0,
    plot: Annotated[Path | None, typer.Option(help="Plot the deviations to this file (.svg, .png).")] = None,
    as_json: Json = False,
) -> None:
    """Allan deviation of a recording at rest, and the coefficients that it shows."""
    from hil.console import show_deviations
    from hil.plot import check_plot, plot_deviations
    from hil.samples import coefficients, deviations, read_samples

    if plot is not None:
        check_plot(plot)
    samples = read_samples(file, imu)
    fits, count, period = deviations(samples, shortest)
    if plot is not None:
        plot_deviations(plot, fits, file.name)
    rows = [{"axis": name, **coefficients(name, fit)} for name, fit in fits.items()]
    if as_json:
        report({"file": str(file), "samples": count, "left_out": len(samples) - count, "rows": rows}, as_json=True)
    else:
        show_deviations(f"{file.name}: {count} samples, {count * period:.6g} s", rows, len(samples) - count)
    if samples.problem:
        raise RunFailed(samples.problem)


def clock(
    file: Annotated[Path, typer.Argument(help="Recording of a live run.")],
    imu: Annotated[str | None, typer.Option(help="Driver of the board; left out: that of the recording.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Plot arrivals, fit, bound and steps (.svg, .png).")] = None,
    as_json: Json = False,
) -> None:
    """Compare the clock of a recorded board with the host's: offset, drift, bound, steps."""
    from hil.clock_log import clock_log
    from hil.plot import check_plot, plot_clock

    if plot is not None:
        check_plot(plot)
    log = clock_log(file, imu)
    if plot is not None:
        plot_clock(plot, log, file.name)
    report({"file": str(file), **log.summary()}, as_json=as_json)
    if log.problem:
        raise RunFailed(log.problem)


def calibrate(
    recordings: Annotated[list[Path] | None, typer.Argument(help="Recordings of positions and turns.")] = None,
    out: Annotated[Path | None, typer.Option(help="The calibration file; with --simulate a folder.")] = None,
    sequence: Annotated[Path | None, typer.Option(help="TOML that says what was done in the recordings.")] = None,
    simulate: Annotated[
        str | None, typer.Option(metavar="SCENARIO", help="Make recordings with the simulated head of a scenario.")
    ] = None,
    scenario: Annotated[str | None, typer.Option(help="Scenario with rotors and layout of the head.")] = None,
    date: Annotated[str | None, typer.Option(help="YYYY-MM-DD; left out: that of the recordings.")] = None,
    base: Annotated[
        Path | None, typer.Option(help="Calibration of the head, where the recording is of a magnetometer alone.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Fit the calibration of a head to recordings of positions at rest and of turns, and of a magnetometer turned about."""
    if out is None:
        raise HilError("--out is missing: the calibration file, or with --simulate the folder")
    if simulate is not None:
        if recordings or sequence or scenario or date or base:
            raise HilError("--simulate makes the recordings: give nothing but --out beside it")
        from hil.calibration_sequence import SEQUENCE
        from hil.calibration_sequence import simulate as make
        from hil.scenario import load

        made = make(load(simulate), out, say)
        report({"recordings": len(made), "sequence": str(out / SEQUENCE)}, as_json=as_json)
        return
    if not recordings or sequence is None:
        raise HilError("give recordings and --sequence, or --simulate SCENARIO to make them")
    _calibrate(recordings, sequence, out, scenario, date, base, as_json=as_json)


def _calibrate(
    recordings: list[Path],
    sequence: Path,
    out: Path,
    scenario: str | None,
    date: str | None,
    base: Path | None,
    *,
    as_json: bool,
) -> None:
    import datetime

    from hil.calibrate import calibrate as fit_recordings
    from hil.calibrate import rows
    from hil.calibration import read, write

    try:
        day = None if date is None else datetime.date.fromisoformat(date)
    except ValueError as error:
        raise HilError(f"--date {date}: expected YYYY-MM-DD") from error
    file = fit_recordings(recordings, sequence, scenario, day, say, None if base is None else read(base))
    write(out, file)
    if as_json:
        residual = None if file.residual is None else file.residual.model_dump()
        print(
            json.dumps(
                {
                    "file": str(out),
                    "serial": file.serial,
                    "date": file.date.isoformat(),
                    "rows": rows(file),
                    "undetermined": file.undetermined,
                    "residual": residual,
                }
            )
        )
        return
    from hil.console import print_calibration

    print_calibration(file, rows(file))
    say(f"calibration written to {out}")
