"""How full a bus is, from the frames and bytes that came: bits of the frames over the bits that fit, stuff bits left out."""

from urllib.parse import parse_qsl

CLASSIC_BITS = 47
"""Of a classic frame with an 11-bit identifier besides its data, space between frames included."""
FD_SLOW_BITS, FD_FAST_BITS = 30, 36
"""Of an FD frame besides its data, at the two bit rates."""
NOMINAL, DATA = 500_000.0, 2_000_000.0
"""Bit rates that a bus is taken to have when its URL says none."""
_UART_BITS = 10
"""Of a byte on a serial line."""


def bus_load(url: str, frames_s: float, bytes_s: float) -> float:
    """Share of the bus's time that `frames_s` frames with `bytes_s` bytes of data take each second.

    Frames of more than eight bytes on average are taken for CAN FD with bit-rate switch.
    """
    channel, _, query = url.partition("?")
    if channel.startswith("serial:"):
        baud = channel.rpartition(":")[2]
        return _UART_BITS * bytes_s / float(baud) if baud.isdecimal() and "://" not in channel else 0.0
    options = {key: float(value) for key, value in parse_qsl(query) if value.isdecimal() and int(value)}
    nominal = options.get("bitrate", NOMINAL)
    if bytes_s <= 8.0 * frames_s:
        return (CLASSIC_BITS * frames_s + 8.0 * bytes_s) / nominal
    fast = options.get("data_bitrate", options.get("dbitrate", max(nominal, DATA)))
    return FD_SLOW_BITS * frames_s / nominal + (FD_FAST_BITS * frames_s + 8.0 * bytes_s) / fast
