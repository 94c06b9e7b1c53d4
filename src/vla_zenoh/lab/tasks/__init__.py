"""Tasks for the scene ``bricks``: goals, prompts, and a judge. Pure.

Reset the scene with a seed, draw a `TaskEpisode` from the objects' true poses, publish its prompt,
and feed a `TaskJudge`::

    episode = draw_episode(seed, objects)
    judge = Judge(episode.order, objects)
    while (verdict := judge.update(objects, width_m, time_s)) is None and time_s < LIMIT_S:
        ...
    verdict = verdict or judge.end()
"""

from vla_zenoh.lab.tasks.episode import TaskEpisode, draw_episode, draw_stay
from vla_zenoh.lab.tasks.judge import FAILURES, LIMIT_S, TaskJudge, Verdict
from vla_zenoh.lab.tasks.order import COLOURS, DIRECTIONS, FAMILIES, Order, brick
from vla_zenoh.lab.tasks.wording import HELD_OUT, NONSENSE, TRAINING, phrase

__all__ = [
    "COLOURS",
    "DIRECTIONS",
    "FAILURES",
    "FAMILIES",
    "HELD_OUT",
    "LIMIT_S",
    "NONSENSE",
    "TRAINING",
    "Order",
    "TaskEpisode",
    "TaskJudge",
    "Verdict",
    "brick",
    "draw_episode",
    "draw_stay",
    "phrase",
]
