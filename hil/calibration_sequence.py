"""What was done with a head in the recordings of a calibration: the sequence file, and a simulated sequence.

`simulate` records the head of a scenario in 24 positions and 12 turns, one recording each, and writes the sequence beside.
"""

import datetime
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from drivers.logs.recording import RecordingWriter
from hil.scenario import Finite, NotNegative, Scenario, Vector, explained, validated
from hil.toml import read_toml
from hil.world.head import SimulatedHead
from nav.errors import HilError
from nav.increments import FloatArray

SEQUENCE = "sequence.toml"
"""Name of the sequence file of a simulated calibration."""
POSITION_S, TURN_S = 60.0, 36.0
"""Lengths of the simulated recordings."""
RATES_DEG_S = (-60.0, -30.0, 30.0, 60.0)
Say = Callable[[str], None]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PositionConfig(_Model):
    """The head stood."""

    recording: str
    heading_deg: Finite
    pitch_deg: Finite
    roll_deg: Finite
    from_s: NotNegative | None = None
    """After the first sample; left out, with `to_s`: the longest steady part of the recording."""
    to_s: NotNegative | None = None

    @model_validator(mode="after")
    def _whole(self) -> "PositionConfig":
        if (self.from_s is None) != (self.to_s is None):
            raise ValueError("from_s and to_s belong together: give both, or neither to have the steady part found")
        if self.from_s is not None and self.to_s is not None and not self.from_s < self.to_s:
            raise ValueError(f"to_s = {self.to_s:g} must come after from_s = {self.from_s:g}")
        return self


class TurnConfig(PositionConfig):
    """The head turned steadily about an axis that stood still; heading, pitch and roll are those at any moment of it."""

    axis: Vector = (0.0, 0.0, 1.0)
    """North, east, down; a positive rate about down raises the heading."""
    rate_deg_s: Finite | None = None
    angle_deg: Finite | None = None
    """Between from_s and to_s, in place of the rate."""

    @model_validator(mode="after")
    def _one_rate(self) -> "TurnConfig":
        if (self.rate_deg_s is None) == (self.angle_deg is None):
            raise ValueError("give either rate_deg_s or angle_deg")
        if self.angle_deg is not None and self.from_s is None:
            raise ValueError("angle_deg needs from_s and to_s")
        if not (self.rate_deg_s or self.angle_deg) or not any(self.axis):
            raise ValueError("rate_deg_s or angle_deg, and the axis, must not be zero")
        return self

    def rate(self) -> FloatArray:
        """Rate of the turn (3,), north, east, down, rad/s."""
        speed = self.rate_deg_s
        if speed is None:
            speed = (self.angle_deg or 0.0) / ((self.to_s or 0.0) - (self.from_s or 0.0))
        axis = np.array(self.axis)
        turn: FloatArray = math.radians(speed) * axis / np.linalg.norm(axis)
        return turn


class SwingConfig(_Model):
    """A magnetometer was turned through all directions in a steady field."""

    recording: str
    known: Literal["nothing", "vertical", "attitude"] = "nothing"
    """What the recording says beside each reading: nothing, forces at rest, or heading, pitch and roll."""
    source: Annotated[int, Field(ge=0, lt=256)] = 0
    field_ut: Annotated[float, Field(gt=0)] | None = None
    """Size of the Earth's field there."""
    field_ned_ut: Vector | None = None
    """The field itself, in place of its size."""

    @model_validator(mode="after")
    def _one_field(self) -> "SwingConfig":
        if (self.field_ut is None) == (self.field_ned_ut is None):
            raise ValueError("give either field_ut or field_ned_ut")
        if self.known == "attitude" and self.field_ned_ut is None:
            raise ValueError('known = "attitude" needs field_ned_ut')
        return self

    def vector(self) -> FloatArray:
        """The field, north, east, down, uT; known only where it was given."""
        return np.array(self.field_ned_ut or (0.0, 0.0, 0.0))

    def size(self) -> float:
        """Of the field, uT."""
        return self.field_ut or float(np.linalg.norm(self.vector()))


class SequenceConfig(_Model):
    """What was done with a head, and with the magnetometer beside it."""

    latitude_deg: Annotated[float, Field(gt=-90, lt=90)]
    height_m: Finite = 0.0
    attitude_sigma_arcsec: NotNegative = 0.0
    """How well the attitudes are known, about each axis; 0: exactly."""
    position: tuple[PositionConfig, ...] = ()
    turn: tuple[TurnConfig, ...] = ()
    magnetometer: SwingConfig | None = None


