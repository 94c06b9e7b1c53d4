"""What a node sends and what it misses, for status and `vla-zenoh net`."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Any, Protocol

import zenoh

from vla_zenoh.types import Header

LINKS_PERIOD_S = 5.0
MAX_SENDERS = 256
MAX_LINKS = 8


class Sender(Protocol):
    """Counts what it has written."""

    @property
    def key(self) -> str: ...
    @property
    def seq(self) -> int: ...
    @property
    def sent_bytes(self) -> int: ...


class Traffic:
    """Rates of what is sent, from one report to the next, and records that never arrived.

    Args:
        session: whose links are shown.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._sessions = [session]
        self._reported_s = time.monotonic()
        self._sent: dict[str, tuple[int, int]] = {}
        self._first: dict[tuple[str, str], tuple[int, int]] = {}
        self._lost: dict[tuple[str, str], int] = {}
        self._links: list[str] = []
        self._links_s = -1e9

    def add(self, session: zenoh.Session) -> None:
        """Show the links of this one as well."""
        self._sessions.append(session)

    def heard(self, key: str, header: Header, arrivals: int) -> None:
        """A record was read.

        What a slot dropped by itself is not lost: it arrived. Where several writers share a slot
        this counts too few, never too many.

        Args:
            key: it came on.
            header: its writer's word.
            arrivals: samples that had arrived in its slot by then; 0: nobody counts there.
        """
        who = (key, header.source)
        if arrivals == 0 or (who not in self._first and len(self._first) >= MAX_SENDERS):
            return
        seq, count = self._first.setdefault(who, (header.seq, arrivals))
        missing = (header.seq - seq) - (arrivals - count)
        self._lost[who] = max(missing, self._lost.get(who, 0))

    def sent(self, streams: Iterable[Sender]) -> dict[str, list[float]]:
        """Key -> records and bytes a second since the last call, of those that carried any."""
        now_s = time.monotonic()
        took_s = max(now_s - self._reported_s, 1e-3)
        out: dict[str, list[float]] = {}
        for stream in streams:
            count, size = self._sent.get(stream.key, (0, 0))
            self._sent[stream.key] = (stream.seq, stream.sent_bytes)
            if stream.seq > count:
                rates = ((stream.seq - count) / took_s, (stream.sent_bytes - size) / took_s)
                out[stream.key] = [round(rate, 2) for rate in rates]
        self._reported_s = now_s
        return out

    def lost(self) -> dict[str, int]:
        """Key -> records that were written and never arrived here."""
        out: dict[str, int] = {}
        for (key, _), count in self._lost.items():
            if count:
                out[key] = out.get(key, 0) + count
        return out

    def links(self) -> list[str]:
        """Where this node is connected to, as Zenoh writes it."""
        if time.monotonic() - self._links_s > LINKS_PERIOD_S:
            self._links_s = time.monotonic()
            found = {str(link.dst) for one in self._sessions for link in one.info.links()}
            self._links = sorted(found)[:MAX_LINKS]
        return self._links

    def detail(self, streams: Iterable[Sender]) -> Mapping[str, Any]:
        """For status."""
        return {"sent": self.sent(streams), "lost": self.lost(), "links": self.links()}
