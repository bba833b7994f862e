"""The simulated sensors that aid: the truth with the errors of the scenario, whoever else sends and however a run is cut."""

import math

import numpy as np
import pytest

from hil.geometry import position_error
from hil.scenario import Scenario
from hil.world.aiding import SimulatedAiding
from hil.world.motion import Motion
from nav.aiding import AIDING, Kind
from nav.rotation import conjugate, euler_from_quaternion, rotated

ALL = {"gnss": [{}], "baro": [{}], "magnetometer": [{}], "heading": [{}]}


def scenario(aiding, seed=1, **motion):
    motion = {"north": {"rate": 20.0}, "heading": {"offset": 30.0, "rate": 2.0}, "roll": {"offset": 5.0}, **motion}
    return Scenario.model_validate({"seed": seed, "motion": motion, "aiding": aiding})


def heard(choice, seconds, kind=None, source=0):
    rows, arrivals = SimulatedAiding(choice).arrived(round(seconds * 1e6))
    chosen = np.ones(len(rows), bool) if kind is None else (rows["kind"] == kind) & (rows["source"] == source)
    return rows[chosen], arrivals[chosen]


def test_how_a_run_is_cut_does_not_matter():
    choice = scenario(ALL)
    whole, arrivals = SimulatedAiding(choice).arrived(20_000_000)
    cut, parts = SimulatedAiding(choice), []
    for until in (1, 99_999, 100_000, 7_654_321, 7_654_321, 20_000_000):
        parts.append(cut.arrived(until))
        assert (parts[-1][1] <= until).all()
    np.testing.assert_array_equal(np.concatenate([rows for rows, _ in parts]), whole)
    np.testing.assert_array_equal(np.concatenate([when for _, when in parts]), arrivals)


def test_each_sensor_has_a_stream_of_its_own():
    alone, _ = heard(scenario({"baro": [{}]}), 10.0, Kind.BARO)
    among, _ = heard(scenario({**ALL, "baro": [{}, {}]}), 10.0, Kind.BARO)
    second, _ = heard(scenario({**ALL, "baro": [{}, {}]}), 10.0, Kind.BARO, 1)
    other, _ = heard(scenario({"baro": [{}]}, seed=2), 10.0, Kind.BARO)
    np.testing.assert_array_equal(alone, among)
    assert not np.isclose(second["value"][:, 0], alone["value"][:, 0]).any()
    assert not np.isclose(other["value"][:, 0], alone["value"][:, 0]).any()


@pytest.mark.parametrize("rate", [1.0, 5.0, 7.0])
def test_rate_delay_and_outages(rate):
    config = {"rate_hz": rate, "delay_s": 0.25, "outages": [{"start_s": 4.0, "end_s": 6.0}]}
    rows, arrivals = heard(scenario({"gnss": [config]}), 10.0)
    expected = np.arange(1, 100) / rate
    expected = expected[(expected <= 9.75) & ((expected < 4.0) | (expected >= 6.0))]
    np.testing.assert_allclose(rows["time"], expected, atol=0.6e-6)
    np.testing.assert_allclose(arrivals * 1e-6, rows["time"] + 0.25, atol=0.6e-6)


def test_noise_is_what_is_stated():
    """Over 4000 fixes the normalised errors have mean 0 and deviation 1 to four standard errors."""
    choice = scenario({"gnss": [{"rate_hz": 100}]})
    rows, _ = heard(choice, 40.0)
    truth = Motion(choice.motion).truth(rows["time"])
    offset = position_error(*rows["value"][:, :3].T, truth)
    scaled = np.column_stack([offset, rows["value"][:, 3:] - truth["vel_n"]]) / rows["sigma"]
    assert (np.abs(scaled.mean(axis=0)) < 4 / math.sqrt(len(rows))).all()
    assert (np.abs(scaled.std(axis=0) - 1.0) < 4 / math.sqrt(2 * len(rows))).all()
    assert (np.abs(np.corrcoef(scaled.T) - np.eye(6)) < 4.5 / math.sqrt(len(rows))).all()


def test_a_claim_changes_what_is_stated_and_nothing_else():
    honest, _ = heard(scenario({"gnss": [{}]}), 5.0)
    proud, _ = heard(scenario({"gnss": [{"claim": 0.1}]}), 5.0)
    np.testing.assert_array_equal(proud["value"], honest["value"])
    np.testing.assert_allclose(proud["sigma"], 0.1 * honest["sigma"])


QUIET = {"position_sigma_m": [1e-9] * 3, "velocity_sigma_ms": [1e-9] * 3}


