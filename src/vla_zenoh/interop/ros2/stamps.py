"""builtin_interfaces/Time and plain nanoseconds."""

from __future__ import annotations

from typing import Any

from vla_zenoh.errors import CodecError

SECOND_NS = 1_000_000_000


def to_ns(stamp: Any) -> int:
    """Nanoseconds since the epoch of a builtin_interfaces/Time.

    Raises:
        CodecError: no time: seconds below zero, or a second and more of nanoseconds.
    """
    if stamp.sec < 0 or stamp.nanosec >= SECOND_NS:
        raise CodecError("invalid", f"a stamp of {stamp.sec} s and {stamp.nanosec} ns")
    return stamp.sec * SECOND_NS + stamp.nanosec


def from_ns(stamp_ns: int) -> dict[str, int]:
    """Fields of a builtin_interfaces/Time or Duration."""
    sec, nanosec = divmod(stamp_ns, SECOND_NS)
    return {"sec": sec, "nanosec": nanosec}
