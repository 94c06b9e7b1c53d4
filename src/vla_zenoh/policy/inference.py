"""A model, what it is given, and the chunk of what it answers.

A model is a class with a `spec` and ``infer(observation) -> ActionSteps``; `Policy` is the whole
contract.

One that plans from scratch may choose another motion in each chunk, and the arm would jump from one
to the other. Real-time chunking conditions it on the steps in execution (`Committed`): the first
ones can no longer change (frozen), the later ones weigh less and less. See K. Black,
M. Y. Galliker, S. Levine, "Real-Time Execution of Action Chunking Flow Policies", NeurIPS 2025.
Models with ``takes_committed = True`` are called with them; for all others the command node aligns
chunks by observation time and blends them.
"""

from __future__ import annotations

import inspect
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_zenoh.errors import SpecError, in_words
from vla_zenoh.policy.meaning import RotationForm, nearest_turn, toward, unturned, wrapped
from vla_zenoh.policy.plan_clock import PlanClock, idle_time, least_steps
from vla_zenoh.policy.spec import ActionSpec, ModelSpec
from vla_zenoh.types import (
    ActionChunk,
    FloatArray,
    GripperState,
    JointState,
    PoseState,
    PrivilegedState,
    Task,
)

REMEMBERED_LATENCIES = 10
SAME_RAD = 1e-6
"""Rotations this near to each other are interpolated as numbers."""
ALIGNED = 1e-3
"""An observation this close to a step's end (in steps) counts as at its end."""


class ActionSteps(NamedTuple):
    """What `Policy.infer` returns.

    Args:
        steps: (H, D), H at most the declared horizon; anything numpy can read.
        done: the policy reports that the task is finished with these steps.
        raw: intermediate output for debugging, as text and numbers: tokens, normalised actions.
            Shown by ``vla-zenoh inspect``, otherwise unused.
        pictures: camera -> (H, W, 3) RGB uint8 as it went into the network, if the model itself
            changes what it is given (a crop).
    """

    steps: ArrayLike
    done: bool = False
    raw: Mapping[str, Any] | None = None
    pictures: Mapping[str, NDArray[np.uint8]] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """One coherent observation, in the form the spec declares.

    Args:
        stamp_wall_ns: capture time of its oldest image (of its state, without images).
        seq: number of that part.
        images: camera -> (H, W, 3) uint8 in the declared order and size.
        depth: camera -> (H, W) uint16 in counts of the declared unit, and in the declared size.
        joint: arm joints, where asked for.
        pose: TCP pose, where asked for.
        gripper: gripper state, where asked for.
        privileged: state that only a simulated benchmark knows, where asked for; no real robot
            reports it.
        wrench: (6,) N and Nm that the surroundings exert on the arm, as in `PoseState`, where asked
            for.
        effort_nm: (n,) as in `JointState`, where asked for.
        history: earlier observations, oldest first, `ObservationSpec.history` - 1 of them.
        task: prompt, episode and rate.
        robot: its name, for a model that serves several and keeps state of each.
        parts: of a robot of several parts, name -> the same with the state of that part, all of one
            time; the observation itself then has no joint, pose and gripper.
        executed_steps: how many steps of the model's last chunk were executed when it was taken,
            with parts of a step; of a chunk of one delta all of it; None: the arm followed none in
            this episode.
    """

    stamp_wall_ns: int
    seq: int
    task: Task
    images: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    depth: Mapping[str, NDArray[np.uint16]] = field(default_factory=dict)
    joint: JointState | None = None
    pose: PoseState | None = None
    gripper: GripperState | None = None
    privileged: PrivilegedState | None = None
    robot: str = ""
    wrench: FloatArray | None = None
    effort_nm: FloatArray | None = None
    history: tuple[Observation, ...] = ()
    parts: Mapping[str, Observation] = field(default_factory=dict)
    executed_steps: float | None = None

    @property
    def prompt(self) -> str:
        return self.task.prompt

    @property
    def rate_hz(self) -> float:
        return self.task.rate_hz


