"""The plan of an action chunk, computed and bounded step by step by `ChunkPlanner`."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from dataclasses import dataclass, field

from vla_zenoh.control.controller_response import Response
from vla_zenoh.control.joint_space import BoundedJoints
from vla_zenoh.control.limits import LimitHit, Slowdown
from vla_zenoh.control.plan_timeline import Goal, Plan
from vla_zenoh.control.reachability import BoundedStep
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.policy import ActionSpec
from vla_zenoh.types import FloatArray


@dataclass(slots=True)
class ChunkPlan(Plan):
    """The plan of a chunk, computed and bounded step by step.

    Args:
        action: the meaning of the numbers of a step.
        steps: (n, D).
        base: W_0, the goal that the first step starts from.
        approaches: one of its targets is further away than a step.
        announced: that has been reported.
        first_step_ns: time that its first step has to approach its target; -1: a whole step.
        evaluations: evaluations of the arm spent on it.
        hits: limits that acted on it, each once by name and place, in path order.
        reported: number of those that have been reported.
        current: the step being bounded.
    """

    action: ActionSpec = field(kw_only=True)
    steps: FloatArray = field(kw_only=True)
    base: Goal = field(kw_only=True)
    approaches: bool = False
    announced: bool = False
    first_step_ns: int = -1
    evaluations: int = 0
    hits: list[LimitHit] = field(default_factory=list)
    reported: int = 0
    current: StepBounding | None = None

    @property
    def step_start(self) -> Goal:
        """The goal that the next step to be bounded starts from."""
        return self.goals[self.bounded - 1] if self.bounded else self.base

    @property
    def shifted_goal(self) -> Goal | None:
        """The end of that step, where the leash has shifted it since it was computed."""
        return self.goals[self.bounded] if self.bounded < self.computed else None

    def add_hits(self, hits: Iterable[LimitHit]) -> None:
        """Keep the hits that are new by name and place."""
        for hit in hits:
            if all(hit.name != known.name or hit.where != known.where for known in self.hits):
                self.hits.append(hit)

    def unreported_hits(self) -> list[LimitHit]:
        """The hits added since the last call."""
        hits, self.reported = self.hits[self.reported :], len(self.hits)
        return hits


@dataclass(slots=True)
class StepBounding:
    """A step while it is bounded.

    Args:
        start: the goal it starts from.
        shifted: its end, where that was computed before.
        asked: its end as the numbers say.
        target: its end within the limits of a step.
        width_m: of the gripper.
        hits: limits that acted so far.
        cut: m and rad that they cut off.
        slowdown: of an approach.
        response: at `target`, of a controller that covers only a part of the step.
        search: bounds it by the arm's kinematics, in pieces; None: there are no kinematics.
    """

    start: Goal
    shifted: Goal | None
    asked: Pose
    target: Pose
    width_m: float
    hits: list[LimitHit] = field(default_factory=list)
    cut: float = 0.0
    slowdown: Slowdown | None = None
    response: Response | None = None
    search: Generator[None, None, BoundedStep | BoundedJoints] | None = None
