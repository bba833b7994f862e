"""Navigation on error-free increments of flights in closed form: how exact each method is, and the figures of the sources.

An error is the largest distance, in three dimensions, between the computed and the true place, twice a second.
"""

import math
from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.geometry import position_error
from hil.scenario import Channel, MotionConfig, Sine, load
from hil.study.report import Line, Plot, Row, Study, at_most, near, shown
from hil.world.motion import Motion
from nav.earth import E2, GM, RATE, curvature_radii
from nav.gravitation import NORMAL, gravitation_cartesian
from nav.increments import FloatArray
from nav.nonholonomy import azimuth_change, constant_gyro_heading, solid_angle
from nav.strapdown import MECHANIZATIONS, Strapdown

DURATION_S = 2050.0
LOOK_S = 0.5
"""Time between comparisons."""
CHUNK = 24_000
"""Steps a call: a multiple of every window, so that the blocks are those of the whole record."""
METHODS = ("two-sample", "high-order:4", "high-order:6", "high-order:8")
LIMITS_M = {("agile", 10): 2e-3, ("agile", 1): 1e-6, ("smooth", 10): 1e-5, ("smooth", 1): 1e-6}
"""For high order, by flight and step in ms."""
SOURCE_STEPS_MS = (1, 2, 5, 10)
PUBLISHED_M = {1: 5.5, 10: 55.0}
"""Source 000: largest position error by step in ms; its flight is not given."""
EARTH_RADIUS_M = 6371e3
ARCMIN = math.pi / 10800.0


def flight(name: str) -> MotionConfig:
    """`smooth`: the built-in flight without its rest; `agile`: a jet that never stops banking and shaking."""
    if name == "smooth":
        return load("flight").motion.model_copy(update={"rest_s": 0.0, "ramp_s": 0.0})
    return MotionConfig(
        attitude="coordinated",
        north=Channel(rate=230.0),
        east=Channel(sines=(Sine(amplitude=176.0, period_s=35.0),)),  # bank of 30 degrees
        up=Channel(offset=3000.0, sines=(Sine(amplitude=300.0, period_s=240.0),)),
        heading=Channel(sines=(Sine(amplitude=1.0, period_s=2.0),)),
        pitch=Channel(sines=(Sine(amplitude=1.5, period_s=1.3, phase_deg=50.0),)),
        roll=Channel(sines=(Sine(amplitude=2.0, period_s=1.0, phase_deg=100.0),)),
    )