@runtime_checkable
class Policy(Protocol):
    """A model. Only `spec` and `infer` are needed; the others are called if they are there.

    ``load()`` runs once before the first inference: heavy imports and weights belong there.
    ``reset()`` runs at the start of every episode, ``close()`` when the worker ends.
    ``normalisation_keys``, where a model has it, names the statistics its weights came with:
    `ActionSpec.normalisation` must be one of them.
    ``example_prompts``, if present, names known prompts; the first one makes it move.
    ``takes_committed = True``: it is called as ``infer(observation, committed=...)`` with the
    steps of its last chunk in execution, see `Committed`.
    ``infer_batch(observations)`` answers several robots at once, one answer for each in their
    order, at most ``max_batch`` of them where that is given. `Observation.robot` names the robot of
    each; ``reset`` then takes that name. With ``takes_committed`` it is called as
    ``infer_batch(observations, committed=[...])``.
    """

    @property
    def spec(self) -> ModelSpec: ...

    def infer(self, observation: Observation) -> ActionSteps: ...


def reset_of(policy: Policy, robot: str = "") -> Callable[[], Any] | None:
    """Function that begins an episode of `robot`; None: the model has no ``reset``."""
    reset = getattr(policy, "reset", None)
    if not callable(reset):
        return None
    return partial(reset, robot) if takes_robot(policy) else reset


def takes_robot(policy: Policy) -> bool:
    """Whether the model's ``reset`` takes the name of the robot whose episode begins."""
    reset = getattr(policy, "reset", None)
    return callable(reset) and len(inspect.signature(reset).parameters) > 0


def check_steps(spec: ActionSpec, steps: ArrayLike) -> NDArray[np.float32]:
    """`steps` as finite float32 (H, D) of the declared shape.

    Raises:
        SpecError: says what is wrong and what was declared; its reason is ``dtype``, ``shape``,
            ``horizon`` or ``not_finite``.
    """
    if inspect.iscoroutine(steps):
        steps.close()
        raise SpecError("infer gave a coroutine: declare it with def, not async def", "dtype")
    try:
        given = np.asarray(steps)
    except Exception as error:  # tensors raise anything
        raise SpecError(f"steps are not numbers: {in_words(error)}", "dtype") from error
    if given.dtype.kind not in "iuf":
        raise SpecError(f"steps are not numbers but {given.dtype}", "dtype")
    with np.errstate(over="ignore"):
        array = np.array(given, dtype=np.float32, order="C")
    if array.ndim == 1 and array.shape[0] == spec.dimension:
        array = array[None]
    if array.ndim != 2 or array.shape[1] != spec.dimension:
        raise SpecError(
            f"steps have shape {array.shape}, the spec says (H, {spec.dimension})", "shape"
        )
    if not 1 <= array.shape[0] <= spec.horizon:
        raise SpecError(
            f"a chunk of {array.shape[0]} steps, the spec says 1 to {spec.horizon}", "horizon"
        )
    if not np.isfinite(array).all():
        raise SpecError("steps hold NaN or infinity", "not_finite")
    return array


def standing_step(spec: ActionSpec, last: NDArray[np.float32]) -> NDArray[np.float32]:
    """(D,) the step without motion after `last`, which keeps the gripper as it is."""
    if spec.parts:
        own = [standing_step(each.action, last[spec.columns(each.part)]) for each in spec.parts]
        return np.concatenate(own)
    out = last.copy()
    if spec.kind != "absolute":
        out[: spec.arm_size] = 0.0
        if spec.space == "tcp":
            out[spec.rotation_columns] = unturned(spec.rotation)
    if spec.gripper == "delta_m":
        out[-1] = 0.0
    return out


def make_chunk(
    worker: str,
    spec: ModelSpec,
    observation: Observation,
    steps: NDArray[np.float32],
    done: bool,
    *,
    patience_s: float,
    times_ns: tuple[int, int, int],
) -> ActionChunk:
    """The action chunk of a worker's answer to `observation`.

    Args:
        worker: its name.
        spec: of its model.
        observation: input of the inference.
        steps: checked.
        done: as in `ActionSteps`.
        patience_s: how long the chunk is valid after its last step.
        times_ns: observation complete, start and end of inference, wall clock.
    """
    valid_ns = int(len(steps) * spec.action.dt_s * 1e9) + int(patience_s * 1e9)
    stamp_ns, seq = observation.stamp_wall_ns, observation.seq
    episode, until_ns = observation.task.episode, stamp_ns + valid_ns
    return ActionChunk(
        *(worker, spec.hash, episode, stamp_ns, seq, until_ns, steps, *times_ns, done)
    )


