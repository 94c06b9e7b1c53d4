"""A place of a Ray cluster where episodes run, with a benchmark and a worker of its own."""

from __future__ import annotations

from typing import Any

from vla_zenoh.errors import MissingExtraError, NodeError
from vla_zenoh.lab.benchmark.episode_clock import EpisodeOutcome, EpisodeRequest
from vla_zenoh.lab.benchmark.process import BenchmarkLost, BenchmarkProcess
from vla_zenoh.lab.benchmark.run import BenchmarkStage, Does, LocalRun


def connect_ray(address: str) -> Any:
    """Ray, connected to a cluster. Once in a process, before any `RayPlace`: it is not for threads.

    Args:
        address: of the cluster, as ``ray start`` tells it.

    Raises:
        MissingExtraError: Ray is not installed.
        NodeError: no cluster answers.
    """
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise MissingExtraError("ray", "ray") from error
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
