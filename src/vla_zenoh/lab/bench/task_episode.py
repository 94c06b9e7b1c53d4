"""One episode of the task benchmark, in real time or in lockstep."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from vla_zenoh.errors import SpecError, WorkerError
from vla_zenoh.lab.bench.task import NOT_OBEYED, TaskOutcome, TaskPlan, TaskRequest
from vla_zenoh.lab.episode import EpisodeLimit
from vla_zenoh.lab.tasks.judge import judge_of
from vla_zenoh.types import FloatArray, ObjectPoses

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
