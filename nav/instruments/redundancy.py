"""Four gyro axes for three rates: combination, parity, own-signal tests, and what goes on when an axis fails.

Each gyro stands turned by the angle s about its own spin axis (G1: z, G2: x), so that its axes sense

    g1x = cos s x + sin s y,   g1y = cos s y - sin s x,   g2y = cos s y + sin s z,   g2z = cos s z - sin s y

With s = 0 (orthogonal) the two y axes are a pair, x and z stand alone. With s = 45 degrees (skewed) any three axes span
space and the parity vector has four equal parts.

Parity: the unit vector p with p H = 0 takes the motion out of the four measurements; p m is noise, unless an axis fails. One
number tells that something is wrong, not what: the axis is named by the own-signal tests, or, for a jump of the orthogonal
pair, by which of the two changed while all other axes stood still. In a manoeuvre nothing tells them apart.

Own-signal tests, on every axis: stuck (the same number for `STUCK_S`), noise (mean square of the sixth difference, which a
motion slower than a tenth of the sample rate does not reach), saturation, and what the head says itself. A failed axis stays
failed until the tests are started anew; saturation passes.
"""

import math
from dataclasses import dataclass
from enum import IntFlag

import numpy as np

from nav.increments import FloatArray, IntArray
from nav.kernel import inline_kernel, kernel

GYRO_AXES = ("g1x", "g1y", "g2y", "g2z")
AXES = (*GYRO_AXES, "ax", "ay", "az")
"""Every axis of the head, in the order of the arrays here."""
STUCK_S = 0.1
"""The same increment for so long is a dead axis, s."""
NOISE_BLOCK_S = 0.05
"""Length of the blocks of the noise test, s."""
NOISE_LIMIT = 30.0
"""Noise above the nominal by this factor is a fault."""
PARITY_BLOCK_S, PARITY_BLOCKS = 0.005, 10
"""The parity residual is averaged over ten blocks of 5 ms."""
PARITY_SIGMAS, TURN_ON_SIGMAS = 6.5, 4.0
"""The averaged residual is a fault above so many standard deviations of its noise, and of what biases, and scale factors and
misalignments by the mean rate, make of it."""
_DIFFERENCE_GAIN = 924.0
"""Sum of the squares of the sixth difference's coefficients."""


class Fault(IntFlag):
    """What is wrong with an axis."""

    GOOD = 0
    STUCK = 1
    NOISE = 2
    SATURATED = 4
    BUILT_IN = 8
    """The head's own test, status bits or rotor speed."""
    PARITY = 16


@dataclass(frozen=True, slots=True)
class Limits:
    """What a healthy head does.

    Attributes
    ----------
    gyro_noise, accelerometer_noise : float
        Angle and velocity random walk, rad/sqrt(s) and m/s/sqrt(s); 0 switches the stuck, noise and parity tests off.
    gyro_scale, gyro_misalignment : float
        Standard deviations of scale factors and misalignments (rad) between the axes.
    gyro_range, accelerometer_range : float
        Saturation, rad/s and m/s^2.
    gyro_bias : float
        Standard deviation of the biases of the axes, rad/s.
    """

    gyro_noise: float = 0.0
    accelerometer_noise: float = 0.0
    gyro_scale: float = 0.0
    gyro_misalignment: float = 0.0
    gyro_range: float = math.inf
    accelerometer_range: float = math.inf
    gyro_bias: float = 0.0


def layout(skew: float) -> FloatArray:
    """H (4, 3): measurements of `GYRO_AXES` from rates in head axes, the gyros turned by `skew`, rad."""
    s, c = math.sin(skew), math.cos(skew)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, c, s], [0.0, -s, c]])


def parity_vector(h: FloatArray) -> FloatArray:
    """Unit vector (4,) with p H = 0, the sign such that g1y counts positive."""
    p = np.linalg.svd(h.T)[2][3]
    parity: FloatArray = np.array(p * math.copysign(1.0, p[1]), dtype=np.float64)
    return parity


def combination(h: FloatArray, weights: FloatArray) -> FloatArray | None:
    """Weighted least squares (3, 4) from measurements to rates; None where what has weight does not span space.

    Parameters
    ----------
    h : (4, 3) float
        Layout.
    weights : (4,) float
        1 / variance of each axis; 0 leaves it out.
    """
    normal = (h.T * weights) @ h
    if np.linalg.cond(normal) > 1e9:
        return None
    solution: FloatArray = np.linalg.inv(normal) @ (h.T * weights)
    return solution


