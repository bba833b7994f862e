"""The long flight: the accuracy that is promised, at both rates, and the same bits every time."""

import pytest

from hil.pytest_plugin import StartBridge


@pytest.mark.slow
@pytest.mark.parametrize(("rate_hz", "limit_m"), [(1000, 0.5), (100, 30.0)])
def test_accuracy_and_determinism(hil_bridge: StartBridge, rate_hz: int, limit_m: float) -> None:
    """2110 s and 320 km from the gyrocompass's own alignment, ideal instruments, no aiding."""
    runs = []
    for _ in range(2):
        with hil_bridge("flight", paced=False, head={"rate_hz": rate_hz}, mavlink={"links": ()}) as bridge:
            runs.append(bridge.wait_end(400))
    first, second = runs
    position = first["error"]["position_m"]
    print(f"{rate_hz} Hz: position error {position}, {first['speed']:.0f} x real time")
    assert first["samples"] == 2110 * rate_hz
    assert first["lost"] == first["silences"] == 0
    assert first["mode"] == "navigate"
    assert position["max"] <= limit_m
    assert first["error"]["attitude_deg"]["max"] < 0.01
    assert first["navigation_digest"] == second["navigation_digest"]


@pytest.mark.parametrize("layout", ["fd", "classic"])
def test_short_hop(hil_bridge: StartBridge, layout: str) -> None:
    """The first minutes, with both sets of messages."""
    summary = hil_bridge("flight", paced=False, head={"layout": layout, "rate_hz": 500}, duration_s=200).wait_end(60)
    assert summary["samples"] == 100_000
    assert summary["lost"] == 0
    assert summary["error"]["position_m"]["max"] < 0.05


@pytest.mark.slow
def test_the_seed_is_part_of_the_world(hil_bridge: StartBridge) -> None:
    digests = set()
    for seed in (1, 1, 2):
        summary = hil_bridge("turns", paced=False, duration_s=20, seed=seed, head={"rate_hz": 200}).wait_end(60)
        digests.add((seed, summary["navigation_digest"], summary["head"]["world_id"]))
    assert len(digests) == 2
