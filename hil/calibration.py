"""The calibration file of a head: TOML in units that people read, one number a channel, with the sigma of each.

The gyro lists stand in the order g1x, g1y, g2y, g2z, the accelerometer lists in the order x, y, z. Names are those of
:mod:`nav.instruments.gyro_errors` and :mod:`nav.instruments.accelerometer_errors`, the unit follows.
"""

import datetime
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, create_model, model_validator

from hil.scenario import Finite, RotorConfig, Vector, explained
from hil.toml import read_toml
from nav.earth import STANDARD_GRAVITY as _G
from nav.errors import HilError
from nav.instruments.accelerometer_errors import AccelerometerErrors
from nav.instruments.calibration import ACCELEROMETER_TERMS, CASES, GYRO_TERMS, POWERS, Calibration
from nav.instruments.calibration_fit import Fit
from nav.instruments.calibration_terms import Values
from nav.instruments.dtg import Rotor
from nav.instruments.gyro_errors import GyroErrors

_DEG_H = math.radians(1.0) / 3600.0
_ARCSEC = _DEG_H
_PPM = 1e-6
UNITS = {
    "gyro": {
        "bias": ("deg_h", _DEG_H),
        "scale": ("ppm", _PPM),
        "misalignment_other": ("arcsec", _ARCSEC),
        "misalignment_spin": ("arcsec", _ARCSEC),
        "unbalance": ("deg_h_g", _DEG_H / _G),
        "quadrature": ("deg_h_g", _DEG_H / _G),
        "axial": ("deg_h_g", _DEG_H / _G),
        "asymmetry": ("ppm", _PPM),
        "anisoelasticity": ("deg_h_g2", _DEG_H / _G**2),
        "anisoelasticity_quadrature": ("deg_h_g2", _DEG_H / _G**2),
        "bias_temperature": ("deg_h_k", _DEG_H),
        "scale_temperature": ("ppm_k", _PPM),
    },
    "accelerometer": {
        "bias": ("ug", 1e-6 * _G),
        "scale": ("ppm", _PPM),
        "misalignment_output": ("arcsec", _ARCSEC),
        "misalignment_pendulous": ("arcsec", _ARCSEC),
        "quadratic": ("ug_g2", 1e-6 / _G),
        "cubic": ("ug_g3", 1e-6 / _G**2),
        "cross_io": ("ug_g2", 1e-6 / _G),
        "cross_ip": ("ug_g2", 1e-6 / _G),
        "cross_po": ("ug_g2", 1e-6 / _G),
        "asymmetry": ("ppm", _PPM),
        "odd_quadratic": ("ug_g2", 1e-6 / _G),
        "output_square": ("ug_g2", 1e-6 / _G),
        "pendulous_square": ("ug_g2", 1e-6 / _G),
        "bias_temperature": ("ug_k", 1e-6 * _G),
        "scale_temperature": ("ppm_k", _PPM),
    },
}
"""Unit in the file and its size; polynomials of the temperature: of the first power, the second by K^2 and so on."""
CHANNELS = {"gyro": ("g1x", "g1y", "g2y", "g2z"), "accelerometer": ("ax", "ay", "az")}
NO_HEAD = {"serial": 0, "date": datetime.date.min, "gyro": {}, "accelerometer": {}}
"""Calibration of no particular head, without errors."""
Numbers = tuple[float, ...]
Table = dict[str, Any]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


def _as_many(kind: str) -> Any:
    """Validator: a number for each channel."""
    names = CHANNELS[kind]

    def check(values: Numbers) -> Numbers:
        if len(values) != len(names):
            raise ValueError(f"expected {len(names)} numbers, for {', '.join(names)}; got {len(values)}")
        return values

    return AfterValidator(check)


def _table(kind: str, number: Any, default: float | None) -> type[_Model]:
    """Model of the table of one kind of instrument."""
    fields: dict[str, Any] = {}
    each = Annotated[tuple[number, ...], _as_many(kind)]
    names = CHANNELS[kind]
    for name, (unit, _) in UNITS[kind].items():
        if name.endswith("temperature"):
            powers = Annotated[tuple[each, ...], Field(max_length=POWERS)]
            fields[f"{name}_{unit}"] = (powers, ())
        elif default is None:
            fields[f"{name}_{unit}"] = (each | None, None)
        else:
            fields[f"{name}_{unit}"] = (each, (default,) * len(names))
    return create_model(f"{kind}_table", __base__=_Model, **fields)


class SigmaTables(_Model):
    """1-sigma of the values; inf: not determined. Left out: not known."""

    gyro: _table("gyro", Annotated[float, Field(ge=0)], None)  # type: ignore[valid-type]
    accelerometer: _table("accelerometer", Annotated[float, Field(ge=0)], None)  # type: ignore[valid-type]


