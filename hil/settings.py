"""What a scenario says to the navigator: its settings, and how the filter is set."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drivers.can.dtg_head_emulator import ANGLE_LSB, VELOCITY_LSB
from hil.magnetic import magnetic_field
from hil.scenario import Scenario
from hil.world.instruments import axis_drift, mounting, sensors_of
from nav.aiding import AT_PORTS
from nav.alignment.rest import UNSTATED
from nav.earth import STANDARD_GRAVITY
from nav.filter.aided import Settings as FilterSettings
from nav.filter.assumptions import Assumptions, Bounds
from nav.filter.states import GYRO_BIAS, SENSOR_BLOCKS, Block, Tuning, tuning
from nav.filter.stillness import Stillness
from nav.gaps import GapPolicy
from nav.instruments.axis_drift import body_drift
from nav.instruments.grades import GRADES
from nav.navigator import Aiding, Settings

BAROMETER_M = 1000.0
"""How far a pressure height may be from the ellipsoid at first, one sigma: it is that above some field, on some day."""


def settings_of(scenario: Scenario) -> Settings:
    """The navigator's settings in a scenario."""
    navigation, start, motion = scenario.navigation, scenario.navigation.start, scenario.motion
    latitude = motion.latitude_deg if start.latitude_deg is None else start.latitude_deg
    longitude = motion.longitude_deg if start.longitude_deg is None else start.longitude_deg
    return Settings(
        lat=math.radians(latitude),
        lon=math.radians(longitude),
        height=motion.height_m if start.height_m is None else start.height_m,
        alignment="gyrocompass" if navigation.alignment == "truth" else navigation.alignment,
        align_s=navigation.align_s,
        heading=None if start.heading_deg is None else math.radians(start.heading_deg),
        sensors=UNSTATED if navigation.alignment == "truth" else sensors_of(scenario),
        sway=navigation.sway_m,
        track_bias_at_rest=navigation.track_bias_at_rest,
        position_trusted=navigation.alignment != "level",
        attitude=navigation.attitude,
        mechanization=navigation.mechanization,
        gravity=navigation.gravity,
        lever_arm=scenario.head.lever_arm_m,
        antenna=antenna_of(scenario),
        gaps=GapPolicy(navigation.gap_interpolate_s, navigation.gap_realign_s),
        aiding=aiding_of(scenario, math.radians(latitude), math.radians(longitude)) if navigation.aided else None,
    )


def antennas_of(scenario: Scenario) -> dict[int, tuple[float, float, float]]:
    """From the head to the antenna of each receiver, m, by its source: those on the bus, then those at ports of their own."""
    arms = {k: one.lever_arm_m for k, one in enumerate(scenario.aiding.gnss)}
    arms |= {k: one.lever_arm_m for k, one in enumerate(scenario.receiver, AT_PORTS)}
    return {k: _three(np.subtract(arm, scenario.head.lever_arm_m)) for k, arm in arms.items()}


def antenna_of(scenario: Scenario) -> tuple[float, float, float]:
    """From the head to the first receiver's antenna, m."""
    return next(iter(antennas_of(scenario).values()), (0.0, 0.0, 0.0))


def aiding_of(scenario: Scenario, lat: float, lon: float) -> Aiding:
    """How the filter of a scenario is set."""
    head, aiding, height = scenario.head, scenario.aiding, scenario.motion.height_m
    chosen, start = scenario.navigation.filter, scenario.navigation.start
    grade = GRADES[chosen.grade or ("dtg" if head.grade == "none" else head.grade)]
    if chosen.gyro_deg_sqrt_h is not None:
        grade = replace(grade, gyro_white=math.radians(chosen.gyro_deg_sqrt_h) / 60.0)
    if chosen.accelerometer_ms_sqrt_h is not None:
        grade = replace(grade, accelerometer_white=chosen.accelerometer_ms_sqrt_h / 60.0)
    tilt = max(math.radians(0.01), grade.accelerometer_bias / STANDARD_GRAVITY)
    removed = scenario.navigation.alignment not in ("moving", "transfer")
    field_n = magnetic_field(aiding.field, lat, lon, height, aiding.year)
    if chosen.declination_deg is not None:
        there, level = math.radians(chosen.declination_deg), math.hypot(field_n[0], field_n[1])
        field_n[:2] = level * math.cos(there), level * math.sin(there)
    believed = tuning(
        grade,
        (*SENSOR_BLOCKS, Block.BAROMETER_BIAS),
        bias_removed=removed,
        barometer=BAROMETER_M,
        barometer_walk=chosen.barometer_m_sqrt_s,
    )
    variances = axis_drift(head, bias_removed=removed)
    if scenario.driver == "dtg-head" and variances is not None:
        believed.sigma[GYRO_BIAS] = body_drift(variances, mounting(head), math.radians(head.skew_deg))
    assumptions = _assumptions_of(scenario, believed)
    if assumptions is not None:  # the tilt errs as the accelerometers do, and the filter has to find out which of them
        tilt *= 10.0
    return Aiding(
        believed,
        FilterSettings(
            lever_arm=antenna_of(scenario),
            antennas=tuple(antennas_of(scenario).items()),
            field_n=_three(field_n),
            magnetic_heading=chosen.magnetic == "heading",
        ),
        np.array([5.0, 5.0, 5.0, 0.05, 0.05, 0.05, tilt, tilt, math.radians(start.heading_sigma_deg)]),
        assumptions,
    )


def _assumptions_of(scenario: Scenario, believed: Tuning) -> Assumptions | None:
    assume, bounds = scenario.navigation.assume, scenario.navigation.assume.bounds
    if assume.rest == "never" and bounds is None and assume.wheels_ms is None:
        return None
    rate_white, force_white = float(believed.white[:3].max()), float(believed.white[3:].max())
    return Assumptions(
        Stillness(rate_white, force_white, ANGLE_LSB, VELOCITY_LSB[scenario.head.layout]),
        assume.rest == "detected",
        assume.smooth_ms,
        None if bounds is None else Bounds(bounds.acceleration_ms2, bounds.speed_ms, bounds.place_m),
        assume.wheels_ms,
    )


def _three(vector: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
