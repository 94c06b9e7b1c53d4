"""Runs the task benchmark in lockstep: the same policy, commander and world on a virtual clock."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec.image import encode_jpeg
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.errors import NodeError, VlaZenohError, WorkerError, in_words
from vla_zenoh.lab.tasks.task import (
    ARM_LOST,
    SceneSnapshot,
    TaskOutcome,
    TaskPlan,
    TaskRequest,
    run_task,
)
from vla_zenoh.policy import ActionSteps, ModelSpec, Observation, Policy, reset_of
from vla_zenoh.policy.loader import find_worker, make_policy
from vla_zenoh.profile import Profile
from vla_zenoh.runtime.process import die_with_parent
from vla_zenoh.simulation.backend import AUTO, choose_backend
from vla_zenoh.simulation.render import Renderer
from vla_zenoh.simulation.robot_model import robot_models
from vla_zenoh.simulation.world import World, build_world
from vla_zenoh.types import Image, ObjectPoses
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Delays

Result = TypeVar("Result")
POLL_S = 0.2
"""How often the parent checks for Ctrl-C, and how often activation is tried."""


def in_processes(
    work: Callable[..., Result],
    jobs: Iterable[tuple[Any, ...]],
    stop: threading.Event,
    *,
    processes: int | None = None,
    prepare: Callable[..., None] | None = None,
    prepared: tuple[Any, ...] = (),
) -> Iterator[Result]:
    """``work(*job)`` for every job, in the order of the jobs.

    Args:
        stop: set by Ctrl-C; jobs that have not ended are dropped.
        processes: at once; None: one per core.
        prepare: called first in every process, a function of a module.

    Raises:
        NodeError: a process was killed.
    """
    with ProcessPoolExecutor(
        processes or os.cpu_count() or 1,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin,
        initargs=(prepare, prepared),
    ) as pool:
        futures = [pool.submit(work, *job) for job in jobs]
        try:
            for future in futures:
                while not wait([future], POLL_S, FIRST_COMPLETED).done:
                    if stop.is_set():
                        return
                yield future.result()
        except BrokenProcessPool as error:
            raise NodeError(
                "a process of the bench was killed; is there enough memory for so many at once?"
            ) from error
        finally:
            if not all(future.done() for future in futures):  # in the middle of a job
                for process in multiprocessing.active_children():
                    process.terminate()
            pool.shutdown(wait=True, cancel_futures=True)


def _begin(prepare: Callable[..., None] | None, prepared: tuple[Any, ...]) -> None:
    die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    if prepare is not None:
        prepare(*prepared)


CAMERA_S, WIRE_S = 0.015, 0.0005
"""Camera stamp to worker, and every other way, about as measured in real time."""
STEP_S = 0.1
"""Period at which the simulator publishes its objects."""
WARM_UP_S, ACTIVATE_PATIENCE_S = 0.5, 5.0


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
                part: ReachabilityFilter(self.profile.of_part(part))
                for part in self.profile.part_names
            },
            seed=seed,
        )
        if self.plan.rate_hz is not None:
            self.loop.put("rate", self.plan.rate_hz)
        return self._objects()

    def start(self, prompt: str) -> str:
        loop = self._running
        loop.put("prompt", prompt)
        loop.run(WARM_UP_S)
        return loop.activate(ACTIVATE_PATIENCE_S, POLL_S)

    def step(self) -> None:
        self._running.run(STEP_S)

    def time_s(self) -> float:
        return self._running.now_ns / 1e9

    def scene(self) -> SceneSnapshot:
        width_m = self.world.gripper_state().opening_m
        return SceneSnapshot(self._running.now_ns, self._objects(), width_m, self.world.tcp()[0])

    def failure(self) -> tuple[str, str] | None:
        commander = self._running.commander
        return None if commander.task.active else (ARM_LOST, commander.why)

    def done(self) -> bool:
        commander = self._running.commander
        return commander.progress.done and commander.at_rest

    def picture(self) -> bytes | None:
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
