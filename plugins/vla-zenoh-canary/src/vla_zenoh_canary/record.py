"""The file of a canary: its figures, and what a promotion replaced."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from vla_zenoh.errors import OutputError, RecordError
from vla_zenoh.lab.durable import write_whole, writing
from vla_zenoh_canary.figures import RobotFigures


@dataclass(frozen=True)
class Promoted:
    """A robot that obeys the canary since `at_ns` (wall clock).

    Args:
        before: the worker that it obeyed.
        counters: of its command node, then.
    """

    before: str
    at_ns: int
    counters: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class CanaryRecord:
    """A canary.

    Args:
        new: the worker.
        measured_ns: when its figures were complete (wall clock).
        robots: robot -> figures.
        promoted: robot -> what the promotion replaced; a robot that was taken back is not here.
    """

    new: str
    measured_ns: int
    robots: dict[str, RobotFigures]
    promoted: dict[str, Promoted] = field(default_factory=dict)


def read_record(path: Path) -> CanaryRecord:
    """Read a file of `vla-zenoh canary watch`.

    Raises:
        RecordError: there is none, or it is none; says what to do.
    """
    again = "write one with `vla-zenoh canary watch WORKER --output FILE`"
    try:
        return msgspec.json.decode(path.read_bytes(), type=CanaryRecord)
    except OSError as error:
        raise RecordError(f"figures_missing: {path}: {error.strerror}; {again}") from error
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise RecordError(f"figures_missing: {path} has no figures: {error}; {again}") from error


def write_record(path: Path, record: CanaryRecord) -> None:
    """Write the file.

    Raises:
        OutputError: it cannot be written.
    """
    text = msgspec.json.format(msgspec.json.encode(record), indent=2)
    with writing(path, OutputError):
        write_whole(path, text + b"\n")
