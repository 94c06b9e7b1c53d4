"""One replica: a model with its weights, in a process that Ray Serve starts and replaces."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping, Sequence
from typing import Any

from vla_zenoh.errors import SpecError
from vla_zenoh.policy import ActionSteps, Observation, reset_of, takes_robot
from vla_zenoh.policy.loader import find_model, make_policy


class Replica:
    """Answers observations of any of the robots; knows nothing of the bus.

    It resets its model by itself where the episode of a robot is another one than it last saw, so
    that no replica has to be told, and one that was lost or added has nothing to catch up on.

    Args:
        model: name or path, found on this host.
        options: of the model, as text.
        profile: name or path of the robots' profile, for a model that asks for it.
        spec_hash: of the worker in front.

    Raises:
        SpecError: the model of this host has another spec: another file, or other options.
    """

    def __init__(
        self, model: str, options: Mapping[str, str], profile: str, spec_hash: str
    ) -> None:
        self._policy = make_policy(find_model(model), options, profile=profile or None)
        if self._policy.spec.hash != spec_hash:
            raise SpecError(
                f"the model {model!r} on {socket.gethostname()} has the spec "
                f"{self._policy.spec.hash}, the worker has {spec_hash}: give both hosts the same "
                "file of the model and the same checkpoint"
            )
        self._episodes: dict[str, int] = {}
        self._name = f"{socket.gethostname()}:{os.getpid()}"
        load = getattr(self._policy, "load", None)
        if callable(load):
            load()

    def answers(
        self, observations: Sequence[Observation], committed: Sequence[Any] | None
    ) -> list[ActionSteps]:
        """One answer for each observation, in their order; each names this replica.

        Args:
            observations: of different robots.
            committed: as `Policy.infer` takes it, of each; None: the model takes none.
        """
        for seen in observations:
            self._begin_episode(seen)
        found = [
            one if isinstance(one, ActionSteps) else ActionSteps(one)
            for one in self._infer(observations, committed)
        ]
        return [one._replace(raw={**(one.raw or {}), "replica": self._name}) for one in found]

    def _infer(self, observations: Sequence[Observation], committed: Sequence[Any] | None) -> Any:
        batch: Any = getattr(self._policy, "infer_batch", None)
        if batch is not None and len(observations) > 1:
            extra = {} if committed is None else {"committed": list(committed)}
            return batch(list(observations), **extra)
        infer: Any = self._policy.infer
        if committed is None:
            return [infer(seen) for seen in observations]
        both = zip(observations, committed, strict=True)
        return [infer(seen, committed=steps) for seen, steps in both]

    def _begin_episode(self, seen: Observation) -> None:
        if self._episodes.get(seen.robot) == seen.task.episode:
            return
        self._episodes[seen.robot] = seen.task.episode
        reset = reset_of(self._policy, seen.robot)
        if reset is not None and takes_robot(self._policy):
            reset()
