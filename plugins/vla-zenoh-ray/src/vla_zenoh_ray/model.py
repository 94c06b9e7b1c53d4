# /// script
# requires-python = ">=3.11"
# dependencies = ["ray[serve]>=2.60", "vla-zenoh-ray"]
# ///
"""A model whose replicas Ray Serve keeps, on several GPUs or hosts: ``vla-zenoh worker ray_serve``.

The worker in front keeps what robots rely on: spec hash, newest observation, prefix, provenance.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from typing import Any

from vla_zenoh.errors import MissingExtraError, WorkerError, in_words
from vla_zenoh.policy import ActionSteps, Observation, Policy, reset_of, takes_robot
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.policy.options import number, whole_number
from vla_zenoh_ray.replica import Replica
from vla_zenoh_ray.spread import Spread

READY_PATIENCE_S = 600.0
"""For the first replica: weights are loaded, perhaps from a network."""
POLL_S = 0.2
HUNG_S = 30.0
"""A request to a replica that neither answers nor ends."""
QUEUED = 2
"""Requests at one replica: with 1, Ray would wait before it tries one that has just become free."""
HEALTH_PERIOD_S, HEALTH_PATIENCE_S = 2.0, 10.0
SHUT_DOWN_S = 2.0
METHOD = "answers"
APP_DIGITS = 8
"""Of a spec's hash, in the name of an application."""


class RayServe:
    """Replicas of another model by Ray Serve.

    Args:
        model: name or path of the model, which every host of the cluster has.
        replicas: how many, on as many GPUs or hosts.
        address: of the Ray cluster, as ``HOST:PORT`` or ``auto``; empty: one of its own here.
        gpus, cpus: that one replica takes of its host, as Ray counts them.
        app: name of the application in Ray Serve; empty: that of the model and its spec.
        profile: of the robots.
        options: of the model.
    """

    def __init__(
        self,
        model: str,
        replicas: str = "2",
        address: str = "",
        gpus: str = "0",
        cpus: str = "1",
        app: str = "",
        profile: str = "",
        **options: str,
    ) -> None:
        self._model, self._options, self._profile = model, options, profile
        self._replicas = whole_number("replicas", replicas, least=1)
        self._resources = {"num_gpus": number("gpus", gpus), "num_cpus": number("cpus", cpus)}
        self._address = address
        # Only its spec: weights are the replicas'.
        front = make_policy(find_model(model), options, profile=profile or None)
        refuse_shared_memory(front)
        self.spec = front.spec
        # A worker that is started again in a cluster that lived on replaces its old replicas.
        self._app = app or f"{self.spec.name}-{self.spec.hash[:APP_DIGITS]}"
        self.takes_committed = bool(getattr(front, "takes_committed", False))
        self.example_prompts = getattr(front, "example_prompts", ())
        if getattr(front, "infer_batch", None) is None:
            self.max_batch: int | None = self._replicas
        else:
            own = getattr(front, "max_batch", None)
            self.max_batch = own and own * self._replicas
        self._spread: Spread | None = None

    def load(self) -> None:
        """Start the replicas, or find the cluster, and wait until one of them answers.

        Raises:
            MissingExtraError: Ray is not installed.
            WorkerError: no cluster there, or the replicas do not start.
        """
        try:
            import ray  # pyright: ignore[reportMissingImports]
            from ray import exceptions, serve  # pyright: ignore[reportMissingImports]
            from ray.serve import exceptions as serving  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise MissingExtraError("ray", "ray", "vla-zenoh-ray") from error
        try:
            where = {"address": self._address} if self._address else {"include_dashboard": False}
            ray.init(logging_level="ERROR", log_to_driver=False, **where)
        except Exception as error:  # Ray raises that itself where it does not start in time
            where_text = f"at {self._address!r}" if self._address else "on this computer"
            raise WorkerError(f"no Ray cluster {where_text}: {in_words(error)}") from error
        serve.start(proxy_location="Disabled")
        deployment = serve.deployment(
            Replica,
            name="model",
            num_replicas=self._replicas,
            max_ongoing_requests=QUEUED,
            ray_actor_options=self._resources,
            health_check_period_s=HEALTH_PERIOD_S,
            health_check_timeout_s=HEALTH_PATIENCE_S,
            graceful_shutdown_timeout_s=SHUT_DOWN_S,
        )
        bound = deployment.bind(self._model, self._options, self._profile, self.spec.hash)
        # Not blocking: one replica is enough to begin, and others may need a host that comes later.
        target = serve.RunTarget(bound, name=self._app, route_prefix=None)
        (handle,) = serve.run_many([target], wait_for_applications_running=False)
        self._await_one(serve)

        def ask(
            observations: Sequence[Observation], committed: Sequence[Any] | None
        ) -> list[ActionSteps]:
            response = getattr(handle, METHOD).remote(list(observations), committed)
            try:
                return response.result(timeout_s=HUNG_S)
            except TimeoutError:
                response.cancel()
                raise
            except exceptions.RayTaskError as error:  # what the model raised
                raise (error.cause or error) from error
            except exceptions.RayError as error:
                raise Lost(str(error)) from error

        lost = (Lost, TimeoutError, serving.RayServeException)
        self._spread = Spread(ask, self._replicas, lost)

    def _await_one(self, serve: Any) -> None:
        give_up_s = time.monotonic() + READY_PATIENCE_S
        while True:
            app = serve.status().applications.get(self._app)
            found = app.deployments.get("model") if app is not None else None
            if found is not None and dict(found.replica_states).get("RUNNING", 0):
                return
            said = (found.message if found is not None else "") or (app.message if app else "")
            failed = app is not None and app.status in ("DEPLOY_FAILED", "UNHEALTHY")
            if failed or time.monotonic() > give_up_s:
                raise WorkerError(f"no replica of {self._model!r} has started: {said}")
            time.sleep(POLL_S)

    def infer(self, observation: Observation, **extra: Any) -> ActionSteps:
        """Of some replica."""
        committed = [extra["committed"]] if self.takes_committed else None
        return self._answers([observation], committed)[0]

    def infer_batch(
        self, observations: Sequence[Observation], committed: Sequence[Any] | None = None
    ) -> list[ActionSteps]:
        """Shared out among all replicas."""
        return self._answers(observations, committed)

    def _answers(
        self, observations: Sequence[Observation], committed: Sequence[Any] | None
    ) -> list[ActionSteps]:
        if self._spread is None:
            raise WorkerError("load() was not called: there is no replica yet")
        return self._spread.answers(observations, committed)

    def close(self) -> None:
        """End the application; the cluster stays, unless it is this worker's own."""
        if self._spread is None:
            return
        import ray  # pyright: ignore[reportMissingImports]
        from ray import serve  # pyright: ignore[reportMissingImports]

        self._spread.close()
        with contextlib.suppress(Exception):
            serve.delete(self._app, _blocking=False)
        ray.shutdown()


class Lost(ConnectionError):
    """A replica, or its host, is gone."""


def refuse_shared_memory(front: Policy) -> None:
    """Raise a `WorkerError` for a model whose memory is of one robot alone."""
    if reset_of(front) is not None and not takes_robot(front):
        raise WorkerError(
            f"model {front.spec.name!r} remembers one robot, and a replica answers several: give "
            "its reset the robot's name, reset(robot), and keep its memory apart by it"
        )
