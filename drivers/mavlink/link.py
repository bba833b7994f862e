"""Byte links for MAVLink: UDP, TCP and serial, none of which ever blocks.

A link is one stream of frames to whoever listens at its other end. Its `fileno` never changes (it is an epoll over what
the link holds open), so that it can be waited on while connections come and go. A peer that is slow or gone loses frames;
the sender is told by `send`. A TCP server is a `Listener`, and each of its clients a link of its own.
"""

import os
import select
import socket
import time
from collections.abc import Callable
from typing import Protocol, TypeAlias

import serial

from nav.errors import HilError

FORMS = "udpout:HOST:PORT, udpin:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT, serial:/dev/NAME:BAUD"

_CHUNK = 2048
"""Most bytes taken at once: bounds the time that a flood can hold the sender up."""
_UDP_PEERS = 4
CLIENTS = 8
"""Most clients of one TCP server."""
_RETRY_S = 1.0
_DEAD_PEER_MS = 5000
_TCP_BUFFER = 65536

Channel: TypeAlias = socket.socket | serial.Serial


class Link(Protocol):
    """One byte link."""

    url: str
    datagrams: bool
    """True when what `receive` returns begins with a frame."""

    def fileno(self) -> int:
        """Descriptor to wait on for reading; constant."""

    def ready(self) -> bool:
        """Whether somebody may be listening; opens the connection again when it is time to."""

    def receive(self) -> bytes:
        """Bytes that have arrived, at most one datagram or chunk; empty when there are none."""

    def heard(self) -> None:
        """What `receive` returned last was good: its sender may be answered."""

    @property
    def gone(self) -> bool:
        """The connection is over and does not come back."""

    def send(self, frame: bytes) -> bool:
        """Send a whole frame or nothing; False when it was dropped."""

    def close(self) -> None:
        """Give everything back."""


def open_link(url: str) -> "Link | Listener":
    """The link of a URL, see `FORMS`. A listening link listens on the very address given.

    Raises
    ------
    HilError
        The URL is malformed, its host is unknown, its port is in use, or its device cannot be opened.
    """
    kind, place, number = parts_of(url)
    try:
        if kind == "serial":
            return StreamLink(url, lambda: serial.Serial(place, number, timeout=0, write_timeout=0, exclusive=True))
        family, address = _resolve(url, place, number, kind.startswith("udp"))
        if kind.startswith("udp"):
            return UdpLink(url, family, address, listen=kind == "udpin")
        if kind == "tcp":
            return StreamLink(url, lambda: _dial(family, address), lazy=True)
        return Listener(url, socket.create_server(address, family=family, backlog=CLIENTS))
    except (OSError, ValueError, OverflowError) as error:  # pyserial's errors are OSErrors
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise HilError(f"MAVLink link {url!r}: cannot open it: {reason}") from error


def parts_of(url: str) -> tuple[str, str, int]:
    """Kind, host or device, and port or baud rate of a URL.

    Raises
    ------
    HilError
        The URL is malformed.
    """
    kind, _, rest = url.partition(":")
    place, _, number = rest.rpartition(":")
    if kind not in ("udpout", "udpin", "tcp", "tcpin", "serial"):
        raise HilError(f"MAVLink link {url!r}: unknown kind {kind!r}; expected one of {FORMS}")
    if not place or place == "[]":
        missing = "device or baud rate" if kind == "serial" else "host or port"
        raise HilError(f"MAVLink link {url!r}: {missing} missing; expected one of {FORMS}")
    lowest, highest = (1, 10_000_000) if kind == "serial" else (0 if kind.endswith("in") else 1, 65535)
    if not (number.isascii() and number.isdigit() and lowest <= int(number) <= highest):
        what = "baud rate" if kind == "serial" else "port"
        raise HilError(f"MAVLink link {url!r}: {what} {number!r} is not a whole number from {lowest} to {highest}")
    return kind, place, int(number)