# Layout of the memory: for each axis 6 older increments, the last raw one, time unchanged, squares, their count | time of the
# last sample, in the noise block | place in the ring, blocks in it | ring, and the block that is filled now: time, sums of
# the residual and of the four gyro axes.
_OLD, _LAST, _SAME, _SQUARES, _COUNT, _AXIS = 0, 6, 7, 8, 9, 10
_TIME, _NOISE_TIME, _SLOT, _FILLED, _RING = (7 * _AXIS + k for k in range(5))
_WIDTH = 6
_RING_BLOCKS = 2 * PARITY_BLOCKS
MEMORY = _RING + _WIDTH * (_RING_BLOCKS + 1)
"""Floats that the tests remember."""


def fresh_memory() -> FloatArray:
    """Memory of tests that have seen nothing."""
    memory = np.zeros(MEMORY)
    memory[_TIME] = -math.inf
    return memory


@kernel
def _begin(memory: FloatArray) -> None:
    """After a gap nothing is known of what came before."""
    for axis in range(7):
        base = axis * _AXIS
        memory[base + _COUNT] = -6.0  # the sixth difference needs six older ones
        memory[base + _SAME] = memory[base + _SQUARES] = 0.0
        memory[base + _LAST] = math.nan
    for i in range(_NOISE_TIME, MEMORY):
        memory[i] = 0.0


@inline_kernel
def _unchanged_for(memory: FloatArray, axis: int, value: float, t: float) -> float:
    """How long the axis has given the same increment, s."""
    base = axis * _AXIS
    memory[base + _SAME] = memory[base + _SAME] + t if value == memory[base + _LAST] else 0.0
    memory[base + _LAST] = value
    return float(memory[base + _SAME])


@inline_kernel
def _add_noise(memory: FloatArray, axis: int, value: float, t: float) -> None:
    """Take an increment into the mean square of the sixth difference."""
    base = axis * _AXIS
    o = base + _OLD
    difference = (
        value
        - 6.0 * (memory[o] + memory[o + 4])
        + 15.0 * (memory[o + 1] + memory[o + 3])
        - 20.0 * memory[o + 2]
        + memory[o + 5]
    )
    for i in range(5, 0, -1):
        memory[o + i] = memory[o + i - 1]
    memory[o] = value
    memory[base + _COUNT] += 1.0
    if memory[base + _COUNT] > 0.0:
        memory[base + _SQUARES] += difference * difference / t


