"""A chunk becomes a plan: its steps as goals, each within what is allowed and what the arm can.

What one evaluation of the arm costs is known, and how many a step takes is not: one in free space,
some ten where a limit cuts. So every tick has a budget of them. A plan is made step by step and
comes in force when the step that is due is bounded: in the tick in which it came, where nothing is
in its way. Then a few steps are looked ahead. Where one is due before it is bounded, the one before
it stays the goal. Whatever the pieces, the plan is the same.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from vla_zenoh.control.actions import rotation_of, step_pose, step_width
from vla_zenoh.control.chunk_validation import Rejection
from vla_zenoh.control.limits import (
    APPROACH,
    LEAST,
    LimitHit,
    Slowdown,
    bound_step,
    full_speed_s,
    going_on,
)
from vla_zenoh.control.plan_timeline import Goal, GoalTimeline, Plan
from vla_zenoh.control.reachability import Bounded, ReachabilityFilter
from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.so3 import Pose, interpolate, pose_distance
from vla_zenoh.policy import ROTATION_SIZE, ActionSpec
from vla_zenoh.profile import REJECT_FACTOR, Profile
from vla_zenoh.types import (
    QUATERNION_NORM_TOLERANCE,
    ActionChunk,
    Cause,
    FloatArray,
    Stamped,
)

ROUNDING = 1e-6
EVALUATIONS_1_S = 1500.0
"""Evaluations of the arm that may be made in a second of ticks."""
PATIENCE = 24
"""After so many for one chunk it comes in force with the steps that are bounded."""
LOOK_AHEAD = 8
"""Steps that are bounded before they are due."""
BEHIND_S = 0.3
"""An arm is behind its goal by up to this where an approach ends."""


@dataclass(slots=True)
class ChunkPlan(Plan):
    """A plan that is made step by step.

    Args:
        action: what the numbers of a step mean.
        steps: (n, D).
        before: what they stand on, W_0.
        approaches: a target of it is further away than a step,
        announced: and that is told already.
        first_ns: time that its first step has to approach it.
        spent: evaluations made for it.
        hits: limits that acted on it, each once by name and place, the first along the path first.
        told: so many of them are told.
        under_way: the step that is being bounded.
    """

    action: ActionSpec = field(kw_only=True)
    steps: FloatArray = field(kw_only=True)
    before: Goal = field(kw_only=True)
    approaches: bool = False
    announced: bool = False
    first_ns: int = -1
    spent: int = 0
    hits: list[LimitHit] = field(default_factory=list)
    told: int = 0
    under_way: _Step | None = None

    @property
    def start(self) -> Goal:
        """Where the step begins that is bounded next."""
        return self.goals[self.bounded - 1] if self.bounded else self.before

    @property
    def moved(self) -> Goal | None:
        """Where it is to end, where the leash has moved it since it was made."""
        return self.goals[self.bounded] if self.bounded < self.made else None

    def note(self, hits: Iterable[LimitHit]) -> None:
        """Keep what was not met before."""
        for hit in hits:
            if all(hit.name != met.name or hit.where != met.where for met in self.hits):
                self.hits.append(hit)

    def news(self) -> list[LimitHit]:
        """What was kept since the last call."""
        news, self.told = self.hits[self.told :], len(self.hits)
        return news


@dataclass(slots=True)
class _Step:
    """A step while it is bounded.

    Args:
        start: where it begins.
        moved: where it is to end, where it was made before.
        pose: where it is to end by the limits of a step.
        width_m: of the gripper.
        hits: what acted already.
        cut: m and rad that this cut off.
        slowdown: of an approach.
        pieces: the arm's say; None: there are no kinematics.
    """

    start: Goal
    moved: Goal | None
    pose: Pose
    width_m: float
    hits: list[LimitHit] = field(default_factory=list)
    cut: float = 0.0
    slowdown: Slowdown | None = None
    pieces: Generator[None, None, Bounded] | None = None


class ChunkPlanner:
    """See the module.

    Args:
        profile: limits, and what is done with a step beyond them.
        reach: the arm's kinematic shadow; None: only steps and workspace are bounded.
    """

    def __init__(self, profile: Profile, reach: ReachabilityFilter | None) -> None:
        self._limits = profile.limits
        self._refusing = profile.limits.out_of_bounds == "refuse"
        self._open_loop_s = profile.timing.max_open_loop_s
        self._max_width_m = profile.robot.gripper.max_width_m
        self._reach = reach
        self._pace = profile.composition.pace
        self.budget = math.ceil(EVALUATIONS_1_S / profile.timing.command_hz)
        """Evaluations of the arm that a tick may have."""
        self._left = self.budget

    def tick(self) -> None:
        """A tick begins, with a budget of its own."""
        self._left = self.budget

    def begin(
        self, chunk: Stamped[ActionChunk], action: ActionSpec, timeline: GoalTimeline
    ) -> ChunkPlan | Rejection:
        """A plan of `chunk` on top of what was asked for when its observation was taken.

        None of its steps is made yet, see `go_on`. Steps later than ``timing.max_open_loop_s`` are
        left out: whoever made them saw nothing of what the arm will have met by then.
        """
        record = chunk.record
        count = len(record.steps)
        if count * action.dt_s > self._open_loop_s + ROUNDING:
            count = max(1, int((self._open_loop_s + ROUNDING) / action.dt_s))
        done = record.done and count == len(record.steps)
        observed_ns = record.observation_stamp_ns
        standing_on = timeline.in_force(observed_ns)
        before = standing_on.goal_at(observed_ns)
        steps = np.asarray(record.steps[:count], np.float64)
        refusal = self._mistake(action, steps, before)
        if refusal is not None:
            return refusal
        # Between two waypoints the joints and the speed are about those of the coming one.
        near = standing_on.goals[standing_on.index_at(observed_ns)]
        plan = ChunkPlan(
            max(chunk.header.stamp_wall_ns, observed_ns),
            observed_ns,
            max(int(action.dt_s * 1e9), 1),
            [before] * count,
            _cause(chunk),
            0,
            record.episode,
            done=done,
            made=0,
            clock=timeline.clock,
            soonest=(action.pace if self._pace == "spec" else self._pace) == "soonest",
            action=action,
            steps=steps,
            before=Goal(before.pose, before.width_m, _joints(before, near), near.slowdown),
        )
        if count < len(record.steps):
            plan.note([LimitHit("open_loop", len(record.steps) * action.dt_s, self._open_loop_s)])
        if isinstance(standing_on, ChunkPlan) and standing_on.approaches:
            # What goes on is not told again, nor faster the more often a model is asked.
            plan.announced = True
            plan.first_ns = min(plan.dt_ns, max(standing_on.elapsed_ns(observed_ns), 0))
        if standing_on.episode == record.episode:
            plan.begun = standing_on.steps_until(observed_ns)
            if done and standing_on.done:  # it only says the last of its steps again
                plan.most = min(standing_on.begun + len(standing_on.goals), standing_on.most)
        return plan

    def go_on(self, plan: ChunkPlan, now_ns: int) -> Rejection | bool:
        """Make the steps of `plan` up to the one that is due, as far as the budget goes.

        Returns:
            whether it may come in force; where the profile says that what is out of bounds is to
            be refused, all of it is made before that is known.
        """
        until = len(plan.goals) if self._refusing else plan.due_index(now_ns) + 1
        while plan.bounded < until:
            acted = self._make_step(plan)
            if acted is None:
                return plan.spent >= PATIENCE and not self._refusing
            if acted and self._refusing:
                why = "out of bounds, and the profile says refuse"
                return Rejection(acted[0].name, why, *acted[0][1:3])
        return True

    def bound_until(self, plans: Sequence[Plan], now_ns: int) -> list[LimitHit]:
        """Bound the steps of `plans` (the newest last) that are due, then those that soon will be.

        What is cut off is known to every later goal.

        Returns:
            what acted on them since the last call.
        """
        chunks = [plan for plan in reversed(plans) if isinstance(plan, ChunkPlan)]
        for ahead in (0, LOOK_AHEAD):
            for plan in chunks:
                due = plan.due_index(now_ns)
                if plan.action.kind == "absolute" and plan.bounded > due:
                    plan.made = plan.bounded  # the leash moves no pose that is named
                until = min(due + 1 + ahead, len(plan.goals))
                while plan.bounded < until and self._make_step(plan) is not None:
                    pass
        return [hit for plan in chunks for hit in plan.news()]

    # -- one step -----------------------------------------------------------------------------
    def _make_step(self, plan: ChunkPlan) -> list[LimitHit] | None:
        """What acted on the next step of `plan`, once it is bounded; None: the budget is spent."""
        step = plan.under_way
        if step is None or step.start is not plan.start or step.moved is not plan.moved:
            step = plan.under_way = self._ask(plan)
        found: Bounded | None = None
        while step.pieces is not None and found is None:
            if self._left <= 0 or self._reach is None:
                return None
            try:
                next(step.pieces)
            except StopIteration as end:
                found = end.value
            self._left -= self._reach.cost
            plan.spent += self._reach.cost
        index, pose, hits, slower, joints_rad = plan.bounded, step.pose, step.hits, None, None
        if found is not None:
            pose, joints_rad, slower = found.pose, found.joints_rad, found.slowdown
            cut = sum(pose_distance(pose, step.pose)) if found.hits else 0.0
            # What cuts most is told first.
            hits = [*found.hits, *hits] if cut > step.cut else [*hits, *found.hits]
            plan.made = index + 1 if found.hits else max(plan.made, index + 1)
        else:
            plan.made = max(plan.made, index + 1)
        if step.slowdown is not None and (slower is None or step.slowdown.share < slower.share):
            slower = step.slowdown
        most_s = self._limits.lead_m / self._limits.translation.velocity_m_s
        slower = going_on(step.start.slowdown, slower, plan.dt_ns / 1e9, most_s)
        plan.goals[index] = Goal(pose, step.width_m, joints_rad, slower)
        plan.bounded, plan.under_way = index + 1, None
        plan.note(hits)
        return hits

    def _ask(self, plan: ChunkPlan) -> _Step:
        """The next step of `plan` by the limits of a step."""
        start, moved = plan.start, plan.moved
        if moved is not None:
            step = _Step(start, moved, moved.pose, moved.width_m, slowdown=moved.slowdown)
        else:
            numbers = plan.steps[plan.bounded]
            asked = step_pose(plan.action, numbers, start.pose)
            slower: Slowdown | None = None
            if plan.action.kind == "absolute":
                asked, slower = self._approach(plan, start.pose, asked)
            width_m = step_width(plan.action, numbers, start.width_m, self._max_width_m)
            pose, acted = bound_step(self._limits, start.pose, asked)
            cut = sum(pose_distance(pose, asked)) if acted else 0.0
            width_m = start.width_m if width_m is None else width_m
            step = _Step(start, None, pose, width_m, acted, cut, slower)
        if self._reach is not None:
            dt_s = plan.dt_ns / 1e9
            step.pieces = self._reach.bounding(start.pose, step.pose, dt_s, start.joints_rad)
            next(step.pieces)  # up to its first evaluation
        return step

    def _approach(self, plan: ChunkPlan, start: Pose, target: Pose) -> tuple[Pose, Slowdown | None]:
        """How far a step goes to `target`, and how fast: straight and slowly while it is far."""
        limits = self._limits
        far_m, far_rad = pose_distance(start, target)
        steps = max(far_m / limits.step_m, far_rad / limits.step_rad)
        if steps <= 1 + ROUNDING:
            return target, None
        in_m = far_m / limits.step_m >= far_rad / limits.step_rad
        far, step, unit = (far_m, limits.step_m, "m") if in_m else (far_rad, limits.step_rad, "rad")
        plan.approaches = True
        if not plan.announced:
            plan.announced = True
            plan.note([LimitHit(APPROACH, far, step, where=unit)])
        needed_s = max(far_m / limits.approach_m_s, far_rad / limits.approach_rad_s)
        full_s = full_speed_s(limits, start, target)
        share = min(max(full_s / needed_s, LEAST), 1.0)
        has_ns = plan.dt_ns if plan.bounded or plan.first_ns < 0 else plan.first_ns
        part = min(has_ns / 1e9 / needed_s, 1 / steps)
        return interpolate(start, target, part), Slowdown(APPROACH, share, far, step, "", BEHIND_S)

    # -- the whole chunk ----------------------------------------------------------------------
    def _mistake(self, action: ActionSpec, steps: FloatArray, before: Goal) -> Rejection | None:
        """What no step can mean, looked for before any of them is followed."""
        turns = steps[:, 3 : 3 + ROTATION_SIZE[action.rotation]]
        try:
            for step in steps if action.gripper != "none" else ():
                step_width(action, step, before.width_m, self._max_width_m)
            if action.rotation == "quaternion":
                off = np.abs(np.linalg.norm(turns, axis=1) - 1.0)
                for index in (off > 0.9 * QUATERNION_NORM_TOLERANCE).nonzero()[0]:
                    rotation_of(action, turns[index])
        except RecordError as error:
            return Rejection("meaning", str(error))
        limits, ways_m = self._limits, steps[:, :3] * action.position_scale_m
        if action.kind == "absolute":
            return self._out_of_the_world(ways_m)
        if action.rotation == "quaternion":
            most_rad = 2.0 * np.arccos(np.clip(np.abs(turns[:, 3]) - ROUNDING, 0.0, 1.0))
        else:  # three turns, or one: together at most as far as this
            most_rad = np.abs(turns).sum(axis=1)
        far = np.linalg.norm(ways_m, axis=1) > limits.step_m * REJECT_FACTOR * (1 - ROUNDING)
        far |= most_rad > limits.step_rad * REJECT_FACTOR * (1 - ROUNDING)
        for index in far.nonzero()[0]:
            asked = step_pose(action, steps[index], before.pose)
            for hit in bound_step(limits, before.pose, asked)[1]:
                if hit.fatal:
                    return Rejection(
                        hit.name,
                        f"a step of {hit.value:.4g} is over {REJECT_FACTOR:g} times its "
                        "limit; is its unit right?",
                        hit.value,
                        hit.limit,
                    )
        return None

    def _out_of_the_world(self, positions_m: FloatArray) -> Rejection | None:
        """Why absolute targets are no targets of this arm."""
        box, most_m = self._limits.workspace, REJECT_FACTOR * self._limits.step_m
        low, high = np.array([box.x_m, box.y_m, box.z_m]).T
        away_m = np.linalg.norm(positions_m - np.clip(positions_m, low, high), axis=1)
        for index in (away_m > most_m).nonzero()[0]:
            at = ", ".join(f"{value:.4g}" for value in positions_m[index])
            return Rejection(
                "workspace",
                f"a target at ({at}) m, {away_m[index]:.4g} m outside the workspace x {box.x_m} "
                f"y {box.y_m} z {box.z_m}: are its numbers metres (position_scale_m), and is it in "
                "the base frame?",
                float(away_m[index]),
                most_m,
            )
        return None


def _joints(before: Goal, near: Goal) -> FloatArray | None:
    """Joints of a goal, or where to look for them."""
    return near.joints_rad if before.joints_rad is None else before.joints_rad


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
