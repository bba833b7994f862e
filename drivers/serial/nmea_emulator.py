"""The other end of the wire of :mod:`drivers.serial.nmea`: a receiver that sends GGA, RMC and GST, and HDT of two antennas."""

import math
from datetime import datetime, timedelta
from typing import Any

from pynmeagps import GET, NMEAMessage

from drivers.can.aiding import AidingArray
from drivers.serial.nmea import KNOT, Undulation
from nav.aiding import Kind

HDOP = 0.8


class NmeaEmulator:
    """Sentences of one receiver.

    Parameters
    ----------
    utc : datetime
        When the time of its rows is 0.
    geoid : Undulation
        What it takes for the separation of sea and ellipsoid.
    gst : bool
        Send GST: it states its errors.
    talker : str
        Two letters.
    """

    def __init__(self, utc: datetime, geoid: Undulation, *, gst: bool = True, talker: str = "GN") -> None:
        self._utc, self._geoid, self._gst, self._talker = utc, geoid, gst, talker
        self.measuring = True
        """It is never told to be silent."""

    def packets(self, rows: AidingArray, *, quality: int = 1) -> list[bytes]:
        """The sentences of each row, joined: fixes, and a heading behind the fix of its time."""
        return [self._fix(row, quality) if row["kind"] == Kind.GNSS else self._heading(row) for row in rows]

    def _fix(self, row: Any, quality: int) -> bytes:
        when = self._utc + timedelta(seconds=float(row["time"]))
        lat, lon, height, north, east, _ = row["value"].tolist()
        sea = self._geoid(lat, lon)
        place = {
            "time": when.time(),
            "lat": math.degrees(lat),
            "NS": "S" if lat < 0.0 else "N",
            "lon": math.degrees(lon),
            "EW": "W" if lon < 0.0 else "E",
        }
        heights = {"alt": round(height - sea, 3), "altUnit": "M", "sep": round(sea, 3), "sepUnit": "M"}
        speed = round(math.hypot(north, east) / KNOT, 4)
        course = round(math.degrees(math.atan2(east, north)) % 360.0, 4)
        data = self._sentence("GGA", **place, quality=quality, numSV=12, HDOP=HDOP, **heights)
        data += self._sentence("RMC", **place, status="A" if quality else "V", spd=speed, cog=course, date=when.date())
        if self._gst:
            n, e, d = (round(sigma, 3) for sigma in row["sigma"][:3].tolist())
            data += self._sentence("GST", time=when.time(), rangeRms=1.0, stdLat=n, stdLong=e, stdAlt=d)
        return data

    def _heading(self, row: Any) -> bytes:
        return self._sentence("HDT", headingT=round(math.degrees(row["value"][0]) % 360.0, 3), headingTu="T")

    def _sentence(self, name: str, **fields: Any) -> bytes:
        return bytes(NMEAMessage(self._talker, name, GET, hpnmeamode=True, **fields).serialize())

    def answer(self, _data: bytes) -> bytes:
        """Nothing: it takes no commands."""
        return b""
