"""Receivers that speak NMEA 0183: GGA, RMC, VTG, GST, HDT, ZDA of any satellite talker to fixes; pynmeagps reads the sentences.

The position is that of GGA: above the sea, with the separation of sea and ellipsoid that it states, else that of our geoid. Its
sigmas are those of GST, else the dilution of precision times a stated error of the ranges; NMEA states no sigma of velocity or
heading at all. The velocity is level. Source: NMEA 0183 as published by the makers of receivers.
"""

import math
import re
from collections.abc import Callable
from datetime import UTC, date, datetime, time, timedelta
from typing import Any

from pynmeagps import VALNONE, NMEAReader
from pynmeagps.exceptions import NMEAMessageError, NMEAParseError, NMEAStreamError, NMEATypeError
from pynmeagps.nmeahelpers import calc_checksum

from drivers.serial.fixes import SMALLEST_M, Epoch, Epochs, Fix, Refused, Stated, fix_of
from drivers.serial.stream import MORE, NONE
from nav.aiding import Kind, aiding

Undulation = Callable[[float, float], float]
"""(lat, lon), rad, to the height of the geoid above the ellipsoid, m."""
LONGEST = 120
"""Bytes of a sentence, of those that are longer than the standard's 82 too."""
_SENTENCE = re.compile(rb"\$(?:G[ABILNPQ]|BD|QZ|HE)[A-Z]{3},[ -)+-~]{0,110}\*[0-9A-Fa-f]{2}\r\n")
_PART = re.compile(rb"\$(?:[A-Z]{0,5}|[A-Z]{5},[ -~]{0,113}\r?)\Z")
READ = ("GGA", "RMC", "VTG", "GST", "HDT", "ZDA")
KNOT = 1852.0 / 3600.0
RANGE_RATIO = {1: 1.0, 2: 0.4, 3: 1.0, 4: 0.01, 5: 0.1}
"""Error of a range over that of a plain fix, by the quality of GGA: plain, differential, PPS, carrier phase fixed and float."""
VERTICAL = 2.0
"""Vertical over horizontal dilution of precision."""
SLOW_MS = 0.5
"""Below this speed a receiver may leave the course out."""
_BROKEN = (NMEAMessageError, NMEAParseError, NMEAStreamError, NMEATypeError, ValueError, OverflowError, IndexError)


def size(data: bytes, at: int) -> int:
    """See `drivers.serial.stream.Framing.size`."""
    sentence = _SENTENCE.match(data, at)
    return sentence.end() - at if sentence else MORE if _PART.match(data, at, at + LONGEST) else NONE


def good(packet: bytes) -> bool:
    """Whether the check of a sentence is right."""
    text, _, check = packet[1:-2].rpartition(b"*")
    return int(calc_checksum(text.decode()), 16) == int(check, 16)


