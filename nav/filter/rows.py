"""Rows of `nav.aiding.AIDING`, checked, in the order in which they are taken."""

import math
from typing import Any, NamedTuple

import numpy as np

from nav.aiding import Kind
from nav.errors import HilError
from nav.filter.settings import Settings
from nav.increments import FloatArray

VALUES = {
    Kind.GNSS: 6,
    Kind.BARO: 1,
    Kind.MAGNETIC: 3,
    Kind.HEADING: 1,
    Kind.ATTITUDE: 4,
    Kind.BODY_VELOCITY: 3,
    Kind.ZERO_RATE: 0,
    Kind.GRAVITY: 0,
}
"""How many values a kind has."""


class Row(NamedTuple):
    """A measurement, and its place in the order: by time, and the same for rows of one time, however they came."""

    key: tuple[float, ...]
    kind: Kind
    source: int
    value: FloatArray
    sigma: FloatArray

    @property
    def time(self) -> float:
        """When it is taken, s."""
        return self.key[0]


def checked(row: Any, settings: Settings) -> Row:
    """A row of `AIDING`, checked.

    Raises
    ------
    HilError
        A value or a sigma that is used is no number, the kind is unknown, or there is no magnetic field to compare with.
    """
    time, number, source = float(row["time"]), int(row["kind"]), int(row["source"])
    if number not in VALUES:
        raise HilError(f"aiding row at {time:g} s: unknown kind {number}; there is: {', '.join(k.name for k in Kind)}")
    kind = Kind(number)
    if kind == Kind.MAGNETIC and settings.field_n is None:
        raise HilError("aiding row MAGNETIC: no magnetic field to compare with: give Settings.field_n")
    value, sigma = np.array(row["value"], float), np.array(row["sigma"], float)
    used = value[: VALUES[kind]]
    if not (math.isfinite(time) and np.isfinite(used).all() and (sigma > 0.0).all()):
        raise HilError(f"aiding row {kind.name} at {time:g} s: a value is no number, or a sigma is not positive")
    if kind == Kind.GNSS:
        time -= settings.delay
    return Row((time, number, source, *map(float, value), *map(float, sigma)), kind, source, value, sigma)
