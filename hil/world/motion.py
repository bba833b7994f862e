"""What is true of a motion, and what a perfect inertial unit on it measures.

The motion is the closed form of :mod:`hil.world.trajectory`. An increment is the Gauss-Legendre integral of the body
rate and of the specific force over its step, of as many nodes as the fastest motion needs; a step in which the ramp
begins or ends is integrated in pieces. The transverse acceleration of the lever arm integrates exactly to the change of
``w x r``.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hil.scenario import MotionConfig
from hil.world.trajectory import FloatArray, Plan, high_bits, motion_times, plan_of, state_at
from nav.errors import HilError
from nav.kernel import kernel

TRUTH = np.dtype(
    [
        ("time", "<f8"),  # s
        ("lat", "<f8"),  # geodetic, rad
        ("lon", "<f8"),  # rad, in [-pi, pi]
        ("height", "<f8"),  # above the ellipsoid, m
        ("vel_n", "<f8", 3),  # north, east, down, m/s
        ("q_nb", "<f8", 4),  # body to n, scalar first, of either sign
        ("w_ib_b", "<f8", 3),  # rad/s
        ("f_b", "<f8", 3),  # at the navigated point, m/s^2
    ]
)
"""What is true at one time."""

_TOLERANCE = 1e-13
"""Error of the quadrature relative to the integral."""


@kernel
def _fill_truth(plan: Plan, times: FloatArray, out: FloatArray) -> None:
    """Rows of `TRUTH` as (n, 17) floats."""
    half_cos = math.sqrt(0.5 * (1.0 + plan.cone_cos))
    half_sin = 0.5 * plan.cone_sin / half_cos
    for k in range(len(times)):
        s = state_at(plan, times[k], 0.0)
        out[k, 0] = times[k]
        for j in range(6):
            out[k, 1 + j] = s[j]
        out[k, 2] -= 2.0 * math.pi * math.floor(s.lon / (2.0 * math.pi) + 0.5)
        sh, sp, sr = math.sin(0.5 * s.heading), math.sin(0.5 * s.pitch), math.sin(0.5 * s.roll)
        ch, cp, cr = math.cos(0.5 * s.heading), math.cos(0.5 * s.pitch), math.cos(0.5 * s.roll)
        w, x = ch * cp * cr + sh * sp * sr, ch * cp * sr - sh * sp * cr
        y, z = ch * sp * cr + sh * cp * sr, sh * cp * cr - ch * sp * sr
        uy, uz = half_sin * math.cos(s.cone), half_sin * math.sin(s.cone)
        out[k, 7] = w * half_cos - y * uy - z * uz
        out[k, 8] = x * half_cos + y * uz - z * uy
        out[k, 9] = y * half_cos + w * uy - x * uz
        out[k, 10] = z * half_cos + w * uz + x * uy
        for j in range(6):
            out[k, 11 + j] = s[10 + j]


@kernel
def _fill_increments(
    plan: Plan,
    rule: FloatArray,  # (m, 2) nodes and weights on [0, 1]
    arm: tuple[float, float, float],
    first: int,
    step: float,
    step_high: float,  # the 24 high bits of step
    dtheta: FloatArray,
    dvel: FloatArray,
) -> None:
    rx, ry, rz = arm
    with_arm = rx != 0.0 or ry != 0.0 or rz != 0.0
    wx0 = wy0 = wz0 = 0.0
    for k in range(first, first + len(dtheta)):
        whole = k * step
        part = (k * step_high - whole) + k * (step - step_high)
        tx = ty = tz = vx = vy = vz = 0.0
        left = 0.0
        while left < step:  # once, but for a step in which the ramp begins or ends: its pieces are smooth
            right = step
            for mark in (plan.rest, plan.rest + plan.ramp):
                if left < (mark - whole) - part < right:
                    right = (mark - whole) - part
            span = right - left
            for j in range(len(rule)):
                s = state_at(plan, whole, part + (left + rule[j, 0] * span))
                wx, wy, wz = s.wx, s.wy, s.wz
                along, square = wx * rx + wy * ry + wz * rz, wx * wx + wy * wy + wz * wz
                weight = rule[j, 1] * span
                tx += weight * wx
                ty += weight * wy
                tz += weight * wz
                vx += weight * (s.fx + wx * along - rx * square)
                vy += weight * (s.fy + wy * along - ry * square)
                vz += weight * (s.fz + wz * along - rz * square)
            left = right
        if with_arm:
            if k == first:
                s = state_at(plan, whole, part)
                wx0, wy0, wz0 = s.wx, s.wy, s.wz
            whole = (k + 1) * step
            s = state_at(plan, whole, ((k + 1) * step_high - whole) + (k + 1) * (step - step_high))
            dx, dy, dz = s.wx - wx0, s.wy - wy0, s.wz - wz0
            wx0, wy0, wz0 = s.wx, s.wy, s.wz
            vx += dy * rz - dz * ry
            vy += dz * rx - dx * rz
            vz += dx * ry - dy * rx
        row = k - first
        dtheta[row, 0], dtheta[row, 1], dtheta[row, 2] = tx, ty, tz
        dvel[row, 0], dvel[row, 1], dvel[row, 2] = vx, vy, vz


@kernel
def _fill_sampled(plan: Plan, first: int, step: float, step_high: float, force: FloatArray, rate: FloatArray) -> None:
    for row in range(len(force)):
        k = first + row
        whole = k * step
        s = state_at(plan, whole, (k * step_high - whole) + k * (step - step_high))
        rate[row, 0], rate[row, 1], rate[row, 2] = s.wx, s.wy, s.wz
        force[row, 0], force[row, 1], force[row, 2] = s.fx, s.fy, s.fz


class Motion:
    """A motion, compiled.

    Parameters
    ----------
    config : MotionConfig
        The motion.
    lever_arm_m : (3,) sequence of float
        Place of the accelerometers in the body, forward-right-down of the navigated point, m.

    Raises
    ------
    HilError
        The start is at a pole, or a coordinated path is vertical or stands still somewhere.
    """

    def __init__(self, config: MotionConfig, lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self._plan = plan_of(config)
        self._arm = (float(lever_arm_m[0]), float(lever_arm_m[1]), float(lever_arm_m[2]))
        self._fastest = _fastest(self._plan)
        self._rules: dict[float, FloatArray] = {}

    def truth(self, times: ArrayLike) -> NDArray[np.void]:
        """What is true at `times` at the navigated point.

        Parameters
        ----------
        times : (n,) array_like
            Times since the start of the run, s.

        Returns
        -------
        (n,) array of TRUTH

        Raises
        ------
        HilError
            The path has crossed a pole, or a coordinated path stands still.
        """
        table = _truth_table(self._plan, np.atleast_1d(np.asarray(times, dtype=np.float64)))
        bad = ~(np.isfinite(table).all(axis=1) & (np.abs(table[:, 1]) <= 0.5 * math.pi))
        if bad.any():
            raise _lost(table[bad.argmax(), 0])
        return table.view(TRUTH)[:, 0]

    def increments(self, first: int, count: int, step: float, dtheta: FloatArray, dvel: FloatArray) -> None:
        """Integrate body rate and specific force over consecutive steps; step k spans [k, k + 1] * step.

        A step's result depends on k and `step` alone, to the last bit. The error is below 1e-12 of the largest rate
        times the step, and of the specific force times the step. A lever arm adds the rounding of ``w x r`` at the
        ends of the step, which does not accumulate.

        Parameters
        ----------
        first, count : int
            The first step and how many.
        step : float
            Length of a step, s.
        dtheta : (count, 3) array, filled
            Integral of ``w_ib_b``, rad.
        dvel : (count, 3) array, filled
            Integral of the specific force at the lever arm, ``f_b + w' x r + w x (w x r)``, in body axes, m/s.

        Raises
        ------
        HilError
            The motion is too fast for the step, or a coordinated path stands still.
        """
        if dtheta.shape != (count, 3) or dvel.shape != (count, 3):
            raise ValueError(f"increments: expected two ({count}, 3) arrays, got {dtheta.shape} and {dvel.shape}")
        rule = self._rules.get(step)
        if rule is None:
            rule = self._rules[step] = _rule(self._fastest, step)
        _fill_increments(self._plan, rule, self._arm, first, step, high_bits(step), dtheta, dvel)
        if not (math.isfinite(dtheta.sum()) and math.isfinite(dvel.sum())):
            bad = ~np.isfinite(dtheta + dvel).all(axis=1)
            raise _lost((first + int(bad.argmax())) * step)

    def sampled(self, first: int, step: float, force: FloatArray, rate: FloatArray) -> None:
        """Specific force and body rate at the times k * step, k from `first`.

        Parameters
        ----------
        first : int
            The first k.
        step : float
            s.
        force, rate : (n, 3) array, filled
            ``f_b`` at the navigated point, m/s^2, and ``w_ib_b``, rad/s.

        Raises
        ------
        HilError
            A coordinated path stands still.
        """
        _fill_sampled(self._plan, first, step, high_bits(step), force, rate)
        if not (math.isfinite(force.sum()) and math.isfinite(rate.sum())):
            bad = ~np.isfinite(force + rate).all(axis=1)
            raise _lost((first + int(bad.argmax())) * step)


def _truth_table(plan: Plan, times: FloatArray) -> FloatArray:
    table = np.empty((len(times), 17))
    _fill_truth(plan, times, table)
    return table


def _fastest(plan: Plan) -> float:
    """Upper bound on the angular frequencies in the body rate and the specific force, rad/s.

    Products of the channels and of the attitude they turn in have sums of their frequencies; a heading that swings
    round a slow point of the path is as fast as its own rate. The septic ramp's steepest derivatives are those of 10 / ramp.
    """
    rates = np.abs(plan.sines[:, 1])
    grid = motion_times(2.0 * math.pi / rates[rates > 0.0])
    times = np.concatenate([plan.rest + plan.ramp * np.linspace(0.0, 1.0, 257), plan.rest + plan.ramp + grid])
    turning = np.sqrt((_truth_table(plan, times)[:, 11:14] ** 2).sum(axis=1)).max()
    return 2.0 * float(rates.max() + turning + (10.0 / plan.ramp if plan.ramp else 0.0))


def _rule(fastest: float, step: float) -> FloatArray:
    """Composite Gauss-Legendre rule on [0, 1] for a step, (m, 2) nodes and weights."""
    if not 0.0 < fastest * step < 2000.0:
        raise HilError(f"motion: {fastest:.3g} rad/s cannot be integrated over a step of {step:g} s; sample faster")
    panels = math.ceil(0.5 * fastest * step)
    angle = fastest * step / panels
    order = 2
    while angle ** (2 * order) * math.factorial(order) ** 4 > _TOLERANCE * (2 * order + 1) * (
        math.factorial(2 * order) ** 3
    ):
        order += 1
    nodes, weights = np.polynomial.legendre.leggauss(order)
    places = (np.arange(panels)[:, None] + 0.5 * (nodes + 1.0)) / panels
    return np.column_stack([places.ravel(), np.tile(0.5 * weights / panels, panels)])


def _lost(time: float) -> HilError:
    return HilError(
        f"motion: at {time:.3f} s the path crosses a pole or, coordinated, stands still; shorten the run or change the path"
    )