def listens_beyond(url: str) -> bool:
    """Whether the link of a URL can be reached from other machines: its address is not one of this machine alone."""
    kind, _, rest = url.partition(":")
    place = rest.rpartition(":")[0].strip("[]")
    return kind.endswith("in") and not (place in {"localhost", "::1"} or place.startswith("127."))


class UdpLink:
    """UDP: `listen` at an address and answer the last peers that spoke, or send to an address and hear only its host."""

    datagrams = True

    def __init__(self, url: str, family: int, address: tuple[str, int], *, listen: bool) -> None:
        self.url = url
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._peers: list[tuple[str, int]] = []
        self._last: tuple[str, int] | None = None
        self._only_host: str | None = None
        if listen:
            try:
                self._socket.bind(address)
            except OSError:
                self._socket.close()
                raise
        else:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            self._peers = [address]
            many = address[0].endswith(".255") or address[0].split(".")[0] in {str(n) for n in range(224, 240)}
            self._only_host = None if many else address[0]
        self._listens = listen

    def fileno(self) -> int:
        """Descriptor to wait on for reading; constant."""
        return self._socket.fileno()

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._socket.getsockname()[1])

    def ready(self) -> bool:
        """Whether there is anybody to send to."""
        return bool(self._peers)

    def receive(self) -> bytes:
        """The next datagram; empty when there is none."""
        try:
            data, sender = self._socket.recvfrom(65535)
        except OSError:  # nothing there, or the refusal of an earlier datagram
            return b""
        peer = (str(sender[0]), int(sender[1]))
        if not self._listens and self._only_host not in (None, peer[0]):
            return b""
        self._last = peer
        return data[:_CHUNK]

    def heard(self) -> None:
        """The sender of the last datagram is answered from now on, where we listen."""
        if self._listens and self._last is not None and self._last not in self._peers:
            self._peers = [self._last, *self._peers][:_UDP_PEERS]

    gone = False

    def send(self, frame: bytes) -> bool:
        """Send to every peer; False when no peer could be sent to."""
        sent = False
        for peer in self._peers:
            try:
                self._socket.sendto(frame, peer)
                sent = True
            except OSError:  # full buffer, refused, no route: the frame is lost, the link lives
                continue
        return sent

    def close(self) -> None:
        """Give everything back."""
        self._socket.close()


