"""The newest record of some streams of a robot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import zenoh

from vla_zenoh.bus.buffers import LatestSample, ReceivedSample, bytes_of, header_of
from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError, NodeError
from vla_zenoh.types import Header

Record = TypeVar("Record")


class StreamSlot(LatestSample):
    """The newest sample of a stream; reading does not consume it."""

    @property
    def arrival(self) -> ReceivedSample | None:
        """The sample and its time of arrival; None before the first."""
        return self._arrivals[0] if self._arrivals else None

    @property
    def mono_s(self) -> float:
        """When it was received, by the monotonic clock; 0 before the first."""
        return self.arrival.mono_ns / 1e9 if self.arrival else 0.0

    def payload(self) -> bytes:
        """Its bytes, empty before the first."""
        return bytes_of(self.arrival.sample.payload) if self.arrival else b""

    def read(self, kind: type[Record]) -> tuple[Header, Record]:
        """Its header and record. Raises NodeError: nothing was received, or no such record."""
        arrival = self.arrival
        if arrival is None:
            raise NodeError(f"no {kind.__name__} received")
        try:
            return header_of(arrival.sample), records.decode(kind, bytes_of(arrival.sample.payload))
        except CodecError as error:
            raise NodeError(f"{kind.__name__}: {error}") from error


class NewestRecords:
    """Subscribes to streams and keeps the newest record of each.

    Args:
        session: an open session; the caller closes it.
        keys: type of record -> key.
    """

    def __init__(self, session: zenoh.Session, keys: Mapping[type[Any], str]) -> None:
        self._slots = {kind: StreamSlot() for kind in keys}
        self._subscribers = [
            self._slots[kind].subscribe(session, key) for kind, key in keys.items()
        ]

    def missing(self, since_s: float = 0.0) -> list[str]:
        """Names of the records that were not received after a time (monotonic clock)."""
        return [kind.__name__ for kind, slot in self._slots.items() if slot.mono_s <= since_s]

    def received_s(self, kind: type[Any]) -> float:
        """When the newest record was received, by the monotonic clock; 0 before the first."""
        return self._slots[kind].mono_s

    def read(self, kind: type[Record]) -> tuple[Header, Record]:
        """Header and record received last.

        Raises:
            NodeError: nothing was received, or no such record.
        """
        return self._slots[kind].read(kind)

    def close(self) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()
