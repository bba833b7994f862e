"""Messages of other systems to measurements: units, frames, what is left out, and that no nonsense comes through."""

import math
from typing import Any

import numpy as np
import pymap3d
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mav
from scipy.spatial.transform import Rotation

from drivers.can.aiding import AidingDecoder, AidingEncoder
from drivers.mavlink.aiding import (
    FROM_ANYONE,
    FROM_MASTER,
    MASTER,
    VISION,
    Place,
    Refused,
    operator_heading,
    operator_position,
)
from drivers.mavlink.solution import Home, geodetic
from nav.aiding import OPERATOR, RELAYED, Kind

GEOID_M = 25.0
HOME = Home(math.radians(50.0), math.radians(36.25), 150.0)
PLACE = Place(HOME, lambda lat, lon: GEOID_M)
DIAGONAL = [k for k, (i, j) in enumerate(zip(*np.triu_indices(6), strict=True)) if i == j]
DECODERS = FROM_ANYONE | FROM_MASTER


def over_the_wire(message: Any) -> Any:
    (received,) = mav.MAVLink(None).parse_buffer(message.pack(mav.MAVLink(None, 255, 190)))
    return received


def rows_of(message: Any, place: Place = PLACE) -> list[Any]:
    """What a message says; every row must pass the wire to the loop."""
    message = over_the_wire(message)
    rows = DECODERS[message.get_type()](message, 12.5, place)
    passed, _ = AidingDecoder().decode(AidingEncoder().frames(np.array(rows)), 12.5)
    assert sorted(passed["kind"].tolist()) == sorted(row["kind"] for row in rows)
    assert {float(row["time"]) for row in rows} == {12.5}
    return rows


def gps(**changes: Any) -> Any:
    fields = {
        "time_usec": 0, "gps_id": 2, "ignore_flags": 0, "time_week_ms": 0, "time_week": 0, "fix_type": 3, "lat": 500_000_000,
        "lon": -362_500_000, "alt": 125.0, "hdop": 1.0, "vdop": 1.0, "vn": 3.0, "ve": -4.0, "vd": 0.5, "speed_accuracy": 0.1,
        "horiz_accuracy": 1.5, "vert_accuracy": 2.5, "satellites_visible": 12, "yaw": 0,
    }  # fmt: skip
    return mav.MAVLink_gps_input_message(**(fields | changes))


def covariance(*sigmas: float) -> list[float]:
    found = [math.nan] * 21
    for place, sigma in zip(DIAGONAL, sigmas, strict=False):
        found[place] = sigma**2
    return found


def odometry(**changes: Any) -> Any:
    fields = {
        "time_usec": 0, "frame_id": mav.MAV_FRAME_LOCAL_NED, "child_frame_id": mav.MAV_FRAME_BODY_FRD, "x": 100.0, "y": -50.0,
        "z": -20.0, "q": [0.6, 0.0, 0.0, 0.8], "vx": 10.0, "vy": 0.5, "vz": -0.25, "rollspeed": 0.0, "pitchspeed": 0.0,
        "yawspeed": 0.0, "pose_covariance": covariance(1.0, 2.0, 3.0, 0.01, 0.02, 0.03),
        "velocity_covariance": covariance(0.1, 0.2, 0.3),
    }  # fmt: skip
    return mav.MAVLink_odometry_message(**(fields | changes))


def vision(**changes: Any) -> Any:
    fields = {
        "usec": 0, "x": 100.0, "y": -50.0, "z": -20.0, "roll": 0.1, "pitch": -0.2, "yaw": 3.0,
        "covariance": covariance(1.0, 2.0, 3.0, 0.01, 0.02, 0.03),
    }  # fmt: skip
    return mav.MAVLink_vision_position_estimate_message(**(fields | changes))


def test_a_fix_comes_through_in_our_units() -> None:
    (row,) = rows_of(gps())
    assert (row["kind"], row["source"]) == (Kind.GNSS, RELAYED + 2)
    assert np.degrees(row["value"][:2]) == pytest.approx([50.0, -36.25])
    assert row["value"][2] == pytest.approx(125.0 + GEOID_M)
    assert row["value"][3:] == pytest.approx([3.0, -4.0, 0.5])
    assert row["sigma"] == pytest.approx([1.5, 1.5, 2.5, 0.1, 0.1, 0.1])


@pytest.mark.parametrize(
    ("flag", "field", "left_out"),
    [
        (mav.GPS_INPUT_IGNORE_FLAG_ALT, "alt", [2]),
        (mav.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ, "vn", [3, 4]),
        (mav.GPS_INPUT_IGNORE_FLAG_VEL_VERT, "vd", [5]),
    ],
)
def test_what_the_receiver_ignores_is_left_out(flag: int, field: str, left_out: list[int]) -> None:
    (row,) = rows_of(gps(ignore_flags=flag, **{field: math.nan}))
    assert np.flatnonzero(np.isinf(row["sigma"])).tolist() == left_out


