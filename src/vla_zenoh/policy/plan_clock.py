"""Plan time: wall time at the speed override.

The command node counts the steps of a chunk in it, and so does whoever tells what was executed.

The first step of a chunk begins at its observation, later by the time until its publication in
which no step of an earlier chunk was left (`idle_time`). The arm stood then, and the observation
shows what it still showed at the publication. So no step of a first chunk, or of one after a pause,
is skipped because its inference took time.

Of a chunk that is replaced as much was executed as it had time for, so the speed that a model asks
for does not depend on how often it is asked. A chunk of one delta has no speed, it is a step: all
of it was executed, however soon it is replaced (`least_steps`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vla_zenoh.policy.spec import ActionSpec

HISTORY_NS = 15_000_000_000
"""Observations are rejected long before they are this old."""
FOREVER_NS = 1 << 62
"""A time that does not come."""


def idle_time(begin: float, end: float, runs: Iterable[tuple[float, float]]) -> float:
    """Time from `begin` to `end` in which no chunk was executed.

    Args:
        begin: an observation, in plan time.
        end: the publication of its chunk, in plan time.
        runs: publication and end of the last step of earlier chunks, oldest first; each is replaced
            by the next.
    """
    idle, replaced = end - begin, end
    for published, over in reversed([*runs]):
        idle -= max(min(over, replaced) - max(published, begin), 0.0)
        replaced = min(replaced, published)
    return max(idle, 0.0)


def least_steps(action: ActionSpec, steps: int) -> float:
    """How many of the `steps` of a chunk are executed at least, once it is in force."""
    meant = [each.action for each in action.parts] or [action]
    return 1.0 if steps == 1 and any(each.kind != "velocity" for each in meant) else 0.0


class PlanClock:
    """Plan time as a function of wall time (both ns): its rate is the speed override.

    At the beginning, `now_ns`, plan time is wall time.
    """

    def __init__(self, override: float = 1.0, now_ns: int = 0) -> None:
        self._marks: list[tuple[int, int, float]] = [(now_ns, now_ns, override)]

    @property
    def override(self) -> float:
        """Plan seconds per wall second, 0 to 1."""
        return self._marks[-1][2]

    def set(self, override: float, now_ns: int) -> None:
        """Set the rate of plan time from `now_ns` on."""
        self._marks.append((now_ns, self.at(now_ns), override))
        while len(self._marks) > 1 and self._marks[1][0] < now_ns - HISTORY_NS:
            del self._marks[0]

    def at(self, wall_ns: int) -> int:
        """Plan time at a wall time: of the last seconds, or later at the present override."""
        before = (mark for mark in reversed(self._marks) if mark[0] <= wall_ns)
        since_ns, plan_ns, override = next(before, self._marks[0])
        passed_ns = wall_ns - since_ns
        return plan_ns + (passed_ns if override == 1.0 else round(override * passed_ns))

    def wall_at(self, plan_ns: int) -> int:
        """Wall time at which plan time will be `plan_ns`; `FOREVER_NS` at override 0."""
        since_ns, base_ns, override = self._marks[-1]
        if override <= 0.0:
            return FOREVER_NS
        return since_ns + round((plan_ns - base_ns) / override)
