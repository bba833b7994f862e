"""The built-in scenarios of the alignment chain, through every process: as accurate as theory says."""

import math

import pytest

from hil.pytest_plugin import StartBridge
from hil.scenario import load
from hil.settings import settings_of
from nav.alignment.chain import heading_limit
from nav.errors import HilError

DEG = math.radians(1.0)


def texts(bridge) -> str:
    return " | ".join(text for _, _, text in bridge.events())


@pytest.mark.slow
def test_a_ship_finds_north_at_its_mooring(hil_bridge: StartBridge) -> None:
    """Ten minutes of sway. Bias alone leaves bias / (U cos B), 0.062 deg with the flicker; three of these in one run."""
    settings = settings_of(load("swaying"))
    limit = heading_limit(settings.sensors, settings.lat) / DEG
    assert limit == pytest.approx(0.0619, abs=0.002)
    bridge = hil_bridge("swaying", paced=False, mavlink={"links": ()})
    summary = bridge.wait_end(600)
    assert "aligned in 600.0 s" in texts(bridge)
    assert "heading known to 0.07" in texts(bridge)
    assert summary["mode"] == "navigate"
    assert summary["failed_axes"] == {}
    assert summary["error"]["attitude_deg"]["max"] < 3.0 * limit
    assert summary["error"]["velocity_ms"]["max"] < 0.1, "the sway is no error of the velocity"


@pytest.mark.slow
def test_a_head_that_is_switched_on_in_flight(hil_bridge: StartBridge) -> None:
    """A tactical grade: accelerometer bias / g, 0.057 deg an axis, is the tilt that coarse alignment leaves; fine less."""
    bridge = hil_bridge("airstart", paced=False, mavlink={"links": ()})
    summary = bridge.wait_end(300)
    assert "aligned in 120.0 s" in texts(bridge)
    assert summary["mode"] == "navigate"
    error = summary["error"]
    coarse = math.sqrt(3.0) * math.degrees(1e-3)
    assert error["attitude_deg"]["max"] < 3.0 * coarse
    assert error["attitude_deg"]["final"] < coarse
    assert error["position_m"]["rms"] < 1.5, "below one fix"
    assert error["velocity_ms"]["final"] < 0.1, "below one fix"


@pytest.mark.parametrize("way", ["gyrocompass", "swaying"])
def test_a_grade_that_cannot_find_north_demands_a_heading_source(hil_bridge: StartBridge, way: str) -> None:
    changes = {"head": {"grade": "tactical"}, "navigation": {"alignment": way}}
    with pytest.raises(HilError, match=r"finds north to 6\.\d deg only at latitude 50\.0 deg.*Give a heading source"):
        hil_bridge("swaying", paced=False, mavlink={"links": ()}, **changes).wait_end(30)