@dataclass(frozen=True, slots=True, eq=False)
class Committed:
    """Steps in execution at the time of an observation, as the spec declares them.

    Args:
        steps: (K, D) float32; the first one starts at the observation, K < horizon.
        frozen: number of them that will have started when the next chunk arrives, at most K.
    """

    steps: NDArray[np.float32]
    frozen: int

    def weights(self, horizon: int) -> NDArray[np.float64]:
        """Weight (horizon,) of each committed step: the soft mask of equation 5 there.

        1 for frozen steps, then falling, 0 where nothing is committed.
        """
        index, overlap = np.arange(horizon), len(self.steps)
        falling = np.clip((overlap - index) / (overlap - self.frozen + 1), 0.0, 1.0)
        soft = falling * np.expm1(falling) / math.expm1(1.0)
        return np.where(index < self.frozen, 1.0, np.where(index < overlap, soft, 0.0))

    def padded(self, horizon: int) -> NDArray[np.float32]:
        """The steps padded with zeros to (horizon, D); the padding has weight 0."""
        out = np.zeros((horizon, self.steps.shape[1]), np.float32)
        out[: len(self.steps)] = self.steps[:horizon]
        return out


@dataclass(frozen=True, slots=True, eq=False)
class _Followed:
    """A chunk that the arm follows. `busy_until`: plan time until which it had other steps."""

    episode: int
    observed_ns: int
    published_ns: int
    busy_until: float
    steps: NDArray[np.float32]

    def begin(self, clock: PlanClock) -> float:
        """Plan time at which its first step begins."""
        seen = clock.at(self.observed_ns)
        return seen + idle_time(seen, clock.at(self.published_ns), [(-math.inf, self.busy_until)])


class ChunkPrefix:
    """Calls a model with what was executed of its last chunk, and with the prefix of the next one.

    Args:
        max_age_s: `max_observation_age_s` of the profile: after a pause (speed override 0) the
            command node drops what an older observation asked for.

    Raises:
        SpecError: it takes the prefix, and its steps are relative to the start of their chunk.
    """

    def __init__(self, policy: Policy, max_age_s: float = math.inf) -> None:
        self._policy, self._action = policy, policy.spec.action
        self._takes = bool(getattr(policy, "takes_committed", False))
        if self._takes and self._action.relative_to == "start":
            raise SpecError(
                "the steps in execution have another start than the next chunk, so a model that "
                "takes them cannot answer relative_to: start; let it answer relative_to: previous, "
                "or absolute poses"
            )
        self._max_age_s = max_age_s
        self._clock: PlanClock | None = None
        self._resumed_ns = 0
        self._latencies_s: deque[float] = deque(maxlen=REMEMBERED_LATENCIES)
        self._last: _Followed | None = None
        self._busy_until = -math.inf
        """Plan time until which the arm has steps to execute of which the worker does not know."""

    def set_task(self, task: Task, stamp_ns: int) -> None:
        """The task in force from `stamp_ns` on, wall clock; oldest first."""
        override, last = task.speed, self._last
        if last and last.episode != task.episode and last.published_ns >= stamp_ns:
            # The command node has rejected it: the arm goes on with what it had before.
            self._last, self._busy_until = None, last.busy_until
        if self._clock is None:
            self._clock = PlanClock(override, stamp_ns)
        if override != self._clock.override:
            if not self._clock.override:
                self._resumed_ns = stamp_ns
            self._clock.set(override, stamp_ns)

    def infer(self, observation: Observation) -> ActionSteps:
        """Infer, with the committed steps if the model takes them."""
        extra: Any = {"committed": self.committed(observation)} if self._takes else {}
        result = self._policy.infer(self.with_progress(observation), **extra)
        return result if isinstance(result, ActionSteps) else ActionSteps(result)

    def published(
        self,
        observation: Observation,
        steps: NDArray[np.float32],
        published_ns: int,
        *,
        obeyed: bool,
    ) -> None:
        """Remember a published chunk.

        Args:
            observation: input of the inference.
            steps: (H, D).
            published_ns: wall clock.
            obeyed: the arm follows this worker; otherwise nothing is committed.
        """
        seen_ns, task = observation.stamp_wall_ns, observation.task
        self._latencies_s.append((published_ns - seen_ns) / 1e9)
        if not obeyed:
            self._last = None
            # How long the chunk of another worker lasts is unknown here.
            self._busy_until = math.inf if task.active else -math.inf
            return
        busy_until = self._busy_until
        if self._last is not None:
            busy_until = self._last.begin(self._plan_time(observation))
            busy_until += len(self._last.steps) * self._action.dt_s * 1e9
        self._last = _Followed(task.episode, seen_ns, published_ns, busy_until, steps)

    def with_progress(self, observation: Observation) -> Observation:
        """The observation with `executed_steps`."""
        return replace(observation, executed_steps=self._executed(observation))

    def _executed(self, observation: Observation) -> float | None:
        last = self._last
        if last is None or last.episode != observation.task.episode:
            return None
        clock = self._plan_time(observation)
        passed_ns = clock.at(observation.stamp_wall_ns) - last.begin(clock)
        executed, count = passed_ns / 1e9 / self._action.dt_s, len(last.steps)
        return min(max(executed, least_steps(self._action, count)), float(count))

    def _plan_time(self, observation: Observation) -> PlanClock:
        return self._clock or PlanClock(observation.task.speed)

    def committed(self, observation: Observation) -> Committed | None:
        """Steps in execution at this observation; None: none."""
        last, had = self._last, self._executed(observation)
        if last is None or had is None:
            return None
        if (self._resumed_ns - last.observed_ns) / 1e9 > self._max_age_s:
            return None
        try:
            left = rest_of(self._action, last.steps, had, _wrapping(self._action, observation))
        except SpecError:  # numbers that are no rotation, which no arm follows
            return None
        if not len(left):
            return None
        late = self._plan_time(observation).override * max(self._latencies_s) / self._action.dt_s
        return Committed(left, min(math.ceil(late - ALIGNED), len(left)))


