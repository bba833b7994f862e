"""u-blox receivers: NAV-PVT, with NAV-COV and NAV-RELPOSNED where they come, to fixes. Source: u-blox, interface descriptions.

A packet is B5 62, class, message, length, payload and an 8-bit Fletcher check; pyubx2 reads and writes the payloads. NAV-PVT has
the height above the ellipsoid. The heading of a moving base (NAV-RELPOSNED) is that from its antenna to ours.
"""

import math
from datetime import UTC, datetime, timedelta
from typing import Any

from pyubx2 import SET_LAYER_RAM, VALNONE, UBXMessage, UBXReader
from pyubx2.exceptions import UBXMessageError, UBXParseError, UBXStreamError, UBXTypeError
from pyubx2.ubxhelpers import calc_checksum

from drivers.serial.dialog import Dialog, check_line
from drivers.serial.fixes import SMALLEST_M, SMALLEST_MS, SMALLEST_RAD, Epoch, Epochs, Fix, Refused, fix_of
from drivers.serial.stream import MORE, NONE
from nav.aiding import Kind, aiding
from nav.errors import HilError

SYNC = b"\xb5\x62"
LONGEST = 2048
"""A message that says to be longer is passed over: what waits for the end of a damaged one is lost for so long."""
NAVIGATION = {0x07: "NAV-PVT", 0x36: "NAV-COV", 0x3C: "NAV-RELPOSNED"}
"""Messages of class NAV that are read."""
LENGTHS = {0x07: (92,), 0x36: (64,), 0x3C: (40, 64)}
"""Their payloads: another length is damage."""
FIX_2D, FIX_3D, FIX_COMBINED = 2, 3, 4
RTK_FIXED = 2
PACKETS = 100 + 72
"""Bytes of NAV-PVT and NAV-COV."""
_BROKEN = (UBXMessageError, UBXParseError, UBXStreamError, UBXTypeError, ValueError, OverflowError, IndexError)


def size(data: bytes, at: int) -> int:
    """See `drivers.serial.stream.Framing.size`."""
    head = data[at : at + 6]
    if not SYNC.startswith(head[:2]):
        return NONE
    length = int.from_bytes(head[4:6], "little")
    if len(head) < 6:
        return MORE
    known = LENGTHS.get(head[3]) if head[2] == 0x01 else None
    return 8 + length if length <= LONGEST and (known is None or length in known) else NONE


def good(packet: bytes) -> bool:
    """Whether the check of a packet is right."""
    return bool(calc_checksum(packet[2:-2]) == packet[-2:])


class Ubx:
    """Packets of one receiver to fixes.

    Parameters
    ----------
    heading_offset : float
        Heading of the line between the antennas of a moving base less that of the body, rad.
    """

    def __init__(self, heading_offset: float = 0.0) -> None:
        self._epochs, self._offset = Epochs(), heading_offset

    def read(self, packet: bytes, arrival_ns: int) -> list[Fix] | None:
        """The fixes that a good packet completes; None for one without a fix.

        Raises
        ------
        Refused
            Its payload cannot be read.
        """
        name = NAVIGATION.get(packet[3]) if packet[2] == 0x01 else None
        if name is None:
            return None
        try:
            message = UBXReader.parse(packet, validate=VALNONE)
        except _BROKEN as error:
            raise Refused("unreadable") from error
        ended = self._epochs.add(_itow(packet), name, message, arrival_ns)
        return [self._fix(epoch) for epoch in ended if "NAV-PVT" in epoch.parts]

    def _fix(self, epoch: Epoch) -> Fix:
        pvt = epoch.parts["NAV-PVT"]
        utc = _utc(pvt)
        try:
            rows = [_position(pvt, epoch.parts.get("NAV-COV"))]
        except Refused as refusal:
            return fix_of(epoch, utc, [], str(refusal))
        relative = epoch.parts.get("NAV-RELPOSNED")
        if relative is not None and _is_heading(relative):
            heading = math.remainder(math.radians(relative.relPosHeading) - self._offset, 2.0 * math.pi)
            sigma = max(math.radians(relative.accHeading), SMALLEST_RAD)
            rows.append(aiding(0.0, Kind.HEADING, (heading,), (sigma,)))
        return fix_of(epoch, utc, rows)


def _itow(packet: bytes) -> int:
    """Time of week, ms: at the start of the payload, of NAV-RELPOSNED four bytes later."""
    at = 10 if packet[3] == 0x3C else 6
    return int.from_bytes(packet[at : at + 4], "little")


