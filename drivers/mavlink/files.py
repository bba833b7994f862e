"""MAVLink FTP for files that are read and never change: a few kilobytes of metadata, from memory.

The number of a session is that of its file, so that nothing is held for a client that goes away. Nothing can be written, and
nothing of the disk can be reached.
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


def answers(request: bytes, files: Mapping[str, bytes]) -> Iterator[bytes]:
    """The payloads that answer the payload of a request; none for one that is no request."""
    number, session, opcode, size, _, _, offset = _HEAD.unpack_from(request)
    data = request[_HEAD.size : _HEAD.size + size]
    if opcode in (0, _ACK, _NAK):
        return
    names = list(files)
    body = files[names[session]] if session < len(names) else None
    path = data.split(b"\0")[0].decode("ascii", "replace").strip("/")

    def reply(content: bytes, *, at: int = offset, more: int = 1, held: int = session, complete: int = 0) -> bytes:
        head = _HEAD.pack((number + more) % 65536, held, _ACK, len(content), opcode, complete, at)
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
            yield reply(struct.pack("<I", len(files[path])), held=names.index(path))
        else:
            yield reply(struct.pack("<I", checksum(files[path])))
    elif opcode in (_READ, _BURST_READ):
        if body is None:
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
