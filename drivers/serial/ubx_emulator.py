"""The other end of the wire of :mod:`drivers.serial.ubx`: NAV-PVT, NAV-COV and NAV-RELPOSNED; it takes CFG-VALSET."""

import math
from datetime import UTC, datetime, timedelta
from typing import Any

from pyubx2 import GET, SET, UBXMessage, UBXReader
from pyubx2.ubxhelpers import cfgname2key

from drivers.can.aiding import AidingArray
from drivers.serial.chunks import to_chunks
from drivers.serial.receiver import GnssFraming
from drivers.serial.stream import ByteStream
from nav.aiding import Kind

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
LEAP_S = 18
"""GPS time less UTC, since 2017."""
WEEK_S = 604800


class UbxEmulator:
    """Bytes of one receiver.

    Parameters
    ----------
    utc : datetime
        When the time of its rows is 0.
    covariance : bool
        Send NAV-COV too.
    refused : collection of str
        Ports whose settings it does not have.
    """

    def __init__(self, utc: datetime, *, covariance: bool = True, refused: tuple[str, ...] = ("UART2",)) -> None:
        self._utc, self._covariance, self._refused = utc, covariance, refused
        self._stream = ByteStream(GnssFraming())
        self.settings: dict[str, int] = {"CFG_RATE_MEAS": 1000}
        self.measuring = True
        """It is never told to be silent."""

    def packets(self, rows: AidingArray, *, fix: int = 3) -> list[bytes]:
        """The packets of each row, joined: fixes, and a heading of a moving base behind the fix of its time."""
        return [self._fix(row, fix) if row["kind"] == Kind.GNSS else self._heading(row) for row in rows]

    def _fix(self, row: Any, fix: int) -> bytes:
        when, itow = self._when(row)
        lat, lon, height, north, east, down = row["value"].tolist()
        sigma = row["sigma"].tolist()
        whole = when.replace(microsecond=0)
        pvt = {
            "iTOW": itow,
            "year": whole.year,
            "month": whole.month,
            "day": whole.day,
            "hour": whole.hour,
            "min": whole.minute,
            "second": whole.second,
            "nano": 1000 * when.microsecond,
            "validDate": 1,
            "validTime": 1,
            "fullyResolved": 1,
            "fixType": fix,
            "gnssFixOk": int(fix > 1),
            "numSV": 12,
            "lat": math.degrees(lat),
            "lon": math.degrees(lon),
            "height": round(1e3 * height),
            "velN": round(1e3 * north),
            "velE": round(1e3 * east),
            "velD": round(1e3 * down),
            "hAcc": round(1e3 * math.hypot(*sigma[:2])),
            "vAcc": round(1e3 * sigma[2]),
            "sAcc": round(1e3 * math.hypot(*sigma[3:])),
        }
        data = UBXMessage("NAV", "NAV-PVT", GET, **pvt).serialize()
        if self._covariance:
            names = [f"{what}Cov{axis}" for what in ("pos", "vel") for axis in ("NN", "EE", "DD")]
            squares = {name: value * value for name, value in zip(names, sigma, strict=True)}
            covariance = UBXMessage("NAV", "NAV-COV", GET, iTOW=itow, posCovValid=1, velCovValid=1, **squares)
            data += covariance.serialize()
        return bytes(data)

    def _heading(self, row: Any) -> bytes:
        flags = {"gnssFixOK": 1, "relPosValid": 1, "carrSoln": 2, "isMoving": 1, "relPosHeadingValid": 1}
        relative = {
            "version": 1,
            "iTOW": self._when(row)[1],
            "relPosHeading": math.degrees(row["value"][0]) % 360.0,
            "accHeading": math.degrees(row["sigma"][0]),
        }
        return bytes(UBXMessage("NAV", "NAV-RELPOSNED", GET, **relative, **flags).serialize())

    def _when(self, row: Any) -> tuple[datetime, int]:
        """UTC, and the time of the week, ms."""
        when = self._utc + timedelta(seconds=float(row["time"]))
        week_s = ((when - GPS_EPOCH).total_seconds() + LEAP_S) % WEEK_S
        return when, round(1e3 * week_s) % (1000 * WEEK_S)

    def answer(self, data: bytes) -> bytes:
        """What the receiver sends back for bytes of the host."""
        return b"".join(self._answer(packet) for packet, _ in self._stream.take(to_chunks(data)))

    def _answer(self, packet: bytes) -> bytes:
        if packet[2:4] == b"\x06\x8a":
            said = UBXReader.parse(packet, msgmode=SET)
            values = {name: value for name, value in vars(said).items() if name.startswith("CFG_")}
            taken = not any(port in name for name in values for port in self._refused)
            self.settings.update(values if taken else {})
            answer = "ACK-ACK" if taken else "ACK-NAK"
            return bytes(UBXMessage("ACK", answer, GET, clsID=0x06, msgID=0x8A).serialize())
        if packet[2:4] == b"\x06\x8b":
            key = int.from_bytes(packet[10:14], "little")
            for name, value in self.settings.items():
                if cfgname2key(name)[0] == key:
                    payload = bytes([1, 0, 0, 0]) + packet[10:14] + value.to_bytes(2, "little")
                    return bytes(UBXMessage(0x06, 0x8B, GET, payload=payload).serialize())
        return b""