def test_a_fix_in_two_dimensions_has_no_height() -> None:
    (row,) = rows_of(gps(fix_type=mav.GPS_FIX_TYPE_2D_FIX, alt=math.nan))
    assert np.isinf(row["sigma"][2])


@pytest.mark.parametrize("missing", [{"horiz_accuracy": 0.0}, {"ignore_flags": 64, "horiz_accuracy": math.nan}])
def test_an_accuracy_that_is_not_stated_is_a_modest_one(missing: dict[str, float]) -> None:
    (row,) = rows_of(gps(**missing))
    assert 2.0 < row["sigma"][0] < 50.0


def test_no_receiver_is_perfect() -> None:
    (row,) = rows_of(gps(horiz_accuracy=1e-9, vert_accuracy=1e-9, speed_accuracy=1e-9))
    assert (row["sigma"] >= 0.005).all()


def test_two_antennas_give_the_heading() -> None:
    _, row = rows_of(gps(yaw=27000))
    assert (row["kind"], row["source"]) == (Kind.HEADING, RELAYED + 2)
    assert row["value"][0] % (2.0 * math.pi) == pytest.approx(1.5 * math.pi)
    _, north = rows_of(gps(yaw=36000))
    assert north["value"][0] == pytest.approx(0.0, abs=1e-12)
    assert len(rows_of(gps(yaw=65535))) == 1


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"fix_type": 0}, "no fix"),
        ({"fix_type": 1}, "no fix"),
        ({"fix_type": 200}, "no fix"),
        ({"lat": 0, "lon": 0}, "no position"),
        ({"lat": 900_000_001}, "out of range"),
        ({"lon": 1_800_000_001}, "out of range"),
        ({"alt": math.nan}, "no number"),
        ({"alt": 1e9}, "out of range"),
        ({"vn": math.inf}, "no number"),
        ({"vd": -3000.0}, "out of range"),
        ({"horiz_accuracy": math.nan}, "no number"),
        ({"speed_accuracy": -1.0}, "out of range"),
        ({"gps_id": 16}, "out of range"),
    ],
)
def test_a_bad_fix_is_refused_with_its_reason(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(Refused, match=reason):
        rows_of(gps(**changes))


@given(*[st.floats(-9e4, 9e4)] * 3, st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_local_positions_agree_with_a_peer(north: float, east: float, down: float, lat: float, lon: float) -> None:
    found = geodetic(Home(lat, lon, 150.0), (north, east, down))
    expected = pymap3d.ned2geodetic(north, east, down, lat, lon, 150.0, deg=False)
    assert found[0] == pytest.approx(expected[0], abs=1e-11)
    assert math.remainder(found[1] - expected[1], 2.0 * math.pi) == pytest.approx(0.0, abs=1e-10)
    assert found[2] == pytest.approx(expected[2], abs=1e-4)


def test_vision_is_relative_to_home_and_north() -> None:
    position, attitude = rows_of(vision())
    expected = pymap3d.ned2geodetic(100.0, -50.0, -20.0, HOME.lat, HOME.lon, HOME.height, deg=False)
    assert position["value"][:3] == pytest.approx(expected, abs=1e-7)
    assert position["sigma"].tolist() == pytest.approx([1.0, 2.0, 3.0, math.inf, math.inf, math.inf])
    assert position["source"] == attitude["source"] == VISION
    turned = Rotation.from_quat(attitude["value"][:4], scalar_first=True)
    assert turned.as_euler("ZYX") == pytest.approx([3.0, -0.2, 0.1], abs=1e-6)
    assert attitude["sigma"][:3] == pytest.approx([0.02, 0.02, 0.03])


def test_odometry_gives_position_velocity_and_attitude() -> None:
    velocity, position, attitude = rows_of(odometry())
    assert (velocity["kind"], position["kind"], attitude["kind"]) == (Kind.BODY_VELOCITY, Kind.GNSS, Kind.ATTITUDE)
    assert velocity["value"][:3] == pytest.approx([10.0, 0.5, -0.25])
    assert velocity["sigma"][:3] == pytest.approx([0.1, 0.2, 0.3])
    assert np.isinf(position["sigma"][3:]).all()
    assert attitude["value"][:4] == pytest.approx([0.6, 0.0, 0.0, 0.8])


def test_odometry_with_a_velocity_in_the_level() -> None:
    position, _ = rows_of(odometry(child_frame_id=mav.MAV_FRAME_LOCAL_NED))
    assert position["value"][3:] == pytest.approx([10.0, 0.5, -0.25])
    assert position["sigma"][3:] == pytest.approx([0.1, 0.2, 0.3])


def test_only_what_has_a_covariance_is_taken() -> None:
    (row,) = rows_of(odometry(pose_covariance=[math.nan] * 21, x=math.nan))
    assert row["kind"] == Kind.BODY_VELOCITY
    (row,) = rows_of(vision(covariance=covariance(1.0, 1.0, 1.0), yaw=math.nan))
    assert row["kind"] == Kind.GNSS
    for nothing in (vision(covariance=[math.nan] * 21), vision(covariance=[0.0] * 21)):
        with pytest.raises(Refused, match="no covariance"):
            rows_of(nothing)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (odometry(frame_id=mav.MAV_FRAME_LOCAL_ENU), "frame"),
        (odometry(child_frame_id=mav.MAV_FRAME_LOCAL_ENU), "frame"),
        (odometry(q=[0.0, 0.0, 0.0, 0.0]), "no attitude"),
        (odometry(q=[math.nan, 0.0, 0.0, 0.0]), "no number"),
        (odometry(x=1e7), "out of range"),
        (odometry(vx=math.nan), "no number"),
        (vision(z=math.inf), "no number"),
    ],
)
def test_bad_local_estimates_are_refused(message: Any, reason: str) -> None:
    with pytest.raises(Refused, match=reason):
        rows_of(message)


