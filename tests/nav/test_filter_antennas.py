"""Two receivers whose antennas stand apart: each is compared with its own place."""

import math

import numpy as np
import pytest

from nav.aiding import Kind, aiding
from nav.earth import normal_gravity
from nav.filter.aided import AidedNavigator, Settings
from nav.filter.health import Channel
from nav.filter.states import tuning
from nav.increments import ImuIncrements
from nav.instruments.grades import GRADES
from nav.strapdown import Strapdown

LAT, LON, HEIGHT = math.radians(50.0), math.radians(36.0), 150.0
ARMS = (2.0, 0.0, 0.0), (-2.0, 0.0, 0.0)
"""Forward and aft: the vehicle looks north."""
METRE = 1.0 / 6.38e6


@pytest.mark.parametrize("own", [True, False])
def test_each_source_has_its_antenna(own: bool) -> None:
    antennas = tuple(enumerate(ARMS, 5)) if own else ()
    filter_ = AidedNavigator(Strapdown(), tuning(GRADES["tactical"]), Settings(lever_arm=ARMS[0], antennas=antennas))
    sigma = np.array([5.0] * 3 + [0.05] * 3 + [1e-4] * 3)
    filter_.start(0.0, LAT, LON, HEIGHT, np.zeros(3), np.array([1.0, 0, 0, 0]), sigma)
    n = 400
    rest = ImuIncrements.empty(n)
    rest.time[:], rest.step[:], rest.sequence[:] = 0.01 * np.arange(1, n + 1), 0.01, np.arange(n)
    rate = 7.292115e-5
    rest.dtheta[:] = 0.01 * rate * np.array([math.cos(LAT), 0.0, -math.sin(LAT)])
    rest.dvel[:, 2] = -0.01 * normal_gravity(math.sin(LAT), HEIGHT)
    for k in range(n // 100):
        filter_.process(rest.rows(100 * k, 100 * (k + 1)))
        for source, (forward, _, _) in enumerate(ARMS, 5):
            value = LAT + forward * METRE, LON, HEIGHT, 0.0, 0.0, 0.0
            filter_.aid(np.array([aiding(k + 0.5, Kind.GNSS, value, (0.1,) * 3 + (0.1,) * 3, source)]))
    north = (filter_.solution[0] - LAT) / METRE
    assert north == pytest.approx(0.0, abs=0.1)
    # With one place for both the aft antenna is four metres from where it should be
    places = {one.source: one for one in filter_.health if one.channel == Channel.GNSS_POSITION}
    assert (places[5].rejected, places[6].rejected > 0) == (0, not own)
