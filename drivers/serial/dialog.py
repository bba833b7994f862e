"""Asking a board on a port: a request goes out, and the packet that answers it is found among the samples."""

import time
from collections.abc import Callable

from drivers.can.bus import Port
from drivers.can.frames import frames
from drivers.serial.chunks import to_chunks
from drivers.serial.stream import ByteStream, Framing
from nav.errors import HilError

ANSWER_S = 0.5
"""Longest time for an answer."""
TRIES = 3


class Dialog:
    """Requests and answers on `port`.

    Parameters
    ----------
    port : Port
        Of a board that speaks `framing`.
    framing : Framing
        How its packets are found.
    """

    def __init__(self, port: Port, framing: Framing) -> None:
        self._port = port
        self._stream = ByteStream(framing)
        self._batch = frames(256)

    def ask(self, what: str, request: bytes, answers: Callable[[bytes], bool]) -> bytes:
        """Send `request` until a packet comes for which `answers` is true; that packet.

        Raises
        ------
        HilError
            None came; `what` says in words what was asked.
        """
        for _ in range(TRIES):
            self._port.send(to_chunks(request))
            deadline = time.monotonic() + ANSWER_S
            while (left := deadline - time.monotonic()) > 0.0:
                n = self._port.receive(self._batch, left)
                for packet, _ in self._stream.take(self._batch[:n]):
                    if answers(packet):
                        return packet
        raise HilError(
            f"the board does not answer to {what}: is the baud rate right, and is its receiving line wired? "
            f"({self._stream.packets} packets came, {self._stream.skipped} bytes made no sense)"
        )


def check_line(rate_hz: float, size: int, baud: int) -> None:
    """Refuse a rate at which packets of `size` bytes fill more than 90 % of a line of `baud`.

    Raises
    ------
    HilError
        The line is too slow; says what is needed.
    """
    needed = rate_hz * size * 10 / 0.9
    if needed > baud:
        raise HilError(
            f"{rate_hz:g} packets of {size} bytes a second need {needed:.0f} baud, and the line has {baud}: lower the rate"
        )
