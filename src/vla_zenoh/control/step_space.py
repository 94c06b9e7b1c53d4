"""Spaces in which the steps of a chunk are added up: poses of the TCP, or joints.

The planner asks the same of both: what a step asks for, how far that is, where its limits end it,
and how the arm's kinematics bound it. So it does not know which of them it plans in. Steps (n, D)
are in a space's own order.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.actions import covered_step, step_joints
from vla_zenoh.control.commander_io import StateHistory
from vla_zenoh.control.joint_space import JointBounds
from vla_zenoh.control.limits import BoundedStep, LimitHit, bound_step, full_speed_s
from vla_zenoh.control.plan_timeline import Goal, JointGoal, joint_goal
from vla_zenoh.control.policy_check import ROUNDING, Rejection
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.so3 import interpolate, pose_distance, pose_of
from vla_zenoh.policy import ActionSpec
from vla_zenoh.profile import Limits
from vla_zenoh.types import FloatArray, JointState, PoseState

Search = Generator[None, None, BoundedStep]
"""Bounds a step by the arm's kinematics, in pieces; yields before every evaluation of the arm."""


class PoseSteps:
    """Steps of the TCP's pose.

    Args:
        limits: of a step.
        reach: bounds steps by the arm's kinematics; None: there are none.
        states: poses that were measured.
        gap_ns: a state measured longer before a time does not count for it.
    """

    def __init__(
        self,
        limits: Limits,
        reach: ReachabilityFilter | None,
        states: StateHistory[PoseState],
        gap_ns: int,
    ) -> None:
        self._limits = limits
        self._reach = reach
        self._states = states
        self._gap_ns = gap_ns

    def origin(self, goal: Goal) -> Goal:
        """`goal` in this space, where the first step can be added to it."""
        return goal

    def measured(self, t_ns: int, width_m: float) -> Goal | None:
        """Where the arm was measured at `t_ns`; None: nowhere near that time."""
        found = self._states.around(t_ns, self._gap_ns)
        if found is None:
            return None
        before, after, share = found
        pose = pose_of(before)
        return Goal(interpolate(pose, pose_of(after), share) if share else pose, width_m)

    def ordered(self, action: ActionSpec, steps: FloatArray) -> FloatArray:
        """Steps of a chunk in the order of this space."""
        return steps

    def slides(self, action: ActionSpec) -> NDArray[np.bool_]:
        """(n,) which of the joints in the columns of a chunk slide."""
        return np.zeros(action.arm_size, bool)

    def far_target(self, action: ActionSpec, steps: FloatArray, base: Goal) -> Rejection | None:
        """Why targets are too far away to be intended, besides what `validate_steps` finds."""
        return None

    def asked(
        self, action: ActionSpec, numbers: FloatArray, start: Goal, base: Goal, width_m: float
    ) -> Goal:
        """The end of a step from `start` as its numbers say, with a gripper width.

        `base`: W_0 of its plan.
        """
        pose, response = covered_step(action, numbers, start.pose, base.pose, start.response)
        return Goal(pose, width_m, response=response)

    def way(self, start: Goal, end: Goal) -> tuple[float, float, float]:
        """Length of a step in m and in rad, and the time (s) that it takes at full speed."""
        far_m, far_rad = pose_distance(start.pose, end.pose)
        return far_m, far_rad, full_speed_s(self._limits, start.pose, end.pose)

    def within_step(
        self, action: ActionSpec, start: Goal, asked: Goal
    ) -> tuple[Goal, list[LimitHit]]:
        """`asked` within the limits of one step from `start`, and the limits that acted."""
        pose, hits = bound_step(self._limits, start.pose, asked.pose)
        return replace(asked, pose=pose), hits

    def search(self, start: Goal, end: Goal, dt_s: float) -> Search | None:
        """The search for the end of a step that the arm can do; None: no kinematics."""
        if self._reach is None:
            return None
        return self._reach.bound_in_pieces(start.pose, end.pose, dt_s, start.joints_rad)


class JointSteps:
    """Steps of the joints, in the order of the kinematics; its methods are those of `PoseSteps`.

    Args:
        bounds: of the joints.
        reach: knows the joints of a pose.
        states: joints that were measured.
        gap_ns: as for `PoseSteps`.
    """

    def __init__(
        self,
        bounds: JointBounds,
        reach: ReachabilityFilter,
        states: StateHistory[JointState],
        gap_ns: int,
    ) -> None:
        self._bounds = bounds
        self._reach = reach
        self._states = states
        self._gap_ns = gap_ns

    def origin(self, goal: Goal) -> JointGoal:
        """Of a pose: the joints with the elbow that the arm has at this moment."""
        if isinstance(goal, JointGoal):
            return goal
        joints_rad = self._reach.joints_at(goal.pose)
        return joint_goal(self._bounds.kinematics, joints_rad, goal.width_m)

    def measured(self, t_ns: int, width_m: float) -> Goal | None:
        arm = self._bounds.kinematics
        found = self._states.around(t_ns, self._gap_ns)
        if found is None:
            return None
        before, after, share = found
        try:
            before_rad, after_rad = arm.joints_of(before), arm.joints_of(after)
        except RecordError:
            return None
        return joint_goal(arm, before_rad + share * (after_rad - before_rad), width_m)

    def ordered(self, action: ActionSpec, steps: FloatArray) -> FloatArray:
        return self._bounds.in_chain_order(action, steps)

    def slides(self, action: ActionSpec) -> NDArray[np.bool_]:
        return self._bounds.kinematics.slides

    def far_target(self, action: ActionSpec, steps: FloatArray, base: Goal) -> Rejection | None:
        if not action.targets:
            return None
        return self._bounds.far_out_of_range(action, steps, self.origin(base).joints_rad)

    def asked(
        self, action: ActionSpec, numbers: FloatArray, start: Goal, base: Goal, width_m: float
    ) -> Goal:
        start_rad, base_rad = self.origin(start).joints_rad, self.origin(base).joints_rad
        arm = self._bounds.kinematics
        asked_rad = step_joints(action, numbers, start_rad, base_rad, arm.endless)
        return joint_goal(arm, asked_rad, width_m)

    def way(self, start: Goal, end: Goal) -> tuple[float, float, float]:
        start_rad = self.origin(start).joints_rad
        way_rad = self.origin(end).joints_rad - start_rad
        full_s = self._bounds.full_speed_s(start_rad, way_rad)
        return *self._bounds.ways(start_rad, way_rad), full_s

    def within_step(
        self, action: ActionSpec, start: Goal, asked: Goal
    ) -> tuple[Goal, list[LimitHit]]:
        """One that is a target has been shortened on the approach to it."""
        if action.targets:
            return asked, []
        far_m, far_rad, _ = self.way(start, asked)
        limits = self._bounds.limits
        part, hits = 1.0, list[LimitHit]()
        for name, far, most in (
            ("step_m", far_m, limits.step_m),
            ("step_rad", far_rad, limits.step_rad),
        ):
            if far > most * (1 + ROUNDING):
                hits.append(LimitHit(name, far, most))
                part = min(part, most / far)
        if not hits:
            return asked, hits
        return replace(start.between(asked, part), width_m=asked.width_m), hits

    def search(self, start: Goal, end: Goal, dt_s: float) -> Search | None:
        self._reach.cost = 1
        start_rad = self.origin(start).joints_rad
        return self._bounds.bound_in_pieces(start_rad, self.origin(end).joints_rad)


StepSpace = PoseSteps | JointSteps
"""What a chunk is planned in."""
