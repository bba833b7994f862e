"""From the raw increments of a dual-DTG head to those of one IMU in body axes.

    lag of the gyros taken off -> calibration -> tests, parity, combination of the four axes -> size effect -> body axes

A failed axis is left out from the sample after the one that shows it. What the layout cannot spare is said, and the samples
are flagged: a noisy or saturated axis then goes on being used, a dead one counts as zero.
"""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, field
from typing import Any

import numpy as np

from nav.cut import Cut
from nav.increments import FloatArray, HeadIncrements, ImuIncrements, IntArray, Validity
from nav.instruments import redundancy
from nav.instruments.calibration import UNCALIBRATED, Calibration, Calibrator, outside, take_off
from nav.instruments.dtg import Rotor
from nav.instruments.dtg_compensation import LagCompensator, take_off_lag
from nav.instruments.pendulum import Pendulum
from nav.instruments.redundancy import AXES, Fault, Limits
from nav.instruments.size_effect import MEMORY as SIZE_MEMORY
from nav.instruments.size_effect import compensate as take_off_size_effect
from nav.instruments.size_effect import size_coefficients
from nav.kernel import kernel

_LOST = Fault.STUCK | Fault.NOISE | Fault.SATURATED | Fault.BUILT_IN
_STATUS_AXES = ((0, 1), (2, 3), (4,), (5,), (6,))
"""Axes of the status bits 0..4."""
_NO_LAG, _NO_SIZE = LagCompensator().parts, np.zeros((3, 9))
SPEED_TOLERANCE = 0.01
"""A rotor speed off by more than this share is a failed gyro."""


@dataclass(frozen=True, slots=True)
class HeadModel:
    """What a head is taken for.

    Attributes
    ----------
    c_bh : (3, 3) float
        Mounting: takes head axes to body axes.
    skew : float
        How far each gyro is turned about its spin axis, rad; see :mod:`nav.instruments.redundancy`.
    rotors : pair of Rotor, optional
        What G1 and G2 send lags by these; None: they send true rates.
    pendulums : sequence of Pendulum
        Their size effect is taken off; none: there is none.
    limits : Limits
        What healthy instruments do.
    calibration : Calibration, optional
        Measured errors of the instruments, taken off; its rotors, if it has any, take the place of `rotors`.
    variances : (4,) float, optional
        How well each gyro axis is known (:func:`nav.instruments.axis_drift.axis_variances`); their ratios are the weights of
        the combination. None: all alike.
    """

    c_bh: FloatArray
    skew: float = 0.0
    rotors: tuple[Rotor, Rotor] | None = None
    pendulums: Sequence[Pendulum] = ()
    limits: Limits = field(default_factory=Limits)
    calibration: Calibration | None = None
    variances: FloatArray | None = None


_Sample = tuple[
    FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, IntArray, IntArray, IntArray, FloatArray, FloatArray
]
"""The arrays of `HeadIncrements` with one row each."""
_Views = tuple[FloatArray, ImuIncrements, IntArray, FloatArray]
"""Of some samples: increments of the gyro axes, what becomes of them, what is said of them, parity residual."""


@dataclass(frozen=True, slots=True)
class Note:
    """Something that the user is told of an instrument."""

    time: float
    bad: bool
    text: str


@kernel
def _combine(gyro: FloatArray, inverse: FloatArray, flag: int, dtheta: FloatArray, validity: IntArray) -> None:
    for k in range(gyro.shape[0]):
        a, b, c, d = gyro[k, 0], gyro[k, 1], gyro[k, 2], gyro[k, 3]
        for i in range(3):
            dtheta[k, i] = inverse[i, 0] * a + inverse[i, 1] * b + inverse[i, 2] * c + inverse[i, 3] * d
        validity[k] |= flag


@kernel
def _turn(c_bh: FloatArray, dtheta: FloatArray, dvel: FloatArray) -> None:
    """Head axes to body axes, in place."""
    for vectors in (dtheta, dvel):
        for k in range(vectors.shape[0]):
            x, y, z = vectors[k, 0], vectors[k, 1], vectors[k, 2]
            for i in range(3):
                vectors[k, i] = c_bh[i, 0] * x + c_bh[i, 1] * y + c_bh[i, 2] * z


