"""The study of the dynamically tuned gyro."""

import math

import numpy as np
import pytest
from scipy.signal import TransferFunction, freqresp

from hil.study import study_names
from hil.study.dtg import STABLE_HZ, TABLE_1, TABLE_2, run
from hil.study.dtg_vibration import MOUNT_DAMPING, MOUNT_HZ, transmissibility
from hil.study.dtg_world import Rocking
from nav.rotation import attitude_error


@pytest.fixture(scope="module")
def rows():
    return {row.id: row for row in run().rows}


@pytest.mark.slow
def test_every_limit_is_kept(rows):
    assert [row for row in rows.values() if not row.ok] == []
    assert all(" " not in id for id in rows)


@pytest.mark.slow
def test_published_figures(rows):
    for pulsation, published in TABLE_1.items():
        assert rows[f"table-1-{pulsation:g}"].ours == pytest.approx(published, abs=0.05)
        for method in ("poisson-rk4", "euler-vector-rk4"):
            assert rows[f"roll-{method}-raw-{pulsation:g}"].ours == pytest.approx(published, abs=0.05)
    for spin_hz, published in TABLE_2.items():
        assert rows[f"table-2-{spin_hz}"].ours == pytest.approx(published, abs=0.02)
    assert rows["stable-rk4-from"].ours == pytest.approx(STABLE_HZ[0], abs=1.0)
    assert rows["stable-rk4-to"].ours == pytest.approx(STABLE_HZ[1], abs=1.0)
    assert rows["stable-source-continuous"].ours > STABLE_HZ[1]


@pytest.mark.slow
def test_the_mount_helps_above_its_resonance_only(rows):
    def drift(hz, mount):
        return rows[f"coning-{hz}hz-{mount}-raw"].ours

    assert drift(20, "mounted") > 2.0 * drift(20, "hard")
    assert drift(100, "mounted") < 0.05 * drift(100, "hard")
    assert rows["mount-roll"].ours == pytest.approx(1.0, abs=0.01)
    for id, row in rows.items():
        if id.startswith("coning") and id.endswith("raw"):
            assert rows[id.removesuffix("raw") + "angles"].ours < 1e-3 * row.ours


def test_mount_is_a_damped_spring():
    natural = 2.0 * math.pi * MOUNT_HZ
    damper = 2.0 * MOUNT_DAMPING * natural
    w = np.geomspace(1.0, 2000.0, 50)
    _, expected = freqresp(TransferFunction([damper, natural**2], [1.0, damper, natural**2]), w)
    np.testing.assert_allclose(transmissibility(w), np.abs(expected), rtol=1e-12)


def test_rocking_is_consistent():
    signal = Rocking(0.3, 8.0)
    edges = np.linspace(0.0, 1.0, 1001)
    q = signal.attitude(edges)
    turned = attitude_error(q[1:], q[:-1])
    np.testing.assert_allclose(turned, signal.increments(edges), atol=1e-14)
    np.testing.assert_allclose(signal.increments(edges) / 1e-3, signal.rate(edges[1:] - 5e-4), atol=1e-4)


def test_registered():
    assert "dtg" in study_names()
