"""Error frames as the drivers of Linux's CAN controllers make them, and what the user is told of them."""

import numpy as np
import pytest

from drivers import Counters
from drivers.can.bus_errors import BusErrors, is_error
from drivers.can.frames import ERR, FrameArray, frames
from drivers.serial.chunks import to_chunks
from hil.wire_watch import QUIET_S, Said, WireWatch

# candump's log of a controller whose wires were shorted: identifier and the first bytes of the data.
SHORTED = [(0x004, "0008"), (0x088, "000019"), (0x004, "0020"), (0x040, ""), (0x100, "")]


def error_frames(lines: list[tuple[int, str]]) -> FrameArray:
    batch = frames(len(lines))
    batch["length"] = 8
    for row, (said, data) in zip(batch, lines, strict=True):
        row["can_id"] = ERR | said
        row["data"][: len(data) // 2] = np.frombuffer(bytes.fromhex(data), np.uint8)
    return batch


def test_what_a_shorted_bus_makes() -> None:
    errors = BusErrors()
    errors.add(error_frames(SHORTED))
    assert errors.as_dict() == {"bus_off": 1, "restarted": 1, "error_passive": 1, "error_warning": 1, "protocol": 1}


@pytest.mark.parametrize(
    ("said", "data", "names"),
    [
        (0x001, "", {"tx_timeout"}),
        (0x002, "1f", {"lost_arbitration"}),
        (0x004, "0001", {"overflow"}),
        (0x010, "000000005000", {"transceiver"}),
        (0x020, "", {"no_ack"}),
        (0x060, "", {"no_ack", "bus_off"}),
        (0x004, "0040", set()),
    ],
)
def test_each_class_has_its_counter(said: int, data: str, names: set[str]) -> None:
    errors = BusErrors()
    errors.add(error_frames([(said, data)]))
    assert set(errors.as_dict()) == names


def test_serial_bytes_are_no_error_frames() -> None:
    assert not is_error(to_chunks(b"\xff" * 100)).any()


def said(watch: WireWatch, counters: Counters, batch: FrameArray, now_s: float) -> list[Said]:
    return list(watch.look(batch, counters.as_list(), now_s))


def test_bus_off_is_told_with_the_commands_that_mend_it() -> None:
    counters = Counters()
    watch = WireWatch(counters, "socketcan:can3")
    batch = error_frames([(0x040, "")])
    counters.foreign += 1
    (told,) = said(watch, counters, batch, 5.0)
    assert (told.severity, told.station) == ("error", True)
    assert "ip link set can3 up type can restart-ms 100" in told.text
    assert "ip link set can3 type can restart" in told.text
    assert len(told.text) <= 240, "an event holds no more"


def test_a_fault_that_goes_on_is_told_when_it_begins_and_when_it_is_over() -> None:
    counters = Counters()
    watch, none, told = WireWatch(counters, "unix:x"), frames(0), []
    for k in range(2000):
        counters.samples += 1
        counters.crc_errors += 300 <= k < 500
        told += [(k, one.text) for one in said(watch, counters, none, 1e-3 * k)]
    (begun, text), (over, end) = told
    assert (begun, text) == (300, "crc_errors: frames fail their check")
    assert over == pytest.approx(499 + 1e3 * QUIET_S, abs=2)
    assert end == "crc_errors: 200 in 0.199 s, no more"
