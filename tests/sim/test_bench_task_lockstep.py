"""The task benchmark gives nothing away: who knows no task does none."""

from __future__ import annotations

import threading

import pytest

from vla_zenoh.bench.task import BASELINES, Ended, Plan
from vla_zenoh.cli.bench_task import _with_bricks
from vla_zenoh.nodes.bench.task_lockstep import run_in_lockstep
from vla_zenoh.profile import load_profile, override

SEED = 1_000_000
LIMIT_S = 4.0


def outcomes(plan: Plan) -> list[Ended]:
    profile = _with_bricks(load_profile("panda_sim"), plan.worker, [])
    small = {
        name: {**camera.model_dump(mode="json"), "width": 64, "height": 48}
        for name, camera in profile.cameras.items()
    }
    profile = override(profile, {"cameras": small})
    found = run_in_lockstep(profile, plan, {}, "front", threading.Event(), 1)
    return [each for each, _ in found]


@pytest.mark.slow
def test_who_stands_still_does_no_task() -> None:
    (end,) = outcomes(Plan("hold", 1, SEED, family="put", limit_s=LIMIT_S))
    assert (end.success, end.failure) == (False, "not_moved")
    assert end.pictures is not None


def test_who_moves_when_nothing_is_asked_fails() -> None:
    (end,) = outcomes(Plan("scripted", 1, SEED, family="stay", limit_s=LIMIT_S))
    assert (end.success, end.failure) == (False, "moved")


@pytest.mark.slow
def test_who_stands_still_when_nothing_is_asked_succeeds() -> None:
    (end,) = outcomes(Plan("hold", 1, SEED, family="stay", limit_s=LIMIT_S))
    assert end.success
    assert end.pictures is None


@pytest.mark.slow
def test_a_worker_that_refuses_the_prompt_is_not_obeyed_and_its_reason_is_told() -> None:
    (end,) = outcomes(Plan("scripted", 1, SEED, prompt="fetch", limit_s=LIMIT_S))
    assert end.failure == "not_obeyed"
    assert "does not know the prompt 'fetch'" in end.why


@pytest.mark.slow
@pytest.mark.parametrize("model", BASELINES)
def test_baselines_reach_nothing(model: str) -> None:
    assert not any(end.success for end in outcomes(Plan(model, 12, SEED)))