def _utc(pvt: Any) -> datetime | None:
    if not (pvt.validDate and pvt.validTime):
        return None
    try:
        whole = datetime(pvt.year, pvt.month, pvt.day, pvt.hour, pvt.min, min(pvt.second, 59), tzinfo=UTC)
    except ValueError:
        return None
    return whole + timedelta(seconds=max(pvt.second - 59, 0), microseconds=1e-3 * pvt.nano)


def _position(pvt: Any, covariance: Any) -> Any:
    if not pvt.gnssFixOk or pvt.invalidLlh or pvt.fixType not in {FIX_2D, FIX_3D, FIX_COMBINED}:
        raise Refused("no fix")
    level, up, swift = 1e-3 * pvt.hAcc, 1e-3 * pvt.vAcc, 1e-3 * pvt.sAcc
    place, speed = (level, level, up), (swift, swift, swift)
    if covariance is not None and covariance.posCovValid:
        place = _roots(covariance.posCovNN, covariance.posCovEE, covariance.posCovDD)
    if covariance is not None and covariance.velCovValid:
        speed = _roots(covariance.velCovNN, covariance.velCovEE, covariance.velCovDD)
    if not all(0.0 < sigma < math.inf for sigma in (*place, *speed)):
        raise Refused("no accuracy")
    sigmas = [max(sigma, SMALLEST_M) for sigma in place] + [max(sigma, SMALLEST_MS) for sigma in speed]
    if pvt.fixType == FIX_2D:
        sigmas[2] = sigmas[5] = math.inf
    velocity = 1e-3 * pvt.velN, 1e-3 * pvt.velE, 1e-3 * pvt.velD
    value = math.radians(pvt.lat), math.radians(pvt.lon), 1e-3 * pvt.height, *velocity
    return aiding(0.0, Kind.GNSS, value, tuple(sigmas))


def _roots(*variances: float) -> tuple[float, float, float]:
    n, e, d = (math.sqrt(v) if v > 0.0 else math.nan for v in variances)
    return n, e, d


def _is_heading(relative: Any) -> bool:
    """Of two antennas on one vehicle, with the cycles resolved: not that to a base on the ground."""
    fixed = relative.relPosValid and relative.carrSoln == RTK_FIXED
    return bool(fixed and relative.isMoving and getattr(relative, "relPosHeadingValid", 0))


def configure(dialog: Dialog, rate_hz: float, baud: int) -> dict[str, object]:
    """Make a receiver of generation 9 or newer send NAV-PVT and NAV-COV and no NMEA, until it is switched off.

    Raises
    ------
    HilError
        It does not answer or refuses, or the rate is none of its rates or too high for the line.
    """
    period_ms = round(1e3 / rate_hz) if rate_hz > 0.0 else 0
    if not (25 <= period_ms <= 65535 and math.isclose(period_ms * rate_hz, 1e3, rel_tol=1e-9)):
        raise HilError(
            f"ubx: {rate_hz:g} Hz is not a whole number of milliseconds from 25 on: take 1, 2, 4, 5, 8, 10, 20"
        )
    check_line(rate_hz, PACKETS, baud)
    if not _set(dialog, {"CFG_RATE_MEAS": period_ms, "CFG_RATE_NAV": 1}):
        raise HilError("ubx: the receiver refuses the rate: too fast, or it is older than generation 9 (take u-center)")
    there = [port for port in ("UART1", "UART2", "USB") if _set(dialog, _outputs(port))]
    if not there:
        raise HilError("ubx: the receiver refuses NAV-PVT and NAV-COV on every port")
    poll = UBXMessage.config_poll(0, 0, ["CFG_RATE_MEAS"]).serialize()
    answer = dialog.ask("CFG-VALGET", poll, lambda packet: packet[2:4] == b"\x06\x8b")
    if (said := UBXReader.parse(answer, validate=VALNONE).CFG_RATE_MEAS) != period_ms:
        raise HilError(f"ubx: the period reads back as {said} ms: the receiver did not take {period_ms} ms")
    return {"ports": there, "rate_hz": rate_hz}


def _outputs(port: str) -> dict[str, int]:
    outputs = {f"CFG_MSGOUT_UBX_NAV_PVT_{port}": 1, f"CFG_MSGOUT_UBX_NAV_COV_{port}": 1}
    return outputs | {f"CFG_{port}OUTPROT_UBX": 1, f"CFG_{port}OUTPROT_NMEA": 0}


def _set(dialog: Dialog, values: dict[str, int]) -> bool:
    """Whether the receiver takes values into its working memory."""
    request = UBXMessage.config_set(SET_LAYER_RAM, 0, list(values.items())).serialize()
    answer = dialog.ask("CFG-VALSET", request, lambda packet: packet[2] == 0x05 and packet[6:8] == b"\x06\x8a")
    return answer[3] == 0x01
