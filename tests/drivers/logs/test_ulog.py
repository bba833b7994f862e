"""ULog of a real flight board, and files that are none."""

import numpy as np
import pytest

from drivers.logs.ulog import ImuLog, read_ulog
from nav.errors import HilError

pytest.importorskip("pyulog", reason="reading ULog needs the extra 'logs'")


@pytest.fixture(scope="module")
def flight(hil_data):
    path = hil_data / "px4_board.ulg"
    if not path.is_file():
        pytest.skip(f"no {path}")
    return path


def test_a_real_board(flight):
    log = read_ulog(flight)
    n = len(log.time_us)
    assert n > 1000
    assert (np.diff(log.time_us) > 0).all()
    assert (np.diff(log.counter) >= 1).all()
    assert log.rate.shape == log.force.shape == (n, 3)
    # What the counter says is missing is what the clock says: the same number of periods to a per cent
    assert log.counter[-1] * log.period_us == pytest.approx(log.time_us[-1] - log.time_us[0], rel=0.01)
    assert (log.step_us > 0).all()
    assert np.median(np.linalg.norm(log.force, axis=1)) == pytest.approx(9.81, rel=0.05)
    np.testing.assert_allclose(np.linalg.norm(log.attitude, axis=1), 1.0, atol=1e-3)
    # The attitude's own vertical agrees with the mean force: conventions are ours, b to n, scalar first
    k = np.searchsorted(log.time_us, log.attitude_us).clip(0, n - 1)
    w, x, y, z = log.attitude.T
    down = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z], axis=1)
    assert np.mean(np.sum(-log.force[k] * down, axis=1)) == pytest.approx(9.81, rel=0.1)


def test_step_of_a_log_with_a_gap():
    time_us = np.array([1000, 2000, 3010, 8000, 9000])
    log = ImuLog(time_us, np.array([0, 1, 2, 7, 8]), 1000, *[np.zeros((5, 3))] * 2, np.zeros(0, int), np.zeros((0, 4)))
    assert log.step_us.tolist() == [1000, 1000, 1010, 1000, 1000]


@pytest.mark.parametrize("share", [0.0001, 0.001, 0.3, 0.999])
def test_truncated_is_read_as_far_as_it_goes_or_refused(flight, tmp_path, share):
    whole = flight.read_bytes()
    (tmp_path / "cut.ulg").write_bytes(whole[: int(len(whole) * share)])
    if share < 0.01:
        with pytest.raises(HilError, match=r"cut\.ulg"):
            read_ulog(tmp_path / "cut.ulg")
        return
    log, full = read_ulog(tmp_path / "cut.ulg"), read_ulog(flight)
    n = len(log.time_us)
    assert n > 0.5 * share * len(full.time_us)
    np.testing.assert_array_equal(log.time_us, full.time_us[:n])
    np.testing.assert_array_equal(log.rate, full.rate[:n])


@pytest.mark.parametrize("content", [b"", b"ULog", b"not a log at all\n" * 100, bytes(range(256)) * 40])
def test_foreign_files(tmp_path, content):
    (tmp_path / "foreign.ulg").write_bytes(content)
    with pytest.raises(HilError, match=r"foreign\.ulg"):
        read_ulog(tmp_path / "foreign.ulg")


def test_missing_file(tmp_path):
    with pytest.raises(HilError, match="No such file"):
        read_ulog(tmp_path / "none.ulg")