def _wrapping(spec: ActionSpec, observation: Observation) -> NDArray[np.bool_]:
    """The columns (D,) of a step that are positions of joints within one turn, without an end."""
    found = np.zeros(spec.dimension, bool)
    for part, seen in (observation.parts or {"": observation}).items():
        own, columns = spec.of(part), spec.columns(part)
        if own.kind == "absolute" and own.turns == "wrapped" and seen.joint is not None:
            found[columns][: len(own.joints)] = np.isin(own.joints, seen.joint.endless)
    return found


def rest_of(
    spec: ActionSpec,
    steps: NDArray[np.float32],
    had: float,
    wrapping: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """The steps of a chunk that remain after `had` of them, which may be fractional.

    They follow the same path, resampled from the observation on: deltas are weighted sums of two
    neighbours, absolute poses and the columns that are `wrapping` (D,) interpolate between two, on
    the shortest turn. Absolute gripper numbers keep their current value.
    """
    whole = math.floor(had + ALIGNED)
    share = max(had - whole, 0.0)
    if share < ALIGNED:
        return steps[whole:].copy()
    first, second = steps[whole:-1].astype(np.float64), steps[whole + 1 :].astype(np.float64)
    if wrapping is not None:
        second[:, wrapping] = nearest_turn(second[:, wrapping], first[:, wrapping])
    mixed = (1.0 - share) * first + share * second
    if wrapping is not None:
        mixed[:, wrapping] = wrapped(mixed[:, wrapping])
    if spec.space == "tcp" and (spec.kind == "absolute" or spec.rotation_form.size > 3):
        turns = spec.rotation_columns
        each = zip(first[:, turns], second[:, turns], strict=True)
        mixed[:, turns] = [_between(spec.rotation_form, a, b, share) for a, b in each]
    if spec.gripper not in ("none", "delta_m"):
        mixed[:, -1] = first[:, -1]
    return mixed.astype(np.float32)


def _between(form: RotationForm, first: Any, second: Any, share: float) -> list[float]:
    """Numbers of the rotation at `share` of the way, nearest to those it begins with."""
    begin = form.decode(first)
    end = toward(form.decode(second), begin)
    angle = math.acos(min(sum(a * b for a, b in zip(begin, end, strict=True)), 1.0))
    weights = 1.0 - share, share
    if angle > SAME_RAD:
        weights = (math.sin(weight * angle) / math.sin(angle) for weight in weights)
    of_begin, of_end = weights
    mixed = [of_begin * a + of_end * b for a, b in zip(begin, end, strict=True)]
    return form.follow(first, mixed)
