"""Receivers that speak UBX and NMEA: what is sent arrives, what is damaged is counted, what is no fix is no measurement.

The sentences and packets are the published examples of makers and of the standard, or those that pyubx2 and pynmeagps write.
"""

import math
import threading
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from functools import cache, reduce
from operator import xor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from beside import beside
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from pty_board import Plugged, cut
from pyubx2 import GET, UBXMessage

from drivers.can.frames import frames
from drivers.serial import probe, ubx
from drivers.serial.chunks import to_chunks
from drivers.serial.dialog import Dialog
from drivers.serial.fixes import Fix, Stated
from drivers.serial.nmea_emulator import NmeaEmulator
from drivers.serial.port import SerialPort
from drivers.serial.receiver import GnssFraming, Receiver
from drivers.serial.ubx_emulator import UbxEmulator
from nav.aiding import AIDING, Kind, aiding_rows
from nav.errors import HilError

MIDNIGHT = datetime(2026, 11, 22, 23, 59, 58, tzinfo=UTC)
SEA_M = 17.0
SPEAKERS: dict[str, Callable[[], Any]] = {
    "ubx": lambda: UbxEmulator(MIDNIGHT),
    "ubx without covariance": lambda: UbxEmulator(MIDNIGHT, covariance=False),
    "nmea": lambda: NmeaEmulator(MIDNIGHT, geoid),
    "nmea without gst": lambda: NmeaEmulator(MIDNIGHT, geoid, gst=False, talker="GP"),
}
speakers = pytest.mark.parametrize("name", SPEAKERS)


def geoid(_lat: float, _lon: float) -> float:
    return SEA_M


def sky(n: int, *, heading: bool = True) -> Any:
    """Fixes five times a second of what flies round the south-west of the globe, each with a heading behind it."""
    k = np.arange(n)
    place = np.column_stack([-0.6 + 1e-6 * k, -1.2 + 2e-6 * k, 300.0 + 0.5 * k])
    velocity = np.column_stack([30.0 * np.cos(k), 30.0 * np.sin(k), 1.0 + 0.1 * k])
    fixes = aiding_rows(0.2 * k, Kind.GNSS, np.hstack([place, velocity]), [1.5, 1.0, 3.0, 0.05, 0.06, 0.1])
    headings = aiding_rows(0.2 * k, Kind.HEADING, np.linspace(-3.0, 3.0, n)[:, None], [0.01])
    rows = np.concatenate([fixes, headings] if heading else [fixes])
    return rows[np.argsort(rows["time"], kind="stable")]


def heard(data: bytes, receiver: Receiver | None = None) -> tuple[Receiver, list[Fix]]:
    receiver = receiver or Receiver("auto", geoid)
    return receiver, receiver.take(to_chunks(data, 1))


def rows_of(fixes: list[Fix]) -> Any:
    return np.concatenate([np.zeros(0, AIDING), *(fix.rows for fix in fixes)])


@speakers
def test_what_is_sent_arrives_to_the_resolution_of_the_wire(name: str) -> None:
    """UBX: 1e-7 deg and 1 mm, 1 mm/s; NMEA with seven decimals: 2e-7 min and 1 mm; the velocity is level there."""
    sent, is_ubx = sky(40), name.startswith("ubx")
    receiver, fixes = heard(b"".join(SPEAKERS[name]().packets(sent)))
    got = rows_of(fixes)
    # The first epoch is complete when the second begins; with a heading the last one is complete with it
    assert len(fixes) == receiver.fixes == 40
    assert receiver.speaks == name[:4].strip()
    assert not receiver.refused
    assert (receiver.stream.skipped, receiver.stream.bad_checks, receiver.foreign) == (0, 0, 0)
    np.testing.assert_allclose([fix.utc_s for fix in fixes], MIDNIGHT.timestamp() + 0.2 * np.arange(40), atol=1e-6)
    for kind in (Kind.GNSS, Kind.HEADING):
        there, was = got[got["kind"] == kind]["value"], sent[sent["kind"] == kind]["value"]
        if kind == Kind.HEADING:
            np.testing.assert_allclose(there[:, 0], was[:, 0], atol=math.radians(1e-3))
            continue
        np.testing.assert_allclose(there[:, :2], was[:, :2], atol=math.radians(0.51e-7))
        np.testing.assert_allclose(there[:, 2], was[:, 2], atol=1.01e-3)
        axes = 6 if is_ubx else 5
        np.testing.assert_allclose(there[:, 3:axes], was[:, 3:axes], atol=0.6e-3)
    sigma = got[got["kind"] == Kind.GNSS]["sigma"]
    truth = sent[sent["kind"] == Kind.GNSS]["sigma"]
    if name in {"ubx", "nmea"}:
        np.testing.assert_allclose(sigma[:, :3], truth[:, :3], rtol=1e-3)
    assert (np.isinf(sigma[:, 5]) == (not is_ubx)).all()
    # What states one number for both level axes never says less than the worse of them
    assert (sigma[:, :2].max(axis=1) >= truth[:, :2].max(axis=1) - 1e-3).all()