@kernel
def _take_over(
    status: IntArray,
    spin: FloatArray,
    speeds: FloatArray,
    dvel: FloatArray,
    validity: IntArray,
    said: IntArray,
    dvel_out: FloatArray,
    validity_out: IntArray,
) -> None:
    """What passes as it is; `said`: status bits of the instruments, and of the gyros whose rotor does not have its speed."""
    for k in range(status.shape[0]):
        said[k] = status[k] & 0x1F
        for gyro in range(speeds.shape[0]):
            if abs(spin[k, gyro] / speeds[gyro] - 1.0) > SPEED_TOLERANCE:
                said[k] |= 1 << gyro
        for i in range(3):
            dvel_out[k, i] = dvel[k, i]
        validity_out[k] = validity[k]


FAULT, OUTSIDE = 1, 2
"""What `combine_one` may answer: an axis has failed or is good again; the temperature has just left the calibrated range."""


@kernel
def combine_one(parts: Any, sample: _Sample) -> int:
    """`HeadCombiner.combine` of the only sample with its `parts`; -1, and nothing has changed, when instruments say news.

    Else what is to be told (`HeadCombiner.told`): the sum of `FAULT` and `OUTSIDE`, or 0. The sample is finite and has a length.
    """
    does, said, lag, calibration, size, tests, turn, out = parts
    has_lag, is_calibrated, has_size, is_pair = does
    status, flag = said
    time, step, raw, rotor, sent, validity_in, sequence, told, spin, temperature = sample
    gyro, dtheta, dvel, validity, now, residual = out
    speeds, inverse, c_bh = turn
    memory, faults, before, parity, limits = tests
    _take_over(told, spin, speeds, sent, validity_in, now, dvel, validity)
    if now[0] != status:
        return -1
    answer = 0
    if has_lag:
        take_off_lag(lag, sequence, step, raw, rotor, gyro)
    else:
        gyro[:] = raw
    if is_calibrated and take_off(calibration, step, temperature, gyro, dvel) >= 0:
        answer = OUTSIDE
    before[:] = faults
    redundancy.examine(memory, faults, time, step, raw, gyro, sent, parity, limits, is_pair, residual)
    _combine(gyro, inverse, flag, dtheta, validity)
    for axis in range(faults.shape[0]):
        if faults[axis] != before[axis]:
            answer |= FAULT
    if has_size:
        size_memory, coefficients = size
        take_off_size_effect(size_memory, coefficients, step, dtheta, dvel, dvel)
    _turn(c_bh, dtheta, dvel)
    return answer


@kernel
def _same_until(said: IntArray, start: int) -> int:
    """The end of the samples from `start` on of which the same is said."""
    for k in range(start + 1, said.shape[0]):
        if said[k] != said[start]:
            return k
    return int(said.shape[0])


