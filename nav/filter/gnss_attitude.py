"""Attitude from the carrier phases of four GNSS antennas in one epoch (source 002, Babich).

Antennas a, b, c, d at known places of the body. For a satellite in the direction u_n (unit vector in e) and the baseline l_j
from d to a, b or c, with whole cycles resolved,

    u_n . l_j = lambda dphi_j / (2 pi)

Least squares over the satellites gives the baselines in e, with the covariance Q = (U^T U)^-1 times R between baselines:
R = sigma^2 (I + 1 1^T), because all share antenna d. The rotation C_eb is that of the singular values of
``sum_jk (R^-1)_jk l_j,e l_k,b^T``; the source inverts [l_a l_b l_c]_b, which antennas in one plane do not allow. Its error is,
to first order,

    theta = H^-1 sum_jk (R^-1)_jk [l_j x] dl_k,   H = sum_jk (R^-1)_jk (l_j . l_k I - l_k l_j^T)
"""

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from nav.aiding import Kind, aiding
from nav.errors import HilError
from nav.frames import level_in_earth
from nav.increments import FloatArray
from nav.rotation import conjugate, dcm_from_quaternion, product, quaternion_from_dcm
from nav.strapdown import Strapdown

FALSE_ALARM = 1e-4
"""Chance that an epoch of healthy satellites is found bad."""
WORST_SPREAD = 0.05
"""Least ratio of the smallest needed singular value to the largest, of the satellites' directions and of the baselines."""


class AttitudeRefused(HilError):
    """The epoch cannot give an attitude; the message says why."""


@dataclass(frozen=True, slots=True)
class GnssAttitude:
    """Attitude of one epoch.

    Attributes
    ----------
    q_eb : (4,) float
        Body to e.
    covariance : (3, 3) float
        Of the error, a rotation vector in e, rad^2.
    excluded : tuple of int
        Satellites that were left out.
    """

    q_eb: FloatArray
    covariance: FloatArray
    excluded: tuple[int, ...]

    def level(self, lat: float, lon: float) -> tuple[FloatArray, FloatArray]:
        """q_nb (4,) and the covariance (3, 3) of its error in n, rad^2, at a place, rad."""
        q_ne = conjugate(level_in_earth(lat, lon))
        c_ne = dcm_from_quaternion(q_ne)
        return product(q_ne, self.q_eb), c_ne @ self.covariance @ c_ne.T

    def row(self, time: float, lat: float, lon: float) -> np.void:
        """The row of `nav.aiding.AIDING` for the time of the epoch, s, and the place, rad."""
        q_nb, covariance = self.level(lat, lon)
        return aiding(time, Kind.ATTITUDE, tuple(q_nb), tuple(np.sqrt(np.diag(covariance))))


def attitude(
    directions_e: FloatArray, phases: FloatArray, antennas_b: FloatArray, wavelength: float, sigma: float
) -> GnssAttitude:
    """Attitude from the phases of one epoch.

    Parameters
    ----------
    directions_e : (n, 3) float
        Unit vectors from the receiver to the satellites, in e.
    phases : (n, 3) float
        Phase of antennas a, b, c less that of d, whole cycles resolved, rad. It grows towards the satellite.
    antennas_b : (4, 3) float
        Places of a, b, c, d in the body, m.
    wavelength : float
        m.
    sigma : float
        Noise of one antenna's phase, m.

    Raises
    ------
    AttitudeRefused
        A value is not finite or a direction no unit vector, fewer than three satellites are left or they lie near a plane, the
        antennas lie near a line, or a satellite is bad and no other can tell which.
    """
    ranges = wavelength / (2.0 * math.pi) * phases
    if not np.isfinite([sigma, *directions_e.ravel(), *ranges.ravel(), *antennas_b.ravel()]).all() or sigma <= 0.0:
        raise AttitudeRefused("GNSS attitude: a phase, direction or antenna is not a number, or sigma is not positive")
    if (np.abs(np.linalg.norm(directions_e, axis=1) - 1.0) > 1e-6).any():
        raise AttitudeRefused("GNSS attitude: a direction is no unit vector")
    l_b = antennas_b[:3] - antennas_b[3]
    spread = np.linalg.svd(l_b, compute_uv=False)
    if spread[1] < WORST_SPREAD * spread[0]:
        raise AttitudeRefused(
            "GNSS attitude: the antennas lie on a line, which leaves the turn about it open; move one"
        )
    weight = (np.eye(3) - 0.25) / sigma**2  # R^-1
    kept, excluded = _healthy(directions_e, ranges, weight)
    u = directions_e[kept]
    l_e = np.linalg.lstsq(u, ranges[kept], rcond=None)[0].T
    left, _, right = np.linalg.svd(l_e.T @ weight @ l_b)
    c_eb = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return GnssAttitude(quaternion_from_dcm(c_eb), _covariance(l_b @ c_eb.T, weight, np.linalg.inv(u.T @ u)), excluded)


