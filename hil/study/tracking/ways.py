"""Two ways to navigate a flight: the tracking correction, and the unrestricted error-state filter."""

import numpy as np

from hil.study.alignment.records import FIX_S, STEP
from hil.study.tracking.flights import Flight
from nav.filter.aided import AidedNavigator, Settings
from nav.filter.gnss_attitude import start_from_epoch
from nav.filter.states import Tuning
from nav.filter.tracking import Tracking
from nav.filter.tracking_gains import TrackingGains
from nav.increments import FloatArray
from nav.strapdown import Strapdown

STRIDE = round(FIX_S / STEP)
"""Samples between fixes."""
PREDICT_S = 0.1
"""Of the filter: the rates here change slowly."""


def track(flight: Flight, gains: TrackingGains) -> FloatArray:
    """Solutions (n - 1, 10) at the fixes, from one epoch of the antennas and pulled to those after it."""
    core, first, imu = Strapdown("two-sample", "wander"), flight.fixes[0]["value"], flight.imu
    lat, lon, height = first[:3].tolist()
    start_from_epoch(core, lat, lon, height, first[3:], flight.start)
    tracking = Tracking(core, gains, 0.0)
    out, still = (np.empty((STRIDE, 3)), np.empty((STRIDE, 3)), np.empty((STRIDE, 4))), np.zeros(3)
    solved = np.empty((len(flight.fixes) - 1, 10))
    for k in range(len(solved)):
        some = slice(k * STRIDE, (k + 1) * STRIDE)
        core.advance(imu.step[some], imu.dtheta[some], imu.dvel[some], still, *out)
        if flight.heard[k + 1]:
            tracking.take(flight.fixes[k + 1])
            tracking.take(flight.attitudes[k + 1])
        solved[k] = core.solution
    return solved


def filtered(flight: Flight, belief: Tuning, *, antennas: bool) -> FloatArray:
    """The same by the filter, with or without the attitudes of the antennas after the first."""
    first = flight.fixes[0]
    lat, lon, height = first["value"][:3].tolist()
    q_nb, covariance = flight.start.level(lat, lon)
    navigator = AidedNavigator(Strapdown(), belief, Settings(predict_s=PREDICT_S))
    sigma = np.concatenate([first["sigma"], np.sqrt(np.diag(covariance))])
    navigator.start(0.0, lat, lon, height, first["value"][3:], q_nb, sigma)
    heard = flight.heard.copy()
    heard[0] = False
    navigator.aid(flight.fixes[heard])
    if antennas:
        navigator.aid(flight.attitudes[heard])
    solved = np.empty((len(flight.fixes) - 1, 10))
    for k in range(len(solved)):
        navigator.process(flight.imu.rows(k * STRIDE, (k + 1) * STRIDE))
        solved[k] = navigator.solution
    return solved
