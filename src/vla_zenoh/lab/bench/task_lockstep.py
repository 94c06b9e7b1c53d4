"""Runs tasks on a virtual clock: the same policy, commander and world, faster than real time.

What a computer's load does is not in it. Pictures are drawn when the policy looks at them, from the
poses of the moment they were taken.
"""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.codec.image import encode_jpeg
from vla_zenoh.control.reachability import make_reachability_filter
from vla_zenoh.errors import NodeError, SpecError, VlaZenohError, WorkerError
from vla_zenoh.lab.bench.task import (
    ARM_LOST,
    NOT_OBEYED,
    SAY_IT_IS_OVER_S,
    TaskOutcome,
    TaskPlan,
    TaskRequest,
)
from vla_zenoh.lab.lockstep import Delays, Lockstep
from vla_zenoh.lab.tasks import TaskJudge
from vla_zenoh.policy import ActionSteps, ModelSpec, Observation, Policy, reset_of
from vla_zenoh.policy.loader import find_worker, make_policy
from vla_zenoh.profile import Profile
from vla_zenoh.runtime.process import die_with_parent
from vla_zenoh.simulation.render import AUTO, Renderer, choose_backend
from vla_zenoh.simulation.world import World, build_world
from vla_zenoh.types import Image, ObjectPoses

CAMERA_S, WIRE_S = 0.015, 0.0005
"""Camera stamp to worker, and every other way, about as measured in real time."""
LOOK_S = 0.1
"""As often as the simulator publishes its objects."""
WARM_UP_S, ACTIVATE_PATIENCE_S = 0.5, 5.0
POLL_S = 0.2


def run_in_lockstep(
    profile: Profile,
    plan: TaskPlan,
    options: Mapping[str, str],
    camera: str | None,
    stop: threading.Event,
    processes: int,
    *,
    named: str | None = None,
) -> Iterator[tuple[TaskOutcome, dict[str, tuple[float, float]]]]:
    """One outcome after the other, each with what an inference took in its process.

    Args:
        profile: with a scene that has what tasks are about.
        plan: what to run.
        options: of the model.
        camera: whose pictures go into the sheet of failures.
        stop: set by Ctrl-C; episodes not begun are left out.
        processes: at once.
        named: name or path of the profile, for a model that takes one.

    Raises:
        NodeError: world or model cannot be made or loaded, says why; or a process was killed.
    """
    with ProcessPoolExecutor(
        processes,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin,
        initargs=(profile, plan, dict(options), camera, named),
    ) as pool:
        futures: list[Future[Any]] = [pool.submit(_one, asked) for asked in plan.asked()]
        try:
            for future in futures:
                while not future.done():
                    if stop.wait(POLL_S):
                        return
                yield future.result()
        except BrokenProcessPool as error:
            raise NodeError(
                "a process of the bench was killed; is there enough memory for --processes?"
            ) from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@dataclass(slots=True)
