"""The figures of Fomichev 2011: regular precession and pure spin."""

import math

import numpy as np

from hil.study.orientation.measure import errors, uniform
from hil.study.report import Line, Plot, Row, at_most, near, shown
from nav.attitude import method
from nav.attitude.signals import Precession
from nav.increments import FloatArray
from nav.rotation import attitude_error

ARCSEC = math.pi / 648000.0
SOURCE_RATE_HZ = 40.0
"""Attitude rate of the source; four samples each."""


def _precession_error(
    name: str, pulsation: float, nutation_deg: float, duration: float
) -> tuple[FloatArray, FloatArray]:
    signal = Precession(pulsation, pulsation, math.radians(nutation_deg))
    time, error = errors(name, signal, uniform(duration, 4.0 * SOURCE_RATE_HZ))
    return time, error / ARCSEC


def _series_drift(spin: float, duration: float) -> float:
    """Error that the series quaternion of the source makes in a pure spin, in closed form, arc seconds."""
    angle = spin / SOURCE_RATE_HZ
    g = angle * angle
    turned = 2.0 * math.atan2(angle * (0.5 - g / 48.0 + g * g / 3840.0), 1.0 - g / 8.0 + g * g / 384.0)
    return abs(turned - angle) * SOURCE_RATE_HZ * duration / ARCSEC


def _spin_drift(name: str, spin: float, duration: float) -> float:
    _, error = errors(name, Precession(spin, 0.0, 0.0), uniform(duration, 4.0 * SOURCE_RATE_HZ))
    return float(error[-1]) / ARCSEC


def published_figures() -> tuple[list[Row], list[Plot]]:
    """The figures of the source, within 30 %: they are printed to one or two digits."""
    turn = 2.0 * math.pi
    time, error = _precession_error("four-sample", turn, 45.0, 1.0)
    peak = int(error.argmax())
    angles = np.arange(0.0, 181.0, 2.0)
    at_half = np.array([_precession_error("four-sample", turn, a, 0.5)[1][-1] for a in angles])
    rows = [
        near("fomichev-peak", "W = w = 2 pi, 45 deg: largest error", error[peak], '"', 0.75, published=2.5),
        near("fomichev-peak-time", "W = w = 2 pi, 45 deg: time of it", time[peak], "s", 0.025, published=0.5),
        at_most(
            "fomichev-whole-turn", "W = w = 2 pi, 45 deg: error after the turn", error[-1], '"', 0.1, published=0.0
        ),
        near(
            "fomichev-worst-angle",
            "W = w = 2 pi: worst nutation angle",
            angles[at_half.argmax()],
            "deg",
            6.0,
            published=60,
        ),
        near(
            "fomichev-worst", "W = w = 2 pi: error at the worst angle, 0.5 s", at_half.max(), '"', 0.81, published=2.7
        ),
    ]
    for key, pulsation, duration, published in (("1.5pi", 1.5, 0.75, 1.0), ("pi", 1.0, 1.0, 0.15)):
        ours = _precession_error("four-sample", pulsation * math.pi, 60.0, duration)[1][-1]
        what = f"W = w = {key.replace('pi', ' pi').strip()}, 60 deg: error at {duration:g} s"
        rows.append(near(f"fomichev-{key}", what, ours, '"', 0.3 * published, published=published))
    for key, spin, duration, published, what in (
        ("4pi", 4.0, 0.5, 0.029, "pure spin 4 pi, series quaternion: error in a turn"),
        ("2pi", 2.0, 60.0, 0.03, "pure spin 2 pi, series quaternion: error in 60 s"),
    ):
        ours = _spin_drift("four-sample-series", spin * math.pi, duration)
        closed = _series_drift(spin * math.pi, duration)
        rows.append(
            near(f"fomichev-spin-{key}", what, ours, '"', 0.3 * published, published=published, reference=closed)
        )
    exact = _spin_drift("four-sample", 2.0 * math.pi, 60.0)
    rows.append(at_most("fomichev-spin-exact", "the same with the exact quaternion", exact, '"', 1e-6, published=0.0))
    rows += _growth()
    _, better = _precession_error("high-order:4", turn, 60.0, 0.5)
    gain = better.max() / at_half.max()
    rows.append(at_most("precession-high-order", "high-order:4 over four-sample, the same samples", gain, "1", 0.01))
    plots = [
        Plot(
            "time",
            "Regular precession, W = w = 2 pi, 45 deg (source: fig. 1)",
            "s",
            "arc seconds",
            [Line("", time, error)],
        ),
        Plot(
            "angle",
            "W = w = 2 pi, error at 0.5 s (source: fig. 3)",
            "nutation, deg",
            "arc seconds",
            [Line("", angles, at_half)],
        ),
    ]
    return rows, plots


def _growth() -> list[Row]:
    """The source's incommensurate precession, of which it says that the error oscillates and does not grow.

    The errors of all blocks are the same in axes that turn with the precession, so what one block adds along the
    precession axis adds up. In the first seconds the oscillation hides it.
    """
    signal = Precession(2.0 * math.pi, math.sqrt(3.0) * math.pi, math.pi / 4.0)
    _, error = errors("four-sample", signal, uniform(120.0, 4.0 * SOURCE_RATE_HZ))
    half = len(error) // 2
    growth = (error[half:].max() - error[:half].max()) / 60.0 / ARCSEC
    edges = uniform(1.0 / SOURCE_RATE_HZ, 4.0 * SOURCE_RATE_HZ)
    q = method("four-sample").block_ends(signal.attitude(edges[:1])[0], np.diff(edges), signal.increments(edges))
    of_a_block = abs(attitude_error(q, signal.attitude(edges[-1:]))[0, 2]) * SOURCE_RATE_HZ / ARCSEC
    what = "W = 2 pi, w = sqrt 3 pi, 45 deg"
    return [
        shown("fomichev-swing", f"{what}: largest error of the first second", error[:40].max() / ARCSEC, '"'),
        near(
            "fomichev-growth",
            f"{what}: growth of the error (the source: none; reference: of one block, along the precession axis)",
            growth,
            '"/s',
            0.1 * of_a_block,
            reference=of_a_block,
        ),
    ]