@pytest.mark.parametrize(
    ("published", "place"),
    [
        # NMEA 0183 as quoted everywhere; height 545.4 m above a sea that lies 46.9 m above the ellipsoid
        ("$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47", (48.1173, 11.516667, 592.3)),
        # u-blox, M8 receiver description, GGA
        ("$GPGGA,092725.00,4717.11399,N,00833.91590,E,1,08,1.01,499.6,M,48.0,M,,*5B", (47.2852332, 8.5652650, 547.6)),
        # Trimble, GGA of a carrier-phase fix in the west
        (
            "$GPGGA,172814.0,3723.46587704,N,12202.26957864,W,2,6,1.2,18.893,M,-25.669,M,2.0,0031*4F",
            (37.3910980, -122.0378263, -6.776),
        ),
    ],
)  # fmt: skip
def test_published_sentences(published: str, place: tuple[float, float, float]) -> None:
    following = sentence("GPGGA,010000.00,,,,,0,00,99.99,,,,,,")
    _, fixes = heard(published.encode() + b"\r\n" + following)
    value, sigma = fixes[0].rows[0]["value"], fixes[0].rows[0]["sigma"]
    assert np.degrees(value[:2]) == pytest.approx(place[:2], abs=1e-6)
    assert value[2] == pytest.approx(place[2], abs=1e-9)
    assert np.isinf(sigma[3:]).all()  # no velocity in it
    assert fixes[0].utc_s is None  # nor a date


def test_velocity_and_time_of_published_sentences() -> None:
    """u-blox, M8 receiver description: RMC 0.004 knots at 77.52 deg on 9 December 2002."""
    rmc = b"$GPRMC,083559.00,A,4717.11437,N,00833.91522,E,0.004,77.52,091202,,,A*57\r\n"
    gga = sentence("GPGGA,083559.00,4717.11437,N,00833.91522,E,1,08,1.01,499.6,M,48.0,M,,")
    assert heard(gga)[1] == []  # nobody knows yet that it is whole
    _, fixes = heard(rmc + gga + sentence("GPGGA,083600.00,,,,,0,00,99.99,,,,,,"))
    assert fixes[0].utc_s == datetime(2002, 12, 9, 8, 35, 59, tzinfo=UTC).timestamp()
    speed = 0.004 * 1852.0 / 3600.0
    assert fixes[0].rows[0]["value"][3:5] == pytest.approx(
        [speed * math.cos(math.radians(77.52)), speed * math.sin(math.radians(77.52))]
    )


def sentence(text: str) -> bytes:
    """A whole sentence: by hand, as pynmeagps writes a zero into an empty field."""
    return f"${text}*{reduce(xor, text.encode(), 0):02X}\r\n".encode()


def nmea_epoch(gga: dict[str, Any]) -> bytes:
    """A GGA, and that of the next epoch, which ends it: without a fix."""
    said = {"lat": "5000.00000", "quality": 1, "hdop": 1.5, "alt": 100.0} | gga
    first = "GNGGA,120000.00,{lat},N,03600.00000,E,{quality},10,{hdop},{alt},M,12.0,M,,".format(**said)
    return sentence(first) + sentence("GNGGA,130000.00,,,,,0,00,99.99,,,,,,")