def start_from_epoch(
    core: Strapdown, lat: float, lon: float, height: float, vel_n: FloatArray, found: GnssAttitude, azimuth: float = 0.0
) -> None:
    """Align an inertial navigator in one epoch: C_wb, C_ew and V at once from the receiver's place, velocity and attitude.

    Parameters
    ----------
    core : Strapdown
        Of any mechanization.
    lat, lon, height, vel_n
        rad, m, (3,) m/s.
    found : GnssAttitude
        Of the same epoch.
    azimuth : float
        Of the platform where there is one, rad: any will do.
    """
    core.start(lat, lon, height, vel_n, found.level(lat, lon)[0], azimuth)


def _healthy(u: FloatArray, ranges: FloatArray, weight: FloatArray) -> tuple[FloatArray, tuple[int, ...]]:
    """Which satellites agree (n,) bool, and which were left out: the largest studentised residual first."""
    kept = np.ones(len(u), bool)
    excluded: list[int] = []
    while True:
        count = int(kept.sum())
        if count < 3:
            raise AttitudeRefused(f"GNSS attitude: {count} satellites are left and 3 are needed; wait for more")
        spread = np.linalg.svd(u[kept], compute_uv=False)
        if spread[2] < WORST_SPREAD * spread[0]:
            raise AttitudeRefused("GNSS attitude: the satellites lie near a plane, or all at one side; wait for others")
        hat = u[kept] @ np.linalg.pinv(u[kept])
        rest = ranges[kept] - hat @ ranges[kept]
        squares = np.einsum("ni,ij,nj->n", rest, weight, rest)
        if count == 3 or squares.sum() < _limit(3 * (count - 3)):
            return kept, tuple(excluded)
        if count == 4:
            raise AttitudeRefused(
                "GNSS attitude: of 4 satellites one is bad, and there is no fifth to tell which; wait"
            )
        worst = int(np.flatnonzero(kept)[np.argmax(squares / np.maximum(1.0 - np.diag(hat), 1e-9))])
        kept[worst] = False
        excluded.append(worst)


def _limit(freedom: int) -> float:
    """What a chi-square of so many degrees of freedom exceeds with the chance `FALSE_ALARM` (Wilson & Hilferty 1931)."""
    part = 2.0 / (9.0 * freedom)
    return freedom * (1.0 - part + NormalDist().inv_cdf(1.0 - FALSE_ALARM) * math.sqrt(part)) ** 3


def _covariance(l_e: FloatArray, weight: FloatArray, q: FloatArray) -> FloatArray:
    """Covariance of theta, see the module; `l_e` has a baseline in each row."""
    gram = l_e.T @ weight @ l_e
    inverse = np.linalg.inv(np.trace(gram) * np.eye(3) - gram)
    x, y, z = l_e.T
    o = np.zeros(3)
    crossed = np.moveaxis(np.array([[o, -z, y], [z, o, -x], [-y, x, o]]), -1, 0)
    spread = np.einsum("jk,jab,bc,kdc->ad", weight, crossed, q, crossed)
    out: FloatArray = inverse @ spread @ inverse.T
    return out
