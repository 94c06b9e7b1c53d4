"""Runs the episodes of a benchmark, several at once."""

from __future__ import annotations

import queue
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from vla_zenoh.errors import MissingExtraError, NodeError
from vla_zenoh.lab.cli.loopback import free_port
from vla_zenoh.lab.cli.running_nodes import running_nodes
from vla_zenoh.profile import load_profile, override, to_yaml
from vla_zenoh.profile.profile import Profile
from vla_zenoh_benchmarks.episode import EpisodeOutcome, EpisodeRequest
from vla_zenoh_benchmarks.process import (
    BenchmarkLost,
    BenchmarkProcess,
    BenchmarkSetting,
    teachers_robot,
)

ATTEMPTS = 3
POLL_S = 0.2
Ended = tuple[EpisodeRequest, EpisodeOutcome]


class Does(Protocol):
    """Where an episode is run."""

    def run(self, request: EpisodeRequest) -> EpisodeOutcome: ...

    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class BenchmarkStage:
    """What runs episodes: a benchmark, and a worker that is started beside it or is there.

    Args:
        worker_options: ``name=value`` of the model.
        teacher_model: file of the worker that takes over.
        connect: endpoint of a router with a worker that runs already; empty: both are started.
        max_width_m: of the benchmark's gripper; None: it does not tell.
    """

    setting: BenchmarkSetting
    worker_options: tuple[str, ...] = ()
    worker_model: str = ""
    teacher_model: str = ""
    worker_python: str | None = None
    benchmark_python: str | None = None
    connect: str = ""
    max_width_m: float | None = None


def robots(processes: int) -> list[str]:
    """Names of the robots that a run has; a worker that runs elsewhere has to serve them."""
    return [f"sim{index}" for index in range(processes)]


def bench_profile(stage: BenchmarkStage, processes: int) -> Profile:
    """The profile of the robots of a run: no arm, a router and its workers."""
    worker, teacher = stage.setting.worker, stage.setting.conditions.takeover
    names = robots(processes)
    serves = {worker: names}
    models = {worker: stage.worker_model} if stage.worker_model else {}
    if teacher:
        serves[teacher] = [*names, *map(teachers_robot, names)]
        models[teacher] = stage.teacher_model
    base = load_profile("panda_sim")
    width_m = stage.max_width_m
    gripper = {} if width_m is None else {"gripper": {"max_width_m": width_m}}
    profile = override(
        base,
        {
            "name": "benchmark",
            "robot": {"name": names[0], **gripper},
            "cameras": dict.fromkeys(base.cameras),
            "workers": list(serves),
            "models": models,
            "serves": serves,
            "task": {"worker": worker},
            "hosts": {"here": {"nodes": ["router", "worker"]}},
        },
    )
    if stage.connect:
        return override(profile, {"session": {"connect": [stage.connect]}})
    here = [f"tcp/127.0.0.1:{free_port()}"]
    return override(profile, {"session": {"connect": here, "listen": here}})


class LocalRun:
    """Episodes in processes of this computer, all of which ask one worker.

    Args:
        log: file for what the worker says; None: it is not kept.
    """

    def __init__(self, stage: BenchmarkStage, processes: int, log: Path | None = None) -> None:
        self._stage, self._processes, self._log = stage, processes, log
        self._stack = ExitStack()
        self._file = ""
        self._look: Callable[[], None] | None = None

    def __enter__(self) -> LocalRun:
        stage = self._stage
        if not stage.setting.worker:  # recorded steps need none
            return self
        profile = bench_profile(stage, self._processes)
        if not stage.connect:
            # The model sees what the environment drew, bit by bit.
            arguments = ["--images", "raw"]
            if stage.worker_python:
                arguments += ["--python", stage.worker_python]
            nodes = running_nodes(
                profile,
                self._log,
                worker_options={stage.setting.worker: stage.worker_options},
                worker_arguments=arguments,
            )
            host = self._stack.enter_context(nodes)
            profile, self._look = host.profile, host.poll
        folder = self._stack.enter_context(tempfile.TemporaryDirectory(prefix="vla-zenoh-"))
        self._file = f"{folder}/benchmark.yaml"
        Path(self._file).write_text(to_yaml(profile), "utf-8")
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def place(self, index: int) -> BenchmarkProcess:
        """A new process for the robot of this number."""
        setting = replace(self._stage.setting, profile_file=self._file)
        name = robots(self._processes)[index]
        return BenchmarkProcess(setting, name, self._stage.benchmark_python)

    def run(self, requests: Sequence[EpisodeRequest], stop: threading.Event) -> Iterator[Ended]:
        """Every episode as it ends.

        Raises:
            NodeError: benchmark or worker failed, or an episode lost its process three times.
        """
        makers = [lambda index=index: self.place(index) for index in range(self._processes)]
        yield from run_at_places(makers, requests, stop, self._look)


