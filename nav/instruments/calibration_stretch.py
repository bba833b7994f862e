"""Stretches of a record in which a head stood or turned steadily: found, checked, and averaged for the calibration.

A steady stretch is judged by means over `BLOCK_S`: those of the gyros, and where the head stands those of the accelerometers
too, stay within `UNSTEADY_SIGMAS` of their noise or within a floor that no calibration would notice.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nav.errors import HilError
from nav.increments import FloatArray, HeadIncrements
from nav.instruments.dtg import Rotor
from nav.instruments.dtg_compensation import LagCompensator
from nav.instruments.redundancy import AXES

BLOCK_S = 0.5
LEAST_BLOCKS = 8
"""A stretch is at least so many blocks long."""
UNSTEADY_SIGMAS = 8.0
_FLOOR = np.repeat([math.radians(0.01), 0.01], [4, 3])
"""Changes of a block below this are no motion, rad/s and m/s^2."""
_SUSPECT = 0x3FF
_SATURATED = 0xE0


@dataclass(frozen=True, slots=True)
class Stretch:
    """What a head measured in a steady stretch.

    Attributes
    ----------
    name : str
        For messages.
    c_nh : (3, 3) float
        Nominal attitude of the head: takes head axes to local north-east-down. Of a turn: at any moment of it.
    turn : (3,) float
        Rate of the turn against the Earth, local axes, rad/s; the stretch holds whole turns. Zeros: it stands.
    gyro, force : (4,), (3,) float
        Mean outputs, the gyros' without lag, rad/s and m/s^2.
    duration : float
        s.
    white : (7,) float
        Random walk of the seven outputs from block to block, rad/sqrt(s) and m/s/sqrt(s).
    temperature : (3,) float
        Means, degrees Celsius; NaN where the head has not said them.
    """

    name: str
    c_nh: FloatArray
    turn: FloatArray
    gyro: FloatArray
    force: FloatArray
    duration: float
    white: FloatArray
    temperature: FloatArray

    @property
    def stands(self) -> bool:
        """Nothing turns."""
        return not self.turn.any()


def without_lag(head: HeadIncrements, rotors: tuple[Rotor, Rotor] | None) -> FloatArray:
    """Outputs (n, 7) of a whole record: mean rates of the gyro axes without their lag, mean specific forces."""
    gyro = head.dtheta.copy()
    if rotors is not None:
        LagCompensator(*rotors).compensate(head, gyro)
    outputs: FloatArray = np.hstack([gyro, head.dvel]) / head.step[:, None]
    return outputs


def steady_part(head: HeadIncrements, outputs: FloatArray, *, stands: bool) -> slice:
    """The longest stretch in which nothing changes from block to block."""
    blocks, per = _blocks(head, outputs)
    judged = blocks if stands else blocks[:, :4]
    if len(judged) < 2:
        return slice(0, len(head))
    change = np.abs(np.diff(judged, axis=0))
    allowed = np.maximum(2.0 * UNSTEADY_SIGMAS * np.median(change, axis=0), _FLOOR[: judged.shape[1]])
    edges = np.flatnonzero((change > allowed).any(axis=1)) + 1
    ends = np.concatenate([[0], edges, [len(judged)]])
    longest = int(np.argmax(np.diff(ends)))
    return slice(int(ends[longest]) * per, int(ends[longest + 1]) * per)


def stretch(
    name: str, head: HeadIncrements, outputs: FloatArray, part: slice, c_nh: FloatArray, turn: FloatArray
) -> Stretch:
    """Average a part of a record.

    Parameters
    ----------
    name : str
        For messages.
    head : HeadIncrements
        The record.
    outputs : (n, 7) float
        Of `without_lag`.
    part : slice
        Which samples; of a turn as many as make whole turns are taken.
    c_nh, turn : (3, 3), (3,) float
        As in `Stretch`.

    Raises
    ------
    HilError
        The part is too short, a sample is flagged, or the head moved.
    """
    time = head.time[part] - head.time[0]
    length = float(head.step[part].sum())
    speed = float(np.linalg.norm(turn))
    if speed:
        turns = math.floor(length * speed / (2.0 * math.pi) + 1e-3)
        if turns == 0:
            raise HilError(f"{name}: {length:.1f} s hold less than one whole turn; record longer or turn faster")
        wanted = turns * 2.0 * math.pi / speed
        part = slice(part.start, part.start + int(np.searchsorted(np.cumsum(head.step[part]), wanted)) + 1)
        part = slice(part.start, min(part.stop, len(head)))
        length = float(head.step[part].sum())
    if length < LEAST_BLOCKS * BLOCK_S:
        raise HilError(f"{name}: {length:.1f} s are too short; a stretch takes {LEAST_BLOCKS * BLOCK_S:g} s or more")
    flagged = np.flatnonzero((head.status[part] & _SUSPECT) | head.validity[part])
    if len(flagged):
        saturated = head.status[part][flagged[0]] & _SATURATED
        what = "an instrument is saturated; turn slower" if saturated else "the head says that an instrument failed"
        raise HilError(f"{name}: {what} ({len(flagged)} samples, the first {time[flagged[0]]:.3f} s after the start)")
    weight = head.step[part] / length
    mean = weight @ outputs[part]
    blocks, _ = _blocks(head.rows(part.start, part.stop), outputs[part])
    change = np.diff(blocks, axis=0)
    if not speed:
        _require_rest(name, float(time[0]), blocks, change)
    return Stretch(
        name,
        c_nh,
        turn,
        mean[:4],
        mean[4:],
        length,
        np.sqrt(0.5 * np.mean(change**2, axis=0) * BLOCK_S),
        np.mean(head.temperature[part], axis=0),
    )


def _require_rest(name: str, start: float, blocks: FloatArray, change: FloatArray) -> None:
    sigma = np.median(np.abs(change), axis=0) / (0.6745 * math.sqrt(2.0))
    off = np.abs(blocks - np.median(blocks, axis=0))
    moved: NDArray[np.bool_] = off > np.maximum(UNSTEADY_SIGMAS * sigma, _FLOOR)
    if moved.any():
        k, axis = (int(i) for i in np.argwhere(moved)[0])
        raise HilError(
            f"{name}: the head moved {start + k * BLOCK_S:.1f} s after the start ({AXES[axis]}); "
            "a position is recorded at rest: give from_s and to_s of the rest"
        )


def _blocks(head: HeadIncrements, outputs: FloatArray) -> tuple[FloatArray, int]:
    """Means over `BLOCK_S`, and how many samples each takes."""
    per = max(1, round(BLOCK_S / float(np.median(head.step))))
    whole = len(outputs) // per
    means: FloatArray = outputs[: whole * per].reshape(whole, per, outputs.shape[1]).mean(axis=1)
    return means, per