class Residuals(_Model):
    """What the fit has left."""

    positions: Annotated[int, Field(ge=0)]
    turns: Annotated[int, Field(ge=0)]
    gyro_deg_h: Annotated[tuple[Finite, ...], _as_many("gyro")]
    accelerometer_ug: Annotated[tuple[Finite, ...], _as_many("accelerometer")]
    factor: tuple[Finite, Finite]
    """Sigma of gyro and accelerometer outputs over that of their white noise."""
    redundancy: tuple[Finite, Finite]


class MagnetometerTable(_Model):
    """Of the magnetometer beside the head: flux in b = matrix (reading - hard iron)."""

    source: Annotated[int, Field(ge=0, lt=256)] = 0
    """Its number among the magnetometers on the bus."""
    hard_iron_ut: Vector
    matrix: tuple[Vector, Vector, Vector]
    """Rows of S: soft iron, scale and misalignment."""
    hard_iron_sigma_ut: Vector | None = None
    matrix_sigma: tuple[Vector, Vector, Vector] | None = None
    residual_ut: Finite | None = None
    """Rms of what the fit left of one component."""
    readings: Annotated[int, Field(ge=0)] = 0


class CalibrationFile(_Model):
    """Calibration of one head, and of the magnetometer beside it."""

    serial: Annotated[int, Field(ge=0, lt=2**32)]
    date: datetime.date
    skew_deg: Finite = 0.0
    reference_c: tuple[Finite, Finite, Finite] | None = None
    """Temperatures of gyro 1, gyro 2 and the accelerometers to which the values belong."""
    range_c: tuple[tuple[Finite, Finite], tuple[Finite, Finite], tuple[Finite, Finite]] | None = None
    gyro: _table("gyro", Finite, 0.0)  # type: ignore[valid-type]
    accelerometer: _table("accelerometer", Finite, 0.0)  # type: ignore[valid-type]
    rotor: tuple[RotorConfig, RotorConfig] | None = None
    """Measured rotors of gyro 1 and gyro 2; left out: those of the scenario."""
    magnetometer: MagnetometerTable | None = None
    undetermined: tuple[str, ...] = ()
    sigma: SigmaTables | None = None
    residual: Residuals | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "CalibrationFile":
        if (self.reference_c is None) != (self.range_c is None):
            raise ValueError("reference_c and range_c belong together: give both or neither")
        for reference, (low, high) in zip(self.reference_c or (), self.range_c or (), strict=True):
            if not low <= reference <= high:
                raise ValueError(f"range_c = [{low:g}, {high:g}] does not hold reference_c = {reference:g}")
        depends = any(
            name.endswith("_k") and getattr(self, kind).__dict__[name] for kind in UNITS for name in _keys(kind)
        )
        if depends and self.reference_c is None:
            raise ValueError("polynomials of the temperature need reference_c and range_c")
        return self

    def calibration(self) -> Calibration:
        """As the core takes it."""
        gyro, force = (_si(kind, getattr(self, kind)) for kind in ("gyro", "accelerometer"))
        ends: Table = {}
        if self.reference_c is not None and self.range_c is not None:
            coldest, warmest = zip(*self.range_c, strict=True)
            ends = {"reference": self.reference_c, "coldest": coldest, "warmest": warmest}
        rotors = None if self.rotor is None else (rotor_of(self.rotor[0]), rotor_of(self.rotor[1]))
        return Calibration(GyroErrors(**gyro, channels=CASES), AccelerometerErrors(**force), rotors, **ends)

    def as_table(self) -> Table:
        """What a run needs of it, as plain values."""
        return self.model_dump(mode="json", exclude={"sigma", "residual"}, exclude_none=True)


def rotor_of(config: RotorConfig) -> Rotor:
    """The rotor that a scenario or a calibration describes."""
    return Rotor.from_ratios(
        2.0 * math.pi * config.spin_hz, config.inertia_ratio, config.stiffness_ratio, config.damping_ratio
    )


def _keys(kind: str) -> list[str]:
    return [f"{name}_{unit}" for name, (unit, _) in UNITS[kind].items()]


def _si(kind: str, table: Any) -> Table:
    values: Table = {}
    for name, (unit, size) in UNITS[kind].items():
        given = getattr(table, f"{name}_{unit}")
        if name.endswith("temperature"):
            values[name] = tuple(tuple(size * one for one in power) for power in given)
        else:
            values[name] = tuple(size * one for one in given)
    return values