def fly(
    config: MotionConfig, step: float, cores: Mapping[str, Strapdown], duration: float = DURATION_S
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Fly all `cores` on the same exact increments.

    Returns
    -------
    time : (m,) float
        s.
    errors : dict of (m,) float
        Position error, m, by the names of `cores`.
    """
    motion = Motion(config)
    truth = motion.truth([0.0])[0]
    for core in cores.values():
        core.start(truth["lat"], truth["lon"], truth["height"], truth["vel_n"], truth["q_nb"])
    stride = round(LOOK_S / step)
    out = np.empty((CHUNK, 3)), np.empty((CHUNK, 3)), np.empty((CHUNK, 4))
    times: list[FloatArray] = []
    found: dict[str, list[FloatArray]] = {name: [] for name in cores}
    for first, dtheta, dvel in _increments(motion, step, round(duration / step)):
        n = len(dtheta)
        rows = np.arange(stride - 1, n, stride)
        times.append(np.asarray((first + rows + 1) * step, np.float64))
        truths = motion.truth(times[-1])
        for name, core in cores.items():
            core.advance(np.full(n, step), dtheta, dvel, np.zeros(3), out[0][:n], out[1][:n], out[2][:n])
            lat, lon, height = np.ascontiguousarray(out[0][rows].T)
            found[name].append(np.linalg.norm(position_error(lat, lon, height, truths), axis=1))
    return np.concatenate(times), {name: np.concatenate(parts) for name, parts in found.items()}


def _increments(motion: Motion, step: float, count: int) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    dtheta, dvel = np.empty((CHUNK, 3)), np.empty((CHUNK, 3))
    for first in range(0, count, CHUNK):
        n = min(CHUNK, count - first)
        motion.increments(first, n, step, dtheta[:n], dvel[:n])
        yield first, dtheta[:n], dvel[:n]


def _exactness() -> tuple[list[Row], list[Plot]]:
    rows, plots = [], []
    for (name, step_ms), limit in LIMITS_M.items():
        cores = {method: Strapdown(method, whole_record=True) for method in METHODS}
        time, errors = fly(flight(name), 1e-3 * step_ms, cores)
        for method, error in errors.items():
            key, what = f"{name}-{step_ms}ms-{method}", f"{name} flight, {DURATION_S:g} s, {step_ms} ms: {method}"
            if method == "two-sample":
                rows.append(shown(key, what, error.max(), "m"))
            else:
                rows.append(at_most(key, what, error.max(), "m", limit))
        if step_ms == 10:
            lines = [Line(method, time, error) for method, error in errors.items()]
            title = f"Position error, {name} flight, 10 ms, geographic"
            plots.append(Plot(f"{name}-10ms", title, "s", "m", lines, log=True))
    return rows, plots


def frame_cores() -> dict[str, Strapdown]:
    """Every mechanization, with the body integrals of high order where it takes them."""
    cores = {name: Strapdown("high-order:6", name, whole_record=True) for name in MECHANIZATIONS[:-1]}
    return cores | {MECHANIZATIONS[-1]: Strapdown(mechanization=MECHANIZATIONS[-1])}


def _frames() -> tuple[list[Row], list[Plot]]:
    """The source's comparison of reference frames, each with the body integrals of high order."""
    cores = frame_cores()
    time, errors = fly(flight("agile"), 0.01, cores)
    rows = []
    for name, error in errors.items():
        if name == "inertial-source":
            what = f"agile flight, 10 ms: {name}, its own attitude (reference: from the lag of gravity)"
            lag = 0.01 * gravity_lag(flight("agile"))[1].max()
            rows.append(shown(f"frame-{name}", what, error.max(), "m", reference=lag))
        else:
            what = f"agile flight, 10 ms, high-order:6: {name}"
            rows.append(at_most(f"frame-{name}", what, error.max(), "m", LIMITS_M["agile", 10]))
    lines = [Line(name, time, error) for name, error in errors.items()]
    return rows, [Plot("frames", "Position error by reference frame, agile flight, 10 ms", "s", "m", lines, log=True)]


def gravity_lag(
    config: MotionConfig, duration: float = DURATION_S, every: float = 0.5
) -> tuple[FloatArray, FloatArray]:
    """Position error, per second of step, of a mechanization that takes gravitation at the start of each step.

    Gravitation then lags by half a step: the acceleration is wrong by -(T/2) dg/dt along the flight, seen from inertial
    axes, and the error grows by the gradient of a sphere's gravitation.

    Returns
    -------
    time, error : (n,), (n,) float
        s, and m per s of step.
    """
    time: FloatArray = np.asarray(np.arange(round(duration / every) + 1) * every, np.float64)
    place, g = _inertial_places(Motion(config).truth(time), time)
    lag = -0.5 * np.gradient(g, every, axis=0)
    offset, speed = np.zeros(3), np.zeros(3)
    error = np.zeros(len(time))
    for k in range(len(time) - 1):  # leapfrog: half a kick, a drift, half a kick
        speed = speed + 0.5 * every * (lag[k] + _gradient(place[k], offset))
        offset = offset + every * speed
        speed = speed + 0.5 * every * (lag[k + 1] + _gradient(place[k + 1], offset))
        error[k + 1] = np.linalg.norm(offset)
    return time, error


def _inertial_places(truth: NDArray[np.void], time: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places and gravitation in inertial axes."""
    place, g = np.empty((len(time), 3)), np.empty((len(time), 3))
    for k, row in enumerate(truth):
        s, c, angle = math.sin(row["lat"]), math.cos(row["lat"]), float(row["lon"]) + RATE * float(time[k])
        prime = curvature_radii(s)[1]
        p = (prime + row["height"]) * c
        place[k] = p * math.cos(angle), p * math.sin(angle), (prime * (1.0 - E2) + row["height"]) * s
        x, y, z = place[k]
        g[k] = gravitation_cartesian(NORMAL, x, y, z, s, c)
    return place, g


def _gradient(place: FloatArray, offset: FloatArray) -> FloatArray:
    r2 = float(place @ place)
    change: FloatArray = -GM / (r2 * math.sqrt(r2)) * (offset - 3.0 * (place @ offset) / r2 * place)
    return change


def _source() -> tuple[list[Row], list[Plot]]:
    config = flight("smooth")
    lag_time, lag = gravity_lag(config)
    largest, lines, rows = [], [], []
    for step_ms in SOURCE_STEPS_MS:
        step = 1e-3 * step_ms
        time, errors = fly(config, step, {"": Strapdown(mechanization="inertial-source")})
        ours, predicted = errors[""].max(), step * lag.max()
        largest.append(ours)
        lines.append(Line(f"{step_ms} ms", time, errors[""]))
        rows.append(
            near(
                f"source-{step_ms}ms",
                f"smooth flight, {step_ms} ms: inertial-source (reference: from the lag of gravity)",
                ours,
                "m",
                0.1 * predicted,
                reference=predicted,
            )
        )
        if step_ms in PUBLISHED_M:
            published = PUBLISHED_M[step_ms]
            what = f"the same beside the source's figure: {published / ours:.0f} times ours; its flight is not given"
            rows.append(shown(f"source-published-{step_ms}ms", what, ours, "m", published=published))
    agile = fly(flight("agile"), 0.005, {"": Strapdown(mechanization="inertial-source")})[1][""].max()
    lag_agile = 0.005 * gravity_lag(flight("agile"))[1].max()
    what = "agile flight, 5 ms: inertial-source (reference: from the lag of gravity)"
    rows.append(shown("source-agile-5ms", what, agile, "m", reference=lag_agile))
    slope = np.polyfit(np.log(SOURCE_STEPS_MS), np.log(largest), 1)[0]
    rows.append(near("source-order", "inertial-source: order in the step", slope, "1", 0.1, published=1.0))
    lines.append(Line("10 ms, from the lag of gravity", lag_time, 0.01 * lag, "--"))
    return rows, [Plot("source", "Position error of the source's method, smooth flight", "s", "m", lines)]


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


def _azimuth() -> tuple[list[Row], list[Plot]]:
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
    motion, step = Motion(flight("agile")), 0.01
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


def run() -> Study:
    """All of it."""
    rows: list[Row] = []
    plots: list[Plot] = []
    for part in (_exactness, _frames, _source, _azimuth):
        more_rows, more_plots = part()
        rows += more_rows
        plots += more_plots
    about = (
        "Error-free increments of flights known in closed form, 2050 s each. Agile: 230 m/s, bank of 30 degrees to both sides "
        "every 35 s, attitude shaken by 1 to 2 degrees at 0.5 to 1 Hz. Smooth: the built-in flight without its rest. Error: "
        "the largest distance from the true place. High order works in blocks of the record, to both sides."
    )
    return Study("navigation", "Navigation on error-free increments", about, rows, plots)