def test_antenna_stands_on_its_arm():
    """By turning: the antenna of a standing, turning vehicle runs round it with w x r."""
    choice = scenario({"gnss": [{**QUIET, "lever_arm_m": [3.0, 0.0, -1.0]}]}, north={}, roll={})
    rows, _ = heard(choice, 5.0)
    truth = Motion(choice.motion).truth(rows["time"])
    offset = position_error(*rows["value"][:, :3].T, truth)
    heading = np.radians(30.0 + 2.0 * rows["time"])
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    np.testing.assert_allclose(offset, np.column_stack([3.0 * ahead, np.full(len(rows), -1.0)]), atol=1e-6)
    across = np.column_stack([-np.sin(heading), np.cos(heading)])
    np.testing.assert_allclose(rows["value"][:, 3:5], 3.0 * np.radians(2.0) * across, atol=3.0 * 1e-4)


def test_a_spoofed_receiver_drifts_away():
    jump = {"at_s": 3.0, "size": [10.0, -5.0, 2.0], "drift_ms": [1.0, 0.5, 0.0]}
    choice = scenario({"gnss": [{**QUIET, "jumps": [jump]}]})
    rows, _ = heard(choice, 8.0)
    truth = Motion(choice.motion).truth(rows["time"])
    offset = position_error(*rows["value"][:, :3].T, truth)
    since = np.maximum(rows["time"] - 3.0, 0.0)[:, None]
    expected = (rows["time"] >= 3.0)[:, None] * np.array([10.0, -5.0, 2.0]) + since * np.array([1.0, 0.5, 0.0])
    np.testing.assert_allclose(offset, expected, atol=1e-5)
    np.testing.assert_allclose(
        rows["value"][:, 3:] - truth["vel_n"], (since > 0.0) * np.array([1.0, 0.5, 0.0]), atol=1e-7
    )


def test_barometer_drifts_as_a_gauss_markov_process():
    """Many barometers: deviation and correlation over the correlation time, to four standard errors."""
    n, config = 1500, {"rate_hz": 1, "sigma_m": 1e-9, "bias_sigma_m": 2.0, "bias_time_s": 10.0, "offset_m": 7.0}
    choice = scenario({"baro": [config] * n}, north={})
    rows, _ = SimulatedAiding(choice).arrived(11_000_000)
    table = np.array([rows["value"][rows["source"] == k, 0] for k in range(n)]) - 150.0 - 7.0
    for column in (0, 5, 10):
        assert table[:, column].std() == pytest.approx(2.0, abs=4 * 2.0 / math.sqrt(2 * n))
        assert abs(table[:, column].mean()) < 4 * 2.0 / math.sqrt(n)
    correlation = (table[:, 0] * table[:, 10]).mean() / 4.0
    assert correlation == pytest.approx(math.exp(-1.0), abs=4 * math.sqrt((1 + math.exp(-2.0)) / n))


def test_magnetometer_sees_the_field_in_body_axes_with_its_iron():
    iron = [3.0, -8.0, 12.0]
    choice = scenario({"magnetometer": [{"sigma_ut": 1e-6, "hard_iron_ut": iron}]}, latitude_deg=0, longitude_deg=0)
    rows, _ = heard(choice, 20.0)
    truth = Motion(choice.motion).truth(rows["time"])
    field = rotated(truth["q_nb"], rows["value"][:, :3] - 1e-6 * np.array(iron))
    assert np.linalg.norm(field - field[0], axis=1).max() < 1e-10, "the field of the place does not turn with the body"
    assert 20e-6 < np.linalg.norm(field[0]) < 70e-6
    back = rotated(conjugate(truth["q_nb"]), field)
    np.testing.assert_allclose(back + 1e-6 * np.array(iron), rows["value"][:, :3], atol=1e-12)


def test_two_antennas_give_the_heading():
    rows, _ = heard(scenario({"heading": [{"sigma_deg": 1e-6, "offset_deg": 0.5}]}, heading={"rate": 60.0}), 10.0)
    truth = Motion(scenario({}, heading={"rate": 60.0}).motion).truth(rows["time"])
    error = rows["value"][:, 0] - euler_from_quaternion(truth["q_nb"])[:, 0] - math.radians(0.5)
    assert np.abs(np.remainder(error + math.pi, 2 * math.pi) - math.pi).max() < 1e-6
    assert ((rows["value"][:, 0] >= 0.0) & (rows["value"][:, 0] < 2 * math.pi)).all()


def test_no_sensors_send_nothing():
    rows, arrivals = SimulatedAiding(scenario({})).arrived(10_000_000)
    assert rows.dtype == AIDING
    assert len(rows) == len(arrivals) == 0


def test_a_classic_bus_cannot_carry_them():
    with pytest.raises(ValueError, match=r'needs CAN FD: head\.layout = "fd"'):
        Scenario.model_validate({"head": {"layout": "classic"}, "aiding": {"baro": [{}]}})
