"""What the network may tell the navigator: by whom, how often, when."""

import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.can.aiding import AidingEncoder
from drivers.mavlink.intake import Intake
from drivers.mavlink.station import Identity, Station
from nav.aiding import Kind
from nav.state import NAV_STATE, Health, Mode

DELAY_S = 0.2
DEVICE_S = 50.0


class Net:
    """A station that takes measurements of system 255 and follows 2/1; what it takes is kept."""

    def __init__(self, mode: Mode = Mode.NAVIGATE, health: Health = Health.GOOD, *, early: bool = False) -> None:
        self.rows: list[Any] = []
        self.encoder = AidingEncoder()
        self.intake = Intake((255,), (2, 1), DELAY_S, self.take, early=early)
        self.station = Station(Identity(), {}, lambda lat, lon: 20.0, print, self.intake)
        row = np.zeros(1, NAV_STATE)
        row["time"], row["mode"], row["health"], row["q_nb"] = DEVICE_S, mode, health, (1.0, 0.0, 0.0, 0.0)
        self.station.update(row[0], 1000.0)

    def take(self, rows: np.ndarray) -> None:
        self.encoder.frames(rows)
        self.rows += list(rows)

    def hear(self, message: Any, system: int = 255, component: int = 190, after_s: float = 0.05) -> None:
        self.station.now_s += after_s
        (received,) = mav.MAVLink(None).parse_buffer(message.pack(mav.MAVLink(None, system, component)))
        self.intake.message(received, self.station)

    def order(self, message: Any, system: int = 255) -> int:
        (received,) = mav.MAVLink(None).parse_buffer(message.pack(mav.MAVLink(None, system, 190)))
        place = ("x", "y", "z") if received.get_type() == "COMMAND_INT" else ("param5", "param6", "param7")
        params = [getattr(received, name) for name in ("param1", "param2", "param3", "param4", *place)]
        return self.intake.command(received, params, self.station)


def gps(**changes: Any) -> Any:
    fields = dict.fromkeys(mav.MAVLink_gps_input_message.fieldnames, 0)
    return mav.MAVLink_gps_input_message(**(fields | {"fix_type": 3, "lat": 500_000_000, "lon": 300_000_000} | changes))


def attitude() -> Any:
    return mav.MAVLink_attitude_quaternion_message(0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_a_measurement_is_as_old_as_is_said_in_device_time() -> None:
    net = Net()
    net.hear(gps(), after_s=0.3)
    assert [float(row["time"]) for row in net.rows] == pytest.approx([DEVICE_S + 0.3 - DELAY_S])
    assert net.intake.taken == {"GPS_INPUT": 1}


def test_only_those_who_may_are_heard() -> None:
    net = Net()
    net.hear(gps(), system=7)
    assert net.rows == []
    assert net.intake.refused == {"sender": 1}


def test_only_the_master_is_followed() -> None:
    net = Net()
    for system, component in ((255, 190), (2, 2), (3, 1)):
        net.hear(attitude(), system, component)
    assert net.rows == []
    assert not net.intake.refused, "telemetry of others is no attempt"
    net.hear(attitude(), 2, 1)
    assert [row["kind"] for row in net.rows] == [Kind.ATTITUDE]


def test_a_flood_is_cut() -> None:
    net = Net()
    for _ in range(1000):
        net.hear(gps(), after_s=0.0001)
    assert 5 <= len(net.rows) <= 11
    assert net.intake.refused["too often"] == 1000 - len(net.rows)


@pytest.mark.parametrize(
    ("mode", "health"), [(Mode.INIT, 0), (Mode.ALIGN, 0), (Mode.DEGRADED, Health.SILENT)], ids=["init", "align", "silent"]
)  # fmt: skip
def test_nothing_is_taken_while_it_could_not_be_used(mode: Mode, health: Health) -> None:
    net = Net(mode, health)
    net.hear(gps())
    assert net.rows == []
    assert net.intake.refused == {"not navigating": 1}


def test_an_alignment_that_uses_measurements_gets_them() -> None:
    net = Net(Mode.ALIGN, early=True)
    net.hear(gps())
    assert [row["kind"] for row in net.rows] == [Kind.GNSS]
    for mode, health in ((Mode.INIT, Health.GOOD), (Mode.ALIGN, Health.SILENT)):
        net = Net(mode, health, early=True)
        net.hear(gps())
        assert (net.rows, net.intake.refused) == ([], {"not navigating": 1})


def test_a_bad_message_is_counted_by_its_reason() -> None:
    net = Net()
    net.hear(gps(fix_type=0))
    net.hear(gps(vn=math.nan))
    assert net.rows == []
    assert net.intake.refused == {"no fix": 1, "no number": 1}


def test_an_operator_gives_position_and_heading() -> None:
    net = Net()
    long = mav.MAVLink_command_long_message(
        1, 1, mav.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, 0, 0.0, 0.1, 30.0, 0, 50.5, 30.25, math.nan
    )
    assert net.order(long) == mav.MAV_RESULT_ACCEPTED
    whole = mav.MAVLink_command_int_message(
        1, 1, 0, mav.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, 0, 0, 0.0, 0.1, 30.0, 0.0, 505_000_000, 302_500_000, math.nan
    )
    net.station.now_s += 1.0
    assert net.order(whole) == mav.MAV_RESULT_ACCEPTED
    for row in net.rows:
        assert np.degrees(row["value"][:2]) == pytest.approx([50.5, 30.25])
        assert row["sigma"][:2] == pytest.approx([30.0, 30.0])
        assert not row["sigma"][2] < math.inf
    assert net.rows[0]["time"] == pytest.approx(DEVICE_S - DELAY_S - 0.1)
    heading = mav.MAVLink_command_long_message(1, 1, mav.MAV_CMD_FIXED_MAG_CAL_YAW, 0, 45.0, 0, 0, 0, 0, 0, 0)
    assert net.order(heading) == mav.MAV_RESULT_ACCEPTED
    assert net.rows[-1]["value"][0] == pytest.approx(math.pi / 4)


def test_commands_that_are_not_followed_are_denied_or_unknown() -> None:
    net = Net()
    heading = mav.MAVLink_command_long_message(1, 1, mav.MAV_CMD_FIXED_MAG_CAL_YAW, 0, 45.0, 0, 0, 0, 0, 0, 0)
    assert net.order(heading, system=7) == mav.MAV_RESULT_DENIED
    nonsense = mav.MAVLink_command_long_message(1, 1, mav.MAV_CMD_FIXED_MAG_CAL_YAW, 0, math.nan, 0, 0, 0, 0, 0, 0)
    assert net.order(nonsense) == mav.MAV_RESULT_DENIED
    unknown = mav.MAVLink_command_long_message(1, 1, mav.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 0, 0)
    assert net.order(unknown) == mav.MAV_RESULT_UNSUPPORTED
    assert net.rows == []
