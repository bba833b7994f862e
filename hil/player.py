"""Playing a recording onto a bus: foreign IMU logs become frames of a head, frame recordings go out as they are."""

import math
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from drivers.can.aiding import AidingEncoder, merge
from drivers.can.bus import check_url, open_port
from drivers.can.dtg_head_emulator import REPLAY, HeadEncoder
from drivers.can.frames import FrameArray, frames
from drivers.logs.imu_log import ImuLog
from hil.bridge import LoopOrder
from hil.control import Control
from hil.flight_log import is_flight_log, read_flight_log
from hil.pacing import Pacer
from hil.reference import Reference, interpolate_attitude
from hil.scenario import Scenario, load, validated
from hil.source import PAUSE_NS, FileSource, is_own, scenario_table
from hil.stats import Stats
from nav.aiding import Kind
from nav.alignment.analytic import magnetic_heading
from nav.errors import HilError
from nav.rotation import euler_from_quaternion

ALIGN_S = 1.5
"""Averaging time at the start of a log of a board that cannot gyrocompass."""
MAGNETIC_SIGMA_DEG = 8.0
"""Of a heading by an undisturbed magnetometer of a small vehicle."""
SHAKEN_S = 5.0
"""How long the error lasts that vibration makes in an accelerometer (rectified, folded): noise of that correlation time."""
HAND = {"acceleration_ms2": 0.3, "speed_ms": 0.3, "place_m": 1.0}
"""What a board without a receiver does, on a desk or in a hand."""
SLOW_S = 1.0
CHUNK = 256


def plan_replay(path: Path, scenario_file: str | None, bus: str | None, *, paced: bool) -> tuple[LoopOrder, bool]:
    """What to do with a recording: the loop's order, and whether a player has to feed the bus.

    Frame recordings are read by the loop itself unless a bus is named; IMU logs always go over a bus. A recording of our
    own brings its scenario along; `scenario_file` takes its place.

    Raises
    ------
    HilError
        The file cannot be read or is of no kind that is known; the URL of the bus is malformed.
    """
    if bus is not None:
        check_url(bus)
    suffix = path.suffix.lower()
    if is_flight_log(path):
        log = read_flight_log(path)
        scenario = load(scenario_file) if scenario_file else _board_scenario(path, log)
        reference = Reference(
            time=np.asarray(log.attitude_us * 1e-6, float),
            q_nb=log.attitude,
            gyro_time=np.asarray(log.time_us * 1e-6, float),
            gyro=log.rate,
            start=float(log.time_us[0]) * 1e-6,
            fixes=log.track,
        )
        scenario = scenario.with_changes(bus=bus or f"unix:replay-{time.monotonic_ns():x}")
        return LoopOrder(scenario, paced=paced, reference=reference), True
    if suffix == ".dhil" or is_own(path):
        table = scenario_table(path)
        scenario = load(scenario_file) if scenario_file else _recorded_scenario(path, table)
    elif suffix in {".log", ".blf", ".asc", ".trc", ".csv"}:
        scenario = load(scenario_file).with_changes(duration_s=None)
    else:
        raise HilError(
            f"replay {path}: unknown kind; there is: our own recordings, .ulg, .bin, candump .log, .blf, .asc"
        )
    if bus is not None:
        return LoopOrder(scenario.with_changes(bus=bus), paced=paced), True
    return LoopOrder(scenario, file=path, paced=paced), False


def _recorded_scenario(path: Path, table: dict[str, Any] | None) -> Scenario:
    if table is None:
        raise HilError(f"recording {path}: its header holds no scenario; give one with --scenario")
    return validated(table, f"in recording {path}")


