"""Fuzz targets: boards on CAN and on serial ports."""

from binascii import crc_hqx
from collections.abc import Callable
from functools import cache

import numpy as np
from fuzz.wires import CUTS, accounted, batches, cut, drive, packed, unpacked
from pty_board import BOARDS, moving

from drivers import FrameDriver, make_emulator
from drivers.can.aiding import AidingDecoder, AidingEncoder, aiding_database_text
from drivers.can.codec import load_database
from drivers.can.dtg_head import DtgHead, head_database_text
from drivers.can.dtg_head_emulator import HeadEncoder
from drivers.can.frames import FrameArray, frames
from drivers.can.integrity import Protection, protection
from drivers.can.j1939 import J1939Imu
from drivers.can.sbg import Sbg
from drivers.can.xsens import Xsens
from drivers.serial import mip
from drivers.serial.chunks import SIZE, fill_chunks, to_chunks
from drivers.serial.dialog import Dialog
from drivers.serial.probe import hear, serial_drivers
from drivers.serial.stream import ByteStream, Framing
from nav.aiding import AIDING, Kind

Take = Callable[[bytes], None]
Made = tuple[Take, list[bytes]]
CLASSIC, FD = 16, 72
"""Bytes of a frame as the kernel hands it over."""
ON_CAN: dict[str, Callable[[], FrameDriver]] = {"sbg": Sbg, "xsens-can": Xsens, "j1939-imu": J1939Imu}
PERIODS_US = {"sbg": 5000, "xsens-can": 2500, "j1939-imu": 10_000}
LONGEST = {"xsens-xbus": 2055, "vectornav": 900, "microstrain-mip": 261}
"""Bytes that a false start can hold up."""


def dtg_head() -> Made:
    """The head, FD and classic."""
    mend = mender(head_database_text())
    rng = np.random.default_rng(0)

    def take(data: bytes) -> None:
        batch = unpacked(data[1:], FD)
        if data[:1] and data[0] & 1:
            mend(batch)
        driver = DtgHead()
        drive(driver, batch, cuts(data))
        accounted(driver)

    seeds = []
    for layout in ("fd", "classic"):
        encoder, k = HeadEncoder(layout, 1000), np.arange(1, 5)
        samples = encoder.samples(k, 1000 * k, rng.normal(0, 1e-3, (4, 4)), rng.normal(0, 1e-2, (4, 3)), rotor=None)
        seeds += [first + packed(np.concatenate([encoder.slow(), samples]), FD) for first in (b"\x81", b"\xc0")]
    return take, seeds


def aiding() -> Made:
    """Measurements on CAN FD."""
    mend = mender(aiding_database_text())

    def take(data: bytes) -> None:
        batch = unpacked(data[1:], FD)
        if data[:1] and data[0] & 1:
            mend(batch)
        decoder, taken = AidingDecoder(), 0
        for piece in batches(batch, cuts(data)):
            rows, places = decoder.decode(piece, 4000.0 if data[0] & 2 else None)
            assert len(rows) == len(places)
            assert np.isfinite(rows["time"]).all()
            assert np.isfinite(rows["value"]).all()
            assert (rows["sigma"] > 0.0).all()
            taken += len(rows)
        assert decoder.counters.samples == taken == sum(decoder.heard.values())
        assert min(decoder.counters.as_list()) >= 0

    rows = np.zeros(12, AIDING)
    rows["kind"], rows["time"] = np.tile(range(1, 7), 2), 4000.0 + 0.1 * np.arange(12)
    rows["value"], rows["sigma"] = 0.5, 0.1
    rows["value"][rows["kind"] == Kind.MAGNETIC] = 2e-5
    rows["source"][6:] = 130
    rows["value"][rows["kind"] == Kind.ATTITUDE] = 0.5, 0.5, 0.5, 0.5, 0.0, 0.0
    return take, [b"\x81" + packed(AidingEncoder().frames(rows), FD)]


def classic(name: str) -> Made:
    """A board that sends a sample as several classic frames, without checks."""

    def take(data: bytes) -> None:
        driver = ON_CAN[name]()
        drive(driver, unpacked(data[1:], CLASSIC), cuts(data))
        accounted(driver)

    emulator = make_emulator(name, PERIODS_US[name])
    batch = np.concatenate([emulator.slow(), emulator.samples(moving(12, PERIODS_US[name] * 1e-6))])
    return take, [bytes([size]) + packed(batch, CLASSIC) for size in (0x7F, 0xFF)]