def test_the_dilution_of_precision_makes_sigmas_where_nothing_better_is_said() -> None:
    receiver = Receiver("nmea", geoid, Stated(range_m=5.0))
    plain, fixed = (receiver.take(to_chunks(nmea_epoch({"quality": q})))[0].rows[0]["sigma"] for q in (1, 4))
    assert plain[:2] == pytest.approx([7.5, 7.5])
    assert plain[2] > plain[0]
    assert fixed[0] < 0.1 * plain[0]


@pytest.mark.parametrize(
    ("gga", "reason"),
    [
        ({"quality": 0}, "no fix"),
        ({"quality": 6}, "no fix"),  # dead reckoning
        ({"quality": 8}, "no fix"),  # a simulator
        ({"lat": ""}, "no position"),
        ({"alt": ""}, "no position"),
        ({"hdop": 99.99}, "no accuracy"),
        ({"hdop": 0.0}, "no accuracy"),
    ],
)
def test_nmea_that_is_no_measurement_is_counted(gga: dict[str, Any], reason: str) -> None:
    receiver, fixes = heard(nmea_epoch(gga))
    assert receiver.stream.bad_checks == receiver.stream.skipped == 0
    assert [fix.refused for fix in fixes] == [reason, "no fix"]  # the second is the one that ended it
    assert receiver.refused[reason] >= 1
    assert receiver.fixes == 0


def test_a_cold_receiver_without_time_is_counted() -> None:
    """u-blox before its first fix."""
    receiver, fixes = heard(b"$GPGGA,,,,,,0,00,99.99,,,,,,*48\r\n" * 3)
    assert fixes == []
    assert dict(receiver.refused) == {"no fix": 3}


def pvt(**fields: Any) -> bytes:
    plain = {
        "iTOW": 1000,
        "fixType": 3,
        "gnssFixOk": 1,
        "lat": 50.0,
        "lon": 36.0,
        "height": 1,
        "hAcc": 900,
        "vAcc": 900,
        "sAcc": 90,
    }
    return bytes(UBXMessage("NAV", "NAV-PVT", GET, **(plain | fields)).serialize())  # fmt: skip


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"gnssFixOk": 0}, "no fix"),
        ({"fixType": 0}, "no fix"),
        ({"fixType": 1}, "no fix"),  # dead reckoning
        ({"fixType": 5}, "no fix"),  # time only
        ({"invalidLlh": 1}, "no fix"),
        ({"hAcc": 0}, "no accuracy"),
        ({}, ""),
    ],
)
def test_ubx_that_is_no_measurement_is_counted(fields: dict[str, Any], reason: str) -> None:
    receiver, fixes = heard(pvt(**fields) + pvt(iTOW=2000))
    assert [fix.refused for fix in fixes] == [reason, ""]
    assert dict(receiver.refused) == ({reason: 1} if reason else {})
    assert receiver.fixes == (1 if reason else 2)
    assert [len(fix.rows) for fix in fixes] == [0 if reason else 1, 1]
    assert [fix.utc_s for fix in fixes] == [None, None]  # no valid date


def test_a_level_fix_says_no_height() -> None:
    _, fixes = heard(pvt(fixType=2) + pvt(iTOW=2000))
    assert np.isinf(fixes[0].rows[0]["sigma"]).tolist() == [False, False, True, False, False, True]


@pytest.mark.parametrize("flag", ["isMoving", "relPosValid", "relPosHeadingValid", "carrSoln"])
def test_the_line_to_a_base_on_the_ground_is_no_heading(flag: str) -> None:
    flags = {"relPosValid": 1, "carrSoln": 2, "isMoving": 1, "relPosHeadingValid": 1}

    def headings(**changed: int) -> list[float]:
        relative = {"version": 1, "iTOW": 1000, "relPosHeading": 90.0, "accHeading": 0.5, **flags, **changed}
        data = pvt() + UBXMessage("NAV", "NAV-RELPOSNED", GET, **relative).serialize() + pvt(iTOW=2000)
        receiver = Receiver("auto", geoid, heading_offset=math.radians(30.0))
        rows = rows_of(receiver.take(to_chunks(data)))
        return [float(row["value"][0]) for row in rows if row["kind"] == Kind.HEADING]

    assert headings() == pytest.approx([math.radians(60.0)])
    assert headings(**{flag: 0}) == []


