"""One sample to be shown, of a recording or off the wire."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from vla_zenoh.codec import records
from vla_zenoh.errors import CodecError
from vla_zenoh.lab.recording.sample import Sample
from vla_zenoh.types import Header


class ShownSample(Protocol):
    """A sample, decoded when it is asked for. `recording.reader.Entry` is one."""

    @property
    def key(self) -> str: ...
    @property
    def header(self) -> Header | None: ...
    @property
    def received_ns(self) -> int: ...
    @property
    def encoding(self) -> str: ...
    @property
    def kind(self) -> type | None: ...
    @property
    def data(self) -> bytes: ...
    def record(self) -> Any: ...


@dataclass(frozen=True, slots=True)
class Live:
    """A sample off the wire.

    Args:
        sample: as it was heard.
        kind: its record, None where it is none.
    """

    sample: Sample
    kind: type | None

    @property
    def key(self) -> str:
        return self.sample.key

    @property
    def header(self) -> Header | None:
        return self.sample.header

    @property
    def received_ns(self) -> int:
        return self.sample.received_ns

    @property
    def encoding(self) -> str:
        return self.sample.encoding

    @property
    def data(self) -> bytes:
        return self.sample.payload

    def record(self) -> Any:
        """The record, checked.

        Raises:
            CodecError: it is none.
        """
        if self.kind is None:
            raise CodecError("malformed", f"{self.key} carries no record")
        return records.decode(self.kind, self.sample.payload)
