"""MAVLink FTP for files that are read and never change: a few kilobytes of metadata, from memory.

Each client has one session, number 0, which is all that some of them can use. Nothing can be written, and nothing of the disk
can be reached.
"""

import struct
from collections.abc import Iterator, Mapping

from drivers.mavlink.metadata import checksum

DATA = 239
"""Bytes of a file in one message."""
_BURST = 16
"""Messages that answer one request for a burst."""
_HEAD = struct.Struct("<HBBBBBxI")
_TERMINATE, _RESET, _LIST, _OPEN, _READ, _CHECKSUM, _BURST_READ = 1, 2, 3, 4, 5, 14, 15
_ACK, _NAK = 128, 129
_NO_SESSION, _EOF, _UNKNOWN, _PROTECTED, _NOT_FOUND = 4, 6, 7, 9, 10
_WRITING = (6, 7, 8, 9, 10, 11, 12, 13)
"""Requests that would change something."""
PAYLOAD = 251


_CLIENTS = 16
"""Clients whose open file is remembered."""


class FileServer:
    """The files, and which of them each client has open."""

    def __init__(self, files: Mapping[str, bytes]) -> None:
        self._files = files
        self._open: dict[tuple[int, int], str] = {}

    def answers(self, request: bytes, sender: tuple[int, int]) -> Iterator[bytes]:
        """The payloads that answer the payload of a request; none for one that is no request."""
        opcode, name = request[3], _path(request)
        if opcode == _OPEN and name in self._files:
            self._open.pop(sender, None)
            self._open[sender] = name
            if len(self._open) > _CLIENTS:
                del self._open[next(iter(self._open))]
        return _answers(request, self._files, self._files.get(self._open.get(sender, "")))


def _path(request: bytes) -> str:
    return request[_HEAD.size : _HEAD.size + request[4]].split(b"\0")[0].decode("ascii", "replace").strip("/")


def _answers(request: bytes, files: Mapping[str, bytes], body: bytes | None) -> Iterator[bytes]:
    """`body` is what the client has open."""
    number, session, opcode, size, _, _, offset = _HEAD.unpack_from(request)
    if opcode in (0, _ACK, _NAK):
        return
    path = _path(request)

    def reply(content: bytes, *, at: int = offset, more: int = 1, complete: int = 0) -> bytes:
        head = _HEAD.pack((number + more) % 65536, session, _ACK, len(content), opcode, complete, at)
        return (head + content).ljust(PAYLOAD, b"\0")

    def refusal(reason: int) -> bytes:
        head = _HEAD.pack((number + 1) % 65536, session, _NAK, 1, opcode, 0, offset)
        return (head + bytes([reason])).ljust(PAYLOAD, b"\0")

    if opcode in (_TERMINATE, _RESET):
        yield reply(b"")
    elif opcode == _LIST:
        rows = [f"F{name}\t{len(content)}\0".encode() for name, content in files.items()]
        if path not in ("", "."):
            yield refusal(_NOT_FOUND)
        elif offset >= len(rows):
            yield refusal(_EOF)
        else:
            yield reply(b"".join(rows[offset:])[:DATA])
    elif opcode in (_OPEN, _CHECKSUM):
        if path not in files:
            yield refusal(_NOT_FOUND)
        elif opcode == _OPEN:
            yield reply(struct.pack("<I", len(files[path])))
        else:
            yield reply(struct.pack("<I", checksum(files[path])))
    elif opcode in (_READ, _BURST_READ):
        if body is None or session != 0:
            yield refusal(_NO_SESSION)
        elif offset >= len(body):
            yield refusal(_EOF)
        elif opcode == _READ:
            yield reply(body[offset : offset + min(size or DATA, DATA)])
        else:
            step = min(size or DATA, DATA)
            starts = range(offset, len(body), step)[:_BURST]
            for i, start in enumerate(starts):
                yield reply(body[start : start + step], at=start, more=i + 1, complete=int(i + 1 == len(starts)))
    else:
        yield refusal(_PROTECTED if opcode in _WRITING else _UNKNOWN)
