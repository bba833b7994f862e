"""What the instruments of the simulated head give: ideal ones the true increments, real ones what physics makes of them.

    motion at the nodes of steps of at most 1/8000 s -> errors of the gyros -> rotors -> torquer increments, rotor angles
                                                    -> pendulums, each in its place -> errors of the accelerometers

Errors and noise are drawn for a whole sample; rotors and pendulums move in the fine steps. The records depend on the scenario
and its seed alone.
"""

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from drivers.can.dtg_head_emulator import ANGLE_LSB, VELOCITY_LSB
from hil.calibration import CalibrationFile, rotor_of
from hil.scenario import HeadConfig, Scenario
from hil.world.motion import Motion
from nav.alignment.axes import matrix, rotation
from nav.alignment.rest import UNSTATED, Sensors
from nav.earth import STANDARD_GRAVITY as _G
from nav.errors import HilError
from nav.increments import FloatArray, IntArray
from nav.instruments.accelerometer_errors import AccelerometerErrors, Accelerometers
from nav.instruments.axis_drift import axis_variances, body_drift
from nav.instruments.calibration import CASES
from nav.instruments.dtg import move, step_map
from nav.instruments.grades import GRADES
from nav.instruments.gyro_errors import GyroErrors, Gyros
from nav.instruments.head import HeadModel
from nav.instruments.layout import common_layout, moved
from nav.instruments.pendulum import Pendulum
from nav.instruments.rebalance import PendulumBlock
from nav.instruments.redundancy import AXES, Limits, layout
from nav.rotation import dcm_from_quaternion, quaternion_from_euler

INTERNAL_HZ = 8000.0
"""Rotors and pendulums move in steps no longer than this."""
BLOCK_OFFSET_M = 0.03
"""How far the level pendulums' hinges of the simulated block lie out of its centre."""
GYRO_RANGE = math.radians(180.0)
"""The torquers saturate here, rad/s."""
_TURN_ON = ("gyro_bias", "gyro_scale", "gyro_misalignment", "gyro_g", "accelerometer_bias", "accelerometer_scale")


@dataclass(frozen=True, slots=True)
class Sensed:
    """Samples of the head before they go on the wire.

    Attributes
    ----------
    dtheta : (n, 4) float
        g1x, g1y, g2y, g2z, rad.
    dvel : (n, 3) float
        m/s.
    rotor : (n, 4) float or None
        Rotor angles at the end of each sample, rad.
    status : (n,) int
        Status bits.
    """

    dtheta: FloatArray
    dvel: FloatArray
    rotor: FloatArray | None
    status: IntArray


def mounting(head: HeadConfig) -> FloatArray:
    """C_bh (3, 3), as the scenario says it in one of three ways."""
    if head.axes is not None:
        return matrix(head.axes)
    if head.mounting is not None:
        return rotation(head.mounting)
    c: FloatArray = dcm_from_quaternion(quaternion_from_euler(*np.radians(head.mounting_deg)))
    return c


def block_of(head: HeadConfig) -> tuple[Pendulum, ...]:
    """The pendulums of the simulated block in their places about its centre, in head axes; none where they are ideal."""
    return common_layout(Pendulum(), BLOCK_OFFSET_M) if head.instruments == "dtg" else ()


def head_model(head: HeadConfig) -> HeadModel:
    """What the core takes the head of a scenario for."""
    rotor = rotor_of(head.rotor)
    calibration = None
    if head.calibration is not None:
        table = CalibrationFile.model_validate(head.calibration)
        if table.skew_deg != head.skew_deg:
            raise HilError(
                f"head.calibration: it is of a head with skew_deg = {table.skew_deg:g}, and head.skew_deg = {head.skew_deg:g}"
            )
        calibration = table.calibration()
    return HeadModel(
        mounting(head),
        math.radians(head.skew_deg),
        (rotor, rotor) if head.instruments == "dtg" else None,
        block_of(head),
        limits_of(head),
        calibration,
        axis_drift(head),
    )


def axis_drift(head: HeadConfig, *, bias_removed: bool = False) -> FloatArray | None:
    """Variances of the drift of the four gyro axes of the scenario's grade, (rad/s)^2; None where there is no grade."""
    if head.grade == "none":
        return None
    factor = max(head.errors_factor, 1.0) if head.calibration is None else 1.0
    return axis_variances(GRADES[head.grade], mounting(head), bias_removed=bias_removed, factor=factor)


