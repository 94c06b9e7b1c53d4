"""Runs the task benchmark in lockstep: the same policy, commander and world on a virtual clock.

Pictures are drawn when the policy reads them, from the poses at their capture.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec.image import encode_jpeg
from vla_zenoh.control.reachability import make_reachability_filter
from vla_zenoh.errors import NodeError, VlaZenohError, WorkerError, in_words
from vla_zenoh.lab.bench.processes import in_processes
from vla_zenoh.lab.bench.task import ARM_LOST, TaskOutcome, TaskPlan, TaskRequest
from vla_zenoh.lab.bench.task_episode import SceneSnapshot, run_task
from vla_zenoh.lab.lockstep import Delays, Lockstep
from vla_zenoh.policy import ActionSteps, ModelSpec, Observation, Policy, reset_of
from vla_zenoh.policy.loader import find_worker, make_policy
from vla_zenoh.profile import Profile
from vla_zenoh.simulation.render import AUTO, Renderer, choose_backend
from vla_zenoh.simulation.robot_model import robot_models
from vla_zenoh.simulation.world import World, build_world
from vla_zenoh.types import Image, ObjectPoses

CAMERA_S, WIRE_S = 0.015, 0.0005
"""Camera stamp to worker, and every other way, about as measured in real time."""
STEP_S = 0.1
"""Period at which the simulator publishes its objects."""
WARM_UP_S, ACTIVATE_PATIENCE_S = 0.5, 5.0
POLL_S = 0.2


def run_in_lockstep(
    profile: Profile,
    plan: TaskPlan,
    options: Mapping[str, str],
    camera: str | None,
    stop: threading.Event,
    processes: int | None,
    *,
    named: str | None = None,
) -> Iterator[tuple[TaskOutcome, dict[str, tuple[float, float]]]]:
    """One outcome after the other, each with what an inference took in its process.

    Args:
        profile: with a scene that has what tasks are about.
        plan: what to run.
        options: of the model.
        camera: for the pictures of an outcome, None: none.
        stop: set by Ctrl-C; episodes that have not ended are left out.
        processes: at once; None: one per core.
        named: name or path of the profile, for a model with that option.

    Raises:
        NodeError: world or model cannot be made or loaded, says why; or a process was killed.
    """
    yield from in_processes(
        _one,
        [(request,) for request in plan.requests()],
        stop,
        processes=processes,
        prepare=_prepare,
        prepared=(profile, plan, dict(options), camera, named),
    )


@dataclass(slots=True)
class _LockstepStage:
    """A `TaskStage` in lockstep; world, renderer and policy stay from one episode to the next."""

    profile: Profile
    plan: TaskPlan
    camera: str | None
    world: World
    renderer: Renderer
    policy: _Loaded
    loop: Lockstep | None = None

    def reset(self, seed: int) -> ObjectPoses:
        """Reset the world and start a new loop around it."""
        self.world.reset(seed)
        if self.profile.sim.vary:
            self.renderer.vary(seed, self.profile.sim.vary)
        self.loop = Lockstep(
            self.profile,
            self.world,
            self.policy,
            delays=Delays(self.plan.delay_ms / 1e3, camera_s=CAMERA_S, wire_s=WIRE_S),
            picture=lambda camera: _LazyImage(self, camera),  # pyright: ignore
            reach={
                part: make_reachability_filter(self.profile.of_part(part))
                for part in self.profile.part_names
            },
            seed=seed,
        )
        if self.plan.rate_hz is not None:
            self.loop.put("rate", self.plan.rate_hz)
        return self._objects()

    def start(self, prompt: str) -> str:
        """Activate; the last rejection, where it is rejected to the end."""
        loop = self._running
        loop.put("prompt", prompt)
        loop.run(WARM_UP_S)
        end_ns = loop.now_ns + round(ACTIVATE_PATIENCE_S * 1e9)
        while loop.now_ns < end_ns:
            loop.put("active", True)
            loop.run(POLL_S)
            if loop.commander.task.active:
                return ""
        reasons = [event.why for event in loop.events if event.what == "activate_refused"]
        return reasons[-1] if reasons else "activation was rejected"

    def step(self) -> None:
        """Run until the next state of the objects."""
        self._running.run(STEP_S)

    def time_s(self) -> float:
        """Virtual time."""
        return self._running.now_ns / 1e9

    def scene(self) -> SceneSnapshot:
        """The world now."""
        width_m = self.world.gripper_state().width_m
        return SceneSnapshot(self._running.now_ns, self._objects(), width_m, self.world.tcp()[0])

    def failure(self) -> tuple[str, str] | None:
        """The arm is inactive."""
        commander = self._running.commander
        return None if commander.task.active else (ARM_LOST, commander.why)

    def done(self) -> bool:
        """As the commander has it."""
        commander = self._running.commander
        return commander.progress.done and commander.at_rest

    def picture(self) -> bytes | None:
        """A picture of the camera, as JPEG."""
        if self.camera is None:
            return None
        return encode_jpeg(Image(self.draw(self.camera, self.world.qpos())))

    def draw(self, camera: str, qpos: NDArray[np.float64]) -> NDArray[np.uint8]:
        """What a camera of the profile sees, in its size."""
        source = self.profile.cameras[camera]
        self.renderer.set_qpos(qpos)
        return self.renderer.render(source.source.removeprefix("sim:"), source.width, source.height)

    @property
    def _running(self) -> Lockstep:
        assert self.loop is not None
        return self.loop

    def _objects(self) -> ObjectPoses:
        places = self.world.objects()
        return ObjectPoses(
            tuple(places),
            np.array([place[0] for place in places.values()]).reshape(-1, 3),
            np.array([place[1] for place in places.values()]).reshape(-1, 4),
        )


class _LazyImage:
    """An `Image` of now that is drawn at the first access."""

    def __init__(self, stage: _LockstepStage, camera: str) -> None:
        self._stage, self._camera, self._qpos = stage, camera, stage.world.qpos()
        self._rgb: NDArray[np.uint8] | None = None

    @property
    def rgb(self) -> NDArray[np.uint8]:
        if self._rgb is None:
            self._rgb = self._stage.draw(self._camera, self._qpos)
        return self._rgb


class _Loaded:
    """A loaded policy that measures its inferences."""

    def __init__(self, policy: Policy) -> None:
        self.spec: ModelSpec = policy.spec
        self.takes_committed = bool(getattr(policy, "takes_committed", False))
        self._policy = policy
        self.took_ms: list[float] = []
        with _model_errors("cannot be loaded"):
            getattr(policy, "load", lambda: None)()

    def reset(self) -> None:
        with _model_errors("cannot be reset"):
            (reset_of(self._policy) or (lambda: None))()

    def infer(self, observation: Observation, **committed: Any) -> ActionSteps:
        began_s = time.perf_counter()
        with _model_errors("failed"):
            result = self._policy.infer(observation, **committed)
        self.took_ms.append((time.perf_counter() - began_s) * 1e3)
        return result if isinstance(result, ActionSteps) else ActionSteps(result)


_stage: _LockstepStage | NodeError | None = None


def _prepare(
    profile: Profile, plan: TaskPlan, options: dict[str, str], camera: str | None, named: str | None
) -> None:
    """Build the stage of this process; an exception here would end the pool without a reason."""
    global _stage
    try:
        world = build_world(profile)
        wanted = profile.sim.renderer
        renderer = Renderer(
            profile.sim.scene,
            robot_models(profile),
            choose_backend(None if wanted == AUTO else wanted),
        )
        _, model = find_worker(plan.worker, profile.models)
        policy = _Loaded(make_policy(model, options, profile=named))
    except Exception as error:
        # As text: some exceptions cannot be pickled.
        _stage = NodeError(in_words(error))
    else:
        _stage = _LockstepStage(profile, plan, camera, world, renderer, policy)


def _one(request: TaskRequest) -> tuple[TaskOutcome, dict[str, tuple[float, float]]]:
    if isinstance(_stage, NodeError):
        raise _stage
    assert _stage is not None
    outcome = run_task(_stage, _stage.plan, request)
    if outcome.success:  # pictures are for the sheet of failures
        outcome = replace(outcome, pictures=None)
    p50, p95 = np.percentile(_stage.policy.took_ms or [0.0], (50, 95))
    return outcome, {f"worker-{_stage.plan.worker}.inference": (float(p50), float(p95))}


@contextmanager
def _model_errors(what: str) -> Iterator[None]:
    """Turn what the model raises into a `WorkerError`."""
    try:
        yield
    except VlaZenohError as error:
        raise WorkerError(str(error)) from error
    except Exception as error:
        raise WorkerError(f"the model {what}: {in_words(error)}") from error