def test_local_positions_need_a_home() -> None:
    with pytest.raises(Refused, match="no home"):
        rows_of(vision(), Place(None, PLACE.geoid))


def test_another_inertial_system_is_followed() -> None:
    (row,) = rows_of(mav.MAVLink_global_position_int_message(0, 500_000_000, 362_500_000, 125_000, 0, 300, -400, 50, 0))
    assert (row["kind"], row["source"]) == (Kind.GNSS, MASTER)
    assert row["value"] == pytest.approx([math.radians(50.0), math.radians(36.25), 150.0, 3.0, -4.0, 0.5])
    (row,) = rows_of(mav.MAVLink_attitude_quaternion_message(0, 0.6, 0.0, 0.8, 0.0, 0.0, 0.0, 0.0))
    assert row["value"][:4] == pytest.approx([0.6, 0.0, 0.8, 0.0])


def test_an_operator_gives_a_place_without_a_height() -> None:
    (row,) = operator_position(50.0, 36.25, 30.0, 0.4, 12.5)
    assert (row["time"], row["source"]) == (12.1, OPERATOR)
    assert row["sigma"].tolist() == [30.0, 30.0, *[math.inf] * 4]
    assert operator_position(50.0, 36.25, math.nan, 0.0, 12.5)[0]["sigma"][0] >= 100.0
    for wrong in ((91.0, 0.0, 1.0, 0.0), (math.nan, 0.0, 1.0, 0.0), (0.0, 0.0, -1.0, 0.0), (0.0, 0.0, 1.0, 9.0)):
        with pytest.raises(Refused):
            operator_position(*wrong, 12.5)


def test_an_operator_gives_a_heading() -> None:
    (row,) = operator_heading(-90.0, 12.5)
    assert row["kind"] == Kind.HEADING
    assert row["value"][0] % (2.0 * math.pi) == pytest.approx(1.5 * math.pi)
    with pytest.raises(Refused):
        operator_heading(math.nan, 12.5)


@given(st.data())
def test_fuzz_nothing_but_finite_rows_comes_through(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(DECODERS)))
    kind = getattr(mav, f"MAVLink_{name.lower()}_message")
    number = st.one_of(st.floats(width=32), st.sampled_from([0.0, 1.0, 1e-20]))
    drawn, lengths = [], dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    for field, form in zip(kind.fieldnames, kind.fieldtypes, strict=True):
        length = lengths[field]
        if form in ("float", "double"):
            one = number
        else:
            bits, signed = int("".join(filter(str.isdigit, form)) or 8), not form.startswith("uint")
            one = st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else st.integers(0, 2**bits - 1)
            if field in ("fix_type", "frame_id", "child_frame_id", "gps_id"):
                one = st.integers(0, 16)
        drawn.append(data.draw(st.lists(one, min_size=length, max_size=length) if length else one))
    try:
        rows = np.array(rows_of(kind(*drawn)))
    except Refused:
        return
    assert np.isfinite(rows["value"]).all()
    assert (rows["sigma"] > 0.0).all()
    assert np.isfinite(rows["sigma"]).any(axis=1).all()
