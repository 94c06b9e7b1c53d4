"""Two runs of `bench task`: what is paired, what is refused, what is printed and returned."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner
from vla_zenoh_benchmarks.cli_compare import B_IS_WORSE
from vla_zenoh_benchmarks.cli_compare import compare as command
from vla_zenoh_benchmarks.paired_tasks import CONDITIONS, TaskResultFile, compare, read_run
from vla_zenoh_benchmarks.task_score import TaskScore

from vla_zenoh.errors import RecordError, ResourceError
from vla_zenoh.lab.tasks.episode import TaskEpisode
from vla_zenoh.lab.tasks.order import Order
from vla_zenoh.lab.tasks.task import TaskOutcome, TaskPlan

SEED = 1_000_000
FAMILIES = ("put", "stack", "push")
ORDERS = {
    "put": Order("put", "red"),
    "stack": Order("stack", "red", onto="blue"),
    "push": Order("push", "red", direction="left"),
}
ATOL = 1e-12


def run(done: Sequence[bool], *, seed: int = SEED, **what: Any) -> TaskResultFile:
    """A run, by way of the file that the benchmark writes."""
    return read_run(written(done, seed=seed, **what), "a.json")


def written(
    done: Sequence[bool], *, seed: int = SEED, model: str = "m", mode: str = "lockstep", **plan: Any
) -> bytes:
    vary, options = plan.pop("vary", ()), plan.pop("options", {})
    orders: Callable[[int], Order] = plan.pop("orders", lambda i: ORDERS[FAMILIES[i % 3]])
    score = TaskScore(TaskPlan(model, len(done), seed, **plan), mode, "p", vary, options=options)
    score.ended += [
        TaskOutcome(
            TaskEpisode(seed + i, orders(i), "do it"),
            "do it",
            success,
            "" if success else "dropped",
            3,
        )
        for i, success in enumerate(done)
    ]
    return json.dumps(score.to_dict()).encode()


A = [True, True, False, False, True, False]
B = [True, False, True, False, True, False]


def test_pairs_are_counted_by_who_did_them() -> None:
    found = compare(run(A), run(B)).to_dict()
    assert [found[name] for name in ("pairs", "both", "only_a", "only_b", "neither")] == [
        6,
        2,
        1,
        1,
        2,
    ]
    assert (found["rate_a"], found["rate_b"], found["difference"]) == (0.5, 0.5, 0.0)
    assert found["p"] == 1.0
    assert found["unpaired"] == {"a": 0, "b": 0}
    assert [(one["seed"], one["done_by"]) for one in found["disagreements"]] == [
        (SEED + 1, "a"),
        (SEED + 2, "b"),
    ]
    assert found["disagreements"][0]["failure_of_the_other"] == "dropped"
    json.dumps(found, allow_nan=False)


def test_families_and_tasks_have_their_own_counts_and_add_up() -> None:
    found = compare(run(A), run(B)).to_dict()
    assert set(found["by_family"]) == set(FAMILIES)
    assert set(found["by_task"]) == {"put red", "stack red on blue", "push red left"}
    assert found["by_family"]["stack"]["only_a"] == 1
    assert found["by_family"]["push"]["only_b"] == 1
    for part in ("by_family", "by_task"):
        assert sum(row["pairs"] for row in found[part].values()) == found["pairs"]


@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=40))
def test_the_difference_is_that_of_the_rates_and_turns_with_the_order(
    outcomes: list[tuple[bool, bool]],
) -> None:
    one, other = (run([each[who] for each in outcomes]) for who in (0, 1))
    found, turned = compare(one, other).to_dict(), compare(other, one).to_dict()
    assert found["difference"] == pytest.approx(found["rate_b"] - found["rate_a"], abs=ATOL)
    assert found["difference"] == pytest.approx(-turned["difference"], abs=ATOL)
    assert found["p"] == turned["p"]
    assert not (found["b_is_worse"] and turned["b_is_worse"])


def test_layouts_of_one_run_alone_are_left_out_and_counted() -> None:
    found = compare(run(A), run(B[:4], seed=SEED + 3, orders=lambda i: ORDERS[FAMILIES[i % 3]]))
    assert found.unpaired == (3, 1)
    assert [one.seed for one, _ in found.pairs] == [SEED + 3, SEED + 4, SEED + 5]


def test_another_task_in_the_same_layout_is_no_pair() -> None:
    found = compare(run(A), run(B, orders=lambda i: ORDERS["put"]))
    assert [one.task for one, _ in found.pairs] == ["put red", "put red"]
    assert found.unpaired == (4, 4)


def test_a_task_that_was_asked_twice_of_a_layout_is_paired_twice() -> None:
    def twice(done: Sequence[bool]) -> TaskResultFile:
        content = json.loads(written(done, orders=lambda _: ORDERS["put"]))
        for each in content["all"]:
            each["seed"] = SEED
        return read_run(json.dumps(content).encode(), "a.json")

    found = compare(twice([True, False]), twice([True, True])).to_dict()
    assert (found["pairs"], found["both"], found["only_b"]) == (2, 1, 1)


@pytest.mark.parametrize(
    ("what", "told"),
    [
        ({"delay_ms": 140.0}, "delay_ms is 0 in A and 140 in B"),
        ({"rate_hz": 10.0}, "rate_hz is not set in A and 10 in B"),
        ({"limit_s": 8.0}, "limit_s is 30 in A and 8 in B"),
        ({"held_out": True}, "held_out is False in A and True in B"),
        ({"prompt": "hold"}, "prompt is not set in A and hold in B"),
        ({"mode": "real_time"}, "mode is lockstep in A and real_time in B"),
        ({"vary": ("lights", "camera")}, "vary is not set in A and lights+camera in B"),
    ],
)
def test_runs_under_other_conditions_are_refused_unless_these_are_compared(
    what: dict[str, Any], told: str
) -> None:
    (name,) = what
    with pytest.raises(RecordError) as refused:
        compare(run(A), run(B, **what))
    assert told in str(refused.value)
    assert f"--differ {name}" in str(refused.value)
    found = compare(run(A), run(B, **what), [name]).to_dict()
    assert list(found["differ"]) == [name]
    others = [each for each in CONDITIONS if each != name]
    with pytest.raises(RecordError, match=f"--differ {name}$"):
        compare(run(A), run(B, **what), others)


def test_the_model_and_its_options_may_differ_as_they_are_what_is_compared() -> None:
    found = compare(run(A), run(B, model="n", options={"checkpoint": "new"})).to_dict()
    assert (found["a"]["model"], found["b"]["model"]) == ("m", "n")
    assert found["b"]["options"] == {"checkpoint": "new"}
    assert found["differ"] == {}


def test_another_scene_is_refused_whatever_is_compared() -> None:
    kitchen = run(B).model_copy(update={"scene": "kitchen"})
    with pytest.raises(RecordError, match="in bricks, B in kitchen"):
        compare(run(A), kitchen, CONDITIONS)


@pytest.mark.parametrize(
    ("b", "told"),
    [
        (run(B, seed=5), "no layout is in both: A has seeds 1000000 to 1000005, B 5 to 10"),
        (run(B[:1], orders=lambda _: ORDERS["push"]), "other tasks were asked in them"),
        (run([]), "B has no episodes"),
    ],
)
def test_runs_without_a_task_in_common_are_refused(b: TaskResultFile, told: str) -> None:
    with pytest.raises(RecordError, match=told):
        compare(run(A), b)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"no json", "x.json is no result of `vla-zenoh bench task`"),
        (b"[]", "x.json is no result"),
        (
            b'{"model": "m"}',
            "x.json is no result of .* or `bench sim`: options is missing",
        ),
        (written(A).replace(b'"seed": 1000002', b'"seed": "x"'), r"all\.2\.seed wants a whole"),
        (written(A).replace(b'"success": true', b'"success": 1'), r"all\.0\.success wants true or"),
        (b"\xff", "x.json is no result"),
    ],
)
def test_a_file_that_is_no_result_is_refused_with_what_is_wrong(content: bytes, told: str) -> None:
    with pytest.raises(RecordError, match=told):
        read_run(content, "x.json")


# -- the command ----------------------------------------------------------------------------------

APP = typer.Typer()
APP.command()(command)


@pytest.fixture
def phrase(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    monkeypatch.chdir(tmp_path)

    def phrase(a: bytes, b: bytes, *words: str) -> Any:
        Path("a.json").write_bytes(a)
        Path("b.json").write_bytes(b)
        return CliRunner().invoke(APP, ["a.json", "b.json", *words])

    return phrase


def test_no_difference_is_no_failure_and_is_said(phrase: Callable[..., Any]) -> None:
    found = phrase(written(A), written(B))
    assert found.exit_code == 0
    assert "Too few of the 6 pairs differ to tell: 2" in found.stdout
    assert "between" not in found.stdout
    assert "1000001, stack red on blue: done by A alone, the other: dropped" in found.stdout


def test_the_exit_code_says_whether_b_is_worse(phrase: Callable[..., Any]) -> None:
    good, bad = written([True] * 9), written([False] * 9)
    worse = phrase(good, bad)
    assert worse.exit_code == B_IS_WORSE
    assert "B does fewer of the same tasks than A: p = 0.0039." in worse.stdout
    better = phrase(bad, good)
    assert better.exit_code == 0
    assert "B does more of the same tasks than A" in better.stdout
    # Five of five are not enough: p is 2/32.
    assert phrase(written([True] * 5), written([False] * 5)).exit_code == 0


def test_a_script_gets_json_and_the_same_exit_code(phrase: Callable[..., Any]) -> None:
    found = phrase(written([True] * 9), written([False] * 9), "--json")
    assert found.exit_code == B_IS_WORSE
    assert json.loads(found.stdout)["only_a"] == 9


def test_a_narrow_screen_loses_no_figure(phrase: Callable[..., Any]) -> None:
    found = phrase(written([True] * 300), written([False] * 300), "--tasks")
    assert "…" not in found.stdout
    assert "-100.0%" in found.stdout


def test_tasks_have_rows_when_they_are_asked_for(phrase: Callable[..., Any]) -> None:
    assert "push red left" not in phrase(written(A), written(A)).stdout
    assert "push red left" in phrase(written(A), written(A), "--tasks").stdout


def test_what_cannot_be_compared_is_an_error(phrase: Callable[..., Any]) -> None:
    assert isinstance(phrase(written(A), written(B, delay_ms=9.0)).exception, RecordError)
    assert phrase(written(A), written(B, delay_ms=9.0), "--differ", "delay_ms").exit_code == 0
    assert phrase(written(A), written(B), "--differ", "delay").exit_code == 2
    Path("b.json").unlink()
    missing = CliRunner().invoke(APP, ["a.json", "b.json"])
    assert isinstance(missing.exception, ResourceError)
    assert "b.json cannot be read: No such file" in str(missing.exception)
