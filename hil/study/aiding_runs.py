"""What the runs of the study of aided navigation gave, and its figures."""

import math
from dataclasses import dataclass

import numpy as np

from hil.study.report import Band, Line, Plot
from nav.chi_square import quantile
from nav.increments import FloatArray
from nav.instruments.grades import GRADES

PARTS = ("position", "velocity", "attitude")
KINDS = ("own", "full")
GAINS = (
    ("height", "height by GNSS height", "1"),
    ("tilt", "tilt by level GNSS velocity", "deg / (m/s)"),
    ("heading", "heading by level GNSS velocity", "deg / (m/s)"),
)


@dataclass(frozen=True, slots=True)
class Runs:
    """What some runs gave, a row a second.

    Attributes
    ----------
    time : (n,) float
        s.
    errors : (seeds, n, 9) float
        Position, velocity (n), attitude: m, m/s, rad.
    sigma : (seeds, n, STATES) float
        What the filter says of each state.
    nees : (seeds, n, 3) float
        e P^-1 e of position, velocity, attitude.
    tilt, heading : (seeds, n) float
        Attitude errors as a user sees them, rad.
    nis : (seeds, m, 2) float
        Of GNSS position and velocity, 3 degrees of freedom each.
    gain : (seeds, n, 3) float
        Kalman gains of GNSS: of height by height, 1, of tilt and of heading by level velocity (norms), rad / (m/s). The
        sigma of an accepted measurement is taken as stated.
    """

    time: FloatArray
    errors: FloatArray
    sigma: FloatArray
    nees: FloatArray
    tilt: FloatArray
    heading: FloatArray
    nis: FloatArray
    gain: FloatArray

    def inside(self, since: float, until: float, campaign: int, *, upper_only: bool = False) -> FloatArray:
        """(3,): share of the epochs whose NEES, averaged over a campaign, is inside its 95 % bounds.

        Parameters
        ----------
        since, until : float
            s.
        campaign : int
            Runs of each campaign, which must go into the runs there are; the share is that of all campaigns.
        upper_only : bool
            Only the upper bound counts.
        """
        chosen = self.nees[:, (self.time >= since) & (self.time <= until)]
        mean = chosen.reshape(-1, campaign, *chosen.shape[1:]).mean(axis=1)
        low, high = nees_bounds(campaign)
        good = mean <= high if upper_only else (mean >= low) & (mean <= high)
        return np.asarray(good.mean(axis=(0, 1)), np.float64)


def nees_bounds(runs: int) -> tuple[float, float]:
    """95 % bounds of the mean NEES of 3 states over independent runs: chi-square of 3 `runs`."""
    return quantile(0.025, 3 * runs) / runs, quantile(0.975, 3 * runs) / runs


def growth(runs: Runs) -> tuple[FloatArray, FloatArray]:
    """(n,), (n,): 3-D position error, rms over the runs, and what the filter says, m."""
    rms = np.sqrt((runs.errors[:, :, :3] ** 2).sum(axis=2).mean(axis=0))
    return rms, np.sqrt((runs.sigma[:, :, :3] ** 2).sum(axis=2).mean(axis=0))


def gains(runs: Runs) -> FloatArray:
    """(n, 3): `gain`, mean over the runs, in the units of `GAINS`."""
    return np.asarray(runs.gain.mean(axis=0) * [1.0, math.degrees(1.0), math.degrees(1.0)], np.float64)


def plots(flown: dict[str, tuple[Runs, Runs]], outage: tuple[float, float], gnss_s: float) -> list[Plot]:
    """Consistency and gains until the outage, its growth, and the heading of some runs; GNSS came every `gnss_s`, s."""
    found = []
    for kind, runs in zip(KINDS, zip(*flown.values(), strict=True), strict=True):
        until = runs[0].time <= outage[0]
        time, count = runs[0].time[until], len(runs[0].errors)
        each = round(float(time[0]) / gnss_s)
        for k, part in enumerate(PARTS):
            means = [one.nees[:, until, k].mean(axis=0) for one in runs]
            found.append(_chi_square(f"nees-{kind}-{part}", f"Mean NEES of {part}", list(flown), time, means, count))
        for k, part in enumerate(PARTS[:2]):
            nis = [one.nis[:, : each * len(time), k].reshape(count, len(time), each) for one in runs]
            means = [one.mean(axis=(0, 2)) for one in nis]
            title = f"Mean NIS of GNSS {part} over a second"
            found.append(_chi_square(f"nis-{kind}-{part}", title, list(flown), time, means, count * each))
    for k, (id, of, unit) in enumerate(GAINS):
        lines = [Line(name, time, gains(full)[until, k]) for name, (_, full) in flown.items()]
        found.append(Plot(f"gain-{id}", f"Mean Kalman gain of {of}", "s", unit, lines, log=True))
    lines = []
    for name, (_, full) in flown.items():
        spread, said = growth(full)
        late = full.time >= outage[0]
        lines += [
            Line(f"{name}: rms", full.time[late], spread[late]),
            Line(f"{name}: sigma", full.time[late], said[late], "--"),
        ]
    found.append(Plot("outage", "Growth of the position error without GNSS", "s", "m", lines))
    for name, (_, full) in flown.items():
        wide = np.degrees(3.0 * full.sigma[0, :, 8])
        some = [Line("", full.time, np.degrees(one)) for one in full.heading[:10]]
        band = Band("3 sigma", full.time, -wide, wide)
        found.append(Plot(f"heading-{name}", f"Heading error, {GRADES[name].name}", "s", "deg", some, bands=[band]))
    return found


def _chi_square(id: str, title: str, names: list[str], time: FloatArray, means: list[FloatArray], count: int) -> Plot:
    low, high = nees_bounds(count)
    bounds = Band("95 %", time, np.full(len(time), low), np.full(len(time), high))
    lines = [Line(name, time, mean) for name, mean in zip(names, means, strict=True)]
    return Plot(id, f"{title}, {id.split('-')[1]} instruments", "s", "1", lines, bands=[bounds])
