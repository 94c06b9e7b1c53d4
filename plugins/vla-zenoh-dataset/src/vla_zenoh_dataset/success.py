"""Success of an episode, by the verdict of a person or by the simulator's true poses."""

from __future__ import annotations

from vla_zenoh.errors import RecordError
from vla_zenoh.lab.recording.run import newest
from vla_zenoh.lab.recording.verdict import FACT, TRIALS, Verdict, verdict_in
from vla_zenoh.lab.tasks.judge import SETTLED_S, judge_of
from vla_zenoh.lab.tasks.order import parse_prompt
from vla_zenoh_dataset.episodes import RecordedEpisode

AFTER_NS = int(1.2 * SETTLED_S * 1e9)
"""Time after the end in which a brick that was just released is judged."""


def verdict_of_person(episode: RecordedEpisode) -> Verdict | None:
    """Of the operator, on any worker that led the arm in it; None: there is none.

    An episode of a trial that was killed before the verdict is void: the trial repeats it.
    """
    ended = episode.run.file.ended
    for worker in (episode.worker, *episode.workers):
        verdict = verdict_in(ended, worker)
        if verdict is not None:
            return verdict
    path = episode.run.path
    return "void" if (path.parent / TRIALS).exists() and FACT not in (ended or {}) else None


def succeeded(episode: RecordedEpisode) -> bool | None:
    """The verdict of a person, else that of the true poses; None if unknown.

    It is unknown if the person called the episode void, or if there is no verdict of a person and
    the prompt changed or is no known task, no true poses were recorded, or the recording ended
    before the episode did.
    """
    said = verdict_of_person(episode)
    if said is not None:
        return None if said == "void" else said == "success"
    prompts = {frame.prompt for frame in episode.frames}
    order = parse_prompt(prompts.pop()) if len(prompts) == 1 else None
    run = episode.run
    before = newest(run.objects, episode.since_ns)
    pose = newest(run.poses, episode.since_ns)
    if order is None or before is None or pose is None:
        return None
    try:
        judge = judge_of(order, before.record, pose.record.position_m)
    except RecordError:
        return None
    verdict = None
    for entry in run.objects:
        at_ns = entry.header.stamp_wall_ns
        if not episode.since_ns <= at_ns < episode.until_ns + AFTER_NS:
            continue
        width, pose = newest(run.grippers, at_ns), newest(run.poses, at_ns)
        if width is None or pose is None:
            continue
        time_s = (at_ns - episode.since_ns) / 1e9
        verdict = judge.update(entry.record, width.record.opening_m, time_s, pose.record.position_m)
        if verdict is not None:
            break
    if verdict is None and not episode.is_over:
        return None
    return (verdict or judge.end()).success
