"""From an action chunk to the goals that the arm follows: validate, plan, bound, enqueue.

`ChunkPlanner.submit` validates a chunk (`vla_zenoh.control.policy_check`) and queues it. `plan`
puts its steps on top of what was asked for when its observation was taken, `bound` shortens each to
its limits and to what the arm can do. `advance` does both with the newest chunk of the queue, and
adds the plan to the `GoalTimeline`; `bound_due` bounds the steps that follow, in time for them.

The cost of one evaluation of the arm is known, their number per step is not: one in free space,
about ten where a limit cuts. So every tick has a budget of evaluations. A plan comes into force as
soon as the step that is due is bounded, in free space before the tick after its arrival. A step
that is due before it is bounded waits: the one before it stays the goal. The plan does not depend
on how the work is divided among ticks.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from vla_zenoh.control.actions import step_width
from vla_zenoh.control.commander_io import StateHistory
from vla_zenoh.control.joint_space import JointBounds
from vla_zenoh.control.limits import (
    APPROACH,
    LEAST_TO_GOAL,
    BoundedStep,
    LimitHit,
    Slowdown,
    keep_slowdown,
    slowest,
)
from vla_zenoh.control.plan_timeline import (
    Goal,
    GoalTimeline,
    Plan,
)
from vla_zenoh.control.policy_check import (
    ROUNDING,
    Lease,
    Rejection,
    validate_chunk,
    validate_steps,
)
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.step_space import JointSteps, PoseSteps, Search, StepSpace
from vla_zenoh.kinematics.so3 import Pose, pose_distance
from vla_zenoh.policy import ActionSpec
from vla_zenoh.policy.plan_clock import least_steps
from vla_zenoh.profile import Profile
from vla_zenoh.types import ActionChunk, Cause, FloatArray, JointState, PoseState, Stamped, Task

MAX_QUEUED = 4
"""Of a burst of chunks only the newest few are kept; the newest valid one is executed."""
EVALUATIONS_1_S = 1500.0
"""Evaluations of the arm per second of ticks."""
PATIENCE = 24
"""After this many evaluations a plan comes into force with the steps bounded so far."""
LOOK_AHEAD_NS = 50_000_000
"""Steps due within this time are bounded before they are: one at a limit takes 7 ms of ticks. Those
after it would mostly be bounded again, since every cut by the leash shifts them."""
BEHIND_S = 0.3
"""At the end of an approach the arm is up to this late."""
OVERTAKEN = Rejection("overtaken", "a newer chunk came before it was planned", quiet=True)
SUPERSEDED = Rejection("superseded", "the arm was stopped or got a new task meanwhile", quiet=True)


class _RejectedError(Exception):
    def __init__(self, rejection: Rejection) -> None:
        super().__init__(rejection.why)
        self.rejection = rejection


class ChunkOutcome(NamedTuple):
    """The end of a chunk's path: it is rejected, or its plan has come into force.

    With the limits that acted on the steps bounded so far.
    """

    chunk: Stamped[ActionChunk]
    rejection: Rejection | None = None
    plan: ChunkPlan | None = None
    hits: Sequence[LimitHit] = ()


@dataclass(slots=True)
class ChunkPlan(Plan):
    """The plan of a chunk, computed and bounded step by step.

    Args:
        action: the meaning of the numbers of a step.
        space: in which the steps are added up.
        steps: (n, D), in its order.
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
    space: StepSpace = field(kw_only=True)
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
        end: its end within the limits of a step.
        hits: limits that acted so far.
        cut: m and rad that they cut off.
        search: bounds it by the arm's kinematics, in pieces; None: there are no kinematics.
    """

    start: Goal
    shifted: Goal | None
    asked: Pose
    end: Goal
    hits: list[LimitHit] = field(default_factory=list)
    cut: float = 0.0
    search: Search | None = None


class ChunkPlanner:
    """Turns action chunks for a part into bounded plans on a timeline, within a budget per tick.

    Without `reach`, the arm's kinematics, only step limits and workspace bound a step.
    """

    def __init__(self, profile: Profile, reach: ReachabilityFilter | None) -> None:
        self._part, self._timing = profile.part, profile.timing
        self._limits = profile.limits
        self._rejecting = profile.limits.out_of_bounds == "refuse"
        self._max_width_m = profile.robot.max_width_m
        self._pace = profile.composition.pace
        self._reach = reach
        self._gap_ns = round(profile.timing.state_timeout_s * 1e9)
        self.poses: StateHistory[PoseState] = StateHistory()
        """Where chunks anchored at the measured pose begin."""
        self.joints: StateHistory[JointState] = StateHistory()
        self._pose_steps = PoseSteps(self._limits, reach, self.poses, self._gap_ns)
        self._joint_steps: JointSteps | None = None
        self.joint_bounds: JointBounds | None = None
        if reach is not None:
            bounds = JointBounds(profile, reach.kinematics, reach.barriers)
            self.joint_bounds = bounds
            self._joint_steps = JointSteps(bounds, reach, self.joints, self._gap_ns)
        self._queue: deque[Stamped[ActionChunk]] = deque()
        self._pending: tuple[Stamped[ActionChunk], list[ChunkPlan]] | None = None
        self.budget = math.ceil(EVALUATIONS_1_S / profile.timing.command_hz)
        """Evaluations of the arm per tick."""
        self._left = self.budget

    def restart(self, pose: Stamped[PoseState], joint: Stamped[JointState] | None) -> None:
        """Start an activation: nothing that was measured before counts."""
        self.poses.restart(pose)
        self.joints.restart(joint)

    @property
    def waiting(self) -> bool:
        """Chunks are queued, or one is being planned."""
        return self._pending is not None or bool(self._queue)

    def begin_tick(self) -> None:
        """Renew the budget of evaluations."""
        self._left = self.budget

    # -- validate -----------------------------------------------------------------------------
    def submit(
        self,
        chunk: Stamped[ActionChunk],
        owner: str | None,
        lease: Lease | None,
        task: Task,
        now_ns: int,
    ) -> ChunkOutcome | None:
        """Validate a chunk and queue it if its worker has the lease, see `validate_chunk`.

        Returns the chunk that was rejected: this one, or the oldest of a full queue.
        """
        rejection = validate_chunk(
            chunk, owner, lease, task, self._timing.max_observation_age_s, now_ns
        )
        if rejection is not None:
            return ChunkOutcome(chunk, rejection)
        if lease is None:
            return None
        oldest = self._queue.popleft() if len(self._queue) == MAX_QUEUED else None
        self._queue.append(chunk)
        return None if oldest is None else ChunkOutcome(oldest, OVERTAKEN)

    # -- all of the path ----------------------------------------------------------------------
    def advance(
        self,
        timeline: GoalTimeline,
        action: ActionSpec,
        episode: int | None,
        earliest_ns: int,
        now_ns: int,
        beside: Sequence[tuple[ChunkPlanner, GoalTimeline]] = (),
    ) -> list[ChunkOutcome]:
        """Continue with the pending chunk, then with the newest of the queue.

        A chunk that arrived meanwhile stands on the pending one, so it is planned when that is in
        force. Of several parts the plans of all come into force at once, and what is rejected for
        one is for all.

        Args:
            timeline: where plans are added.
            action: the meaning of the numbers of all parts, by the lease.
            episode: the current one; None: the arm executes no chunks.
            earliest_ns: no plan comes into force before this time. An arm that holds stands, and so
                do observations of it: the chunks of a burst after a pause replace each other.
            now_ns: wall time.
            beside: planners and timelines of the other parts.
        """
        outcomes: list[ChunkOutcome] = []
        parts = [(self, timeline), *beside]
        while self.waiting:
            chunk, plans = self._pending or (self._queue.pop(), None)
            try:
                if chunk.record.episode != episode:
                    raise _RejectedError(SUPERSEDED)
                if plans is None:
                    plans = [
                        planner.plan(chunk, action, own, earliest_ns) for planner, own in parts
                    ]
                    outcomes += [ChunkOutcome(older, OVERTAKEN) for older in self._queue]
                    self._queue.clear()
                    self._pending = chunk, plans
                ready = [
                    each[0].bound(plan, now_ns) for each, plan in zip(parts, plans, strict=True)
                ]
            except _RejectedError as error:
                self._pending = None
                outcomes.append(ChunkOutcome(chunk, error.rejection))
                continue
            if not all(ready):
                break
            self._pending = None
            hits: list[LimitHit] = []
            for (planner, own), plan in zip(parts, plans, strict=True):
                own.add(plan, now_ns)
                for hit in plan.unreported_hits():
                    hits.append(hit._replace(where=f"{planner._part} {hit.where}".strip()))
            outcomes.append(ChunkOutcome(chunk, None, plans[0], hits))
        return outcomes

    def _rejected(self, rejection: Rejection) -> _RejectedError:
        """With the part that it is about."""
        why = f"{self._part}: {rejection.why}" if self._part else rejection.why
        return _RejectedError(rejection._replace(why=why))

    # -- plan ---------------------------------------------------------------------------------
    def plan(
        self,
        chunk: Stamped[ActionChunk],
        action: ActionSpec,
        timeline: GoalTimeline,
        earliest_ns: int = 0,
    ) -> ChunkPlan:
        """A plan of the part's columns of `chunk` on top of what was asked for at its observation.

        `bound` computes its steps. Steps later than ``timing.max_open_loop_s``
        are left out: the model has seen nothing of what the arm will meet by then.
        """
        record, columns = chunk.record, action.columns(self._part)
        action = action.of(self._part)
        count, open_loop_s = len(record.steps), self._timing.max_open_loop_s
        if count * action.dt_s > open_loop_s + ROUNDING:
            count = max(1, int((open_loop_s + ROUNDING) / action.dt_s))
        done = record.done and count == len(record.steps)
        observed_ns = record.observation_stamp_ns
        published_ns = min(chunk.header.stamp_wall_ns, chunk.received_ns)
        effective_ns = max(published_ns, observed_ns, earliest_ns)
        previous = timeline.in_force(observed_ns)
        base = previous.goal_at(observed_ns)
        space = self._space(action)
        if action.anchor == "measured":
            measured = space.measured(observed_ns, base.width_m)
            if measured is None:
                why = (
                    f"the arm was not measured within {self._gap_ns / 1e9:g} s before its "
                    "observation, which the first step is added to (anchor: measured)"
                )
                raise self._rejected(Rejection("not_measured", why))
            base = measured
        base = space.origin(base)
        steps = space.ordered(action, np.asarray(record.steps[:count, columns], np.float64))
        rejection = validate_steps(
            action, steps, base, self._limits, self._max_width_m, space.slides(action)
        )
        rejection = rejection or space.far_target(action, steps, base)
        if rejection is not None:
            raise self._rejected(rejection)
        # Between two waypoints the joints and the speed are about those of the coming one.
        near = previous.goals[previous.index_at(observed_ns)]
        start_rad = near.joints_rad if base.joints_rad is None else base.joints_rad
        plan = ChunkPlan(
            effective_ns,
            observed_ns,
            max(int(action.dt_s * 1e9), 1),
            [base] * count,
            Cause(
                record.worker,
                chunk.header.seq,
                record.observation_stamp_ns,
                record.observed_ns,
                record.inference_start_ns,
                record.inference_end_ns,
                chunk.header.stamp_wall_ns,
                chunk.received_ns,
            ),
            0,
            record.episode,
            done=done,
            computed=0,
            clock=timeline.clock,
            soonest=(action.pace if self._pace == "spec" else self._pace) == "soonest",
            idle_ns=timeline.idle_ns(observed_ns, effective_ns),
            begin=None if least_steps(action, len(record.steps)) else base,
            action=action,
            space=space,
            steps=steps,
            base=replace(base, joints_rad=start_rad, slowdown=near.slowdown),
        )
        if count < len(record.steps):
            plan.add_hits([LimitHit("open_loop", len(record.steps) * action.dt_s, open_loop_s)])
        if isinstance(previous, ChunkPlan) and previous.approaches:
            # An approach that continues is not reported again, nor is it faster the more often a
            # model is asked.
            plan.announced = True
            plan.first_step_ns = min(plan.dt_ns, max(previous.elapsed_ns(observed_ns), 0))
        if previous.episode == record.episode:
            plan.steps_before = previous.steps_until(observed_ns)
            if done and previous.done:  # the last of its steps are repeated
                plan.steps_total = min(
                    previous.steps_before + len(previous.goals), previous.steps_total
                )
        return plan

    def _space(self, action: ActionSpec) -> StepSpace:
        if action.space == "joint" and self._joint_steps is not None:
            return self._joint_steps
        return self._pose_steps

    # -- bound --------------------------------------------------------------------------------
    def bound(self, plan: ChunkPlan, now_ns: int) -> bool:
        """Bound the steps of `plan` up to the one that is due, as far as the budget goes.

        Returns whether it may come into force. Where the profile rejects steps that are out of
        bounds, all of them are bounded first.
        """
        until = len(plan.goals) if self._rejecting else plan.due_index(now_ns) + 1
        while plan.bounded < until:
            acted = self._bound_step(plan)
            if acted is None:
                return plan.evaluations >= PATIENCE and not self._rejecting
            if acted and self._rejecting:
                why = "out of bounds, and the profile says refuse"
                raise self._rejected(Rejection(acted[0].name, why, *acted[0][1:3]))
        return True

    def bound_due(self, plans: Sequence[Plan], now_ns: int, ahead_ns: int = 0) -> list[LimitHit]:
        """Bound the steps of `plans` (the newest last) that are due, and those of `ahead_ns` more.

        Later goals move with what is cut off. Returns the limits that acted since the last call.
        """
        chunks = [plan for plan in reversed(plans) if isinstance(plan, ChunkPlan)]
        for plan in chunks:
            due = plan.due_index(now_ns)
            if plan.action.targets and plan.bounded > due:
                plan.computed = plan.bounded  # the leash does not shift targets
            until = min(due + 1 + math.ceil(ahead_ns / plan.dt_ns), len(plan.goals))
            while plan.bounded < until and self._bound_step(plan) is not None:
                pass
        return [hit for plan in chunks for hit in plan.unreported_hits()]

    def _bound_step(self, plan: ChunkPlan) -> list[LimitHit] | None:
        """Limits that acted on the next step of `plan`; None: not bounded, the budget is spent."""
        step = plan.current
        if (
            step is None
            or step.start is not plan.step_start
            or step.shifted is not plan.shifted_goal
        ):
            step = plan.current = self._begin_step(plan)
        found: BoundedStep | None = None
        while step.search is not None and found is None:
            if self._left <= 0 or self._reach is None:
                return None
            try:
                next(step.search)
            except StopIteration as last:
                found = last.value
            self._left -= self._reach.cost
            plan.evaluations += self._reach.cost
        index, end, hits = plan.bounded, step.end, step.hits
        pose, joints_rad, slower, state = end.pose, end.joints_rad, end.slowdown, end.response
        plan.computed = max(plan.computed, index + 1)
        if found is not None:
            pose, joints_rad, slower = found.pose, found.joints_rad, slowest(found.slowdown, slower)
            if found.hits:
                cut = sum(pose_distance(pose, end.pose))
                # The limit that cuts most comes first.
                hits = [*found.hits, *hits] if cut > step.cut else [*hits, *found.hits]
                plan.computed = index + 1
        most_s = self._limits.lead_m / self._limits.translation.velocity_m_s
        slower = keep_slowdown(step.start.slowdown, slower, plan.dt_ns / 1e9, most_s)
        if state is not None and hits and step.shifted is None:
            state = state.stopped(step.asked, pose)
        plan.goals[index] = replace(
            end, pose=pose, joints_rad=joints_rad, slowdown=slower, response=state
        )
        plan.bounded, plan.current = index + 1, None
        plan.add_hits(hits)
        return hits

    def _begin_step(self, plan: ChunkPlan) -> StepBounding:
        """The next step of `plan` within the limits of a step, and the search for its end."""
        start, shifted = plan.step_start, plan.shifted_goal
        if shifted is None:
            step = self._asked_step(plan, start)
        else:
            step = StepBounding(start, shifted, shifted.pose, shifted)
        step.search = plan.space.search(start, step.end, plan.dt_ns / 1e9)
        if step.search is not None:
            next(step.search)  # up to its first evaluation
        return step

    def _asked_step(self, plan: ChunkPlan, start: Goal) -> StepBounding:
        action, space = plan.action, plan.space
        numbers = plan.steps[plan.bounded]
        width_m = step_width(action, numbers, start.width_m, self._max_width_m)
        width_m = start.width_m if width_m is None else width_m
        asked = space.asked(action, numbers, start, plan.base, width_m)
        slower: Slowdown | None = None
        if action.targets:
            part, slower = self._approach(plan, *space.way(start, asked))
            if part < 1.0:
                asked = replace(start.between(asked, part), width_m=width_m)
        end, hits = space.within_step(action, start, asked)
        cut = sum(pose_distance(end.pose, asked.pose)) if hits else 0.0
        end = replace(end, slowdown=slower)
        return StepBounding(start, None, asked.pose, end, hits, cut)

    def _approach(
        self, plan: ChunkPlan, far_m: float, far_rad: float, full_s: float
    ) -> tuple[float, Slowdown | None]:
        """The part of a step to a target that is taken; one further than a step is approached."""
        limits = self._limits
        steps = max(far_m / limits.step_m, far_rad / limits.step_rad)
        if steps <= 1 + ROUNDING:
            return 1.0, None
        in_m = far_m / limits.step_m >= far_rad / limits.step_rad
        far, step, unit = (far_m, limits.step_m, "m") if in_m else (far_rad, limits.step_rad, "rad")
        plan.approaches = True
        if not plan.announced:
            plan.announced = True
            plan.add_hits([LimitHit(APPROACH, far, step, where=unit)])
        needed_s = max(far_m / limits.approach_m_s, far_rad / limits.approach_rad_s)
        share = min(max(full_s / needed_s, LEAST_TO_GOAL), 1.0)
        has_ns = plan.dt_ns if plan.bounded or plan.first_step_ns < 0 else plan.first_step_ns
        part = min(has_ns / 1e9 / needed_s, 1 / steps)
        return part, Slowdown(APPROACH, share, far, step, "", BEHIND_S)