@kernel
def examine(
    memory: FloatArray,
    faults: IntArray,
    time: FloatArray,
    step: FloatArray,
    raw: FloatArray,
    gyro: FloatArray,
    accelerometer: FloatArray,
    parity: FloatArray,
    limits: tuple[float, float, float, float, float, float, float],
    pair: bool,
    residual: FloatArray,
) -> int:
    """Take a batch until an axis newly fails or recovers from saturation; the number of samples examined.

    Parameters
    ----------
    memory : (MEMORY,) float
        What the tests remember (`fresh_memory`); updated in place.
    faults : (7,) int
        `Fault` of each of `AXES`; updated in place.
    time, step : (n,) float
        End and length of each sample, s.
    raw, accelerometer : (n, 4), (n, 3) float
        Increments of each axis as the head sends them, rad and m/s.
    gyro : (n, 4) float
        Those of the gyros without their lag.
    parity : (4,) float
        Parity vector; zeros where an axis is lost already.
    limits : tuple
        The values of `Limits`, in its order.
    pair : bool
        The layout is orthogonal: a jump may be told to one of g1y, g2y.
    residual : (n,) float
        Out: parity residual of each sample, rad.

    Returns
    -------
    int
        n, or fewer: `faults` has changed with the last sample examined.
    """
    gyro_noise, accelerometer_noise, scale, misalignment, gyro_range, accelerometer_range, bias = limits
    ring_end = _RING + _WIDTH * _RING_BLOCKS
    for k in range(time.shape[0]):
        t = step[k]
        residual[k] = 0.0
        if t <= 0.0:
            continue
        gap = abs(time[k] - t - memory[_TIME]) > 0.5 * t
        memory[_TIME] = time[k]
        if gap:
            _begin(memory)
        memory[_NOISE_TIME] += t
        block = memory[_NOISE_TIME] >= NOISE_BLOCK_S - 1e-9
        if block:
            memory[_NOISE_TIME] = 0.0
        changed = False
        for axis in range(7):
            if axis < 4:
                noise, largest, value, clean = gyro_noise, gyro_range, raw[k, axis], gyro[k, axis]
            else:
                noise, largest = accelerometer_noise, accelerometer_range
                value = clean = accelerometer[k, axis - 4]
            fault = faults[axis] & ~4
            if noise > 0.0:
                if _unchanged_for(memory, axis, value, t) >= STUCK_S - 1e-9:
                    fault |= 1
                _add_noise(memory, axis, clean, t)
                base = axis * _AXIS
                if block:
                    allowed = NOISE_LIMIT * NOISE_LIMIT * _DIFFERENCE_GAIN * noise * noise
                    if memory[base + _SQUARES] > allowed * max(memory[base + _COUNT], 0.0):
                        fault |= 2
                    memory[base + _SQUARES], memory[base + _COUNT] = 0.0, min(memory[base + _COUNT], 0.0)
            if abs(value) > largest * t:
                fault |= 4
            changed = changed or fault != faults[axis]
            faults[axis] = fault

        r = 0.0
        for axis in range(4):
            r += parity[axis] * gyro[k, axis]
            memory[ring_end + 2 + axis] += gyro[k, axis]
        residual[k] = r
        memory[ring_end] += t
        memory[ring_end + 1] += r
        if memory[ring_end] >= PARITY_BLOCK_S - 1e-9:
            slot = int(memory[_SLOT])
            for i in range(_WIDTH):
                memory[_RING + _WIDTH * slot + i] = memory[ring_end + i]
                memory[ring_end + i] = 0.0
            memory[_SLOT] = (slot + 1) % _RING_BLOCKS
            memory[_FILLED] = min(memory[_FILLED] + 1.0, float(_RING_BLOCKS))
            told = (faults[0] | faults[1] | faults[2] | faults[3]) & 16
            if gyro_noise > 0.0 and memory[_FILLED] >= PARITY_BLOCKS and not told:
                named = _judge_parity(memory, slot, parity, gyro_noise, bias, scale, misalignment, pair)
                for axis in range(4):
                    if named & 1 << axis and not faults[axis] & 16:
                        faults[axis] |= 16
                        changed = True
        if changed:
            return k + 1
    return int(time.shape[0])


@kernel
def _judge_parity(
    memory: FloatArray,
    slot: int,
    parity: FloatArray,
    noise: float,
    bias: float,
    scale: float,
    misalignment: float,
    pair: bool,
) -> int:
    """Compare the averaged residual with what is allowed: bits of the axes that may be wrong."""
    time = residual = a = b = c = d = old_a = old_b = old_c = old_d = old_time = 0.0
    for i in range(int(memory[_FILLED])):
        at = _RING + _WIDTH * ((slot - i) % _RING_BLOCKS)
        if i < PARITY_BLOCKS:
            time += memory[at]
            residual += memory[at + 1]
            a, b, c, d = a + memory[at + 2], b + memory[at + 3], c + memory[at + 4], d + memory[at + 5]
        else:
            old_time += memory[at]
            old_a, old_b = old_a + memory[at + 2], old_b + memory[at + 3]
            old_c, old_d = old_c + memory[at + 4], old_d + memory[at + 5]
    scaled = math.sqrt((parity[0] * a) ** 2 + (parity[1] * b) ** 2 + (parity[2] * c) ** 2 + (parity[3] * d) ** 2)
    turn_on = bias * time + scale * scaled + misalignment * math.sqrt(a * a + b * b + c * c + d * d)
    if abs(residual) <= PARITY_SIGMAS * noise * math.sqrt(time) + TURN_ON_SIGMAS * turn_on:
        return 0
    if not pair:
        return 0b1111
    if old_time > 0.0:  # one that changed while all the others stood still
        still = PARITY_SIGMAS * noise * math.sqrt(1.0 / time + 1.0 / old_time)
        moved_a, moved_b = abs(a / time - old_a / old_time) > still, abs(b / time - old_b / old_time) > still
        moved_c, moved_d = abs(c / time - old_c / old_time) > still, abs(d / time - old_d / old_time) > still
        if not (moved_a or moved_d) and moved_b != moved_c:
            return 0b0010 if moved_b else 0b0100
    return 0b0110
