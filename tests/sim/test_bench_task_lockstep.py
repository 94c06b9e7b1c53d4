"""The task benchmark gives nothing away: who knows no task does none."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from vla_zenoh_benchmarks import task_lockstep
from vla_zenoh_benchmarks.cli_task import _with_bricks
from vla_zenoh_benchmarks.task_lockstep import run_in_lockstep

from vla_zenoh.errors import NodeError
from vla_zenoh.lab.tasks.task import BASELINES, TaskOutcome, TaskPlan
from vla_zenoh.profile import load_profile, override

SEED = 1_000_000
LIMIT_S = 4.0


MODEL = """\
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec


class Nod:
    spec = ModelSpec(name="nod", action=ActionSpec(horizon=1, dt_s=0.1))

    def __init__(self, step_m="0.0"):
        self.step_m = float(step_m)

    def load(self):
        pass

    def infer(self, observation):
        return ActionSteps([[0, 0, self.step_m, 0, 0, 0, 0]])
"""


def outcomes(
    plan: TaskPlan, path: str = "", options: dict[str, str] | None = None, processes: int = 1
) -> list[TaskOutcome]:
    profile = _with_bricks(load_profile("panda_sim"), plan.worker, [], path)
    small = {
        name: {**camera.model_dump(mode="json"), "width": 64, "height": 48}
        for name, camera in profile.cameras.items()
    }
    profile = override(profile, {"cameras": small})
    event = threading.Event()
    found = run_in_lockstep(profile, plan, options or {}, "front", event, processes)
    return [each for each, _ in found]


@pytest.mark.slow
def test_a_model_of_ones_own_is_run_with_its_options(tmp_path: Path) -> None:
    (tmp_path / "nod.py").write_text(MODEL)
    plan = TaskPlan("nod", 1, SEED, family="stay", limit_s=LIMIT_S)
    (still,) = outcomes(plan, str(tmp_path / "nod.py"))
    (moved,) = outcomes(plan, str(tmp_path / "nod.py"), {"step_m": "0.02"})
    assert (still.success, moved.failure) == (True, "moved")


@pytest.mark.parametrize(
    ("text", "options", "told"),
    [
        (MODEL, {"colour": "red"}, r"has no option 'colour'\. Its options: step_m"),
        (MODEL.replace("pass", "raise OSError('no weights')"), {}, "loaded: OSError: no weights"),
    ],
)
def test_why_a_model_cannot_be_made_is_told_by_the_first_that_asks(
    tmp_path: Path, text: str, options: dict[str, str], told: str
) -> None:
    (tmp_path / "nod.py").write_text(text)
    plan = TaskPlan("nod", 1, SEED)
    profile = _with_bricks(load_profile("panda_sim"), "nod", [], str(tmp_path / "nod.py"))
    task_lockstep._prepare(profile, plan, options, None, None)
    with pytest.raises(NodeError, match=told):
        task_lockstep._one(next(plan.requests()))


@pytest.mark.slow
def test_a_model_that_cannot_be_made_ends_the_bench_with_its_reason(tmp_path: Path) -> None:
    (tmp_path / "nod.py").write_text(MODEL)
    with pytest.raises(NodeError, match="Its options: step_m"):
        outcomes(TaskPlan("nod", 40, SEED), str(tmp_path / "nod.py"), {"colour": "red"}, 2)


@pytest.mark.slow
def test_a_model_that_raises_fails_its_episode_and_its_words_are_told(tmp_path: Path) -> None:
    text = MODEL.replace(
        "return ActionSteps", "raise KeyError('front')\n        return ActionSteps"
    )
    (tmp_path / "nod.py").write_text(text)
    ends = outcomes(TaskPlan("nod", 2, SEED, limit_s=LIMIT_S), str(tmp_path / "nod.py"))
    assert [end.failure for end in ends] == ["not_obeyed"] * 2
    assert ends[0].why == "the model failed: KeyError: there is no 'front'"


@pytest.mark.slow
def test_who_stands_still_does_no_task() -> None:
    (end,) = outcomes(TaskPlan("hold", 1, SEED, family="put", limit_s=LIMIT_S))
    assert (end.success, end.failure) == (False, "not_moved")
    assert end.pictures is not None


@pytest.mark.slow
def test_who_moves_when_nothing_is_asked_fails() -> None:
    (end,) = outcomes(TaskPlan("scripted", 1, SEED, family="stay", limit_s=LIMIT_S))
    assert (end.success, end.failure) == (False, "moved")


@pytest.mark.slow
def test_who_stands_still_when_nothing_is_asked_succeeds() -> None:
    (end,) = outcomes(TaskPlan("hold", 1, SEED, family="stay", limit_s=LIMIT_S))
    assert end.success
    assert end.pictures is None


@pytest.mark.slow
def test_a_worker_that_refuses_the_prompt_is_not_obeyed_and_its_reason_is_told() -> None:
    (end,) = outcomes(TaskPlan("scripted", 1, SEED, prompt="fetch", limit_s=LIMIT_S))
    assert end.failure == "not_obeyed"
    assert "does not know the prompt 'fetch'" in end.why


@pytest.mark.slow
@pytest.mark.parametrize("model", BASELINES)
def test_baselines_reach_nothing(model: str) -> None:
    assert not any(end.success for end in outcomes(TaskPlan(model, 12, SEED)))


@pytest.mark.long
@pytest.mark.parametrize("speed_percent", [30, 60])
def test_the_shipped_policy_pushes_a_brick_at_a_lower_speed_override(speed_percent: float) -> None:
    profile = override(load_profile("panda_bricks"), {"task": {"speed_percent": speed_percent}})
    plan = TaskPlan("brick", 1, SEED, family="push", limit_s=20.0)
    ((done, _),) = run_in_lockstep(profile, plan, {}, "front", threading.Event(), 1)
    assert done.success, done.failure
