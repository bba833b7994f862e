"""The gap policy at its limits, and that a stream gives the same rows however it is split."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nav.gaps import MAX_FILL, GapFiller, GapPolicy
from nav.increments import ImuIncrements, Validity

STEP = 0.01


def stream(n, rate=lambda t: np.stack([0.1 * t, -0.2 * t, 0 * t + 0.3], 1), step=STEP):
    """Samples of a rate and force that are linear in time."""
    time = step * np.arange(1, n + 1)
    middle = rate(time - 0.5 * step)
    imu = ImuIncrements.empty(n)
    imu.time[:], imu.step[:], imu.sequence[:] = time, step, np.arange(100, 100 + n)
    imu.dtheta[:], imu.dvel[:] = middle * step, 10 * middle * step
    return imu


def pick(imu, rows):
    return ImuIncrements(*(getattr(imu, name)[rows] for name in ImuIncrements.__dataclass_fields__))


def columns(parts):
    return {name: np.concatenate([getattr(p, name) for p in parts]) for name in ImuIncrements.__dataclass_fields__}


def without(n, start, stop):
    return np.concatenate([np.arange(start), np.arange(stop, n)])


def test_nothing_missing_is_nothing_done():
    imu = stream(50)
    filler = GapFiller(GapPolicy())
    result, gaps = filler.fill(imu)
    assert result is imu
    assert gaps == []
    assert filler.fill(imu.rows(0, 0))[1] == []


def test_interpolation_is_exact_for_linear_motion():
    whole = stream(60)
    result, (gap,) = GapFiller(GapPolicy(interpolate_s=0.1)).fill(pick(whole, without(60, 20, 28)))
    assert (gap.row, gap.missing, gap.realign) == (20, 8, False)
    assert gap.length_s == pytest.approx(8 * STEP)
    assert gap.time == pytest.approx(20 * STEP)
    for name in ("time", "step", "sequence"):
        np.testing.assert_allclose(getattr(result, name), getattr(whole, name), rtol=1e-12)
    # The ends hold the mean over their steps: between their middles a linear rate is met up to the half steps
    np.testing.assert_allclose(result.dtheta, whole.dtheta, atol=STEP * 0.2 * STEP)
    np.testing.assert_allclose(result.dtheta.sum(0), whole.dtheta.sum(0), rtol=1e-12)
    np.testing.assert_allclose(result.dvel.sum(0), whole.dvel.sum(0), rtol=1e-12)
    assert (result.validity[20:28] == Validity.INTERPOLATED).all()
    assert not result.validity[:20].any()
    assert not result.validity[28:].any()


@pytest.mark.parametrize(
    ("missing", "bridged", "realign"),
    [(1, False, False), (9, False, False), (11, True, False), (99, True, False), (101, True, True)],
)
def test_each_limit(missing, bridged, realign):
    policy = GapPolicy(interpolate_s=0.1, realign_s=1.0)
    result, (gap,) = GapFiller(policy).fill(pick(stream(150), without(150, 20, 20 + missing)))
    assert gap.realign == realign
    assert gap.missing == missing
    assert len(result) == (150 - missing if realign else 150)
    if not realign:
        assert ((result.validity[20 : 20 + missing] & Validity.BRIDGED) != 0).all() == bridged
        assert np.diff(result.time).min() > 0.0
        assert result.time[-1] == pytest.approx(result.step.sum(), rel=1e-12)


def test_a_very_long_bridge_is_bounded_and_keeps_its_time():
    whole = stream(10_000, step=1e-3)
    result, (gap,) = GapFiller(GapPolicy(realign_s=100.0)).fill(pick(whole, without(10_000, 10, 9_990)))
    assert gap.missing == 9_980
    assert len(result) == 20 + MAX_FILL
    assert result.step.sum() == pytest.approx(10.0, rel=1e-12)
    np.testing.assert_allclose(result.dtheta.sum(0), whole.dtheta.sum(0), rtol=1e-9)
    assert (np.diff(result.sequence) >= 0).all()


@pytest.mark.parametrize("back", [0.5, 1000.0])
def test_time_that_goes_back_is_a_new_start(back):
    imu = stream(40)
    imu.sequence[20:] += 5
    imu.time[20:] -= back
    result, (gap,) = GapFiller(GapPolicy()).fill(imu)
    assert gap.realign
    assert len(result) == 40


def test_counter_jump_without_time_fills_nothing():
    imu = stream(40)
    imu.sequence[20:] += 5
    result, (gap,) = GapFiller(GapPolicy()).fill(imu)
    assert not gap.realign
    assert gap.length_s == pytest.approx(0.0, abs=1e-12)
    assert len(result) == 40


def test_sample_without_length_before_a_gap():
    """A step of zero has no rate; the interpolation starts from the last sample that has one."""
    imu = pick(stream(40), without(40, 20, 25))
    imu.step[19], imu.dtheta[19], imu.dvel[19] = 0.0, 0.0, 0.0
    whole = columns([GapFiller(GapPolicy()).fill(imu)[0]])
    filler = GapFiller(GapPolicy())
    split = columns([filler.fill(pick(imu, slice(k, k + 1)))[0] for k in range(len(imu))])
    for name, values in whole.items():
        np.testing.assert_array_equal(split[name], values)
    assert np.isfinite(whole["dtheta"]).all()


@given(
    st.sets(st.integers(1, 298), max_size=150),
    st.lists(st.integers(0, 300), max_size=10),
    st.floats(0, 0.3),
    st.floats(0.01, 1),
)
def test_splits_do_not_matter(lost, cuts, interpolate_s, realign_s):
    kept = [k for k in range(300) if k not in lost]
    imu = pick(stream(300, lambda t: np.stack([np.sin(7 * t), np.cos(9 * t), t], 1)), kept)
    policy = GapPolicy(interpolate_s, realign_s)
    result, gaps = GapFiller(policy).fill(imu)
    whole = columns([result])
    assert (np.diff(whole["time"]) > 0).all()
    assert sum(gap.missing for gap in gaps) == len(lost)
    filler = GapFiller(policy)
    parts, met, rows = [], [], 0
    edges = [0, *sorted(min(cut, len(kept)) for cut in cuts), len(kept)]
    for start, stop in pairwise(edges):
        part, new = filler.fill(imu.rows(start, stop))
        met += [(gap.row + rows, gap.time, gap.length_s, gap.missing, gap.realign) for gap in new]
        rows += len(part)
        parts.append(part)
    split = columns(parts)
    for name, values in whole.items():
        np.testing.assert_array_equal(split[name], values)
    assert met == [(gap.row, gap.time, gap.length_s, gap.missing, gap.realign) for gap in gaps]
