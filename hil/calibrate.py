"""`hil calibrate`: from recordings and what was done in them to the calibration file of a head.

The sequence file says, for each recording, how the head stood or how it was turned. A simulated sequence is made by
`simulate`: the head of a scenario in 24 positions and 12 turns, one recording each.
"""

import datetime
import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from drivers import FrameDriver, make_driver
from drivers.can.frames import frames
from drivers.logs.recording import EVENT, RecordingReader, RecordingWriter
from hil.calibration import CHANNELS, CalibrationFile, from_fit, rotor_of
from hil.scenario import Finite, NotNegative, Scenario, Vector, explained, load, validated
from hil.source import FileSource, is_own
from hil.world.head import SimulatedHead
from nav.errors import HilError
from nav.increments import FloatArray, HeadIncrements
from nav.instruments.calibration_fit import fit
from nav.instruments.calibration_stretch import Stretch, steady_part, stretch, without_lag
from nav.rotation import dcm_from_euler

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


class SequenceConfig(_Model):
    """What was done with a head."""

    latitude_deg: Annotated[float, Field(gt=-90, lt=90)]
    height_m: Finite = 0.0
    attitude_sigma_arcsec: NotNegative = 0.0
    """How well the attitudes are known, about each axis; 0: exactly."""
    position: tuple[PositionConfig, ...] = ()
    turn: tuple[TurnConfig, ...] = ()


def read_sequence(path: Path) -> SequenceConfig:
    """The sequence in a file.

    Raises
    ------
    HilError
        The file cannot be read, is not TOML, or a key is unknown or has a wrong value.
    """
    try:
        return SequenceConfig.model_validate(tomllib.loads(path.read_text()))
    except OSError as error:
        raise HilError(f"sequence {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise HilError(f"sequence {path}: not TOML: {error}") from error
    except ValidationError as error:
        raise HilError(explained(error, f"sequence {path}")) from error


def calibrate(
    recordings: Sequence[Path], sequence_file: Path, scenario_file: str | None, date: datetime.date | None, say: Say
) -> CalibrationFile:
    """Fit a calibration.

    Parameters
    ----------
    recordings : sequence of Path
        Every recording that the sequence names.
    sequence_file : Path
        What was done.
    scenario_file : str, optional
        Scenario with rotors and layout of the head; None: that of the first recording, the default for a foreign one.
    date : date, optional
        None: that of the first frame.
    say : callable
        Gets a line for each recording that is read.

    Raises
    ------
    HilError
        A file cannot be used, the recordings are of several heads, or do not show the sequence.
    """
    sequence = read_sequence(sequence_file)
    steps = (*sequence.position, *sequence.turn)
    given = {path.name: path for path in recordings}
    missing = sorted({step.recording for step in steps} - set(given))
    if missing:
        raise HilError(f"sequence {sequence_file}: recording = {missing[0]!r}: it is not among the recordings given")
    unused = sorted(set(given) - {step.recording for step in steps})
    if unused:
        raise HilError(
            f"sequence {sequence_file}: nothing is said of the recording {unused[0]}; leave it out or say it"
        )
    if not steps:
        raise HilError(f"sequence {sequence_file}: no [[position]] and no [[turn]]")
    head = load(scenario_file).head if scenario_file else _scenario_of(recordings[0]).head
    rotors = (rotor_of(head.rotor), rotor_of(head.rotor)) if head.instruments == "dtg" else None
    stretches: list[Stretch] = []
    serials: dict[int, str] = {}
    for name, path in given.items():
        samples, driver, first = _samples(path)
        say(f"{name}: {len(samples)} samples")
        date = date or first
        serials[int(str(driver.identity().get("serial", 0)))] = name
        outputs = without_lag(samples, rotors)
        for step in steps:
            if step.recording == name:
                stretches.append(_stretch(step, samples, outputs))
    if len(serials) > 1:
        pairs = ", ".join(f"{serial} in {name}" for serial, name in serials.items())
        raise HilError(f"the recordings are of several heads: serial {pairs}")
    found = fit(
        stretches,
        math.radians(sequence.latitude_deg),
        sequence.height_m,
        skew=math.radians(head.skew_deg),
        attitude_sigma=math.radians(sequence.attitude_sigma_arcsec / 3600.0),
    )
    return from_fit(
        found,
        serial=next(iter(serials)),
        date=date or datetime.date.min,
        skew_deg=head.skew_deg,
        counts=(len(sequence.position), len(sequence.turn)),
    )


def _scenario_of(path: Path) -> Scenario:
    if not is_own(path):
        return load(None)
    reader = RecordingReader.open(path)
    reader.close()
    table = reader.header.get("scenario")
    return validated(table, f"in recording {path}") if isinstance(table, dict) else load(None)


def _samples(path: Path) -> tuple[HeadIncrements, FrameDriver, datetime.date]:
    """All samples of a recording, its driver, and the day of its first frame."""
    source, driver, batch = FileSource(path, paced=False), make_driver("dtg-head"), frames(4096)
    parts: list[HeadIncrements] = []
    began = 0
    while n := source.receive(batch, 0.0):
        good = batch[:n][batch["reserved"][:n, 0] != EVENT]
        began = began or int(good["time_ns"][0]) if len(good) else began
        got = driver.decode(good)
        if isinstance(got, HeadIncrements):
            parts.append(HeadIncrements(*(getattr(got, field.name).copy() for field in fields(got))))
    if source.problem():
        raise HilError(source.problem())
    whole = HeadIncrements(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(HeadIncrements)))
    if len(whole) == 0:
        raise HilError(f"recording {path}: no samples of a head in it")
    if driver.counters.restarts:
        raise HilError(f"recording {path}: the head was started anew in it; record without a break")
    return whole, driver, datetime.datetime.fromtimestamp(began * 1e-9, datetime.UTC).date()


def _stretch(step: PositionConfig, samples: HeadIncrements, outputs: FloatArray) -> Stretch:
    turn = step.rate() if isinstance(step, TurnConfig) else np.zeros(3)
    if step.from_s is None or step.to_s is None:
        part = steady_part(samples, outputs, stands=not turn.any())
    else:
        since = samples.time - (samples.time[0] - samples.step[0])
        part = slice(*np.searchsorted(since, [step.from_s + 1e-9, step.to_s + 1e-9]).tolist())
    attitude = np.radians([step.heading_deg, step.pitch_deg, step.roll_deg])
    return stretch(f"recording {step.recording}", samples, outputs, part, dcm_from_euler(*attitude), turn)


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


def rows(file: CalibrationFile) -> list[dict[str, Any]]:
    """Every value with its sigma: axis, key of the file, value, sigma (None: not determined)."""
    listed = []
    for kind, axes in CHANNELS.items():
        values = getattr(file, kind).model_dump()
        sigmas = getattr(file.sigma, kind).model_dump() if file.sigma is not None else {}
        for key, sigma in sigmas.items():
            if sigma is None:
                continue
            powers = [(key, values[key], sigma)]
            if key.endswith("_k"):
                zeros = [(0.0,) * len(axes)] * len(sigma)
                powers = [
                    (f"{key}[{n}]", value, one)
                    for n, (value, one) in enumerate(zip(values[key] or zeros, sigma, strict=False))
                ]
            for name, value, one in powers:
                listed += [
                    {"axis": axis, "key": name, "value": v, "sigma": s if math.isfinite(s) else None}
                    for axis, v, s in zip(axes, value, one, strict=True)
                ]
    return listed
