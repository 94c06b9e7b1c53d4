"""How a record arrives: its header beside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from vla_zenoh.types.checks import integer, set_field, text


@dataclass(frozen=True, slots=True)
class Header:
    """What stands beside every streamed record.

    Args:
        stamp_wall_ns: time of capture, nanoseconds since the Unix epoch on the writer's clock.
        seq: counts up by one for every record this source writes on this key.
        source: who wrote it: node name and a number that differs after every restart.
    """

    stamp_wall_ns: int
    seq: int
    source: str

    def __post_init__(self) -> None:
        set_field(self, "stamp_wall_ns", integer("stamp_wall_ns", self.stamp_wall_ns))
        set_field(self, "seq", integer("seq", self.seq))
        text("source", self.source, 128)


Record = TypeVar("Record")


@dataclass(frozen=True, slots=True)
class Stamped(Generic[Record]):
    """A record as it arrived.

    Args:
        header: what its writer said of it.
        record: the record.
        received_ns: when it arrived here, same clock as the caller's ``now_ns``.
    """

    header: Header
    record: Record
    received_ns: int
