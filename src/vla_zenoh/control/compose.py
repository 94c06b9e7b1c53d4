"""Which goal was in force when: chunks as plans on a time axis.

A chunk whose observation was taken at ``t_o`` asks for waypoints ``W_1 .. W_H``::

    W_0 = G(t_o)                   what was asked for until the observation was taken
    W_k = W_(k-1) o step_k         k = 1 .. H
    in force at t: W_k, k = floor((t - t_o) / dt) + 1, at least 1 and at most H

    G(t) = W_s, s = (t - t_o) / dt, at least 1 and at most H, between two waypoints interpolated

``G`` is the same function of every plan before it. A plan is in force from the moment its chunk was
*published*: an observation taken later shows its effect, so the next delta stands on top of it; one
taken earlier does not, so the next delta replaces it. Nothing is counted twice and nothing is lost,
whatever the latency. Steps whose time has passed when a chunk arrives are skipped, never replayed:
waypoints are sums, so skipping them loses no way.

A chunk that is replaced half-way counts for the time it had, and for its first step at least: the
speed a model asks for is the speed it gets however often it is asked, and a single step is a step.
"""

from __future__ import annotations

from dataclasses import dataclass

from vla_zenoh.control.limits import into_workspace
from vla_zenoh.control.so3 import Pose, between, orthonormal
from vla_zenoh.profile import Limits
from vla_zenoh.types import Cause, FloatArray

HISTORY_NS = 15_000_000_000
"""Observations are refused long before they are this old."""


@dataclass(frozen=True, slots=True)
class Goal:
    """A TCP pose and a gripper width (m) to go to.

    Args:
        pose: of the TCP.
        width_m: of the gripper.
        joints_rad: (n,) a joint solution of the pose, where one was looked for.
    """

    pose: Pose
    width_m: float
    joints_rad: FloatArray | None = None


@dataclass(slots=True)
class Plan:
    """Goals on a time axis.

    Args:
        effective_ns: in force from this time on.
        start_ns: time of the observation; the first step's window begins here.
        dt_ns: length of a step's window.
        goals: one per step.
        cause: the chunk it came from, None for a hold.
        bounded: so many of the goals are known to be within what the arm can do.
    """

    effective_ns: int
    start_ns: int
    dt_ns: int
    goals: list[Goal]
    cause: Cause | None = None
    bounded: int = 0

    def index_at(self, t_ns: int) -> int:
        """Index of the step in force at `t_ns`."""
        return min(max((t_ns - self.start_ns) // self.dt_ns, 0), len(self.goals) - 1)

    def asked_until(self, t_ns: int) -> Goal:
        """What its steps have asked for until `t_ns`, its first step at least."""
        done, part_ns = divmod(t_ns - self.start_ns, self.dt_ns)
        if done < 1:
            return self.goals[0]
        if done >= len(self.goals) or part_ns == 0:
            return self.goals[min(done, len(self.goals)) - 1]
        last, coming, share = self.goals[done - 1], self.goals[done], part_ns / self.dt_ns
        return Goal(
            between(last.pose, coming.pose, share),
            last.width_m + share * (coming.width_m - last.width_m),
        )

    @property
    def end_ns(self) -> int:
        """End of the last step's window."""
        return self.start_ns + len(self.goals) * self.dt_ns


class GoalTimeline:
    """All plans of the last seconds."""

    def __init__(self, goal: Goal, now_ns: int) -> None:
        self._plans: list[Plan] = []
        self.hold(goal, now_ns)

    def hold(self, goal: Goal, now_ns: int) -> None:
        """From now on the goal is to stand at `goal`."""
        self.add(Plan(now_ns, now_ns, 1_000_000_000, [goal]), now_ns)

    def restart(self, goal: Goal, now_ns: int) -> None:
        """Forget everything and stand at `goal`."""
        self._plans.clear()
        self.hold(goal, now_ns)

    def add(self, plan: Plan, now_ns: int) -> None:
        """Put `plan` in force, not before what is there already and not after now."""
        earliest = self._plans[-1].effective_ns if self._plans else plan.effective_ns
        plan.effective_ns = max(earliest, min(plan.effective_ns, now_ns))
        self._plans.append(plan)
        while len(self._plans) > 1 and self._plans[1].effective_ns < now_ns - HISTORY_NS:
            del self._plans[0]

    @property
    def plan(self) -> Plan:
        """The newest plan."""
        return self._plans[-1]

    def at(self, t_ns: int) -> Goal:
        """G(t): what the plan that was in force at `t_ns` had asked for by then."""
        chosen = self._plans[0]
        for plan in reversed(self._plans):
            if plan.effective_ns <= t_ns:
                chosen = plan
                break
        return chosen.asked_until(t_ns)

    def shift_rest(self, index: int, goal: Goal, limits: Limits) -> None:
        """Replace the newest plan's goal `index`, moving the later ones along with it.

        A leash that shortened the goal in force has to be known to every later composition, or
        the cut way would come back. What is moved out of the workspace stays at its border.
        """
        plan = self.plan
        old = plan.goals[index].pose
        way_m = goal.pose.position_m - old.position_m
        turn = old.rotation.T @ goal.pose.rotation
        for later in range(index + 1, len(plan.goals)):
            pose = plan.goals[later].pose
            inside, _ = into_workspace(limits, pose.position_m + way_m)
            plan.goals[later] = Goal(
                Pose(inside, orthonormal(pose.rotation @ turn)), plan.goals[later].width_m
            )
        plan.goals[index] = goal