class HeadCombiner:
    """Turns `HeadIncrements` into `ImuIncrements`; how a stream is split into batches changes no bit.

    Parameters
    ----------
    model : HeadModel
        The head.

    Attributes
    ----------
    faults : (7,) int
        `Fault` of each of `nav.instruments.redundancy.AXES`.
    residual : (n,) float
        Parity residual of each sample of the last batch, rad; zero once an axis is lost.
    """

    def __init__(self, model: HeadModel) -> None:
        self._c_bh = np.ascontiguousarray(model.c_bh, dtype=float)
        self.parts: tuple[Any, ...] = ()
        """For kernels (`combine_one`); another tuple whenever something in it is."""
        calibration = self._calibration = model.calibration
        self._h = redundancy.layout(model.skew) if calibration is None else calibration.gyro_matrix(model.skew)
        self._weights = np.ones(4) if model.variances is None else model.variances.max() / model.variances
        self._calibrator = None if calibration is None else Calibrator(calibration, model.skew)
        self._outside = False
        self._pair = math.sin(model.skew) == 0.0
        self._rotors = (None if calibration is None else calibration.rotors) or model.rotors
        self._lag = None if self._rotors is None else LagCompensator(*self._rotors)
        self._size = size_coefficients(model.pendulums) if model.pendulums else None
        self._size_memory = np.zeros(SIZE_MEMORY)
        self._limits = astuple(model.limits)
        self._notes: list[Note] = []
        self.faults, self._before = np.zeros(7, np.int64), np.zeros(7, np.int64)
        self.residual = np.zeros(0)
        self._speeds = np.array([rotor.spin / (2.0 * math.pi) for rotor in self._rotors or ()])
        self._views = Cut(self._cut)
        self._room(256)
        self.renew()

    def renew(self) -> None:
        """Forget all faults and begin the tests anew."""
        self.faults[:] = 0
        self._memory = redundancy.fresh_memory()
        self._status = 0
        self._weigh()

    def failed(self) -> dict[str, str]:
        """Axes that have failed, and how."""
        return {AXES[k]: _words(Fault(int(self.faults[k]))) for k in np.flatnonzero(self.faults)}

    def notes(self) -> list[Note]:
        """What happened since the last call."""
        if not self._notes:
            return []
        notes, self._notes = self._notes, []
        return sorted(notes, key=lambda note: note.time)

    def combine(self, head: HeadIncrements) -> ImuIncrements:
        """The batch in body axes; valid until the next call.

        Raises
        ------
        HilError
            An increment is not finite.
        """
        n = len(head)
        gyro, imu, said, self.residual = self._views[n]
        dtheta, dvel, validity = imu.dtheta, imu.dvel, imu.validity
        if self._lag is None:
            gyro[:] = head.dtheta
        else:
            self._lag.compensate(head, gyro)
        _take_over(head.status, head.spin, self._speeds, head.dvel, head.validity, said, dvel, validity)
        self._calibrate(head, gyro, dvel)
        start = 0
        while start < n:
            if said[start] != self._status:
                self._take_status(float(head.time[start]), int(said[start]))
            stop = n if n - start == 1 else _same_until(said, start)
            before = self.faults.tobytes()
            sent, clean, residual = head, gyro, self.residual
            if start > 0 or stop < n:
                sent, clean, residual = head.rows(start, stop), gyro[start:stop], residual[start:stop]
            seen = sent.time, sent.step, sent.dtheta, clean, sent.dvel
            tests = self._parity, self._limits, self._pair
            done = redundancy.examine(self._memory, self.faults, *seen, *tests, residual)
            _combine(clean[:done], self._inverse, self._flag, dtheta[start:], validity[start:])
            start += done
            if self.faults.tobytes() != before:
                self._tell(float(head.time[start - 1]), np.frombuffer(before, np.int64))
        if self._size is not None:
            take_off_size_effect(self._size_memory, self._size, head.step, dtheta, dvel, dvel)
        _turn(self._c_bh, dtheta, dvel)
        return ImuIncrements(head.time, head.step, dtheta, dvel, validity, head.sequence)

    def told(self, head: HeadIncrements, answer: int) -> ImuIncrements:
        """The only sample of `head` in body axes, which `combine_one` has taken with this answer; valid until the next one."""
        _, imu, _, self.residual = self._views[1]
        if answer & OUTSIDE:
            self._say_outside(head, 0)
        if answer & FAULT:
            self._tell(float(head.time[0]), self._before)
        return ImuIncrements(head.time, head.step, imu.dtheta, imu.dvel, imu.validity, head.sequence)

    def _calibrate(self, head: HeadIncrements, gyro: FloatArray, dvel: FloatArray) -> None:
        if self._calibrator is not None and (left := self._calibrator.take_off(head, gyro, dvel)) >= 0:
            self._say_outside(head, left)

    def _say_outside(self, head: HeadIncrements, left: int) -> None:
        if self._calibration is not None and not self._outside:
            self._outside = True
            where = outside(self._calibration, head.temperature[left])
            text = f"the calibration does not reach this temperature: {where} C; the values of its edge are used"
            self._notes.append(Note(float(head.time[left]), True, text))

    def _take_status(self, time: float, status: int) -> None:
        before, self._status = self.faults.copy(), status
        self.faults &= ~Fault.BUILT_IN.value
        for bit, axes in enumerate(_STATUS_AXES):
            if status & 1 << bit:
                self.faults[list(axes)] |= Fault.BUILT_IN.value
        if (self.faults != before).any():
            self._tell(time, before)
        self._gather()

    def _weigh(self) -> None:
        """Leave out what is lost."""
        gyros = self.faults[:4]
        lost = (gyros & _LOST.value) != 0
        suspects = (gyros & Fault.PARITY.value) != 0
        if (suspects & lost).any():  # found: the others are cleared
            gyros[~lost] &= ~Fault.PARITY.value
            suspects &= lost
        doubt = bool((suspects & ~lost).sum() > 1)
        if not doubt:
            lost |= suspects
        inverse = redundancy.combination(self._h, np.where(lost, 0.0, self._weights))
        bad = inverse is None or doubt or bool((self.faults[4:] & _LOST.value).any())
        self._flag = int(Validity.SENSOR) if bad else int(Validity.SPARE) if lost.any() else 0
        self._spans = inverse is not None
        if inverse is None:  # better a bad measurement than none; a dead one is none
            dead = (gyros & Fault.STUCK.value) != 0
            inverse = np.linalg.pinv(np.where(dead[:, None], 0.0, self._h))
        self._inverse = np.ascontiguousarray(inverse)
        self._parity = np.zeros(4) if lost.any() else redundancy.parity_vector(self._h)
        self._doubt = doubt
        self._gather()

    def _gather(self) -> None:
        """Hand `combine_one` what has changed."""
        does = self._lag is not None, self._calibrator is not None, self._size is not None, self._pair
        lag = _NO_LAG if self._lag is None else self._lag.parts
        calibration = UNCALIBRATED if self._calibrator is None else self._calibrator.parts
        size = self._size_memory, _NO_SIZE if self._size is None else self._size
        tests = self._memory, self.faults, self._before, self._parity, self._limits
        imu = self._imu
        out = self._gyro[:1], imu.dtheta[:1], imu.dvel[:1], imu.validity[:1], self._said[:1], self._residuals[:1]
        turn = self._speeds, self._inverse, self._c_bh
        self.parts = does, (self._status, self._flag), lag, calibration, size, tests, turn, out

    def _tell(self, time: float, before: IntArray) -> None:
        self._weigh()
        parity = [AXES[k] for k in range(4) if self.faults[k] & ~before[k] & Fault.PARITY.value]
        for k in np.flatnonzero(self.faults != before):
            found = Fault(int(self.faults[k] & ~before[k]))
            name = AXES[k]
            if not self.faults[k] and not found:
                self._notes.append(Note(time, False, f"axis {name} is good again"))
            elif found and not (found == Fault.PARITY and self._doubt):
                self._notes.append(Note(time, True, f"axis {name}: {_words(found)}; {self._consequence(int(k))}"))
        if parity and self._doubt:
            self._notes.append(
                Note(
                    time,
                    True,
                    f"{' and '.join(parity)} disagree, and nothing tells which is wrong: attitude is not to be trusted",
                )
            )

    def _consequence(self, axis: int) -> str:
        if axis > 3:
            return "velocity and position are not to be trusted"
        if self._spans:
            return "the others carry on, none is left to spare"
        return "no other axis measures its rate: attitude is not to be trusted"

    def _cut(self, n: int) -> _Views:
        """Room for `n` samples."""
        if n > len(self._imu):
            self._room(2 * n)
        return self._gyro[:n], self._imu.rows(0, n), self._said[:n], self._residuals[:n]

    def _room(self, n: int) -> None:
        self._views.clear()
        self._imu, self._gyro = ImuIncrements.empty(n), np.zeros((n, 4))
        self._said, self._residuals = np.zeros(n, np.int64), np.zeros(n)
        if self.parts:
            self._gather()


def _words(fault: Fault) -> str:
    return str(fault.name).lower().replace("_", "-").replace("|", " and ")
