"""The quick lane: a lone frame of a dual-DTG head, from its bytes to its solution in the ring, in one compiled call.

At a thousand samples a second nearly all come like this. Where one is not ordinary the lane says how far it has got, and the
way of batches does the rest, with the same answer to the last bit.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.can.dtg_head import DtgHead
from drivers.can.dtg_head import take as decode
from drivers.can.frames import FrameArray, as_bytes, frames
from drivers.system import day_ns
from hil.ring import Ring, push
from nav.bundle import Bundle, bundle
from nav.increments import HeadIncrements, first_bad
from nav.instruments.head import HeadCombiner, combine_one
from nav.kernel import kernel
from nav.navigator import Navigator
from nav.ordinary import take_one

OTHER, DECODED, COMBINED, DONE = -1, 0, 1, 2
"""How far a frame has got: it is nothing for the lane, and nothing has changed; the driver has taken it; the combiner too; its
solution is in the ring."""


@kernel
def _take(
    lane: Bundle,
    frame: NDArray[np.uint8],
    core: int,
    expected: tuple[int, int, int],
    what: tuple[int, int, float],
    until: float,
) -> tuple[int, int]:
    """How far the `frame` (1, 80) got, and how many samples the driver gave, or what the combiner answered.

    `core`, `expected`, `what`: as :func:`nav.ordinary.take_one`; the last sample before `until`, s, is not ordinary.
    """
    driver, head, navigator, ring, rows_bytes, times = lane.parts
    count = decode(driver, frame)
    if count < 0:
        return OTHER, 0
    samples, sensed = driver[-2], driver[-1]
    time, step, sequence, validity = samples[0][:1], samples[1][:1], samples[2][:1], samples[3][:1]
    dtheta, rotor, dvel = sensed[0][:1], sensed[1][:1], sensed[2][:1]
    status, spin, temperature = sensed[3][:1], sensed[4][:1], sensed[5][:1]
    number, flags, mask = expected
    flag = head[1][1]
    follows = count == 1 and sequence[0] == number and time[0] + step[0] < until
    is_sound = step[0] > 0.0 and first_bad(time, step, dtheta, dvel) < 0 and math.isfinite(dtheta[0, 3])
    if not follows or not is_sound or (validity[0] | flag) & mask != flags:
        return DECODED, count
    sample = time, step, dtheta, rotor, dvel, validity, sequence, status, spin, temperature
    answer = combine_one(head, sample)
    if answer < 0:
        return DECODED, count
    out = head[-1]
    increments = time, step, out[1], out[2], out[3], sequence
    if not take_one(core, expected, what, navigator, increments):
        return COMBINED, answer
    rows, arrivals = navigator[3], driver[4][-1]
    rows[1].arrival_ns = arrivals[0]
    rows[1].solution_ns = day_ns(times)
    push(ring, rows_bytes[1:2])
    times[2] = day_ns(times)
    return DONE, answer


class Lane:
    """See the module.

    Attributes
    ----------
    answer : int
        Of the last `take`: how many samples the driver gave, or what the combiner answered.
    """

    def __init__(self, driver: DtgHead, combiner: HeadCombiner, navigator: Navigator, states: Ring) -> None:
        self._driver, self._combiner, self._navigator, self._states = driver, combiner, navigator, states
        self._times = np.zeros(3, np.int64)
        self._made: tuple[Any, ...] = (None, None, None)
        self._bundle: Any = None
        self._frame = frames(1)
        self._bytes = as_bytes(self._frame)
        self.answer = 0

    @property
    def in_ring_ns(self) -> int:
        """When the last solution was in the ring, by the host's clock."""
        return int(self._times[2])

    def samples(self, stage: int) -> HeadIncrements:
        """The samples of the last frame, which has got as far as `stage`."""
        return self._driver.taken(1, self.answer if stage == DECODED else 1)

    def take(self, frame: FrameArray, until: float) -> int:
        """Take the only frame (1,) as far as it is ordinary: `OTHER` to `DONE`; samples end before `until`, s."""
        ready = self._navigator.ordinary()
        if ready is None:
            return OTHER
        driver, head, navigator = self._driver.parts, self._combiner.parts, self._navigator.parts
        made = self._made
        if driver is not made[0] or head is not made[1] or navigator is not made[2]:
            self._made = driver, head, navigator
            rows = navigator[3]
            as_rows = rows.view(np.uint8).reshape(len(rows), rows.itemsize)
            self._bundle = bundle((driver, head, navigator, self._states.parts, as_rows, self._times))
        if frame is not self._frame:
            self._frame, self._bytes = frame, as_bytes(frame)
        stage, self.answer = _take(self._bundle, self._bytes, *ready, until)
        return int(stage)
