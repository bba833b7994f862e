"""`hil check-axes`: which axis of a board looks swapped, and which sign wrong, of its gyros and of its accelerometers."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivers import make_driver
from drivers.can.bus import open_port
from drivers.can.frames import FrameArray, frames
from hil.flight_log import is_flight_log, read_flight_log
from hil.samples import driver_of, log_increments
from hil.scenario import HeadConfig, load, validated
from hil.source import FileSource, is_own, scenario_table
from hil.world.instruments import head_model
from nav.alignment.axes import NAMES, Fit, gyro_fit
from nav.alignment.postures import FORCES, ORDERS, Postures, judged
from nav.earth import STANDARD_GRAVITY
from nav.errors import HilError
from nav.increments import FloatArray, HeadIncrements, ImuIncrements, joined
from nav.instruments.head import HeadCombiner
from nav.rotation import orthonormal

MISFIT_DEG = 30.0
"""What is further off fits no axes at all."""
ASKEW_DEG = 12.0
"""What is further off stands askew: more than a hand errs by."""
UNIT_SHARE = 0.15
"""A specific force at rest that is further from 1 g, as a share, is in another unit."""
MUTE_S = 5.0
"""A board that is there has sent something by then."""
WAIT_S = 60.0
"""Longest time for one posture."""


@dataclass(slots=True)
class AxesCheck:
    """Takes samples in a board's own axes, and says what they show."""

    postures: Postures = field(default_factory=Postures)
    _parts: list[ImuIncrements] = field(default_factory=list)

    def take(self, imu: ImuIncrements) -> None:
        """Take the next samples."""
        self.postures.take(imu)
        self._parts.append(joined([imu]))

    def report(self) -> dict[str, Any]:
        """What was found, as ``--json`` prints it.

        Returns
        -------
        dict
            ``rests``; ``accelerometer``, ``gyro`` by the sequence, and ``motion`` (the gyros against the accelerometers, by
            motion alone), each null where it was not seen, else ``axes``, ``off_deg``, ``left_handed``, ``certain``, ``says``;
            ``head_axes``, ``head_mounting``: what goes into the scenario, or null; ``verdict``; ``ok``.
        """
        said: dict[str, Any] = {"rests": len(self.postures.found), "head_axes": None, "head_mounting": None}
        moving = gyro_fit(joined(self._parts)) if self._parts else None
        said |= {"accelerometer": None, "gyro": None, "motion": None if moving is None else _said(moving)}
        try:
            by_force, by_turn = judged(self.postures.found)
        except HilError as refusal:
            said["ok"], said["verdict"] = _by_motion(moving, str(refusal))
            return said
        said |= {"accelerometer": _said(by_force), "gyro": _said(by_turn)}
        said["ok"], said["verdict"] = _verdict(by_force, by_turn)
        size = float(np.mean([np.linalg.norm(one.force) for one in self.postures.found])) / STANDARD_GRAVITY
        if abs(size - 1.0) > UNIT_SHARE:
            said["verdict"] += f"; but the specific force at rest is {size:.3g} g: is its unit m/s^2?"
        if said["ok"]:
            said["head_axes"] = list(by_force.names)
            if np.degrees(by_force.off) > ASKEW_DEG:
                said["head_mounting"] = _askew(self.postures)
        return said


def described(c: FloatArray) -> str:
    """A signed permutation in words, against the axes as they should be."""
    row_of = np.abs(c).argmax(axis=1)
    reversed_ = [NAMES[int(row_of[row])] for row in range(3) if c[row, row_of[row]] < 0.0]
    signs = f"the sign of {' and '.join(sorted(reversed_))} is reversed" if reversed_ else ""
    moved = [NAMES[row] for row in range(3) if row_of[row] != row]
    if len(moved) == 2:
        return ", ".join(part for part in (f"{moved[0]} and {moved[1]} are swapped", signs) if part)
    if moved:
        names = [("-" if c[row, row_of[row]] < 0.0 else "") + NAMES[int(row_of[row])] for row in range(3)]
        return f"all three are turned about: {names[0]} stands where x should, {names[1]} for y, {names[2]} for z"
    return signs or "as they should be"


def _said(found: Fit) -> dict[str, Any]:
    return {
        "axes": list(found.names),
        "off_deg": float(np.degrees(found.off)),
        "left_handed": found.left_handed,
        "certain": found.certain,
        "says": described(found.c),
    }