def test_ubx_takes_the_place_of_sentences() -> None:
    """A receiver with both on: the sentences before the first NAV-PVT count, those after it say nothing new."""
    rows = sky(20, heading=False).reshape(20, 1)
    emulators = NmeaEmulator(MIDNIGHT, geoid), UbxEmulator(MIDNIGHT)
    both = [emulator.packets(row)[0] for row in rows for emulator in emulators]
    receiver, fixes = heard(b"".join(both))
    assert receiver.speaks == "ubx"
    assert receiver.fixes == len(fixes) <= 22
    only, fixes = heard(b"".join(both), Receiver("nmea", geoid))
    assert (only.speaks, len(fixes)) == ("nmea", 20)
    assert only.foreign == 40  # NAV-PVT and NAV-COV


@cache
def epochs_of(name: str) -> tuple[list[bytes], list[Fix]]:
    """Eight epochs as bytes, and their fixes."""
    epochs = [b"".join(SPEAKERS[name]().packets(rows)) for rows in sky(8).reshape(8, 2)]
    _, whole = heard(b"".join(epochs))
    assert len(whole) == 8
    return epochs, whole


@speakers
@given(
    data=st.data(),
    sizes=st.lists(st.integers(1, 90), max_size=60),
    noise=st.binary(max_size=40),
)
@settings(max_examples=25, deadline=None, phases=[Phase.explicit, Phase.generate])
def test_cuts_do_not_matter_and_damage_costs_the_epochs_it_hits(
    name: str, data: st.DataObject, sizes: list[int], noise: bytes
) -> None:
    epochs, whole = epochs_of(name)
    # Rubbish between epochs and a wrong bit in one of them, which is not the first, by which the order is learnt
    hit = data.draw(st.integers(1, 7))
    broken, at = bytearray(epochs[hit]), data.draw(st.integers(0, len(epochs[hit]) - 1))
    broken[at] ^= 1 << data.draw(st.integers(0, 7))
    rubbish = noise.replace(b"$", b"").replace(b"\xb5", b"")
    receiver = Receiver("auto", geoid)
    stream = [*epochs[:hit], rubbish, bytes(broken), rubbish, *epochs[hit + 1 :]]
    kept = {fix.utc_s: fix.rows.tobytes() for fix in receiver.take(cut(b"".join(stream), sizes)) if not fix.refused}
    good = {fix.utc_s: fix.rows.tobytes() for k, fix in enumerate(whole) if k != hit}
    assert good.items() <= kept.items()
    assert kept.keys() <= {fix.utc_s for fix in whole}
    assert receiver.stream.skipped + receiver.stream.waiting > 2 * len(rubbish)


@given(
    st.lists(
        st.one_of(
            st.binary(max_size=60),
            st.sampled_from([b"\xb5\x62", b"\xb5\x62\x01\x07\x5c\x00", b"$GPGGA,", b"*47\r\n", b"$"]),
        )
    )
)
@settings(max_examples=60, deadline=None)  # fmt: skip
def test_any_bytes_are_survived_and_accounted_for(parts: list[bytes]) -> None:
    data = b"".join(parts)
    receiver = Receiver("auto", geoid)
    receiver.take(to_chunks(data))
    assert receiver.stream.waiting <= 8 + ubx.LONGEST
    assert receiver.stream.skipped + receiver.stream.waiting <= len(data)


@given(
    st.sampled_from([(1, 0x07, 92), (1, 0x36, 64), (1, 0x3C, 40), (1, 0x3C, 64), (1, 0x35, 20), (6, 0x8B, 9)]),
    st.randoms(),
)
@settings(max_examples=60, deadline=None)
def test_any_payload_behind_a_right_check_is_survived(what: tuple[int, int, int], dice: Any) -> None:
    kind, message, length = what
    body = bytes([kind, message]) + length.to_bytes(2, "little") + dice.randbytes(length)
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    receiver, fixes = heard(b"\xb5\x62" + body + bytes([a, b]) + pvt(iTOW=7) + pvt(iTOW=8))
    assert receiver.stream.packets == 3
    assert all(np.isfinite(fix.rows["value"]).all() for fix in fixes)
    assert any(not fix.refused for fix in fixes)


