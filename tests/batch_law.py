"""The law of `infer_batch`: each robot is answered as if a worker of its own answered it.

Robots come and go, in any order, at rates of their own, and begin episodes when they like.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from hypothesis import strategies as st

from vla_zenoh.policy import Observation, check_steps
from vla_zenoh.policy.inference import Committed

ROBOTS = ("a", "b", "c")
PERIOD_NS = 200_000_000


@dataclass(frozen=True, slots=True)
class Round:
    """One inference.

    Args:
        asked: robot -> the seed of what it sees, in the order in which they are asked.
        begun: robots that began an episode before.
        frozen: robot -> number of the steps of its last chunk that can no longer change.
    """

    asked: Mapping[str, int]
    begun: frozenset[str]
    frozen: Mapping[str, int]


def rounds() -> st.SearchStrategy[list[Round]]:
    """Some inferences, each for some of `ROBOTS`."""
    order = st.lists(st.sampled_from(ROBOTS), min_size=1, unique=True)
    one = order.flatmap(
        lambda asked: st.builds(
            Round,
            asked=st.fixed_dictionaries({robot: st.integers(0, 99) for robot in asked}),
            begun=st.frozensets(st.sampled_from(ROBOTS), max_size=1),
            frozen=st.dictionaries(st.sampled_from(asked), st.integers(1, 3)),
        )
    )
    return st.lists(one, min_size=1, max_size=4)


def check_law(
    together: Any,
    alone: Mapping[str, Any],
    given: list[Round],
    observe: Callable[[int], Observation],
    atol: float,
) -> None:
    """Compare one model for all with one for each, both from the beginning of an episode.

    Args:
        together: the model that batches.
        alone: robot -> a model like it.
        given: what happens.
        observe: an observation for a seed.
        atol: of the steps.
    """
    last: dict[str, np.ndarray] = {}
    for robot in ROBOTS:
        begin(together, robot)
        begin(alone[robot], robot)
    for number, one in enumerate(given):
        for robot in one.begun:
            begin(together, robot)
            begin(alone[robot], robot)
            last.pop(robot, None)
        seen = [
            replace(observe(seed), robot=robot, stamp_wall_ns=(number + 1) * PERIOD_NS)
            for robot, seed in one.asked.items()
        ]
        prefixes = [
            Committed(last[each.robot][1:], one.frozen[each.robot])
            if each.robot in last and each.robot in one.frozen
            else None
            for each in seen
        ]
        takes = together.takes_committed if hasattr(together, "takes_committed") else False
        found = together.infer_batch(seen, **({"committed": prefixes} if takes else {}))
        assert len(found) == len(seen)
        for each, prefix, answer in zip(seen, prefixes, found, strict=True):
            own = alone[each.robot].infer(each, **({"committed": prefix} if takes else {}))
            steps = check_steps(together.spec.action, answer.steps)
            np.testing.assert_allclose(steps, np.asarray(own.steps), atol=atol)
            last[each.robot] = steps


def begin(model: Any, robot: str) -> None:
    """Begin an episode, of a model that remembers something."""
    if hasattr(model, "reset"):
        model.reset(robot)
