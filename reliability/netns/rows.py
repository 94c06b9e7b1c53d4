"""A fault, and the row that is made of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from netns.stage import Stage


def _always(_: Stage) -> bool:
    return True


def _nothing(_: Stage) -> str:
    return ""


@dataclass(frozen=True, slots=True)
class Fault:
    """Something that goes wrong while the arm moves.

    Args:
        name: for ``--only``.
        about: a sentence for people.
        inject: makes it happen, and may say when that was, on the monotonic clock.
        clear: ends it.
        layout: of `LAYOUTS`.
        needs: why it cannot be done here; empty: it can.
        ever: it is so before the motion begins, and does not come as a surprise.
        seconds: how long it lasts; None: until the motion has come to its end.
        over: it lasts longer than `seconds`, until this says that it is over.
        missing: what would have had to be seen of it and was not; empty: nothing.
        goes_on: the arm is to reach its goal all the same, or not to stand on its way.
        from_fault: recovery counts from the fault itself, which ends without us.
        alone: the robot's side notices by itself, and brakes.
    """

    name: str
    about: str
    inject: Callable[[Stage], float | None]
    clear: Callable[[Stage], None]
    layout: str = "lab"
    needs: str = ""
    ever: bool = False
    seconds: float | None = None
    over: Callable[[Stage], bool] = _always
    missing: Callable[[Stage], str] = _nothing
    goes_on: bool = False
    from_fault: bool = False
    alone: bool = False


@dataclass
class Row:
    """What a fault did. Times are in seconds, None where there is none.

    Args:
        name: of the fault.
        about: likewise.
        did: what the arm did, in words.
        stood_s: from the fault until the arm stood on its way.
        braked_s: the longest it moved on after a chunk that was carried out, or after the fault.
        braked_bound_s: what the watchdog and one Ruckig brake allow of that.
        unheard_s: the longest it moved on after the simulator had last heard a command, and was
            moved on after the command node had last heard of it, by node.
        unheard_bound_s: what the profile's patience and one Ruckig brake allow of that.
        way_mm: how far it went meanwhile.
        acceleration: largest measured, as a share of the limit.
        jerk: largest commanded, likewise.
        recovered_s: from the end of the fault until the arm moved again.
        activated: a person had to activate it.
        off_mm: beside the goal in the end, where it reached one.
        lost: records that were written and never arrived, by reader and key.
        refused: by node and reason.
        news: what the command node and the simulator said of it: node, transition, why.
        wrong: what of our promises it broke.
    """

    name: str
    about: str
    did: str = ""
    stood_s: float | None = None
    braked_s: float | None = None
    braked_bound_s: float | None = None
    unheard_s: dict[str, float] = field(default_factory=dict)
    unheard_bound_s: dict[str, float] = field(default_factory=dict)
    way_mm: float | None = None
    acceleration: float = 0.0
    jerk: float = 0.0
    recovered_s: float | None = None
    activated: bool = False
    off_mm: float | None = None
    lost: dict[str, int] = field(default_factory=dict)
    refused: dict[str, int] = field(default_factory=dict)
    news: list[list[str]] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)
