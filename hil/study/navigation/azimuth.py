"""The wander azimuth of source 002: strip, trapezoid, constant gyroscopic heading, and A of the mechanization itself."""

import math
from importlib import import_module
from typing import Any

import numpy as np

from hil.study.navigation.flights import CHUNK, flight
from hil.study.report import Line, Plot, Row, at_most, near
from nav.earth import curvature_radii
from nav.increments import FloatArray
from nav.nonholonomy import azimuth_change, constant_gyro_heading, solid_angle
from nav.strapdown import Strapdown

EARTH_RADIUS_M = 6371e3
ARCMIN = math.pi / 10800.0


def strip_paths(length: float, width: float, count: int = 20_001) -> tuple[FloatArray, FloatArray]:
    """Planned line and the way round a strip to the left of it, on a sphere: (count, 2) and (3 count, 2) lat, lon.

    The line is a great circle from (30 deg N, 0) at 60 deg; the other way goes `width` m to the left at once, along, and back.
    """
    along, side = np.linspace(0.0, length / EARTH_RADIUS_M, count), width / EARTH_RADIUS_M
    lat, azimuth = math.radians(30.0), math.radians(60.0)
    start = np.array([math.cos(lat), 0.0, math.sin(lat)])
    ahead = math.cos(azimuth) * np.array([-math.sin(lat), 0.0, math.cos(lat)]) + math.sin(azimuth) * np.eye(3)[1]
    left = np.cross(start, ahead)

    def points(forward: FloatArray, aside: FloatArray) -> FloatArray:
        level = np.cos(forward)[:, None] * start + np.sin(forward)[:, None] * ahead
        x, y, z = (np.cos(aside)[:, None] * level + np.sin(aside)[:, None] * left).T
        return np.stack([np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)], axis=1)

    out = np.linspace(0.0, side, count)
    ends = points(np.zeros(count), out), points(np.full(count, along[-1]), out[::-1])
    return points(along, np.zeros(count)), np.concatenate([ends[0], points(along, np.full(count, side)), ends[1]])


def wander_azimuth() -> tuple[list[Row], list[Plot]]:
    planned, other = strip_paths(5e6, 5e3)
    on_planned, on_other = azimuth_change(*planned.T), azimuth_change(*other.T)
    loop = np.concatenate([other, planned[::-1]])
    area = 5e6 * 5e3 / EARTH_RADIUS_M**2 / ARCMIN
    what = "strip 5000 km x 5 km to the left of the planned line"
    difference = (on_other[-1] - on_planned[-1]) / ARCMIN
    inside = solid_angle(*loop.T) / ARCMIN
    rows = [
        near(
            "strip-azimuth",
            f"{what}: A' = L' sin B along both ways (reference: S/R^2)",
            difference,
            "'",
            1e-3,
            published=2.117,
            reference=area,
        ),
        near(
            "strip-solid-angle",
            f"{what}: solid angle of the two ways (reference: S/R^2)",
            inside,
            "'",
            1e-3,
            published=2.117,
            reference=area,
        ),
    ]
    lat1, lat2, width = math.radians(40.0), math.radians(60.0), math.radians(30.0)
    run = np.linspace(0.0, 1.0, 20_001)
    lat = np.concatenate([np.full_like(run, lat1), lat1 + (lat2 - lat1) * run, np.full_like(run, lat2), [lat1]])
    lon = np.concatenate([width * run, np.full_like(run, width), width * (1.0 - run), [0.0]])
    closed = (math.sin(lat1) - math.sin(lat2)) * width
    what = "trapezoid, parallels 40 and 60 deg, 30 deg wide: A4 - A0 (reference: (sin B1 - sin B2) dL)"
    rows.append(near("trapezoid", what, azimuth_change(lat, lon)[-1], "rad", 1e-8, reference=closed))

    start, length = (math.radians(55.0), math.radians(37.0), math.radians(70.0)), 5e6
    path = constant_gyro_heading(*start, length, 5000)
    clairaut = np.array([curvature_radii(math.sin(b))[1] * math.cos(b) for b in path[:, 0]])
    clairaut *= np.sin(start[2] + path[:, 2])
    what = "5000 km at constant gyroscopic heading: change of Clairaut's constant of a geodesic"
    rows.append(at_most("geodesic-clairaut", what, float(np.abs(clairaut / clairaut[0] - 1.0).max()), "1", 1e-12))
    rows += _against_geodesic(start, length, path)

    core = Strapdown("high-order:6", "wander", whole_record=True)
    motion, step = flight("agile"), 0.01
    truth = motion.truth([0.0])[0]
    core.start(truth["lat"], truth["lon"], truth["height"], truth["vel_n"], truth["q_nb"])
    n = CHUNK
    dtheta, dvel = np.empty((n, 3)), np.empty((n, 3))
    motion.increments(0, n, step, dtheta, dvel)
    position = np.empty((n, 3))
    core.advance(np.full(n, step), dtheta, dvel, np.zeros(3), position, np.empty((n, 3)), np.empty((n, 4)))
    lat, lon = (np.concatenate([[truth[name]], position[:, k]]) for k, name in enumerate(("lat", "lon")))
    what = "agile flight, 240 s: A of the wander mechanization (reference: A' = L' sin B along its path)"
    expected = azimuth_change(lat, lon)[-1]
    rows.append(near("wander-azimuth", what, core.azimuth, "rad", 1e-10, reference=expected))
    count = len(planned)
    apart = (on_other[count : 2 * count] - on_planned) / ARCMIN
    title = "A on the line 5 km to the left less A on the planned line"
    return rows, [Plot("strip", title, "km", "arc minutes", [Line("", np.linspace(0.0, 5e3, count), apart)])]


def _against_geodesic(start: tuple[float, float, float], length: float, path: FloatArray) -> list[Row]:
    """The end of the path of constant gyroscopic heading beside that of geographiclib; nothing where it is missing."""
    try:
        geodesic: Any = import_module("geographiclib.geodesic")
    except ImportError:
        return []
    lat, lon, heading = map(math.degrees, start)
    end = geodesic.Geodesic.WGS84.Direct(lat, lon, heading, length)
    apart = geodesic.Geodesic.WGS84.Inverse(
        end["lat2"], end["lon2"], math.degrees(path[-1, 0]), math.degrees(path[-1, 1])
    )["s12"]
    turned = math.remainder(start[2] + path[-1, 2] - math.radians(end["azi2"]), 2.0 * math.pi)
    what = "the same beside geographiclib"
    return [
        at_most("geodesic-end", f"{what}: distance of the ends", apart, "m", 1e-5),
        at_most("geodesic-azimuth", f"{what}: A + psi_r less the geodesic's azimuth", abs(turned), "rad", 1e-11),
    ]
