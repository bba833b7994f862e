"""`hil replay --smooth`: a recording through the loop once more, without a bus, and the filter's record smoothed."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from drivers.can.frames import FrameArray, frames
from hil.bridge import BATCH, Loop, LoopOrder, Outlets, take_with_events
from hil.flight_log import is_flight_log
from hil.offline import nav_rows
from hil.offline_aided import AIDED_HEADER
from hil.player import timed
from hil.scenario import Scenario
from hil.source import FileSource
from hil.tables import write_table
from hil.world.truth import TruthKeeper
from nav.errors import HilError
from nav.filter.record import Recorder
from nav.filter.smoother import Smoothed, smooth
from nav.lever_arm import shift
from nav.state import NAV_STATE, Mode


def smooth_recording(path: Path, scenario: Scenario, out: Path) -> dict[str, Any]:
    """Write the smoothed solution of a recording at the ends of the filter's intervals (`AIDED_HEADER`); what there is to say.

    The scenario's navigation is aided here even where it says otherwise.

    Raises
    ------
    HilError
        The recording cannot be read, nothing in it aids, or the alignment does not end in it.
    """
    scenario = scenario.with_changes(navigation={"aided": True})
    recorder = Recorder()
    loop = Loop(LoopOrder(scenario, file=path, paced=False), Outlets.make(recording=False, readers=1), recorder)
    for batch in batches(path):
        take_with_events(loop, batch)
        if loop.finished:
            break
    result = loop.result()
    if not result["aiding"]:
        raise HilError(f"--smooth: nothing in {path} aids the navigator: there is nothing to smooth by")
    if not recorder.runs:
        raise HilError(f"--smooth: the alignment does not end in {path}: there is no navigation to smooth")
    found = smooth(recorder)
    rows = _states(found, scenario)
    sigma = np.hstack([found.sigma[:, :6], np.degrees(found.sigma[:, 6:9])])
    place = np.column_stack([rows["lat"], rows["lon"], rows["height"]])
    table = np.column_stack([nav_rows(found.time, place, rows["vel_n"], rows["q_nb"]), sigma])
    last = np.append(np.diff(found.time) != 0.0, True)  # of an epoch that comes twice, what comes behind
    write_table(out, AIDED_HEADER, table[last])
    report: dict[str, Any] = {"file": str(out), "rows": int(last.sum())}
    if "error" in result:
        truth = TruthKeeper(scenario)
        truth.compare(rows[last])
        report["error"] = truth.summary()
    return report


def batches(path: Path) -> Iterator[FrameArray]:
    """The frames of a recording or a flight log, events among them, for a loop without a bus; each valid until the next."""
    if is_flight_log(path):
        for _, batch in timed(path, one_by_one=False):
            yield batch
        return
    source, batch = FileSource(path, paced=False), frames(BATCH)
    while n := source.receive(batch, 0.0):
        yield batch[:n]
    source.close()


def _states(found: Smoothed, scenario: Scenario) -> np.ndarray:
    """Rows of `NAV_STATE` of the navigated point."""
    rows = np.zeros(len(found.time), NAV_STATE)
    lat, lon, height = np.ascontiguousarray(found.position.T)
    velocity, arm = found.velocity.copy(), -np.array(scenario.head.lever_arm_m)
    shift(lat, lon, height, velocity, found.attitude, found.rate, arm)
    rows["time"], rows["mode"] = found.time, Mode.NAVIGATE
    rows["lat"], rows["lon"], rows["height"], rows["vel_n"] = lat, lon, height, velocity
    rows["q_nb"] = found.attitude
    return rows