class Nmea:
    """Sentences of one receiver to fixes.

    Parameters
    ----------
    geoid : Undulation
        For receivers that do not state the separation.
    stated : Stated
        What the sentences do not say.
    heading_offset : float
        Heading of the line between two antennas less that of the body, rad.
    """

    def __init__(self, geoid: Undulation, stated: Stated, heading_offset: float = 0.0) -> None:
        self._epochs, self._geoid, self._stated, self._offset = Epochs(), geoid, stated, heading_offset
        self._utc: datetime | None = None

    def read(self, packet: bytes, arrival_ns: int) -> list[Fix] | None:
        """The fixes that a good sentence completes; None for one without a fix.

        Raises
        ------
        Refused
            It cannot be read.
        """
        name = packet[3:6].decode()
        if name not in READ:
            return None
        try:
            message = NMEAReader.parse(packet, validate=VALNONE)
        except _BROKEN as error:
            raise Refused("unreadable") from error
        key = getattr(message, "time", None) or None
        if name == "GGA" and key is None:
            raise Refused("no fix")
        ended = self._epochs.add(key, name, message, arrival_ns)
        return [self._fix(epoch) for epoch in ended if "GGA" in epoch.parts]

    def _fix(self, epoch: Epoch) -> Fix:
        parts = epoch.parts
        try:
            utc = self._time(epoch)
            rows = [self._position(parts)]
        except Refused as refusal:
            return fix_of(epoch, None, [], str(refusal))
        if "HDT" in parts and _is_number(turned := parts["HDT"].headingT):
            heading = math.remainder(math.radians(turned) - self._offset, 2.0 * math.pi)
            rows.append(aiding(0.0, Kind.HEADING, (heading,), (self._stated.heading,)))
        return fix_of(epoch, utc, rows)

    def _time(self, epoch: Epoch) -> datetime | None:
        """UTC of an epoch; one that does not say the day has that next to the epoch before."""
        day, clock, before = _day(epoch.parts), epoch.key, self._utc
        assert isinstance(clock, time)
        if day is None and before is not None:
            near = [datetime.combine(before.date() + timedelta(days=k), clock, UTC) for k in (-1, 0, 1)]
            self._utc = min(near, key=lambda utc: abs(utc - before))
        else:
            self._utc = None if day is None else datetime.combine(day, clock, UTC)
        return self._utc

    def _position(self, parts: dict[str, Any]) -> Any:
        gga, gst = parts["GGA"], parts.get("GST")
        if gga.quality not in RANGE_RATIO:
            raise Refused("no fix")
        if not all(map(_is_number, (gga.lat, gga.lon, gga.alt))) or not (
            abs(gga.lat) <= 90.0 and abs(gga.lon) <= 180.0
        ):
            raise Refused("no position")
        lat, lon = math.radians(gga.lat), math.radians(gga.lon)
        height = gga.alt + (gga.sep if _is_number(gga.sep) else self._geoid(lat, lon))
        sigmas = [] if gst is None else [gst.stdLat, gst.stdLong, gst.stdAlt]
        if not sigmas or not all(_is_number(sigma) and sigma > 0.0 for sigma in sigmas):
            if not (_is_number(gga.HDOP) and 0.0 < gga.HDOP < 50.0):
                raise Refused("no accuracy")
            level = gga.HDOP * self._stated.range_m * RANGE_RATIO[gga.quality]
            sigmas = [level, level, VERTICAL * level]
        velocity, speed_sigma = self._velocity(parts)
        deviations = (*(max(sigma, SMALLEST_M) for sigma in sigmas), speed_sigma, speed_sigma)
        return aiding(0.0, Kind.GNSS, (lat, lon, height, *velocity), deviations)

    def _velocity(self, parts: dict[str, Any]) -> tuple[tuple[float, float], float]:
        """North and east with their sigma, infinite where there is none."""
        rmc, vtg = parts.get("RMC"), parts.get("VTG")
        if rmc is not None and rmc.status == "A":
            speed, course = rmc.spd, rmc.cog
        elif vtg is not None and getattr(vtg, "posMode", "A") not in {"N", "E", "S"}:
            speed, course = vtg.sogn, vtg.cogt
        else:
            return (0.0, 0.0), math.inf
        if _is_number(speed) and 0.0 <= speed * KNOT <= SLOW_MS and not _is_number(course):
            return (0.0, 0.0), math.hypot(self._stated.speed_ms, speed * KNOT)
        if not (_is_number(speed) and _is_number(course)):
            return (0.0, 0.0), math.inf
        angle = math.radians(course)
        return (speed * KNOT * math.cos(angle), speed * KNOT * math.sin(angle)), self._stated.speed_ms


def _day(parts: dict[str, Any]) -> date | None:
    rmc, zda = parts.get("RMC"), parts.get("ZDA")
    if rmc is not None and rmc.status == "A" and isinstance(rmc.date, date):
        return rmc.date
    if zda is not None and all(map(_is_number, (zda.year, zda.month, zda.day))):
        try:
            return date(zda.year, zda.month, zda.day)
        except ValueError as error:
            raise Refused("unreadable") from error
    return None


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
