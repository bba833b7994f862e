"""A receiver of satellite navigation on a port: chunks of its bytes to fixes. It speaks UBX, NMEA 0183, or both at once.

With ``auto`` what comes first is taken, and NAV-PVT takes the place of the sentences as soon as it is heard: it says more.
"""

import re
from collections import Counter
from typing import Literal

from drivers.can.frames import FrameArray
from drivers.serial import nmea, ubx
from drivers.serial.fixes import Fix, Refused, Stated
from drivers.serial.stream import ByteStream

Language = Literal["auto", "ubx", "nmea"]


class GnssFraming:
    """UBX packets and NMEA sentences between each other; satisfies `drivers.serial.stream.Framing`."""

    sync = re.compile(rb"[\xb5$]")

    def size(self, data: bytes, at: int) -> int:
        """See `Framing.size`."""
        return nmea.size(data, at) if data[at] == ord("$") else ubx.size(data, at)

    def good(self, packet: bytes) -> bool:
        """See `Framing.good`."""
        return nmea.good(packet) if packet[0] == ord("$") else ubx.good(packet)


class Receiver:
    """See the module.

    Parameters
    ----------
    protocol : {"auto", "ubx", "nmea"}
        What is listened to.
    geoid : Undulation
        For receivers that say the height above the sea alone.
    stated : Stated
        Sigmas that NMEA does not say.
    heading_offset : float
        Heading of the line between two antennas less that of the body, rad.

    Attributes
    ----------
    stream : ByteStream
        Counts packets, wrong checks and skipped bytes.
    speaks : str
        What its fixes come by; empty before the first.
    fixes : int
        Good ones.
    refused : Counter of str
        Epochs and packets that were none, by the reason.
    foreign : int
        Good packets of no use.
    """

    def __init__(
        self,
        protocol: Language,
        geoid: nmea.Undulation,
        stated: Stated = Stated(),  # noqa: B008 (frozen)
        heading_offset: float = 0.0,
    ) -> None:
        self.stream = ByteStream(GnssFraming())
        self._ubx = None if protocol == "nmea" else ubx.Ubx(heading_offset)
        self._nmea = None if protocol == "ubx" else nmea.Nmea(geoid, stated, heading_offset)
        self.speaks = ""
        self.fixes = self.foreign = 0
        self.refused: Counter[str] = Counter()

    def take(self, batch: FrameArray) -> list[Fix]:
        """The fixes, good and refused ones, that `batch` completes."""
        out: list[Fix] = []
        for packet, arrival_ns in self.stream.take(batch):
            is_sentence = packet[0] == ord("$")
            reader = self._nmea if is_sentence else self._ubx
            if reader is None:
                self.foreign += 1
                continue
            try:
                found = reader.read(packet, arrival_ns)
            except Refused as refusal:
                self.refused[str(refusal)] += 1
                continue
            if found is None:
                self.foreign += 1
                continue
            if found and not is_sentence:
                self._nmea = None
            self._count(found, "nmea" if is_sentence else "ubx")
            out += found
        return out

    def _count(self, found: list[Fix], speaks: str) -> None:
        for fix in found:
            if fix.refused:
                self.refused[fix.refused] += 1
            else:
                self.fixes += 1
                self.speaks = speaks
