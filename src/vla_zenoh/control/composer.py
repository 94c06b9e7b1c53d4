"""A chunk becomes a plan: its steps as goals, each within what is allowed and what the arm can."""

from __future__ import annotations

from vla_zenoh.control.acceptance import Refusal
from vla_zenoh.control.actions import step_pose, step_width
from vla_zenoh.control.compose import Goal, GoalTimeline, Plan
from vla_zenoh.control.limits import LimitHit, bound_step
from vla_zenoh.control.ports import Outputs
from vla_zenoh.control.reach import Shadow
from vla_zenoh.control.slowdown import Slowdown
from vla_zenoh.errors import RecordError
from vla_zenoh.policy import ActionSpec
from vla_zenoh.profile import REFUSE_FACTOR, Profile
from vla_zenoh.types import ActionChunk, Cause, FloatArray, Stamped

ROUNDING_S = 1e-6
BOUND_AHEAD = 8
"""Steps of a chunk that are checked against the arm at once; the rest when they come due."""


class Composer:
    """See the module.

    Args:
        profile: limits, and what is done with a step beyond them.
        reach: the arm's kinematic shadow; None: only steps and workspace are bounded.
    """

    def __init__(self, profile: Profile, reach: Shadow | None) -> None:
        self._limits = profile.limits
        self._refusing = profile.limits.out_of_bounds == "refuse"
        self._open_loop_s = profile.timing.max_open_loop_s
        self._max_width_m = profile.robot.gripper.max_width_m
        self._reach = reach
        self._pace = profile.composition.pace

    def compose(
        self, chunk: Stamped[ActionChunk], action: ActionSpec, timeline: GoalTimeline, out: Outputs
    ) -> Plan | Refusal:
        """The plan of `chunk` on top of what was asked for when its observation was taken.

        Steps later than ``timing.max_open_loop_s`` are left out: whoever made them saw nothing of
        what the arm will have met by then.
        """
        record = chunk.record
        steps, lasts_s = record.steps, len(record.steps) * action.dt_s
        hits: list[LimitHit] = []
        if lasts_s > self._open_loop_s + ROUNDING_S:
            steps = steps[: max(1, int((self._open_loop_s + ROUNDING_S) / action.dt_s))]
            hits.append(LimitHit("open_loop", lasts_s, self._open_loop_s))
        done = record.done and len(steps) == len(record.steps)
        standing_on = timeline.in_force(record.observation_stamp_ns)
        before = standing_on.asked_until(record.observation_stamp_ns)
        goals: list[Goal] = []
        for step in steps:
            try:
                asked = step_pose(action, step, before.pose)
                width_m = step_width(action, step, before.width_m, self._max_width_m)
            except RecordError as error:
                return Refusal("meaning", str(error))
            pose, acted = bound_step(self._limits, before.pose, asked)
            for hit in acted:
                if hit.fatal:
                    return Refusal(
                        hit.name,
                        f"a step of {hit.value:.4g} is over {REFUSE_FACTOR:g} times its "
                        "limit; is its unit right?",
                        hit.value,
                        hit.limit,
                    )
            joints_rad: FloatArray | None = None
            slower: Slowdown | None = None
            if self._reach is not None and (len(goals) < BOUND_AHEAD or self._refusing):
                pose, cut = self._reach.bound(before.pose, pose, action.dt_s, before.joints_rad)
                acted = [*acted, *cut]
                joints_rad, slower = self._reach.joints_rad, self._reach.slowdown
            if acted and self._refusing:
                return Refusal(
                    acted[0].name, "out of bounds, and the profile says refuse", *acted[0][1:3]
                )
            hits += acted
            width_m = before.width_m if width_m is None else width_m
            before = Goal(pose, width_m, joints_rad, slower)
            goals.append(before)
        out.shortened(hits)
        plan = Plan(
            max(chunk.header.stamp_wall_ns, record.observation_stamp_ns),
            record.observation_stamp_ns,
            max(int(action.dt_s * 1e9), 1),
            goals,
            _cause(chunk),
            len(goals) if self._reach is None or self._refusing else min(len(goals), BOUND_AHEAD),
            record.episode,
            done=done,
            soonest=(action.pace if self._pace == "spec" else self._pace) == "soonest",
        )
        if standing_on.episode == record.episode:
            plan.begun = standing_on.steps_asked_until(record.observation_stamp_ns)
            if done and standing_on.done:  # it only says the last of its steps again
                plan.most = min(standing_on.begun + len(standing_on.goals), standing_on.most)
        return plan

    def bound_until(self, plan: Plan, index: int, out: Outputs) -> None:
        """Bound those goals of `plan` up to `index` that were left for when they are due.

        What is cut off is known to every later goal.
        """
        if self._reach is None or plan.cause is None or index < plan.bounded:
            return
        for due in range(plan.bounded, index + 1):
            before, asked = plan.goals[due - 1], plan.goals[due]
            pose, cut = self._reach.bound(
                before.pose, asked.pose, plan.dt_ns / 1e9, before.joints_rad
            )
            goal = Goal(pose, asked.width_m, self._reach.joints_rad, self._reach.slowdown)
            if cut:
                plan.shift_rest(due, goal, self._limits)
                out.shortened(cut)
            else:
                plan.goals[due] = goal
        plan.bounded = index + 1


def _cause(chunk: Stamped[ActionChunk]) -> Cause:
    record = chunk.record
    return Cause(
        record.worker,
        chunk.header.seq,
        record.observation_stamp_ns,
        record.observed_ns,
        record.inference_start_ns,
        record.inference_end_ns,
        chunk.header.stamp_wall_ns,
        chunk.received_ns,
    )