def sensors_of(scenario: Scenario) -> Sensors:
    """What an alignment is told of the sensors of a scenario, in a level vehicle."""
    head = scenario.head
    variances = axis_drift(head)
    if variances is None:
        return UNSTATED
    grade = GRADES[head.grade]
    by_gravity = grade.gyro_g * _G
    drift = np.full(3, math.hypot(grade.gyro_bias, by_gravity, grade.gyro_flicker))
    if scenario.driver == "dtg-head":
        drift = body_drift(variances, mounting(head), math.radians(head.skew_deg))
    level = float(drift[:2].max())
    upright = math.sqrt(max(0.0, float(drift[2]) ** 2 - level**2))
    return Sensors(grade.gyro_white, grade.accelerometer_white, level, grade.accelerometer_bias, upright)


def limits_of(head: HeadConfig) -> Limits:
    """What healthy instruments of the scenario's grade do."""
    if head.instruments == "ideal":
        return Limits()
    limit = Pendulum().limit
    if head.grade == "none":
        return Limits(gyro_range=GYRO_RANGE, accelerometer_range=limit)
    grade, factor = GRADES[head.grade], max(head.errors_factor, 1.0)
    return Limits(
        grade.gyro_white,
        grade.accelerometer_white,
        factor * grade.gyro_scale,
        factor * grade.gyro_misalignment,
        GYRO_RANGE,
        limit,
        factor * grade.gyro_bias,
    )


class IdealInstruments:
    """True increments; both y axes are equal."""

    def __init__(self, scenario: Scenario, step: float) -> None:
        head = scenario.head
        self._motion = Motion(scenario.motion, head.lever_arm_m)
        self._c_hb, self._step = mounting(head).T, step
        self._h = layout(math.radians(head.skew_deg))

    def sense(self, first: int, count: int) -> Sensed:
        """Samples `first` to `first` + `count`; the calls follow one another."""
        dtheta, dvel = np.empty((count, 3)), np.empty((count, 3))
        self._motion.increments(first, count, self._step, dtheta, dvel)
        gyro = dtheta @ self._c_hb.T @ self._h.T
        return Sensed(gyro, dvel @ self._c_hb.T, None, np.zeros(count, np.int64))


class DtgInstruments:
    """Two gyros and three pendulums by their physics, with the errors of a grade."""

    def __init__(self, scenario: Scenario, step: float) -> None:
        head = scenario.head
        self._motion = Motion(scenario.motion)
        self._c_hb, self._step = mounting(head).T, step
        self._per = math.ceil(step * INTERNAL_HZ - 1e-9)
        self._fine = step / self._per
        h = layout(math.radians(head.skew_deg))
        # Axes of each case: two input axes, spin axis.
        self._cases = [np.array([h[2 * g], h[2 * g + 1], np.eye(3)[2 - 2 * g]]) for g in range(2)]
        rotor = rotor_of(head.rotor)
        self._gain = -1.0 / rotor.lag
        self._table = step_map(rotor, self._fine, head.rotor.method)
        seeds = np.random.SeedSequence(scenario.seed).spawn(4)
        of_errors = seeds[0] if head.errors_seed is None else np.random.SeedSequence(head.errors_seed).spawn(1)[0]
        errors = drawn_errors(head, np.random.default_rng(of_errors))
        self._gyros = [Gyros(_part(errors[0], g), step, np.random.default_rng(seeds[1 + g])) for g in range(2)]
        self._accelerometers = Accelerometers(errors[1], step, np.random.default_rng(seeds[3]))
        arm = self._c_hb @ np.asarray(head.lever_arm_m)
        self._block = PendulumBlock(moved(block_of(head), -arm), self._fine)
        force, rate = np.empty((1, 3)), np.empty((1, 3))
        self._motion.sampled(0, self._fine, force, rate)
        still = (rate @ self._c_hb.T)[0]
        self._rotors = [rotor.settled(tuple((case @ still)[:2])) for case in self._cases]

    def sense(self, first: int, count: int) -> Sensed:
        """Samples `first` to `first` + `count`; the calls follow one another."""
        n = count * self._per
        force, rate = np.empty((2 * n + 1, 3)), np.empty((2 * n + 1, 3))
        self._motion.sampled(2 * first * self._per, 0.5 * self._fine, force, rate)
        force, rate = force @ self._c_hb.T, rate @ self._c_hb.T
        change = rate[2::2] - rate[:-1:2]
        mean = (rate[:-1:2] + 4.0 * rate[1::2] + rate[2::2]) / 6.0
        pushed = self._block.sense(force, rate).reshape(count, self._per, 3).sum(axis=1)
        turned = self._step * mean.reshape(count, self._per, 3).mean(axis=1)
        dtheta, angle = np.empty((count, 4)), np.empty((count, 4))
        for g, (case, gyros) in enumerate(zip(self._cases, self._gyros, strict=True)):
            true = turned @ case.T
            wrong = (gyros.sense(true, pushed @ case.T) - true[:, :2]) / self._step
            inputs = mean @ case[:2].T + np.repeat(wrong, self._per, axis=0)
            tilt, swept = np.empty((n, 2)), np.empty((n, 2))
            move(self._table, self._rotors[g], inputs, np.ascontiguousarray(change @ case[:2].T), tilt, swept)
            columns = slice(2 * g, 2 * g + 2)
            dtheta[:, columns] = self._gain * swept.reshape(count, self._per, 2).sum(axis=1)
            angle[:, columns] = tilt[self._per - 1 :: self._per]
        limit = GYRO_RANGE * self._step
        saturated = np.abs(dtheta) > limit
        status = np.zeros(count, np.int64)
        for gyro in range(2):
            status[saturated[:, 2 * gyro : 2 * gyro + 2].any(axis=1)] |= 1 << (5 + gyro)
        return Sensed(np.clip(dtheta, -limit, limit), self._accelerometers.sense(pushed), angle, status)


