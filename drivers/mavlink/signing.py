"""Signatures of MAVLink 2: what goes out is signed, and what comes in unsigned, wrongly signed or again is refused.

A signature is the first 48 bits of SHA-256 over key, frame, link and time; the time is in 10 us since 2015 and rises from frame
to frame of a stream (system, component, link of the sender). Our own time and the last one of each stream are kept on
disk, ours a little ahead, so that a killed process does not begin with a time that it has used.

The packer of pymavlink signs. Its check is not used: it takes over the time of a frame before it has looked at the
signature, so that one forged frame would silence a stream.
"""

import base64
import binascii
import contextlib
import hashlib
import hmac
import stat
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink.store import Store
from nav.errors import HilError

KEY_BYTES = 32
EPOCH_S = 1_420_070_400
"""2015-01-01 UTC, as Unix time."""
TICKS = 100_000
"""Ticks a second."""
AHEAD_S = 5
"""How far ahead our time is kept: it is written as often, and a crash costs no more."""
BEHIND_S = 60
"""How far a stream that was never heard may be behind us."""
_SIGNATURE, _BLOCK = 6, 13

UNSIGNED, WRONG, REPLAYED, OLD = "unsigned", "wrong signature", "replayed", "too old"
"""Why a frame is refused."""


def read_key(path: Path) -> bytes:
    """The key in a file: 32 bytes, or those as hexadecimal or base64 text.

    Raises
    ------
    HilError
        The file cannot be read, others can read it too, or it holds no such key. The message never shows what it holds.
    """
    try:
        mode = path.stat().st_mode
        data = path.read_bytes() if stat.S_ISREG(mode) else b""
    except OSError as error:
        raise HilError(f"signing key {path}: {error.strerror}") from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise HilError(f"signing key {path}: others can read or change it; chmod 600 {path}")
    if len(data) == KEY_BYTES:
        return data
    text = data.strip()
    for decode in (bytes.fromhex, lambda text: base64.b64decode(text, validate=True)):
        try:
            key: bytes = decode(text.decode("ascii"))
        except (ValueError, binascii.Error):
            continue
        if len(key) == KEY_BYTES:
            return key
    raise HilError(
        f"signing key {path}: expected {KEY_BYTES} bytes, as they are or in hexadecimal or base64; "
        f"make one with: (umask 077; openssl rand -hex {KEY_BYTES} > {path})"
    )


class Signer:
    """Key, times and exceptions, shared by all links of a component.

    Parameters
    ----------
    key : bytes
        32 of them.
    store : Store
        Keeps the times.
    accept_unsigned : collection of str
        Names of messages that are taken without a signature; one that is there must be right for them too.
    clock : callable
        Unix time, s. It may step; our time rises all the same.

    Raises
    ------
    HilError
        An unknown message name, or the times cannot be kept.
    """

    def __init__(
        self,
        key: bytes,
        store: Store,
        accept_unsigned: Collection[str] = (),
        clock: Callable[[], float] = time.time,
    ) -> None:
        names = {kind.msgname for kind in mav.mavlink_map.values()}
        if unknown := sorted(set(accept_unsigned) - names):
            raise HilError(f"mavlink.accept_unsigned: unknown message {unknown[0]!r}; give names as RADIO_STATUS")
        self._key, self._store, self._clock = key, store, clock
        self._accept_unsigned = frozenset(accept_unsigned)
        kept = store.read()
        try:
            self._ticks = max(int(kept.get("ticks", 0)), self._now())
            self._streams = {str(stream): int(ticks) for stream, ticks in kept.get("streams", {}).items()}
        except (AttributeError, TypeError, ValueError) as error:
            raise HilError(f"{store.path}: holds no times of signatures; remove it") from error
        self._reserved = 0
        self._keep(AHEAD_S * TICKS)

    def sign(self, packer: mav.MAVLink, link_id: int) -> None:
        """Have `packer` sign the next frame, with a time later than every one before."""
        self._ticks = max(self._ticks + 1, self._now())
        if self._ticks >= self._reserved:
            try:
                self._keep(AHEAD_S * TICKS)
            except HilError:  # a full disk may not end the run; what is sent is still later than all before
                self._reserved = self._ticks + AHEAD_S * TICKS
        signing = packer.signing
        signing.secret_key, signing.sign_outgoing = self._key, True
        signing.link_id, signing.timestamp = link_id, self._ticks

    def refusal(self, message: Any) -> str:
        """Why a message is refused; empty for one that is taken, whose time then holds for its stream."""
        frame = bytes(message.get_msgbuf())
        header = message.get_header()
        if not header.incompat_flags & mav.MAVLINK_IFLAG_SIGNED:
            return "" if message.get_type() in self._accept_unsigned else UNSIGNED
        block = frame[-_BLOCK:]
        expected = hashlib.sha256(self._key + frame[:-_SIGNATURE]).digest()[:_SIGNATURE]
        if not hmac.compare_digest(expected, block[-_SIGNATURE:]):
            return WRONG
        stream = f"{header.srcSystem}.{header.srcComponent}.{block[0]}"
        ticks = int.from_bytes(block[1:7], "little")
        last = self._streams.get(stream)
        if last is not None and ticks <= last:
            return REPLAYED
        if last is None and ticks < max(self._ticks, self._now()) - BEHIND_S * TICKS:
            return OLD
        self._streams[stream] = ticks
        self._ticks = max(self._ticks, ticks)
        return ""

    def close(self) -> None:
        """Keep the times as they are now, where the disk takes them."""
        with contextlib.suppress(HilError):
            self._keep(0)

    def _now(self) -> int:
        return int((self._clock() - EPOCH_S) * TICKS)

    def _keep(self, ahead: int) -> None:
        self._reserved = self._ticks + ahead

        def merged(kept: dict[str, Any]) -> dict[str, Any]:
            """Another program's times are not lost."""
            streams = {**kept.get("streams", {})}
            for stream, ticks in self._streams.items():
                streams[stream] = max(ticks, int(streams.get(stream, 0)))
            return {"ticks": max(self._reserved, int(kept.get("ticks", 0))), "streams": streams}

        self._store.update(merged)
