"""Faults that the simulated head is told to have while it runs, a second each: of its samples, and of what reaches the bus."""

from drivers.can.dtg_head_emulator import ANGLE_LSB
from drivers.can.frames import FrameArray
from hil.control import Control, Injected
from hil.world.instruments import Sensed

LASTS_S = 1.0
_DROPPED = 10
"""One sample of so many is lost."""
_STUCK_AXIS = 2
"""g2y."""
_GYRO_1 = 1
"""Status bit."""


class Injection:
    """Obeys the faults that `control` is asked for, each for `LASTS_S` of device time.

    Parameters
    ----------
    control : Control
        Where they are asked for.
    step : float
        Sample period, s.
    """

    def __init__(self, control: Control, step: float) -> None:
        self._control, self._lasts = control, max(1, round(LASTS_S / step))
        self._count, _ = control.injected
        self._until = dict.fromkeys(Injected, 0)
        """Number of the first sample without the fault."""
        self._stuck = 0.0

    def sensed(self, first: int, sensed: Sensed) -> None:
        """Change the samples from number `first` on before they are encoded."""
        self._look(first)
        if first < self._until[Injected.STUCK]:
            sensed.dtheta[:, _STUCK_AXIS] = self._stuck
        else:
            self._stuck = ANGLE_LSB * round(sensed.dtheta[-1, _STUCK_AXIS] / ANGLE_LSB)  # the same number on the wire
        if first < self._until[Injected.BUILT_IN]:
            sensed.status[:] |= _GYRO_1

    def sent(self, number: int, piece: FrameArray) -> FrameArray:
        """What reaches the bus of the frames of sample `number`."""
        self._look(number)
        silent = number < self._until[Injected.SILENCE]
        lost = number < self._until[Injected.LOSS] and number % _DROPPED == 0
        return piece[:0] if silent or lost else piece

    def _look(self, number: int) -> None:
        count, code = self._control.injected
        if count != self._count:
            self._count = count
            self._until[Injected(code)] = number + self._lasts