class StreamLink:
    """A byte stream: a serial port or TCP connection made by `opener`, again every second after a loss; or one `client`."""

    datagrams = False

    def __init__(
        self,
        url: str,
        opener: Callable[[], Channel] | None,
        *,
        client: socket.socket | None = None,
        lazy: bool = False,
    ) -> None:
        self.url = url
        self._opener = opener
        self._channel: Channel | None = None
        self._tail = b""
        self._retry_at = 0.0
        self._epoll = select.epoll()
        if client is not None:
            self._take(client)
        elif opener is not None and not lazy:
            try:
                self._take(opener())
            except (OSError, ValueError, OverflowError):
                self._epoll.close()
                raise

    def fileno(self) -> int:
        """Descriptor to wait on for reading; constant."""
        return self._epoll.fileno()

    @property
    def gone(self) -> bool:
        """The client has left."""
        return self._channel is None and self._opener is None

    @property
    def left(self) -> bool:
        """The other end has closed, though what it sent before may not all be read."""
        if self._channel is None:
            return True
        poll = select.poll()
        poll.register(self._channel.fileno(), select.POLLRDHUP)
        return bool(poll.poll(0))

    def heard(self) -> None:
        """There is but one peer: nothing to do."""

    def ready(self) -> bool:
        """Whether there is a connection (or one on its way); opens it again when it is time to."""
        if self._channel is None and self._opener is not None and time.monotonic() >= self._retry_at:
            self._retry_at = time.monotonic() + _RETRY_S
            try:
                self._take(self._opener())
            except (OSError, ValueError, OverflowError):
                self._channel = None
        return self._channel is not None

    def receive(self) -> bytes:
        """Bytes that have arrived, at most one chunk."""
        data = b""
        if self._channel is not None:
            try:
                data = os.read(self._channel.fileno(), _CHUNK)
                if not data and (self._is_socket() or self._hung_up()):
                    self._drop()
            except BlockingIOError:
                pass
            except OSError:
                self._drop()
        return data

    def send(self, frame: bytes) -> bool:
        """Send a whole frame; False when the connection is down or still busy with an earlier frame."""
        if self._channel is None:
            return False
        try:
            if self._tail:
                self._tail = self._tail[os.write(self._channel.fileno(), self._tail) :]
                if self._tail:
                    return False
            self._tail = frame[os.write(self._channel.fileno(), frame) :]
        except BlockingIOError:
            return False
        except OSError:
            self._drop()
            return False
        return True

    def close(self) -> None:
        """Give everything back."""
        self._drop()
        self._epoll.close()

    def _is_socket(self) -> bool:
        return isinstance(self._channel, socket.socket)

    def _hung_up(self) -> bool:
        assert self._channel is not None
        fd = self._channel.fileno()
        lost = select.EPOLLHUP | select.EPOLLERR
        return any(found == fd and events & lost for found, events in self._epoll.poll(0))

    def _take(self, channel: Channel) -> None:
        self._channel, self._tail = channel, b""
        self._epoll.register(channel.fileno(), select.EPOLLIN)

    def _drop(self) -> None:
        if self._channel is not None:
            try:
                self._epoll.unregister(self._channel.fileno())
            except OSError:
                pass  # the device is gone, and its descriptor with it
            self._channel.close()
        self._channel, self._tail = None, b""


class Listener:
    """A TCP server: each client is a link of its own, so that none waits for another."""

    def __init__(self, url: str, server: socket.socket) -> None:
        self.url = url
        self.turned_away = 0
        """Clients for whom there was no room."""
        self._server = server
        server.setblocking(False)

    def fileno(self) -> int:
        """Descriptor to wait on for reading; constant."""
        return self._server.fileno()

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._server.getsockname()[1])

    def accept(self, room: int, most: int = socket.SOMAXCONN) -> list[StreamLink]:
        """Links of the next `most` clients that have come, `room` at most; the others are turned away."""
        links: list[StreamLink] = []
        for _ in range(most):
            try:
                client, _ = self._server.accept()
            except OSError:
                break
            if len(links) < room:
                _tune(client)
                links.append(StreamLink(self.url, None, client=client))
            else:
                self.turned_away += 1
                client.close()
        return links

    def close(self) -> None:
        """Give everything back."""
        self._server.close()


def _resolve(url: str, host: str, port: int, udp: bool) -> tuple[int, tuple[str, int]]:
    kind = socket.SOCK_DGRAM if udp else socket.SOCK_STREAM
    try:
        found = socket.getaddrinfo(host.strip("[]"), port, type=kind)
    except (socket.gaierror, UnicodeError) as error:
        raise HilError(f"MAVLink link {url!r}: unknown host {host!r}; expected one of {FORMS}") from error
    # IPv4 first: that is where ground stations listen when a name such as localhost means both
    family, _, _, _, address = min(found, key=lambda entry: entry[0] != socket.AF_INET)
    return family, (str(address[0]), int(address[1]))


def _tune(connection: socket.socket) -> None:
    """Frames leave at once, few of them queue up, and a peer that vanished is noticed."""
    connection.setblocking(False)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _DEAD_PEER_MS)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _TCP_BUFFER)


def _dial(family: int, address: tuple[str, int]) -> socket.socket:
    connection = socket.socket(family, socket.SOCK_STREAM)
    _tune(connection)
    connection.connect_ex(address)  # goes on in the background; a refusal shows in the next read or write
    return connection
