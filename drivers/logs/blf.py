"""Vector's BLF through python-can's reader, which goes round for ever at an object that says it has no length."""

import struct
from collections.abc import Iterator

import can
from can.io.blf import BLFReader

from nav.errors import HilError

_OBJECT = struct.Struct("<4sHHII")
"""Mark, size of the header, its version, size of the object, its type."""
_LEAST = 32
"""Bytes of an object's header."""


class BlfReader(BLFReader):
    """As python-can's; an object that is shorter than its header is refused by name."""

    def _parse_data(self, data: bytes) -> Iterator[can.Message]:
        at = 0
        while (at := data.find(b"LOBJ", at, at + 8)) >= 0 and at + _OBJECT.size <= len(data):
            size = _OBJECT.unpack_from(data, at)[3]
            if size < _LEAST:
                data = data[:at]  # what came before is good
                yield from super()._parse_data(data)
                raise HilError(f"an object of {size} bytes, which its header alone has not room in")
            at += size
        yield from super()._parse_data(data)