class _Bench:
    """What a process keeps from one episode to the next."""

    profile: Profile
    plan: TaskPlan
    camera: str | None
    world: World
    renderer: Renderer
    policy: _Loaded

    def picture(self, camera: str) -> Image:
        """What a camera sees now, drawn when somebody looks."""
        return _Drawn(self, camera, self.world.qpos())  # pyright: ignore[reportReturnType]

    def draw(self, camera: str, qpos: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Draw a camera of the profile in its size."""
        source = self.profile.cameras[camera]
        self.renderer.set_qpos(qpos)
        name = source.source.removeprefix("sim:")
        return self.renderer.render(name, source.width, source.height)


class _Drawn:
    """An `Image` that is drawn at the first look."""

    def __init__(self, bench: _Bench, camera: str, qpos: NDArray[np.float64]) -> None:
        self._bench, self._camera, self._qpos = bench, camera, qpos
        self._rgb: NDArray[np.uint8] | None = None

    @property
    def rgb(self) -> NDArray[np.uint8]:
        if self._rgb is None:
            self._rgb = self._bench.draw(self._camera, self._qpos)
        return self._rgb


class _Loaded:
    """A policy whose weights stay from one episode to the next; counts what inferences take."""

    def __init__(self, policy: Policy) -> None:
        self.spec: ModelSpec = policy.spec
        self._policy = policy
        self.took_ms: list[float] = []
        with _told("cannot be loaded"):
            getattr(policy, "load", lambda: None)()

    def reset(self) -> None:
        with _told("cannot be reset"):
            (reset_of(self._policy) or (lambda: None))()

    def infer(self, observation: Observation) -> ActionSteps:
        began_s = time.perf_counter()
        with _told("failed"):
            result = self._policy.infer(observation)
        self.took_ms.append((time.perf_counter() - began_s) * 1e3)
        return result if isinstance(result, ActionSteps) else ActionSteps(result)


_bench: _Bench | NodeError | None = None


def _begin(
    profile: Profile, plan: TaskPlan, options: dict[str, str], camera: str | None, named: str | None
) -> None:
    """Make what the process keeps. What raises here would end the pool without a word of it."""
    global _bench
    die_with_parent()
    try:
        world = build_world(profile)
        wanted = profile.sim.renderer
        renderer = Renderer(
            profile.sim.scene, world.robot, choose_backend(None if wanted == AUTO else wanted)
        )
        _, model = find_worker(plan.worker, profile.models)
        policy = _Loaded(make_policy(model, options, profile=named))
    except Exception as error:
        # Not as it is: some errors take more than a text, and cannot go from process to process.
        _bench = NodeError(_in_words(error))
    else:
        _bench = _Bench(profile, plan, camera, world, renderer, policy)


def _one(asked: TaskRequest) -> tuple[TaskOutcome, dict[str, tuple[float, float]]]:
    if isinstance(_bench, NodeError):
        raise _bench
    assert _bench is not None
    ended = _episode(_bench, asked)
    p50, p95 = np.percentile(_bench.policy.took_ms or [0.0], (50, 95))
    return ended, {f"worker-{_bench.plan.worker}.inference": (float(p50), float(p95))}


def _episode(bench: _Bench, asked: TaskRequest) -> TaskOutcome:
    plan, world = bench.plan, bench.world
    world.reset(asked.seed)
    if bench.profile.sim.vary:
        bench.renderer.vary(asked.seed, bench.profile.sim.vary)
    objects = _objects(world)
    episode = asked.draw(objects, held_out=plan.held_out)
    prompt = plan.prompt_for(episode)
    loop = Lockstep(
        bench.profile,
        world,
        bench.policy,
        delays=Delays(plan.delay_ms / 1e3, camera_s=CAMERA_S, wire_s=WIRE_S),
        picture=bench.picture,
        reach=make_reachability_filter(bench.profile),
        seed=asked.seed,
    )
    beginning = bench.draw(bench.camera, world.qpos()) if bench.camera else None
    if plan.rate_hz is not None:
        loop.put("rate", plan.rate_hz)
    loop.put("prompt", prompt)
    try:
        refused = _activate(loop)
        if refused:
            pictures = _pictures(bench, beginning)
            return TaskOutcome(episode, prompt, False, NOT_OBEYED, 0.0, refused, pictures)
        judge = TaskJudge(episode.order, _objects(world), world.tcp()[0])
        began_ns, over_since_s = loop.now_ns, 0.0
        while True:
            loop.run(LOOK_S)
            time_s = (loop.now_ns - began_ns) / 1e9
            width_m = world.gripper_state().width_m
            verdict = judge.see(_objects(world), width_m, time_s, world.tcp()[0])
            commander = loop.commander
            if verdict is None and not commander.task.active:
                pictures = _pictures(bench, beginning)
                return TaskOutcome(
                    episode, prompt, False, ARM_LOST, time_s, commander.why, pictures
                )
            over = commander.progress.done and commander.at_rest
            over_since_s = (over_since_s or time_s) if over else 0.0
            too_long = bool(over_since_s) and time_s - over_since_s > SAY_IT_IS_OVER_S
            if verdict is None and (too_long or time_s > plan.limit_s):
                verdict = judge.end()
            if verdict is not None:
                pictures = None if verdict.success else _pictures(bench, beginning)
                return TaskOutcome.by(verdict, episode, prompt, pictures)
    except (SpecError, WorkerError) as error:
        return TaskOutcome(episode, prompt, False, NOT_OBEYED, 0.0, str(error))


def _activate(loop: Lockstep) -> str:
    loop.run(WARM_UP_S)
    end_ns = loop.now_ns + round(ACTIVATE_PATIENCE_S * 1e9)
    while loop.now_ns < end_ns:
        loop.put("active", True)
        loop.run(POLL_S)
        if loop.commander.task.active:
            return ""
    told = [event.why for event in loop.events if event.what == "activate_refused"]
    return told[-1] if told else "activation was refused"


def _pictures(bench: _Bench, beginning: NDArray[np.uint8] | None) -> tuple[bytes, bytes] | None:
    if beginning is None or bench.camera is None:
        return None
    end = bench.draw(bench.camera, bench.world.qpos())
    return encode_jpeg(Image(beginning)), encode_jpeg(Image(end))


@contextmanager
def _told(what: str) -> Iterator[None]:
    """What a model raises, as a `WorkerError`; what ours say is said already."""
    try:
        yield
    except VlaZenohError as error:
        raise WorkerError(str(error)) from error
    except Exception as error:
        raise WorkerError(f"the model {what}: {_in_words(error)}") from error


def _in_words(error: Exception) -> str:
    return str(error) if isinstance(error, VlaZenohError) else f"{type(error).__name__}: {error}"


def _objects(world: World) -> ObjectPoses:
    places = world.objects()
    return ObjectPoses(
        tuple(places),
        np.array([place[0] for place in places.values()]).reshape(-1, 3),
        np.array([place[1] for place in places.values()]).reshape(-1, 4),
    )
