"""The host's clock against UTC: pulses as the kernel shows them, and the times of a receiver."""

from pathlib import Path

import numpy as np
import pytest

from drivers.utc import PulseClock, UtcFit

UTC = 1_700_000_000 * 10**9


def pulse(line: Path, host_ns: int, number: int) -> None:
    line.write_text(f"{host_ns // 10**9}.{host_ns % 10**9:09d}#{number}\n")


def test_a_pulse_line_tells_offset_and_drift_of_the_host(tmp_path: Path) -> None:
    """A host that is 40 ms ahead and gains 12 ppm, interrupts that come a few microseconds late."""
    lines = [tmp_path / name / "assert" for name in ("pps0", "pps1")]
    for line in lines:
        line.parent.mkdir()
        line.write_text("")  # the first one never pulses
    random, clock = np.random.default_rng(1), PulseClock(tmp_path)
    assert clock.summary() is None
    for second in range(300):
        late = random.exponential(3e-6)
        pulse(lines[1], UTC + round((second + 0.040 + 12e-6 * second + late) * 1e9), second)
        clock.poll()
        clock.poll()  # the same pulse again
        if second == 0:
            assert clock.summary() is None, "a stamp that was there before may be old"
    said = clock.summary()
    assert said is not None
    assert said["source"] == "pps1"
    assert said["pairs"] == 299
    assert said["drift_ppm"] == pytest.approx(12.0, abs=0.05)
    assert abs(said["offset_us"] - (40_000.0 + 12.0 * 299)) <= said["bound_us"] < 20.0
    assert said["steps"] == 0


def test_a_line_that_vanishes_or_says_nonsense_is_survived(tmp_path: Path) -> None:
    line = tmp_path / "pps0" / "assert"
    line.parent.mkdir()
    pulse(line, UTC, 1)
    clock = PulseClock(tmp_path)
    clock.poll()
    for text in ("", "x#y", "1.2.3#4", "#", "5"):
        line.write_text(text)
        clock.poll()
    line.unlink()
    clock.poll()
    assert clock.summary() is None
    assert PulseClock(tmp_path / "none").summary() is None


def test_a_receivers_times_tell_a_step_of_the_host() -> None:
    random, fit = np.random.default_rng(1), UtcFit()
    fit.update(UTC, UTC)
    assert fit.summary()["offset_us"] is None
    for k in range(1, 2000):  # 5 Hz, the solution takes 80 ms and a serial line up to 20 ms more
        step = -0.5 if k > 1000 else 0.0
        fit.update(UTC + k * 200_000_000, UTC + k * 200_000_000 + round((0.08 + step + random.exponential(5e-3)) * 1e9))
    said = fit.summary()
    assert said["steps"] == 1
    assert abs(said["offset_us"] + 420_000.0) <= said["bound_us"] < 10_000.0, "the smallest delay is in the offset"
