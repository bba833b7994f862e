"""`hil calibrate`: from recordings and what was done in them to the calibration file of a head.

The sequence file (:mod:`hil.calibration_sequence`) says, for each recording, how the head stood or how it was turned.
"""

import datetime
import math
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from drivers import FrameDriver, make_driver
from hil.calibration import CHANNELS, NO_HEAD, CalibrationFile, from_fit, rotor_of, validated
from hil.calibration_sequence import PositionConfig, Say, SequenceConfig, TurnConfig, read_sequence
from hil.magnetometer import fit as fit_magnetometer
from hil.scenario import Scenario, load
from hil.scenario import validated as validated_scenario
from hil.source import FileSource, is_own, scenario_table
from nav.errors import HilError
from nav.increments import FloatArray, HeadIncrements
from nav.instruments.calibration_fit import fit
from nav.instruments.calibration_stretch import Stretch, steady_part, stretch, without_lag
from nav.rotation import dcm_from_euler


def calibrate(
    recordings: Sequence[Path],
    sequence_file: Path,
    scenario_file: str | None,
    date: datetime.date | None,
    say: Say,
    base: CalibrationFile | None = None,
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
    base : CalibrationFile, optional
        Calibration of the head to which that of a magnetometer alone is added; None: a head without errors.

    Raises
    ------
    HilError
        A file cannot be used, the recordings are of several heads, or do not show the sequence.
    """
    sequence = read_sequence(sequence_file)
    steps = (*sequence.position, *sequence.turn)
    given = {path.name: path for path in recordings}
    swing = sequence.magnetometer
    named = {step.recording for step in steps} | ({swing.recording} if swing else set())
    missing = sorted(named - set(given))
    if missing:
        raise HilError(f"sequence {sequence_file}: recording = {missing[0]!r}: it is not among the recordings given")
    unused = sorted(set(given) - named)
    if unused:
        raise HilError(
            f"sequence {sequence_file}: nothing is said of the recording {unused[0]}; leave it out or say it"
        )
    if not named:
        raise HilError(f"sequence {sequence_file}: no [[position]], no [[turn]] and no [magnetometer]")
    if steps and base is not None:
        raise HilError(f"sequence {sequence_file}: it has positions or turns of its own: leave the base out")
    if steps:
        found = _head(given, sequence, scenario_file, date, say)
    else:
        day = date or datetime.datetime.now(datetime.UTC).date()
        found = base or validated(NO_HEAD | {"date": day}, "of no head")
    if swing is None:
        return found
    table = fit_magnetometer(swing, given[swing.recording])
    say(f"{swing.recording}: {table.readings} readings of the magnetometer")
    return found.model_copy(update={"magnetometer": table})


def _head(
    given: dict[str, Path],
    sequence: SequenceConfig,
    scenario_file: str | None,
    date: datetime.date | None,
    say: Say,
) -> CalibrationFile:
    """Gyros and accelerometers from the positions and turns."""
    steps = (*sequence.position, *sequence.turn)
    given = {name: path for name, path in given.items() if name in {step.recording for step in steps}}
    head = load(scenario_file).head if scenario_file else _scenario_of(next(iter(given.values()))).head
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
    table = scenario_table(path)
    return load(None) if table is None else validated_scenario(table, f"in recording {path}")


def _samples(path: Path) -> tuple[HeadIncrements, FrameDriver, datetime.date]:
    """All samples of a recording, its driver, and the day of its first frame."""
    source, driver = FileSource(path, paced=False), make_driver("dtg-head")
    parts: list[HeadIncrements] = []
    began = 0
    for batch in source.batches(4096):
        began = began or int(batch["time_ns"][0]) if len(batch) else began
        got = driver.decode(batch)
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
    table = file.magnetometer
    if table is not None and table.hard_iron_sigma_ut is not None and table.matrix_sigma is not None:
        names = [f"m{axis}" for axis in "xyz"]
        pairs = [("hard_iron_ut", table.hard_iron_ut, table.hard_iron_sigma_ut)]
        pairs += [(f"matrix[{k}]", table.matrix[k], table.matrix_sigma[k]) for k in range(3)]
        for key, value, one in pairs:
            listed += [
                {"axis": m, "key": key, "value": v, "sigma": s} for m, v, s in zip(names, value, one, strict=True)
            ]
    return listed
