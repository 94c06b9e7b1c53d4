"""Tasks by prompt: a plan of them, and one episode in real time or in lockstep. Pure."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple, Protocol

from vla_zenoh.errors import ResourceError, SpecError, WorkerError
from vla_zenoh.lab.episode import EpisodeLimit
from vla_zenoh.lab.tasks.episode import TaskEpisode, draw_episode, draw_stay
from vla_zenoh.lab.tasks.judge import LIMIT_S, judge_of
from vla_zenoh.lab.tasks.order import (
    DIRECTIONS,
    FAMILIES,
    LIFT,
    LIFT_PROMPT,
    PUSH,
    Order,
    is_nonsense,
    parse_prompt,
)
from vla_zenoh.types import FloatArray, ObjectPoses

SCENE = "bricks"
"""The scene of the tasks."""
STAY = "stay"
NOT_OBEYED, ARM_LOST, NO_STATE = "not_obeyed", "arm_lost", "no_state"
CHAIN_FAILURES: Mapping[str, str] = {
    NOT_OBEYED: "activation was rejected to the end",
    ARM_LOST: "the arm was deactivated during the episode",
    NO_STATE: "the simulator's objects were silent",
}
"""Kinds of failure of the chain, beside those of the task (`FAILURES` of its judge)."""

BASELINES: Mapping[str, tuple[str, str]] = {
    "hold": ("scripted", "hold"),
    "scripted": ("scripted", "HARD: go down x12"),
}
"""Baseline -> worker and prompt. Neither does any task: their successes are false positives."""


@dataclass(frozen=True, slots=True)
class TaskPlan:
    """Episodes to run.

    Args:
        model: name of the worker, or of one of `BASELINES`.
        seed: of the first layout; the others follow.
        family: one of `FAMILIES` or ``stay``; None: all three in turn.
        prompt: in place of the episode's own.
        rate_hz: chunks per second; None: of the profile.
    """

    model: str
    episodes: int
    seed: int
    family: str | None = None
    held_out: bool = False
    prompt: str | None = None
    limit_s: float = LIMIT_S
    rate_hz: float | None = None
    delay_ms: float = 0.0

    @property
    def worker(self) -> str:
        return BASELINES.get(self.model, (self.model, ""))[0]

    def requests(self) -> Iterator[TaskRequest]:
        families = (self.family,) if self.family else FAMILIES
        for index in range(self.episodes):
            yield TaskRequest(self.seed + index, families[index % len(families)])

    def prompt_for(self, episode: TaskEpisode) -> str:
        """The prompt to publish for `episode`."""
        return self.prompt or BASELINES.get(self.model, ("", episode.prompt))[1]


@dataclass(frozen=True, slots=True)
class TaskRequest:
    """One episode of a plan, before its layout is known.

    Args:
        prompt: of the user, in place of a task that is drawn; judged as ``stay`` if it is unknown.
        order: what the prompt is taken for; None: what its wording says.
    """

    seed: int
    family: str
    prompt: str | None = None
    order: Order | None = None

    def draw(self, objects: ObjectPoses, *, held_out: bool) -> TaskEpisode:
        """Draw the task in this layout.

        Where no brick can be pushed, another family is drawn instead of skipping the layout.
        """
        if self.prompt is not None:
            order = self.order or parse_prompt(self.prompt) or Order(STAY)
            return TaskEpisode(self.seed, order, self.prompt)
        if self.family == LIFT:
            return TaskEpisode(self.seed, Order(LIFT), LIFT_PROMPT)
        if self.family == STAY:
            return draw_stay(self.seed)
        others = [family for family in FAMILIES if family != self.family]
        try:
            return draw_episode(self.seed, objects, family=self.family, held_out=held_out)
        except ResourceError:
            return draw_episode(self.seed, objects, family=others[0], held_out=held_out)


@dataclass(frozen=True, slots=True)
class TaskOutcome:
    """Outcome of one episode.

    Args:
        failure: kind, empty after a success.
        why: reason, where the chain failed.
        pictures: (start, end) as JPEG, None: no camera.
    """

    episode: TaskEpisode
    prompt: str
    success: bool
    failure: str
    time_s: float
    why: str = ""
    pictures: tuple[bytes, bytes] | None = None

    def to_dict(self) -> dict[str, Any]:
        order = {name: value for name, value in asdict(self.episode.order).items() if value}
        return {
            "seed": self.episode.seed,
            **order,
            "prompt": self.prompt,
            "success": self.success,
            "failure": self.failure,
            "time_s": round(self.time_s, 3),
            **({"why": self.why} if self.why else {}),
        }


def shown_camera(cameras: Collection[str]) -> str | None:
    """The camera whose images show a task; None: there is none."""
    return "front" if "front" in cameras else next(iter(cameras), None)


FIRST_SEED = 1
"""The default layout."""


@dataclass(frozen=True, slots=True)
class DemoPlan(TaskPlan):
    """Prompts of the user, or one task of every family, all in the same layout.

    Args:
        prompts: one after the other; empty: one task of every family.
        orders: prompt -> what it is taken for, of those in free wording.
    """

    prompts: tuple[str, ...] = ()
    orders: Mapping[str, Order] = field(default_factory=dict)

    def requests(self) -> Iterator[TaskRequest]:
        for prompt in self.prompts:
            yield TaskRequest(self.seed, STAY, prompt, self.orders.get(prompt))
        if not self.prompts:
            for family in FAMILIES:
                yield TaskRequest(self.seed, family)


def is_judged(prompt: str) -> bool:
    """The goal of `prompt` is known, so that it can be judged."""
    return parse_prompt(prompt) is not None or is_nonsense(prompt)


def order_of(reading: str) -> Order | None:
    """The goal of what the policy ``brick`` says it read, as ``stack red blue``; None: no task."""
    kind, *colours = reading.split() or [""]
    if kind in DIRECTIONS:
        return Order(PUSH, colours[0], direction=kind)
    return Order(kind, *colours[:1], onto="".join(colours[1:])) if colours else None


# -- one episode ----------------------------------------------------------------------------------
DONE_S = 1.5
"""An episode ends when the policy has been done, and the arm at rest, for this long."""


class SceneSnapshot(NamedTuple):
    """State of the simulated scene. `tcp_m`: (3,) measured TCP, base frame."""

    stamp_ns: int
    objects: ObjectPoses
    width_m: float
    tcp_m: FloatArray


class TaskStage(Protocol):
    """Where task episodes take place: on running nodes, or in lockstep."""

    def reset(self, seed: int) -> ObjectPoses:
        """Arm at home, objects placed by `seed`; their true poses."""
        ...

    def start(self, prompt: str) -> str:
        """Publish the prompt and activate; why that was rejected, empty: the arm is active."""
        ...

    def step(self) -> None:
        """Let time pass until the next look at the scene."""
        ...

    def time_s(self) -> float:
        """A clock that never goes back."""
        ...

    def scene(self) -> SceneSnapshot:
        """The newest state of the scene."""
        ...

    def failure(self) -> tuple[str, str] | None:
        """What of the chain failed, one of `CHAIN_FAILURES`, and why; None: nothing."""
        ...

    def done(self) -> bool:
        """The policy reports its end, and the arm is at rest."""
        ...

    def picture(self) -> bytes | None:
        """What a camera sees, as JPEG; None: no camera."""
        ...


def run_task(stage: TaskStage, plan: TaskPlan, request: TaskRequest) -> TaskOutcome:
    """Run one episode until the judge's verdict, the end of the policy, or the time limit.

    Raises:
        NodeError: the stage broke down, or a client other than this one ended the episode.
    """
    task = request.draw(stage.reset(request.seed), held_out=plan.held_out)
    prompt, before = plan.prompt_for(task), stage.picture()

    def outcome(success: bool, failure: str, time_s: float, why: str = "") -> TaskOutcome:
        after = None if before is None else stage.picture()
        pictures = None if before is None or after is None else (before, after)
        return TaskOutcome(task, prompt, success, failure, time_s, why, pictures)

    try:
        rejected = stage.start(prompt)
        if rejected:
            return outcome(False, NOT_OBEYED, 0.0, rejected)
        scene, began_s = stage.scene(), stage.time_s()
        judge = judge_of(task.order, scene.objects, scene.tcp_m)
        limit = EpisodeLimit(plan.limit_s, DONE_S)
        while True:
            stage.step()
            time_s, last_ns, scene = stage.time_s() - began_s, scene.stamp_ns, stage.scene()
            verdict = None
            if scene.stamp_ns > last_ns:
                verdict = judge.update(scene.objects, scene.width_m, time_s, scene.tcp_m)
            if verdict is None:
                failed = stage.failure()
                if failed is not None:
                    return outcome(False, failed[0], time_s, failed[1])
                if limit.update(time_s, done=stage.done()):
                    verdict = judge.end()
            if verdict is not None:
                return outcome(verdict.success, verdict.failure, verdict.time_s)
    except (SpecError, WorkerError) as error:
        return TaskOutcome(task, prompt, False, NOT_OBEYED, 0.0, str(error))