def read_sequence(path: Path) -> SequenceConfig:
    """The sequence in a file.

    Raises
    ------
    HilError
        The file cannot be read, is not TOML, or a key is unknown or has a wrong value.
    """
    try:
        return SequenceConfig.model_validate(read_toml(path, f"sequence {path}"))
    except ValidationError as error:
        raise HilError(explained(error, f"sequence {path}")) from error


def built_in_sequence() -> tuple[list[dict[str, float]], list[dict[str, float]]]:
    """Positions and turns: down along the 6 faces (twice, by half a turn) and the 12 edges of a cube; turns about each axis.

    Each is a table of the sequence file without its recording.
    """
    positions: list[dict[str, float]] = []
    for k, place in enumerate(np.ndindex(3, 3, 3)):
        x, y, z = (i - 1.0 for i in place)
        sides = abs(x) + abs(y) + abs(z)
        headings = {1: (0.0, 180.0), 2: (45.0 * (k % 8),)}.get(int(sides), ())
        pitch, roll = -math.asin(x / max(math.sqrt(sides), 1.0)), math.atan2(y, z)
        tilt = {"pitch_deg": round(math.degrees(pitch), 9), "roll_deg": round(math.degrees(roll), 9)}
        positions += [{"heading_deg": heading, **tilt} for heading in headings]
    turns = [
        {"heading_deg": 0.0, "pitch_deg": pitch, "roll_deg": roll, "rate_deg_s": rate}
        for pitch, roll in ((-90.0, 0.0), (0.0, 90.0), (0.0, 0.0))
        for rate in RATES_DEG_S
    ]
    return positions, turns


def simulate(
    scenario: Scenario, folder: Path, say: Say, position_s: float = POSITION_S, turn_s: float = TURN_S
) -> list[Path]:
    """Record the built-in sequence with the simulated head of a scenario, and write the sequence file beside.

    Every recording has noise of its own; the errors of the head are those that the scenario itself has.

    Raises
    ------
    HilError
        The folder cannot be written.
    """
    positions, turns = built_in_sequence()
    place = scenario.motion.latitude_deg, scenario.motion.longitude_deg, scenario.motion.height_m
    seed = scenario.seed if scenario.head.errors_seed is None else scenario.head.errors_seed
    lines = [f"latitude_deg = {place[0]!r}", f"height_m = {place[2]!r}"]
    made = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for k, step in enumerate([*positions, *turns]):
            rate = step.get("rate_deg_s", 0.0)
            kind = "turn" if rate else "position"
            path = folder / f"{k:02d}-{kind}.dhil"
            motion = {
                "latitude_deg": place[0],
                "longitude_deg": place[1],
                "height_m": place[2],
                "heading": {"offset": step["heading_deg"], "rate": rate},
                **{name: {"offset": step[f"{name}_deg"]} for name in ("pitch", "roll")},
            }
            table = scenario.model_dump(mode="json")
            table |= {"motion": motion, "duration_s": turn_s if rate else position_s, "seed": scenario.seed + 1 + k}
            table["head"] |= {
                "errors_seed": seed,
                "mounting_deg": (0, 0, 0),
                "axes": None,
                "mounting": None,
                "lever_arm_m": (0, 0, 0),
                "calibration": None,
            }
            _record(validated(table, "of the simulated calibration"), path)
            say(f"{path.name}: {', '.join(f'{key} = {one:g}' for key, one in step.items())}")
            lines += [
                "",
                f"[[{kind}]]",
                f'recording = "{path.name}"',
                *(f"{key} = {one!r}" for key, one in step.items()),
            ]
            made.append(path)
        (folder / SEQUENCE).write_text("\n".join(lines) + "\n")
    except OSError as error:
        raise HilError(f"{folder}: {error.strerror}") from error
    return made


def _record(scenario: Scenario, path: Path) -> None:
    """What `hil run --speed max --record` writes, without navigation, at device time from the present day on."""
    began = int(datetime.datetime.now(datetime.UTC).timestamp()) * 10**9
    head = SimulatedHead(scenario)
    with RecordingWriter(path, {"scenario": scenario.model_dump(mode="json"), "created_ns": began}) as writer:
        for first, slow, batch in head.chunks(round((scenario.duration_s or 0.0) / head.step)):
            slow["time_ns"] = began + first * head.period_us * 1000
            k = head.frames_per_sample
            batch["time_ns"] = began + np.repeat(first + 1 + np.arange(len(batch) // k), k) * head.period_us * 1000
            writer.write(slow)
            writer.write(batch)
