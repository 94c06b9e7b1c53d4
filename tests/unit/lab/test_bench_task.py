"""The task benchmark: what it asks, what outcomes add up to, and that it gives nothing away."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner
from vla_zenoh_benchmarks.cli_task import _named, _varied, _with_bricks, task
from vla_zenoh_benchmarks.statistics import wilson_95
from vla_zenoh_benchmarks.task_score import TaskScore, failure_sheet

from vla_zenoh.codec.image import decode_jpeg, encode_jpeg
from vla_zenoh.errors import NodeError
from vla_zenoh.lab.cli.running_nodes import LAST_LINES, up_with_last_lines
from vla_zenoh.lab.tasks.episode import TaskEpisode
from vla_zenoh.lab.tasks.judge import Verdict
from vla_zenoh.lab.tasks.order import COLOURS, FAMILIES, Order, brick
from vla_zenoh.lab.tasks.task import BASELINES, TaskOutcome, TaskPlan, TaskRequest
from vla_zenoh.lab.tasks.task_sheet import (
    FRAME_HEIGHT,
    FRAME_WIDTH,
    GAP,
    TITLE_HEIGHT,
    sheet,
)
from vla_zenoh.profile import load_profile
from vla_zenoh.types import Image, ObjectPoses

SEED = 1_000_000
ATOL = 5e-4
PICTURE = encode_jpeg(Image(np.full((48, 64, 3), 90, np.uint8)))


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    # As R's binom.confint(method = "wilson") and others give them.
    [
        (97, 100, 0.9155, 0.9897),
        (0, 20, 0.0, 0.1611),
        (20, 20, 0.8389, 1.0),
        (5, 10, 0.2366, 0.7634),
    ],
)
def test_the_wilson_interval_of_known_counts_is_known(
    successes: int, trials: int, low: float, high: float
) -> None:
    assert wilson_95(successes, trials) == pytest.approx((low, high), abs=ATOL)


@given(st.integers(1, 2000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_the_interval_holds_the_rate_and_more_trials_make_it_narrower(
    counts: tuple[int, int],
) -> None:
    successes, trials = counts
    low, high = wilson_95(successes, trials)
    assert 0.0 <= low <= successes / trials <= high <= 1.0
    wider, narrower = high - low, np.diff(wilson_95(4 * successes, 4 * trials))[0]
    assert narrower < wider


def test_without_trials_nothing_is_known() -> None:
    assert wilson_95(0, 0) == (0.0, 1.0)


# -- what is asked --------------------------------------------------------------------------------


def test_families_take_turns_and_every_episode_has_a_layout_of_its_own() -> None:
    asked = list(TaskPlan("m", 7, SEED).requests())
    assert [each.seed for each in asked] == list(range(SEED, SEED + 7))
    assert [each.family for each in asked[:3]] == list(FAMILIES)


def scattered(names: list[str]) -> ObjectPoses:
    """Bricks far apart on the table, the box behind them."""
    places = [(0.40 + 0.13 * (i % 2), -0.15 + 0.14 * (i // 2), 0.01) for i in range(len(names))]
    places[-1] = (0.45, 0.30, 0.0)
    return ObjectPoses(
        tuple(names), np.array(places), np.tile([0.0, 0.0, 0.0, 1.0], (len(names), 1))
    )


OBJECTS = scattered([*map(brick, COLOURS), "box"])
CROWDED = ObjectPoses(
    OBJECTS.names,
    np.array([[0.45 + 0.036 * (i % 3), 0.036 * (i // 3), 0.01] for i in range(5)]),
    OBJECTS.quat_xyzw,
)


@pytest.mark.parametrize("family", FAMILIES)
def test_the_task_is_of_the_family_asked_for(family: str) -> None:
    assert TaskRequest(SEED, family).draw(OBJECTS, held_out=False).order.family == family


def test_where_nothing_can_be_pushed_another_task_is_asked_instead_of_leaving_the_layout_out() -> (
    None
):
    episode = TaskRequest(SEED, "push").draw(CROWDED, held_out=False)
    assert episode.order.family != "push"
    assert episode.seed == SEED


def test_a_baseline_runs_a_shipped_worker_with_its_own_prompt() -> None:
    episode = TaskRequest(SEED, "put").draw(OBJECTS, held_out=False)
    for name, (worker, prompt) in BASELINES.items():
        plan = TaskPlan(name, 1, SEED)
        assert plan.worker == worker
        assert plan.prompt_for(episode) == prompt
    assert TaskPlan("brick", 1, SEED).worker == "brick"
    assert TaskPlan("brick", 1, SEED).prompt_for(episode) == episode.prompt
    assert TaskPlan("brick", 1, SEED, prompt="hold").prompt_for(episode) == "hold"


# -- what it adds up to ---------------------------------------------------------------------------


def ended(family: str, failure: str = "", time_s: float = 8.0) -> TaskOutcome:
    order = {
        "put": Order("put", "red"),
        "stack": Order("stack", "red", onto="blue"),
        "push": Order("push", "red", direction="left"),
        "stay": Order("stay"),
    }[family]
    verdict = Verdict(not failure, failure, time_s)
    task = TaskEpisode(SEED, order, "do it")
    how = (verdict.success, verdict.failure, verdict.time_s)
    return TaskOutcome(task, "do it", *how, pictures=(PICTURE, PICTURE))


def score(*outcomes: TaskOutcome, **plan: Any) -> dict[str, Any]:
    made = TaskScore(TaskPlan("m", len(outcomes), SEED, **plan), "lockstep", "p")
    made.ended += outcomes
    return json.loads(json.dumps(made.to_dict(), allow_nan=False))


def test_outcomes_are_counted_by_kind_and_by_family() -> None:
    result = score(
        ended("put", time_s=6.0),
        ended("put", "dropped"),
        ended("stack", time_s=10.0),
        ended("push", "off_course"),
        ended("push", "off_course"),
    )
    assert (result["successes"], result["episodes"], result["success_rate"]) == (2, 5, 0.4)
    assert result["failures"] == {"off_course": 2, "dropped": 1}
    assert result["wilson_95"] == pytest.approx(wilson_95(2, 5))
    assert result["time_to_success_s"]["p50"] == 8.0
    families = result["by_family"]
    assert {name: row["successes"] for name, row in families.items()} == {
        "push": 0,
        "put": 1,
        "stack": 1,
    }
    assert families["push"]["time_to_success_s"] is None
    assert sum(row["episodes"] for row in families.values()) == 5
    assert [each["seed"] for each in result["all"]] == [SEED] * 5


def test_a_run_that_was_ended_before_its_first_episode_has_no_rate() -> None:
    result = score()
    assert result["success_rate"] is None
    assert result["wilson_95"] == [0.0, 1.0]


def test_a_result_says_with_which_options_it_was_made_and_keeps_secrets() -> None:
    made = TaskScore(
        TaskPlan("m", 0, SEED), "lockstep", "p", options={"file": "a", "api_key": "hush"}
    )
    assert made.to_dict()["options"] == {"file": "a", "api_key": "(secret)"}


def test_the_sheet_shows_the_failures_alone() -> None:
    assert failure_sheet([ended("put")]) is None
    found = failure_sheet([ended("put"), *(ended("push", "off_course") for _ in range(4))])
    assert found is not None
    height, width, _ = decode_jpeg(found).rgb.shape
    assert (height, width) == (
        4 * (TITLE_HEIGHT + FRAME_HEIGHT + GAP),
        2 * FRAME_WIDTH + 3 * GAP,
    )


def test_a_sheet_of_many_failures_is_a_picture_that_can_be_read() -> None:
    found = failure_sheet([ended("push", "off_course") for _ in range(25)])
    assert found is not None
    assert decode_jpeg(found).rgb.shape[0] == 15 * (TITLE_HEIGHT + FRAME_HEIGHT + GAP)


@pytest.mark.parametrize(("failure", "strongest"), [("", "green"), ("off_course", "red")])
def test_the_mark_of_a_row_tells_success_from_failure(failure: str, strongest: str) -> None:
    found = sheet([replace(ended("push", failure), prompt="push the red brick left")])
    assert found is not None
    mark = decode_jpeg(found).rgb[:TITLE_HEIGHT, :TITLE_HEIGHT].reshape(-1, 3).astype(int)
    coloured = mark[np.ptp(mark, axis=1) > 80].mean(axis=0)
    assert ("red", "green", "blue")[int(coloured.argmax())] == strongest


def test_a_prompt_that_nobody_can_judge_has_neither_colour() -> None:
    unknown = replace(ended("stay"), prompt="make me a sandwich")
    found = sheet([unknown])
    assert found is not None
    mark = decode_jpeg(found).rgb[:TITLE_HEIGHT, :TITLE_HEIGHT].reshape(-1, 3).astype(int)
    assert not (np.ptp(mark, axis=1) > 80).any()


def test_the_profile_gets_the_scene_the_worker_and_what_is_varied() -> None:
    profile = _with_bricks(load_profile("panda_sim"), "brick", _varied(["camera", "lights"]))
    assert profile.sim.scene == "bricks"
    assert profile.sim.vary == ("lights", "camera")
    assert profile.task.worker == "brick"
    assert [host.workers for host in profile.hosts.values()] == [("brick",)]


@pytest.mark.parametrize("own", ["nod.py", "nod/model.py", "nod"])
def test_a_model_of_ones_own_is_a_worker_of_the_profile_by_its_name(
    tmp_path: Path, own: str
) -> None:
    file = tmp_path / ("nod.py" if own == "nod.py" else "nod/model.py")
    file.parent.mkdir(exist_ok=True)
    file.write_text("class Nod: ...\n")
    name, path = _named(str(tmp_path / own))
    assert (name, path) == ("nod", str(file))
    profile = _with_bricks(load_profile("panda_sim"), name, [], path)
    assert profile.models == {"nod": path}
    assert profile.task.worker == "nod"
    assert [host.workers for host in profile.hosts.values()] == [("nod",)]


BENCH = typer.Typer()
BENCH.command()(task)


def told(*words: str) -> str:
    """What the command says before anything runs."""
    found = CliRunner().invoke(BENCH, [*words, "--episodes", "1"], env={"COLUMNS": "200"})
    assert found.exit_code != 0
    return f"{found.output} {found.exception}"


@pytest.mark.parametrize("how", [(), ("--lockstep",)])
def test_what_cannot_run_is_told_before_anything_starts(
    tmp_path: Path, how: tuple[str, ...]
) -> None:
    assert "no model called 'brik'; did you mean 'brick'?" in told("--model", "brik", *how)
    assert "--set wants name=value" in told("--model", "brick", "--set", "file", *how)
    (tmp_path / "hold.py").write_text("")
    said = told("--model", str(tmp_path / "hold.py"), *how)
    assert "hold is the name of a baseline" in said


LONG = "worker-nod | " + "x" * 300 + " takes: step_m"


@pytest.mark.parametrize("fails", ["before it is up", "at work"])
def test_where_the_nodes_fail_their_last_lines_are_shown_whole_and_not_those_of_their_end(
    fails: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lines: deque[str] = deque(["old", *map(str, range(LAST_LINES - 1)), LONG], LAST_LINES)

    @contextmanager
    def nodes() -> Iterator[Any]:
        if fails == "before it is up":
            raise NodeError("a router answers already")
        try:
            yield None
        finally:
            lines.extend(["farewell"] * LAST_LINES)

    host: Any = nodes()
    with pytest.raises(NodeError), up_with_last_lines(host, lines):
        raise NodeError("it dies again and again")
    said = capsys.readouterr().err
    assert LONG in said
    assert "farewell" not in said
    assert "old" not in said
