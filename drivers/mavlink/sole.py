"""A TCP server with one client at a time, as one `drivers.mavlink.link.Link`: the next is let in when the first has left."""

import select

from drivers.mavlink.link import Listener, StreamLink


class SoleClient:
    """See the module.

    Parameters
    ----------
    listener : Listener
        Ours from now on.

    Attributes
    ----------
    connections : int
        Clients so far that were let in.
    """

    datagrams = False
    gone = False

    def __init__(self, listener: Listener) -> None:
        self.url, self.port = listener.url, listener.port
        self.connections = 0
        self._listener = listener
        self._client: StreamLink | None = None
        self._epoll = select.epoll()
        self._epoll.register(listener.fileno(), select.EPOLLIN)

    @property
    def refused(self) -> int:
        """Clients that were turned away."""
        return self._listener.turned_away

    def fileno(self) -> int:
        """Descriptor to wait on for reading; constant."""
        return self._epoll.fileno()

    def ready(self) -> bool:
        """Whether there is a client."""
        return self._client is not None and self._client.ready()

    def receive(self) -> bytes:
        """Bytes that have arrived of the client that is there, or has just come; at most one chunk."""
        there = {fd for fd, _ in self._epoll.poll(0)}
        if self._listener.fileno() in there:
            self._let_in()
        if self._client is None:
            return b""
        data = self._client.receive()
        if self._client.gone:
            self._drop()
        return data

    def heard(self) -> None:
        """There is but one peer: nothing to do."""

    def send(self, frame: bytes) -> bool:
        """Send a whole frame; False when there is no client, or it is still busy with an earlier frame."""
        return self._client is not None and self._client.send(frame)

    def close(self) -> None:
        """Give everything back."""
        self._drop()
        self._epoll.close()
        self._listener.close()

    def _let_in(self) -> None:
        room = 1 if self._client is None or self._client.left else 0
        for client in self._listener.accept(room, 1):  # the next one may have waited for this one to leave
            self._drop()
            self._client = client
            self.connections += 1
            self._epoll.register(client.fileno(), select.EPOLLIN)

    def _drop(self) -> None:
        if self._client is not None:
            self._epoll.unregister(self._client.fileno())
            self._client.close()
        self._client = None
