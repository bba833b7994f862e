"""What a fit finds: the coefficients of the error models in their order, what they multiply, and how well each must be known."""

import math
from typing import Any

import numpy as np

from nav.earth import STANDARD_GRAVITY as _G
from nav.increments import FloatArray

_DEG_H = math.radians(1.0) / 3600.0
REQUIRED = {
    "gyro": {
        "bias": 10.0 * _DEG_H,
        "scale": 1e-4,
        "misalignment_other": 1e-4,
        "misalignment_spin": 1e-4,
        "unbalance": _DEG_H / _G,
        "quadrature": _DEG_H / _G,
        "axial": _DEG_H / _G,
        "asymmetry": 1e-4,
        "anisoelasticity": _DEG_H / _G**2,
        "anisoelasticity_quadrature": _DEG_H / _G**2,
        "bias_temperature[0]": _DEG_H,
        "bias_temperature[1]": 0.1 * _DEG_H,
        "scale_temperature[0]": 1e-4,
    },
    "accelerometer": {
        "bias": 1e-3 * _G,
        "scale": 1e-3,
        "misalignment_output": 1e-3,
        "misalignment_pendulous": 1e-3,
        "quadratic": 1e-4 / _G,
        "cubic": 1e-4 / _G**2,
        "cross_io": 1e-4 / _G,
        "cross_ip": 1e-4 / _G,
        "cross_po": 1e-4 / _G,
        "bias_temperature[0]": 1e-4 * _G,
        "bias_temperature[1]": 1e-5 * _G,
        "scale_temperature[0]": 1e-4,
    },
}
"""The coefficients that are fitted, in their order, and the sigma that each must reach."""
KINDS = ("gyro",) * 4 + ("accelerometer",) * 3

Values = dict[str, FloatArray]
"""By the name of the coefficient: one number a channel."""


def gyro_terms(w: FloatArray, f: FloatArray) -> tuple[float, list[float]]:
    """Rate along the input axis and the terms in the order of `REQUIRED`, from (m, 3) along input, other input and spin axis."""
    wi, wo, ws = w.mean(axis=0).tolist()
    fi, fo, fs = f.mean(axis=0).tolist()
    asymmetry = 0.5 * float(np.abs(w[:, 0]).mean())
    uneven = [float((f[:, 0] * f[:, 2]).mean()), float((f[:, 1] * f[:, 2]).mean())]
    return wi, [1.0, wi, wo, ws, fi, fo, fs, asymmetry, *uneven]


def accelerometer_terms(_: FloatArray, f: FloatArray) -> tuple[float, list[float]]:
    """Force along the input axis and the terms in the order of `REQUIRED`, at rest."""
    a, b, c = f[0].tolist()
    return a, [1.0, a, b, c, a * a, a**3, a * b, a * c, b * c]


def as_errors(values: Values) -> dict[str, Any]:
    """As the error models take them: polynomials of temperature as tuples of powers."""
    fields: dict[str, Any] = {name: tuple(map(float, one)) for name, one in values.items() if not name.endswith("]")}
    for name in ("bias_temperature", "scale_temperature"):
        powers = [tuple(map(float, one)) for key, one in values.items() if key.startswith(name)]
        fields[name] = tuple(powers) if any(any(power) for power in powers) else ()
    return fields