def _verdict(by_force: Fit, by_turn: Fit) -> tuple[bool, str]:
    for what, found in (("accelerometers", by_force), ("gyros", by_turn)):
        if np.degrees(found.off) > MISFIT_DEG:
            off = f"{np.degrees(found.off):.0f} deg off the nearest"
            return False, f"the {what} fit no axes ({off}): the sequence was another one, or a unit is wrong"
        if not found.certain:
            return False, f"the {what} fit several axes alike: do the sequence again, in turns of 90 deg"
    if (by_force.c == by_turn.c).all():
        if not by_force.left_handed:
            return True, "gyros and accelerometers lie alike"
        return False, (
            "gyros and accelerometers lie alike and are left-handed, which no mounting mends: "
            f"{described(by_force.c)}; mend it in the board's settings or in its driver"
        )
    against = described(by_force.c.T @ by_turn.c)
    wrong = [what for what, found in (("accelerometers", by_force), ("gyros", by_turn)) if found.left_handed]
    which = f"the {' and '.join(wrong)} are left-handed" if wrong else "both are right-handed"
    return False, (
        f"gyros and accelerometers do not lie alike, which no mounting mends: {which}; the gyros against the "
        f"accelerometers: {against}; mend it in the board's settings or in its driver"
    )


def _by_motion(found: Fit | None, refusal: str) -> tuple[bool, str]:
    """Without the sequence: whether the gyros turn gravity the way in which it turns."""
    if found is None:
        return False, f"{refusal}; and gravity turned too little to compare gyros and accelerometers"
    if np.degrees(found.off) > MISFIT_DEG:
        return False, f"{refusal}; and the gyros turn gravity in no way as the accelerometers feel it: is a unit wrong?"
    if found.allows(np.eye(3)):
        sure = "" if found.certain else ", as far as it was turned"
        return True, f"gyros and accelerometers lie alike{sure}; how they lie in the vehicle takes the sequence"
    if not found.certain:
        return False, "gyros and accelerometers do not lie alike; turn it about all three axes to see which is wrong"
    return (
        False,
        f"gyros and accelerometers do not lie alike: the gyros against the accelerometers: {described(found.c)}",
    )


def _askew(postures: Postures) -> list[list[float]] | None:
    """The mounting of a board whose axes are not along those of the body."""
    forces = np.array([one.force / np.linalg.norm(one.force) for one in postures.found])
    return [[round(float(one), 5) + 0.0 for one in row] for row in orthonormal(FORCES.T @ forces)]


class BoardSamples:
    """Samples of any board in its own axes: of a DTG head after all compensation, but without its mounting."""

    def __init__(self, driver_name: str, head: HeadConfig) -> None:
        self.driver = make_driver(driver_name)
        bare = head.model_copy(update={"mounting_deg": (0.0, 0.0, 0.0), "axes": None, "mounting": None})
        self._combiner = HeadCombiner(head_model(bare))

    def take(self, batch: FrameArray) -> ImuIncrements:
        """The samples in `batch`; valid until the next call."""
        raw = self.driver.decode(batch)
        return self._combiner.combine(raw) if isinstance(raw, HeadIncrements) else raw


def of_recording(path: Path, driver_name: str | None) -> Iterator[ImuIncrements]:
    """The samples of a recording or a flight log."""
    if is_flight_log(path):
        yield log_increments(read_flight_log(path))
        return
    head = HeadConfig()
    if is_own(path) and (table := scenario_table(path)) is not None:
        head = validated(table, f"in recording {path}").head
    name = driver_name or driver_of(path)
    board, count = BoardSamples(name, head), 0
    for batch in FileSource(path, paced=False).batches(1024):
        samples = board.take(batch)
        count += len(samples)
        yield samples
    if not count:
        raise HilError(f"{path}: no samples of {name} in it: give the board's driver with --imu")


def of_bus(url: str, driver_name: str, scenario: str | None, cancelled: Callable[[], bool]) -> Iterator[ImuIncrements]:
    """The samples on a bus, until cancelled."""
    board = BoardSamples(driver_name, load(scenario).head)
    port, batch = open_port(url), frames(1024)
    try:
        while not cancelled():
            yield board.take(batch[: port.receive(batch, 0.1)])
    finally:
        port.close()


def guide(
    check: AxesCheck, samples: Iterator[ImuIncrements], say: Callable[[str], None], clock: Callable[[], float]
) -> None:
    """Lead the user through the sequence, a posture after the other.

    Raises
    ------
    HilError
        No samples come, or a posture did not in time.
    """
    asked, since, came = -1, clock(), False
    for imu in samples:
        check.take(imu)
        came = came or len(imu) > 0
        if not came:
            if clock() - since > MUTE_S:
                raise HilError(f"no samples in {MUTE_S:g} s: hil monitor shows what comes, and who understands it")
            continue
        done = len(check.postures.found)
        if done >= len(ORDERS):
            return
        if done != asked:
            asked, since = done, clock()
            say(f"{done + 1} of {len(ORDERS)}: {ORDERS[done]}")
        if clock() - since > WAIT_S:
            raise HilError(f"step {done + 1} did not come in {WAIT_S:g} s: {ORDERS[done]}")
