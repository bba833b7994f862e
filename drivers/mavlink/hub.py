"""All links of a component: each with an endpoint, a TCP server with one for each client, none of which waits for another."""

import select
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import count
from pathlib import Path
from typing import Any

from drivers.logs.tlog import TlogWriter
from drivers.mavlink.endpoint import Endpoint
from drivers.mavlink.link import CLIENTS, Link, Listener, open_link
from drivers.mavlink.options import LinkOptions
from drivers.mavlink.signing import Signer
from drivers.mavlink.station import Station

_AGAIN_S = 0.5
"""When to look again at the latest."""
_NAMED, _NUMBERS = ("sent", "received", "refused"), ("bad_data", "dropped", "lost")
Tally = dict[str, Any]
"""Counters of a link: counts by name, and numbers."""


class Hub:
    """See the module; the caller waits on its `fileno` and says what time it is.

    Parameters
    ----------
    station : Station
        What all links share.
    links : sequence of LinkOptions
        What to open.
    signer : Signer, optional
        Signs and checks on every link that does not say otherwise.

    Raises
    ------
    HilError
        A link or a log cannot be opened.
    """

    def __init__(self, station: Station, links: Sequence[LinkOptions], signer: Signer | None = None) -> None:
        self.station = station
        self.endpoints: list[Endpoint] = []
        self.listeners: list[tuple[Listener, LinkOptions]] = []
        self._signer = signer
        self._numbers = count()
        self._logs: Counter[str] = Counter()
        self._tallies: dict[str, Tally] = {}
        """Of each URL: those that have left."""
        self._epoll = select.epoll()
        try:
            for options in links:
                self._open(options)
        except BaseException:
            self.close()
            raise

    def fileno(self) -> int:
        """Descriptor to wait on for reading; constant."""
        return self._epoll.fileno()

    def poll(self, now_s: float) -> float:
        """Serve every link; returns when to come again at the latest."""
        next_s = now_s + _AGAIN_S
        for endpoint in tuple(self.endpoints):
            next_s = min(next_s, endpoint.poll(now_s))
            if endpoint.link.gone:
                self._leave(endpoint)
            elif endpoint.log is not None:
                next_s = min(next_s, now_s + endpoint.log.flush_due())
                if endpoint.log.problem:
                    self.station.tell("error", endpoint.log.problem)
                    endpoint.log = None
        for listener, options in self.listeners:
            taken = sum(endpoint.options is options for endpoint in self.endpoints)
            for link in listener.accept(CLIENTS - taken):
                self._add(link, options)
                next_s = now_s
        return next_s

    def tallies(self) -> dict[str, Tally]:
        """Counters of each URL; the clients of a server are counted together."""
        found = dict(self._tallies)
        for endpoint in self.endpoints:
            found[endpoint.options.url] = total([found[endpoint.options.url], _tally(endpoint)])
        for listener, options in self.listeners:
            found[options.url] |= {"turned_away": listener.turned_away}
        return found

    def close(self) -> None:
        """Give everything back."""
        for endpoint in tuple(self.endpoints):
            self._leave(endpoint)
        for listener, _ in self.listeners:
            listener.close()
        self._epoll.close()

    def _open(self, options: LinkOptions) -> None:
        opened = open_link(options.url)
        self._tallies[options.url] = total([])
        if isinstance(opened, Listener):
            self.listeners.append((opened, options))
            self._epoll.register(opened.fileno(), select.EPOLLIN)
        else:
            self._add(opened, options)

    def _add(self, link: Link, options: LinkOptions) -> None:
        try:
            log = TlogWriter(self._log_path(options.tlog)) if options.tlog else None
        except BaseException:
            link.close()
            raise
        number = next(self._numbers) % 256
        self.endpoints.append(Endpoint(self.station, link, options, self._signer, log, number))
        self._epoll.register(link.fileno(), select.EPOLLIN)

    def _log_path(self, name: str) -> Path:
        """The file itself for the first connection; each has sequences of its own, so the next gets NAME-2."""
        self._logs[name] += 1
        path = Path(name)
        return path if self._logs[name] == 1 else path.with_stem(f"{path.stem}-{self._logs[name]}")

    def _leave(self, endpoint: Endpoint) -> None:
        url = endpoint.options.url
        self._tallies[url] = total([self._tallies[url], _tally(endpoint)])
        self.endpoints.remove(endpoint)
        self._epoll.unregister(endpoint.link.fileno())
        endpoint.close()
        endpoint.link.close()
        if endpoint.log is not None:
            endpoint.log.close()


def total(tallies: Iterable[Tally]) -> Tally:
    """The counters of several links together."""
    every = tuple(tallies)
    named: Tally = {key: dict(sum((Counter(one[key]) for one in every), Counter[str]())) for key in _NAMED}
    return named | {key: sum(one[key] for one in every) for key in _NUMBERS}


def _tally(endpoint: Endpoint) -> Tally:
    return {key: getattr(endpoint, key) for key in (*_NAMED, *_NUMBERS)}