def _board_scenario(path: Path, log: ImuLog) -> Scenario:
    """For a board that cannot gyrocompass: level at the start, heading by its magnetometer, then aided by what the log has.

    The place is that of the first fix. Without a magnetometer the heading is that of the log's own estimate, and without any
    aiding the gyro bias is kept at rest.
    """
    heading = _magnetic_start(log)
    if heading is None:
        times = np.asarray(log.attitude_us * 1e-6, float)
        at = np.clip(float(log.time_us[0]) * 1e-6 + ALIGN_S, times[0], times[-1])
        heading, _, _ = euler_from_quaternion(interpolate_attitude(times, log.attitude, np.array([at]))[0])
    start = {"heading_deg": math.degrees(heading), "heading_sigma_deg": MAGNETIC_SIGMA_DEG}
    if log.place is not None:
        lat, lon, height = log.place
        start |= {"latitude_deg": math.degrees(lat), "longitude_deg": math.degrees(lon), "height_m": height}
    period_s = log.period_us * 1e-6
    return Scenario.model_validate(
        {
            "name": path.stem,
            "head": {"rate_hz": 1e6 / log.period_us},
            "navigation": {
                "alignment": "level",
                "align_s": ALIGN_S,
                "start": start,
                "track_bias_at_rest": len(log.aiding) == 0,
                "aided": len(log.aiding) > 0,
                "assume": {} if log.place is not None or not len(log.aiding) else {"rest": "detected", "bounds": HAND},
                "filter": {
                    "grade": "mems",
                    "gyro_deg_sqrt_h": max(math.degrees(log.shake(log.rate) * math.sqrt(period_s)) * 60.0, 0.3),
                    "accelerometer_ms_sqrt_h": max(log.shake(log.force) * math.sqrt(2.0 * SHAKEN_S) * 60.0, 0.1),
                    "magnetic": "heading",
                    "declination_deg": None if log.declination is None else math.degrees(log.declination),
                },
            },
        }
    )


def _magnetic_start(log: ImuLog) -> float | None:
    """Heading at the start of a log, rad, level by the forces and north by the magnetometer; None without one."""
    end_us = log.time_us[0] + ALIGN_S * 1e6
    there = (log.aiding["kind"] == Kind.MAGNETIC) & (log.arrival_us <= end_us)
    there &= log.aiding["source"] == log.aiding["source"][there].min(initial=np.iinfo(np.int32).max)
    if not there.any():
        return None
    flux = log.aiding["value"][there, :3].mean(axis=0)
    return magnetic_heading(log.force[log.time_us <= end_us].mean(axis=0), flux, log.declination or 0.0)


def run_player(path: Path, scenario: Scenario, paced: bool, control: Control, _: Stats, answer: Connection) -> None:
    """Target of the player's process; begins on `Control.go`, answers ``{"sent", "dropped"}`` or ``{"failed"}``."""
    try:
        port = open_port(scenario.bus, listen=False, lossless=not paced)
        while not (control.go or control.stop):
            time.sleep(0.005)
        sent = 0
        pacer = Pacer()
        try:
            for due_s, batch in timed(path, one_by_one=paced):
                if control.stop or (paced and not pacer.wait(due_s, lambda: control.stop)):
                    break
                port.send(batch)
                sent += len(batch)
        finally:
            port.close()
        answer.send({"sent": sent, "dropped": port.dropped})
    except HilError as error:
        answer.send({"failed": str(error)})
    finally:
        answer.close()


def timed(path: Path, *, one_by_one: bool) -> Iterator[tuple[float, FrameArray]]:
    """(seconds from the start, frames) of a recording; events are left out."""
    if is_flight_log(path):
        yield from _head_frames(read_flight_log(path), 1 if one_by_one else CHUNK)
        return
    source = FileSource(path, paced=False)
    batch = frames(CHUNK)
    due_ns, last_ns = 0, None
    while n := source.receive(batch, 0.0):
        good = batch[:n][batch["reserved"][:n, 0] == 0]
        pieces = np.split(good, range(1, len(good))) if one_by_one else [good]
        for piece in pieces:
            if len(piece):
                time_ns = int(piece["time_ns"][0])
                pause_ns = 0 if last_ns is None else time_ns - last_ns
                due_ns += pause_ns if abs(pause_ns) <= PAUSE_NS else 0
                last_ns = time_ns
                yield due_ns * 1e-9, piece.copy()


def _head_frames(log: ImuLog, chunk: int) -> Iterator[tuple[float, FrameArray]]:
    """The samples of an IMU log as frames of a head; what aids stands behind the first sample that is not older."""
    encoder = HeadEncoder("fd", log.period_us, hardware=REPLAY)
    step_s = (log.step_us * 1e-6)[:, None]
    dtheta, dvel = (log.rate * step_s)[:, (0, 1, 1, 2)], log.force * step_s
    aiding, behind = AidingEncoder().frames(log.aiding), np.searchsorted(log.time_us, log.arrival_us)
    next_slow = 0
    for first in range(0, len(log.time_us), chunk):
        part = slice(first, first + chunk)
        due = float(log.time_us[min(first + chunk, len(log.time_us)) - 1] - log.time_us[0]) * 1e-6
        if log.time_us[first] >= next_slow:
            next_slow = int(log.time_us[first]) + round(SLOW_S * 1e6)
            yield due, encoder.slow()
        samples = encoder.samples(log.counter[part], log.time_us[part], dtheta[part], dvel[part])
        yield due, merge(samples, aiding, behind - first)
