"""Tasks for the scenes ``bricks`` and ``pair``: goals, prompts, and judges. Pure.

Reset the scene with a seed, draw a `TaskEpisode` from the objects' true poses, publish its prompt,
and feed a `TaskJudge`::

    episode = draw_episode(seed, objects)
    judge = Judge(episode.order, objects)
    while (verdict := judge.update(objects, width_m, time_s)) is None and time_s < LIMIT_S:
        ...
    verdict = verdict or judge.end()
"""

from vla_zenoh.lab.tasks.episode import TaskEpisode, draw_episode, draw_stay
from vla_zenoh.lab.tasks.judge import FAILURES, LIMIT_S, BarJudge, TaskJudge, Verdict
from vla_zenoh.lab.tasks.order import (
    COLOURS,
    DIRECTIONS,
    FAMILIES,
    HELD_OUT,
    LIFT,
    LIFT_PROMPT,
    NONSENSE,
    TRAINING,
    Order,
    brick,
    phrase,
)
from vla_zenoh.types import FloatArray, ObjectPoses


def judge_of(
    order: Order, before: ObjectPoses, tcp_m: FloatArray | None = None
) -> TaskJudge | BarJudge:
    """The judge of a goal; see `TaskJudge` for the arguments and errors."""
    return BarJudge(order, before) if order.family == LIFT else TaskJudge(order, before, tcp_m)


__all__ = [
    "COLOURS",
    "DIRECTIONS",
    "FAILURES",
    "FAMILIES",
    "HELD_OUT",
    "LIFT",
    "LIFT_PROMPT",
    "LIMIT_S",
    "NONSENSE",
    "TRAINING",
    "BarJudge",
    "Order",
    "TaskEpisode",
    "TaskJudge",
    "Verdict",
    "brick",
    "draw_episode",
    "draw_stay",
    "judge_of",
    "phrase",
]
