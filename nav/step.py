"""A whole strapdown step in one compiled call: body integrals and mechanization, for a batch or for one sample.

For one sample all that the step reads and writes lies in one array, the core (`CORE`), and is handed over by its address:
taking an array apart costs more than the step itself.
"""

import math

from numba import carray

from nav.body_integrals import MEMORY, integrate_blocks, integrate_body
from nav.earth import RATE
from nav.increments import FloatArray
from nav.kernel import float_pointer, kernel
from nav.mechanization import cartesian, geographic, wander

MECHANIZATIONS = ("geographic", "wander", "earth", "inertial", "inertial-source")
"""Names; their places are the codes in the kernels."""
_GEOGRAPHIC, _WANDER, _EARTH, _INERTIAL, _SOURCE = range(5)

STATE = max(geographic.STATE, wander.STATE, cartesian.STATE)
CODE, FIELD, WINDOW, BIAS = 0, 1, 2, 3
_MEMORY = 6
_STATE = _MEMORY + MEMORY
_SAMPLE = _STATE + STATE
_BODY = _SAMPLE + 7
_SOLUTION = _BODY + 10
CORE = _SOLUTION + 11
"""Floats of a core: mechanization, gravity field, window, gyro bias (3) | stream memory | state of the mechanization | step,
increments (6) | body integrals (10) | lat, lon, height, vel_n, q_nb, azimuth."""
MEMORY_PART = slice(_MEMORY, _STATE)
STATE_PART = slice(_STATE, _SAMPLE)
SOLUTION_PART = slice(_SOLUTION, CORE)

PUSH = "intp(intp, f8, f8, f8, f8, f8, f8, f8)"
"""Signature of `push`."""
DONE, POLE, NOT_FINITE = 1, 0, -1
"""Answers of `push`."""


@kernel
def mechanize(
    code: int,
    field: int,
    state: FloatArray,
    step: FloatArray,
    dq: FloatArray,
    dv: FloatArray,
    ds: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    attitude: FloatArray,
    azimuth: FloatArray,
) -> int:
    """Take body integrals with any mechanization but the source's; see :func:`nav.mechanization.geographic.advance`."""
    if code == _GEOGRAPHIC:
        return geographic.advance(state, field, step, dq, dv, ds, position, velocity, attitude)
    if code == _WANDER:
        return wander.advance(state, field, step, dq, dv, ds, position, velocity, attitude, azimuth)
    turn_rate = RATE if code == _EARTH else 0.0
    return cartesian.advance(state, field, turn_rate, step, dq, dv, ds, position, velocity, attitude)


@kernel
def advance(
    code: int,
    field: int,
    window: int,
    blocks: bool,
    memory: FloatArray,
    state: FloatArray,
    gyro_bias: FloatArray,
    step: FloatArray,
    dtheta: FloatArray,
    dvel: FloatArray,
    dq: FloatArray,
    dv: FloatArray,
    ds: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    attitude: FloatArray,
    azimuth: FloatArray,
) -> int:
    """Take a batch of samples; the number of steps done. `blocks`: the batch is a whole record without steps of zero."""
    if code == _SOURCE:
        return cartesian.advance_source(state, field, step, dtheta, dvel, gyro_bias, position, velocity, attitude)
    if blocks:
        integrate_blocks(window, step, dtheta, dvel, gyro_bias, dq, dv, ds)
    else:
        integrate_body(memory, window, step, dtheta, dvel, gyro_bias, dq, dv, ds)
    return mechanize(code, field, state, step, dq, dv, ds, position, velocity, attitude, azimuth)


@kernel
def push(address: int, step: float, x: float, y: float, z: float, vx: float, vy: float, vz: float) -> int:
    """Take one sample into the core at `address`: `DONE`, or nothing changed and `POLE` or `NOT_FINITE`.

    `NOT_FINITE` as well where an increment is so large that the solution is no number any more; only a start helps then.

    Parameters
    ----------
    address : int
        Of a core, (CORE,) float.
    step : float
        s.
    x, y, z, vx, vy, vz : float
        Angle and velocity increments, rad and m/s, body axes.
    """
    if not math.isfinite(step + x + y + z + vx + vy + vz):
        return NOT_FINITE
    head = carray(float_pointer(address), _MEMORY)
    memory = carray(float_pointer(address + 8 * _MEMORY), MEMORY)
    state = carray(float_pointer(address + 8 * _STATE), STATE)
    steps = carray(float_pointer(address + 8 * _SAMPLE), 1)
    dtheta = carray(float_pointer(address + 8 * (_SAMPLE + 1)), (1, 3))
    dvel = carray(float_pointer(address + 8 * (_SAMPLE + 4)), (1, 3))
    dq = carray(float_pointer(address + 8 * _BODY), (1, 4))
    dv = carray(float_pointer(address + 8 * (_BODY + 4)), (1, 3))
    ds = carray(float_pointer(address + 8 * (_BODY + 7)), (1, 3))
    position = carray(float_pointer(address + 8 * _SOLUTION), (1, 3))
    velocity = carray(float_pointer(address + 8 * (_SOLUTION + 3)), (1, 3))
    attitude = carray(float_pointer(address + 8 * (_SOLUTION + 6)), (1, 4))
    azimuth = carray(float_pointer(address + 8 * (_SOLUTION + 10)), 1)
    if head[CODE] == _GEOGRAPHIC and abs(state[0]) > geographic.MAX_LAT:
        return POLE
    steps[0] = step
    dtheta[0, 0], dtheta[0, 1], dtheta[0, 2] = x, y, z
    dvel[0, 0], dvel[0, 1], dvel[0, 2] = vx, vy, vz
    code, field, bias = int(head[CODE]), int(head[FIELD]), head[BIAS:_MEMORY]
    body = dq, dv, ds
    out = position, velocity, attitude
    # As `advance`, without its calls: handing on a dozen arrays twice costs half a step.
    if code == _SOURCE:
        done = cartesian.advance_source(state, field, steps, dtheta, dvel, bias, position, velocity, attitude)
    else:
        integrate_body(memory, int(head[WINDOW]), steps, dtheta, dvel, bias, dq, dv, ds)
        if code == _GEOGRAPHIC:
            done = geographic.advance(state, field, steps, *body, *out)
        elif code == _WANDER:
            done = wander.advance(state, field, steps, *body, *out, azimuth)
        else:
            done = cartesian.advance(state, field, RATE if code == _EARTH else 0.0, steps, *body, *out)
    total = attitude[0, 3]
    for i in range(3):
        total += position[0, i] + velocity[0, i] + attitude[0, i]
    return done if math.isfinite(total) else NOT_FINITE
