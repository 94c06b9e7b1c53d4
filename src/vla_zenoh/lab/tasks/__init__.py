"""Tasks for the scenes ``bricks`` and ``pair``: goals, prompts, and judges. Pure.

Reset the scene with a seed, draw a `TaskEpisode` from the objects' true poses, publish its prompt,
and feed a judge::

    episode = draw_episode(seed, objects)
    judge = judge_of(episode.order, objects)
    while (verdict := judge.update(objects, width_m, time_s)) is None and time_s < LIMIT_S:
        ...
    verdict = verdict or judge.end()
"""
