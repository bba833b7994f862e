"""The calibration of a magnetometer between files and the loop: readings in, a table of the calibration file out, rows corrected.

Readings are a CSV as `HEADER` and `KNOWN` say, or a recording of a bus with magnetic rows among its frames.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.can.aiding import AidingDecoder
from hil.calibration import MagnetometerTable
from hil.calibration_sequence import SwingConfig
from hil.source import FileSource
from hil.tables import TABLES, read_table
from nav.aiding import Kind
from nav.errors import HilError
from nav.increments import FloatArray
from nav.instruments.magnetometer import MagnetometerCalibration, from_field, from_size, from_vertical
from nav.rotation import conjugate, quaternion_from_euler, rotated

HEADER = ("time_s", "flux_x_ut", "flux_y_ut", "flux_z_ut")
KNOWN = {
    "nothing": (),
    "vertical": ("force_x", "force_y", "force_z"),
    "attitude": ("heading_deg", "pitch_deg", "roll_deg"),
}
"""Further columns of the CSV by what is known of each reading; forces in m/s^2, or any other unit, at rest."""


def fit(swing: SwingConfig, path: Path) -> MagnetometerTable:
    """The calibration that a recording tells.

    Raises
    ------
    HilError
        The file cannot be used, or its readings do not tell it.
    """
    if path.suffix.lower() in TABLES:
        table = read_table(path, HEADER + KNOWN[swing.known])
        flux, other = table[:, 1:4], table[:, 4:]
    elif swing.known == "nothing":
        flux, other = 1e6 * _recorded(path, swing.source), np.zeros((0, 3))
    else:
        raise HilError(f"recording {path}: known = {swing.known!r} needs a CSV with {', '.join(KNOWN[swing.known])}")
    try:
        if swing.known == "vertical":
            found = from_vertical(flux, other, swing.size())
        elif swing.known == "attitude":
            q_bn = conjugate(np.array([quaternion_from_euler(*angles) for angles in np.radians(other).tolist()]))
            found = from_field(flux, rotated(q_bn, np.broadcast_to(swing.vector(), flux.shape)))
        else:
            found = from_size(flux, swing.size())
    except HilError as error:
        raise HilError(f"recording {path}: {error}") from error
    return _table(found, swing.source, len(flux))


def correct(table: MagnetometerTable, rows: NDArray[np.void]) -> None:
    """Take the calibration off the magnetic rows of `AIDING` that are of its source, in place."""
    own = (rows["kind"] == Kind.MAGNETIC) & (rows["source"] == table.source)
    if own.any():
        off = rows["value"][own, :3] - 1e-6 * np.array(table.hard_iron_ut)
        rows["value"][own, :3] = off @ np.array(table.matrix).T


def _recorded(path: Path, source: int) -> FloatArray:
    """Magnetic rows (n, 3) of a recording, T."""
    file, decoder = FileSource(path, paced=False), AidingDecoder()
    parts = [np.zeros((0, 3))]
    for batch in file.batches(4096):
        rows, _ = decoder.decode(batch, None)
        parts.append(rows["value"][(rows["kind"] == Kind.MAGNETIC) & (rows["source"] == source), :3])
    if file.problem():
        raise HilError(file.problem())
    return np.concatenate(parts)


def _table(found: MagnetometerCalibration, source: int, count: int) -> MagnetometerTable:
    sigma = np.sqrt(np.diag(found.covariance))

    def written(values: FloatArray) -> tuple[float, ...]:
        return tuple(float(f"{one:.7g}") for one in values)

    return MagnetometerTable.model_validate(
        {
            "source": source,
            "hard_iron_ut": written(found.hard_iron),
            "matrix": tuple(written(row) for row in found.matrix),
            "hard_iron_sigma_ut": written(sigma[9:]),
            "matrix_sigma": tuple(written(row) for row in sigma[:9].reshape(3, 3)),
            "residual_ut": float(f"{found.residual:.7g}"),
            "readings": count,
        }
    )
