"""What goes over the MAVLink links, in shared memory: written by the publisher, read by whoever shows it."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from drivers.mavlink.hub import Tally
from drivers.mavlink.messages import KINDS
from drivers.mavlink.options import LinkOptions
from hil.ring import Shared

_COLUMNS = ("sent", "received", "refused", "bad", "dropped", "lost")


class LinkStats:
    """Counters of each link, and how often each message was sent; picklable to a spawned process.

    Parameters
    ----------
    links : iterable of LinkOptions
        The links; those to the same URL are counted together, and so are the clients of a server.
    """

    def __init__(self, links: Iterable[LinkOptions], shared: Shared | None = None) -> None:
        self._options = tuple(links)
        self.urls = urls = tuple(dict.fromkeys(one.url for one in self._options))
        self._shared = shared or Shared(8 * max(1, len(urls) * (len(_COLUMNS) + len(KINDS))))
        table = np.frombuffer(self._shared.memory, np.int64, len(urls) * (len(_COLUMNS) + len(KINDS)))
        self._table = table.reshape(len(urls), len(_COLUMNS) + len(KINDS))

    def __reduce__(self) -> Any:
        return LinkStats, (self._options, self._shared)

    def tell(self, tallies: Mapping[str, Tally]) -> None:
        """Say what the links have counted, by URL."""
        for row, url in zip(self._table, self.urls, strict=True):
            one = tallies[url]
            named = (sum(one[key].values()) for key in ("sent", "received", "refused"))
            row[: len(_COLUMNS)] = *named, one["bad_data"], one["dropped"], one["lost"]
            row[len(_COLUMNS) :] = [one["sent"].get(name, 0) for name in KINDS]

    def links(self) -> list[dict[str, int | str]]:
        """url, sent, received, refused, bad, dropped, lost of each link."""
        return [
            {"url": url} | dict(zip(_COLUMNS, row[: len(_COLUMNS)].tolist(), strict=True))
            for url, row in zip(self.urls, self._table, strict=True)
        ]

    def sent(self) -> dict[str, int]:
        """How often each message was sent, over all links."""
        return dict(zip(KINDS, self._table[:, len(_COLUMNS) :].sum(axis=0).tolist(), strict=True))