def run_at_places(
    makers: Sequence[Callable[[], Does]],
    requests: Sequence[EpisodeRequest],
    stop: threading.Event,
    look: Callable[[], None] | None = None,
) -> Iterator[Ended]:
    """Share episodes out; one that loses its place is begun again at a new one.

    Args:
        stop: set by Ctrl-C; what has not ended is left out.
        look: looks after the worker meanwhile, often.

    Raises:
        NodeError: an episode failed, or lost its place three times; or by `look`.
    """
    waiting: queue.SimpleQueue[EpisodeRequest] = queue.SimpleQueue()
    ended: queue.SimpleQueue[Ended | Exception] = queue.SimpleQueue()
    for request in requests:
        waiting.put(request)
    places: dict[int, Does] = {}
    over = threading.Event()

    def work(index: int) -> None:
        try:
            while not over.is_set():
                request = waiting.get_nowait()
                ended.put((request, _at_a_place(makers[index], places, index, request)))
        except queue.Empty:
            place = places.pop(index, None)  # another one may wait for its computer
            if place is not None:
                place.close()
        except Exception as error:
            ended.put(error)

    threads = [
        threading.Thread(target=work, args=(index,), daemon=True) for index in range(len(makers))
    ]
    for thread in threads:
        thread.start()
    try:
        left = len(requests)
        while left and not stop.is_set():
            if look is not None:
                look()
            try:
                found = ended.get(timeout=POLL_S)
            except queue.Empty:
                continue
            if isinstance(found, Exception):
                raise found
            left -= 1
            yield found
    finally:
        over.set()
        for place in list(places.values()):
            place.close()


def _at_a_place(
    make: Callable[[], Does], places: dict[int, Does], index: int, request: EpisodeRequest
) -> EpisodeOutcome:
    for attempt in range(1, ATTEMPTS + 1):
        if index not in places:
            places[index] = make()
        try:
            return replace(places[index].run(request), attempts=attempt)
        except BenchmarkLost as error:
            places.pop(index).close()
            if attempt == ATTEMPTS:
                raise NodeError(f"{request.key}: {attempt} attempts, the last: {error}") from error
    raise AssertionError


def connect_ray(address: str) -> Any:
    """Ray, connected to a cluster. Once in a process, before any `RayPlace`: it is not for threads.

    Args:
        address: of the cluster, as ``ray start`` tells it.

    Raises:
        NodeError: no cluster answers.
    """
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise MissingExtraError("ray", "ray", "vla-zenoh-benchmarks") from error
    try:
        ray.init(address, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise NodeError(f"no Ray cluster answers at {address}: {error}") from error
    return ray


class RayPlace(Does):
    """An actor of a Ray cluster, on the computer that Ray chooses.

    Args:
        stage: what to run; its files have to be on every computer of the cluster.
        ray: see `connect_ray`.
    """

    def __init__(self, stage: BenchmarkStage, ray: Any) -> None:
        self._ray = ray
        # Begun again by `run_at_places` and not by Ray, which does not tell how often.
        actor = ray.remote(num_cpus=1, max_restarts=0, scheduling_strategy="SPREAD")(_OnRay)
        self._actor: Any = actor.remote(stage)

    def run(self, request: EpisodeRequest) -> EpisodeOutcome:
        errors = self._ray.exceptions
        try:
            return self._ray.get(self._actor.run.remote(request))
        except errors.RayTaskError as error:
            raise error.cause from error
        except errors.RayError as error:  # its process or computer died
            raise BenchmarkLost(f"a place on Ray was lost: {error}") from error

    def close(self) -> None:
        """Let the cluster have the place for others."""
        self._ray.kill(self._actor)


class _OnRay:
    """In a process of Ray."""

    def __init__(self, stage: BenchmarkStage) -> None:
        self._nodes = LocalRun(stage, 1)  # kept: they end with it
        self._place: BenchmarkProcess | None = None

    def run(self, request: EpisodeRequest) -> EpisodeOutcome:
        if self._place is None:
            self._place = self._nodes.__enter__().place(0)
        return self._place.run(request)