def from_fit(
    fit: Fit,
    *,
    serial: int,
    date: datetime.date,
    skew_deg: float,
    counts: tuple[int, int],
) -> CalibrationFile:
    """The file of a fit; `counts` are the positions and the turns that it is made of."""
    c = fit.calibration
    known = math.isfinite(c.warmest[0])
    return CalibrationFile.model_validate(
        {
            "serial": serial,
            "date": date,
            "skew_deg": skew_deg,
            "reference_c": _scaled(c.reference, 1.0) if known else None,
            "range_c": tuple(_scaled(ends, 1.0) for ends in zip(c.coldest, c.warmest, strict=True)) if known else None,
            "gyro": _written("gyro", GYRO_TERMS, c.gyros),
            "accelerometer": _written("accelerometer", ACCELEROMETER_TERMS, c.accelerometers),
            "undetermined": fit.undetermined,
            "sigma": {
                "gyro": _written_sigma("gyro", fit.gyro_sigma),
                "accelerometer": _written_sigma("accelerometer", fit.accelerometer_sigma),
            },
            "residual": {
                "positions": counts[0],
                "turns": counts[1],
                "gyro_deg_h": _scaled(fit.residual[:4], _DEG_H),
                "accelerometer_ug": _scaled(fit.residual[4:], 1e-6 * _G),
                "factor": _scaled(fit.factor, 1.0),
                "redundancy": _scaled(fit.redundancy, 1.0),
            },
        }
    )


def _scaled(values: Iterable[float], size: float) -> Numbers:
    """In the unit of the file, to seven digits."""
    return tuple(float(f"{one / size:.7g}") for one in values)


def _written(kind: str, terms: tuple[str, ...], errors: GyroErrors | AccelerometerErrors) -> Table:
    table: Table = {}
    for name, (unit, size) in UNITS[kind].items():
        value = getattr(errors, name)
        if name.endswith("temperature"):
            table[f"{name}_{unit}"] = tuple(_scaled(power, size) for power in value)
        elif name in terms and isinstance(value, tuple):
            table[f"{name}_{unit}"] = _scaled(value, size)
    return table


def _written_sigma(kind: str, sigma: Values) -> Table:
    table: Table = {}
    for name, (unit, size) in UNITS[kind].items():
        powers = tuple(_scaled(one, size) for key, one in sigma.items() if key.startswith(f"{name}["))
        if name in sigma:
            table[f"{name}_{unit}"] = _scaled(sigma[name], size)
        elif powers:
            table[f"{name}_{unit}"] = powers
    return table


def read(path: Path) -> CalibrationFile:
    """The calibration in a file.

    Raises
    ------
    HilError
        The file cannot be read, is not TOML, or a key is unknown or has a wrong value.
    """
    if not path.exists():
        raise HilError(f"calibration {path}: No such file or directory; `hil calibrate` makes one")
    return validated(read_toml(path, f"calibration {path}"), str(path))


def validated(table: Mapping[str, Any], source: str) -> CalibrationFile:
    """The calibration in a table of plain values; `source` names it in errors.

    Raises
    ------
    HilError
        A key is unknown or has a wrong value.
    """
    try:
        return CalibrationFile.model_validate(table)
    except ValidationError as error:
        raise HilError(explained(error, f"calibration {source}")) from error


def write(path: Path, file: CalibrationFile) -> None:
    """Write a calibration.

    Raises
    ------
    HilError
        The file cannot be written.
    """
    table = file.model_dump(exclude_none=True)
    lines = ["# Made by hil calibrate. Gyro lists: g1x, g1y, g2y, g2z; accelerometer lists: x, y, z."]
    lines += _toml(table)
    try:
        path.write_text("\n".join(lines) + "\n")
    except OSError as error:
        raise HilError(f"calibration {path}: {error.strerror}") from error


def _toml(table: Table, prefix: str = "") -> list[str]:
    """Lines of a table: its values first, then the tables in it."""
    lines = [
        f"{key} = {_value(one)}"
        for key, one in table.items()
        if not isinstance(one, dict) and key != "rotor" and one != ()
    ]
    for key, one in table.items():
        inner = [one] if isinstance(one, dict) else one if key == "rotor" else []
        for part in inner:
            name = f"[{prefix}{key}]" if isinstance(one, dict) else f"[[{prefix}{key}]]"
            lines += ["", name, *_toml(part, f"{prefix}{key}.")]
    return lines


def _value(one: Any) -> str:
    if isinstance(one, list | tuple):
        return f"[{', '.join(map(_value, one))}]"
    if isinstance(one, datetime.date):
        return one.isoformat()
    return repr(one) if isinstance(one, float) else json.dumps(one)