class Faulty:
    """Instruments that fail as the scenario says."""

    def __init__(self, inner: IdealInstruments | DtgInstruments, scenario: Scenario, step: float) -> None:
        self._inner, self._faults, self._step = inner, scenario.head.faults, step
        self._rng = np.random.default_rng([scenario.seed, 1])
        grade = GRADES["dtg" if scenario.head.grade == "none" else scenario.head.grade]
        self._noise = np.repeat([grade.gyro_white, grade.accelerometer_white], [4, 3]) * math.sqrt(step)
        self._velocity_lsb = VELOCITY_LSB[scenario.head.layout]
        self._stuck = np.full(7, np.nan)

    def sense(self, first: int, count: int) -> Sensed:
        """As those within."""
        sensed = self._inner.sense(first, count)
        time = self._step * np.arange(first + 1, first + count + 1)
        for fault in self._faults:
            axis = AXES.index(fault.axis)
            values = sensed.dtheta[:, axis] if axis < 4 else sensed.dvel[:, axis - 4]
            bad = time > fault.at_s + 1e-9
            if not bad.any():
                continue
            if fault.kind == "stuck":
                if math.isnan(self._stuck[axis]):  # the head goes on sending the same number
                    lsb = ANGLE_LSB if axis < 4 else self._velocity_lsb
                    self._stuck[axis] = lsb * round(values[bad][0] / lsb)
                values[bad] = self._stuck[axis]
            elif fault.kind == "noise":
                values[bad] += fault.size * self._noise[axis] * self._rng.standard_normal(int(bad.sum()))
            elif fault.kind == "jump":
                values[bad] += fault.size * self._step
            else:
                sensed.status[bad] |= 1 << (axis // 2 if axis < 4 else axis - 2)
        return sensed


Instruments = IdealInstruments | DtgInstruments | Faulty


def instruments(scenario: Scenario, step: float) -> Instruments:
    """The instruments of a scenario, sampled every `step` s."""
    inner = IdealInstruments(scenario, step) if scenario.head.instruments == "ideal" else DtgInstruments(scenario, step)
    return Faulty(inner, scenario, step) if scenario.head.faults else inner


def drawn_errors(head: HeadConfig, rng: np.random.Generator) -> tuple[GyroErrors, AccelerometerErrors]:
    """Errors of the scenario's grade, for four gyro channels."""
    if head.grade == "none":
        return GyroErrors(channels=CASES), AccelerometerErrors()
    grade = GRADES[head.grade]
    sizes: dict[str, Any] = {name: head.errors_factor * getattr(grade, name) for name in _TURN_ON}
    return replace(grade, gyro_channels=CASES, **sizes).draw(rng)


def _part(errors: GyroErrors, gyro: int) -> GyroErrors:
    """Those of one gyro's two channels."""
    changed: dict[str, Any] = {
        field.name: getattr(errors, field.name)[2 * gyro : 2 * gyro + 2]
        for field in fields(errors)
        if isinstance(getattr(errors, field.name), tuple) and len(getattr(errors, field.name)) == len(errors.channels)
    }
    return replace(errors, **changed)
