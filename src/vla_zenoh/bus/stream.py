"""A stream that a node receives: its subscription, the filter of its writer, and its records."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import zenoh

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample, ZenohRing
from vla_zenoh.bus.node import Node
from vla_zenoh.keys import Kind
from vla_zenoh.types import SingleWriterFilter, Stamped

Record = TypeVar("Record")
Buffer = TypeVar("Buffer", bound=CallbackRing | ZenohRing)


class Stream(Generic[Record, Buffer]):
    """Records on one key, from one writer at a time; decoded when they are asked for.

    What is rejected is counted and reported, see `Node.decode`.

    Args:
        node, key: who subscribes, and to what.
        kind: of the records.
        buffer: keeps the samples until they are asked for.
        silence_s: after this silence of the writer another one is accepted.
        quality: kind of the key; images may have a connection of their own.
        read: decodes a sample that is no record of msgpack, as an image; it raises a `CodecError`.

    Raises:
        SessionError: the router does not answer at the port for images.
    """

    def __init__(
        self,
        node: Node,
        key: str,
        kind: type[Record],
        buffer: Buffer,
        silence_s: float,
        *,
        quality: Kind = Kind.STATE,
        read: Callable[[zenoh.Sample], Record] | None = None,
    ) -> None:
        self._node, self._kind, self._read = node, kind, read
        self.writer = SingleWriterFilter(silence_s)
        self.buffer = buffer
        node.subscribe(key, buffer, quality)

    def decode(self, arrival: ReceivedSample) -> Stamped[Record] | None:
        """The record of a sample of this stream; None: it was rejected."""
        return self._node.decode(self._kind, arrival, self.writer, read=self._read)

    def newest(self) -> Stamped[Record] | None:
        """The newest record that arrived since the last call, whatever other writers publish."""
        for arrival in reversed(self.buffer.drain()):
            found = self.decode(arrival)
            if found is not None:
                return found
        return None

    def restart(self) -> None:
        """Drop the samples that wait, and accept the next of any writer: the last one is gone."""
        self.buffer.drain()
        self.writer.release()

    def close(self) -> None:
        """End the subscription."""
        self._node.unsubscribe(self.buffer)