@cache
def tail(name: str) -> bytes:
    """Good packets, more than a false start can swallow."""
    packets = BOARDS[name][1]().packets(moving(4, start_s=9.0))
    return b"".join(packets) * (2 + LONGEST[name] // sum(map(len, packets)))


def serial(name: str) -> Made:
    """A board on a serial port: the driver, and that the stream finds good packets again behind anything."""
    make, emulator = BOARDS[name]

    def take(data: bytes) -> None:
        body = data[1:]
        driver, size = make(), cuts(data)
        if data[:1] and data[0] & 1:
            body = mended(name, driver.board, body)
        batch = frames(CUTS + 1 + len(body) // SIZE)
        used = 0
        for piece in cut(len(body), size):
            used += fill_chunks(batch[used:], body[piece], 1000 * piece.start)
        drive(driver, batch[:used], 64 if data[:1] and data[0] & 2 else 8)
        stream, count = ByteStream(driver.board), driver.counters
        assert count.samples + count.foreign + count.short + count.duplicated <= driver.stream.packets
        inside = sum(len(packet) for packet, _ in stream.take(to_chunks(body)))
        assert inside + stream.skipped + stream.waiting == len(body)
        assert stream.waiting <= LONGEST[name]
        assert stream.packets == driver.stream.packets, "how bytes are cut changes nothing"
        last = [packet for packet, _ in stream.take(to_chunks(tail(name)))][-1:]
        assert last, "good packets are found again"
        assert tail(name).endswith(last[0])

    packets = [emulator(increments=way).packets(moving(3)) for way in (True, False)]
    return take, [first + b"".join(some) for some in packets for first in (b"\x41", b"\xff")]


def probe() -> Made:
    """Listening for every serial board at once."""
    assert {*BOARDS} == {*serial_drivers()} - {"mavlink-imu"}  # its parser is that of the target mavlink
    framings = {name: make().board for name, (make, _) in BOARDS.items()}

    def take(data: bytes) -> None:
        assert hear({name: ByteStream(framing) for name, framing in framings.items()}, to_chunks(data)) in {"", *BOARDS}

    return take, [b"".join(emulator().packets(moving(4))) for _, emulator in BOARDS.values()]


class Line:
    """The port of a board that has said `said` and says no more."""

    dropped = 0

    def __init__(self, said: bytes) -> None:
        self._said = to_chunks(said)

    def receive(self, batch: FrameArray, timeout: float) -> int:
        """See `Port.receive`; ends the dialog where nothing more will come."""
        if not len(self._said):
            raise EOFError
        n = min(8, len(self._said))
        batch[:n], self._said = self._said[:n], self._said[n:]
        return n

    def send(self, batch: FrameArray) -> None:
        """See `Port.send`."""

    def close(self) -> None:
        """See `Port.close`."""


def answers() -> Made:
    """What boards answer while they are set up: the first byte says which board."""
    names = list(BOARDS)

    def take(data: bytes) -> None:
        name = names[data[0] % 3] if data else names[0]
        board = BOARDS[name][0]().board
        body = mended(name, board, data[1:])
        try:
            board.configure(Dialog(Line(body), board), 100.0, 921600)
        except EOFError:
            pass

    return take, [bytes([k]) + _answers(name) for k, name in enumerate(names)]


def _answers(name: str) -> bytes:
    """What the emulated board sends back to the whole of a set-up."""
    board, emulator, said = BOARDS[name][0]().board, BOARDS[name][1](), bytearray()

    class Talk(Line):
        def send(self, batch: FrameArray) -> None:
            data = emulator.answer(batch["data"].tobytes()[: int(batch["length"].sum())])
            said.extend(data)
            self._said = to_chunks(data)

    board.configure(Dialog(Talk(b""), board), 100.0, 921600)
    return bytes(said)


def cuts(data: bytes) -> int:
    """Frames or bytes taken at once: 1 to 64, as the highest bits of the first byte say."""
    return 1 << min(data[0] >> 5, 6) if data else 1


def mender(text: str) -> Callable[[FrameArray], None]:
    """Makes the checks of frames right that a DBC protects; counters stay."""
    found: dict[int, Protection] = {}
    for codec in load_database(text).messages.values():
        declared = protection(codec)
        assert declared is not None
        found[codec.can_id] = declared

    def mend(batch: FrameArray) -> None:
        for row in batch:
            declared = found.get(int(row["can_id"]))
            if declared is not None:
                data = row["data"][None, :].copy()
                counter = data[:, 2] if declared.profile == "P05" else data[:, 1] & 15
                declared.protect(data, counter.astype(np.int64))
                row["data"] = data[0]

    return mend


def mended(name: str, framing: Framing, data: bytes) -> bytes:
    """`data` with the check of every packet in it made right."""
    at = 0
    while (start := framing.sync.search(data, at)) is not None:
        at = start.start()
        size = framing.size(data, at)
        if size <= 4 or at + size > len(data) or data[at : at + 1] == b"$":
            at += 1
            continue
        packet = data[at : at + size]
        data = data[:at] + _checked(name, packet) + data[at + size :]
        at += size
    return data


def _checked(name: str, packet: bytes) -> bytes:
    if name == "xsens-xbus":
        return packet[:-1] + bytes([-sum(packet[1:-1]) & 0xFF])
    if name == "vectornav":
        return packet[:-2] + crc_hqx(packet[1:-2], 0).to_bytes(2, "big")
    return packet[:-2] + mip.check(packet[:-2])
