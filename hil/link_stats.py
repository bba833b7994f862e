"""What goes over the MAVLink links, in shared memory: written by the publisher, read by whoever shows it."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from drivers.mavlink.endpoint import Endpoint
from drivers.mavlink.messages import KINDS
from hil.ring import Shared

_COLUMNS = ("sent", "received", "bad", "dropped")


class LinkStats:
    """Counters of each link, and how often each message was sent; picklable to a spawned process.

    Parameters
    ----------
    urls : tuple of str
        The links.
    """

    def __init__(self, urls: tuple[str, ...], shared: Shared | None = None) -> None:
        self.urls = urls
        self._shared = shared or Shared(8 * max(1, len(urls) * (len(_COLUMNS) + len(KINDS))))
        table = np.frombuffer(self._shared.memory, np.int64, len(urls) * (len(_COLUMNS) + len(KINDS)))
        self._table = table.reshape(len(urls), len(_COLUMNS) + len(KINDS))

    def __reduce__(self) -> Any:
        return LinkStats, (self.urls, self._shared)

    def tell(self, endpoints: Sequence[Endpoint]) -> None:
        """Say what the endpoints have counted, in the order of the links."""
        for row, one in zip(self._table, endpoints, strict=True):
            row[: len(_COLUMNS)] = one.sent.total(), one.received.total(), one.bad_data, one.dropped
            row[len(_COLUMNS) :] = [one.sent[name] for name in KINDS]

    def links(self) -> list[dict[str, int | str]]:
        """url, sent, received, bad, dropped of each link."""
        return [
            {"url": url} | dict(zip(_COLUMNS, row[: len(_COLUMNS)].tolist(), strict=True))
            for url, row in zip(self.urls, self._table, strict=True)
        ]

    def sent(self) -> dict[str, int]:
        """How often each message was sent, over all links."""
        return dict(zip(KINDS, self._table[:, len(_COLUMNS) :].sum(axis=0).tolist(), strict=True))