@given(
    st.sampled_from(["GGA", "RMC", "VTG", "GST", "HDT", "ZDA"]),
    st.text(st.characters(codec="ascii", min_codepoint=32, max_codepoint=126, exclude_characters="*$!"), max_size=80),
)
@settings(max_examples=60, deadline=None)  # fmt: skip
def test_any_fields_behind_a_right_check_are_survived(name: str, fields: str) -> None:
    text = f"GP{name},{fields}"
    check = 0
    for byte in text.encode():
        check ^= byte
    receiver, fixes = heard(
        f"${text}*{check:02X}\r\n".encode() + b"".join(NmeaEmulator(MIDNIGHT, geoid).packets(sky(3)))
    )
    assert receiver.fixes >= 2
    assert all(np.isfinite(fix.rows["value"]).all() and (fix.rows["sigma"] > 0.0).all() for fix in fixes)


@pytest.fixture
def port_file(tmp_path: Path) -> Path:
    return tmp_path / "ttyACM0"


def test_two_receivers_at_once_on_two_ports(tmp_path: Path) -> None:
    rows, places = sky(30), (tmp_path / "a", tmp_path / "b")
    emulators = UbxEmulator(MIDNIGHT), NmeaEmulator(MIDNIGHT, geoid)
    with Plugged(emulators[0], places[0]) as one, Plugged(emulators[1], places[1]) as two:
        ports = [SerialPort(f"serial:{place}:115200") for place in places]
        receivers = [Receiver("auto", geoid) for _ in ports]
        batch, counts = frames(64), [0, 0]
        for packets in zip(*(emulator.packets(rows) for emulator in emulators), strict=True):
            one.send(packets[0])
            two.send(packets[1])
            for k, port in enumerate(ports):
                counts[k] += len(receivers[k].take(batch[: port.receive(batch, 0.5)]))
        for port in ports:
            port.close()
    assert [receiver.speaks for receiver in receivers] == ["ubx", "nmea"]
    assert counts == [30, 30]
    assert [receiver.stream.skipped for receiver in receivers] == [0, 0]


@pytest.mark.parametrize("baud", [9600, 115200])
def test_a_wrong_rate_is_found(port_file: Path, baud: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probe, "RATES", (38400, 9600, 115200))
    emulator = NmeaEmulator(MIDNIGHT, geoid)
    with Plugged(emulator, port_file, only_baud=baud) as plug:

        def speak(ended: threading.Event) -> None:
            while not ended.wait(0.05):
                plug.send(emulator.packets(sky(1))[0])

        with beside(speak):
            assert probe.check_receiver(f"serial:{port_file}:{baud}") == ""
            with pytest.raises(HilError, match=rf"gnss at {baud} baud: use --gnss serial:{port_file}:{baud}"):
                probe.check_receiver(f"serial:{port_file}:57600", 0.3)


def test_setting_up_and_refusals(port_file: Path) -> None:
    emulator = UbxEmulator(MIDNIGHT)
    with Plugged(emulator, port_file), closing(SerialPort(f"serial:{port_file}:38400")) as port:
        dialog = Dialog(port, GnssFraming())
        assert ubx.configure(dialog, 4.0, 38400) == {"ports": ["UART1", "USB"], "rate_hz": 4.0}
        assert emulator.settings["CFG_MSGOUT_UBX_NAV_PVT_USB"] == 1
        assert emulator.settings["CFG_UART1OUTPROT_NMEA"] == 0
        assert "CFG_UART2OUTPROT_NMEA" not in emulator.settings
        with pytest.raises(HilError, match="whole number of milliseconds"):
            ubx.configure(dialog, 3.0, 38400)
        with pytest.raises(HilError, match="lower the rate"):
            ubx.configure(dialog, 20.0, 9600)
        deaf = UbxEmulator(MIDNIGHT, refused=("UART1", "UART2", "USB"))
        deaf.settings = emulator.settings
        emulator.answer = deaf.answer  # type: ignore[method-assign]
        with pytest.raises(HilError, match="on every port"):
            ubx.configure(dialog, 4.0, 38400)


def test_an_old_or_silent_receiver_is_told(port_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.serial.dialog.ANSWER_S", 0.05)
    with (
        Plugged(None, port_file),
        closing(SerialPort(f"serial:{port_file}:38400")) as port,
        pytest.raises(HilError, match="does not answer to CFG-VALSET"),
    ):
        ubx.configure(Dialog(port, GnssFraming()), 5.0, 38400)
