"""Benchmarks as robots: episodes, clocks, what is kept of a run, and lost processes."""

from __future__ import annotations

import json
import threading
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmark_rig import Reacher, own_benchmark, request
from vla_zenoh_benchmarks.contract import make_benchmark, raw_steps
from vla_zenoh_benchmarks.episode import EpisodeConditions, EpisodeOutcome, EpisodeRequest
from vla_zenoh_benchmarks.journal import EPISODES, RunJournal
from vla_zenoh_benchmarks.paired_tasks import compare, read_run
from vla_zenoh_benchmarks.process import BenchmarkLost, replay_episode, run_episode
from vla_zenoh_benchmarks.result import summary, write_page
from vla_zenoh_benchmarks.run import run_at_places

from vla_zenoh.errors import NodeError, OutputError, RecordError, SpecError, WorkerError
from vla_zenoh.policy import ActionSpec
from vla_zenoh.policy.loader import find_model

NATIVE = EpisodeConditions()
PLAN: dict[str, Any] = {
    "benchmark": "own",
    "suite": "reach",
    "worker": "reacher",
    "model": "reacher",
    "options": {},
    "mode": "native",
    "delay_ms": None,
    "replan": 0,
    "versions": {"numpy": "2"},
    "tasks": ["far"],
    "episodes": 3,
}


def run(conditions: EpisodeConditions = NATIVE, worker: Any = None, **of: Any) -> EpisodeOutcome:
    return run_episode(own_benchmark(), request(**of), worker or Reacher(), conditions)


def test_a_model_that_reaches_the_mark_succeeds_and_its_prompt_is_the_tasks() -> None:
    worker = Reacher()
    ended = run(worker=worker)
    assert ended.success
    assert ended.failure == ""
    assert worker.prompts == ["reach the far mark"]
    assert ended.steps == len(ended.actions) < 20


def test_an_episode_is_the_same_every_time_and_another_one_is_not() -> None:
    assert run().end == run().end != run(episode=1).end


def test_the_step_limit_ends_an_episode_as_a_failure() -> None:
    ended = run(max_steps=2)
    assert (ended.success, ended.steps, ended.failure) == (False, 2, "steps")


def test_replan_carries_out_so_many_steps_of_each_chunk() -> None:
    whole, one = run(), run(EpisodeConditions(replan=1))
    assert one.chunks == one.steps
    assert whole.chunks == -(-whole.steps // 3)


def test_live_the_arm_stands_while_the_model_thinks() -> None:
    native, live = run(), run(EpisodeConditions("live", delay_ms=120.0))
    thought = live.chunks - 1  # before its first chunk the clock stands
    assert live.steps == native.steps + 3 * thought  # 120 ms are three steps of 50 ms
    assert live.end == native.end


def test_live_without_a_delay_is_native_to_the_bit() -> None:
    assert run(EpisodeConditions("live", delay_ms=0.0)).end == run().end


def test_through_the_command_node_the_mark_is_reached_within_its_limits() -> None:
    pytest.importorskip("ruckig")
    ended = run(EpisodeConditions("command", delay_ms=100.0))
    assert ended.success, ended.failure
    speed_m_s = np.abs(np.array(ended.actions)[:, :3]) / 0.05
    assert speed_m_s.max() <= 0.5 + 1e-3  # of profile panda_sim


def test_a_hand_that_hangs_below_its_controllers_point_follows_from_the_first_chunk_on() -> None:
    pytest.importorskip("ruckig")
    benchmark = own_benchmark()
    seen, held = benchmark.observe, np.array([0.0, 0.0, 0.04])  # farther than a guard lets jump

    def observe(cameras: Any) -> Any:
        found = seen(cameras)
        pose = found.pose
        assert pose is not None
        above = {"reference_position_m": pose.position_m + held}
        turned = {"reference_quat_xyzw": pose.quat_xyzw}
        return found._replace(pose=replace(pose, **above, **turned))

    benchmark.observe = observe
    pulled = getattr(benchmark, "set_point")  # noqa: B009
    setattr(benchmark, "set_point", lambda at, width: pulled(at - held, width))  # noqa: B010
    command = EpisodeConditions("command", delay_ms=0.0)
    ended = run_episode(benchmark, request(), Reacher(anchor="goal"), command)
    assert ended.success, ended.failure
    assert np.abs(np.array(ended.actions)[1:3, :3]).max() > 0.001


def test_through_the_command_node_the_same_delay_gives_the_same_end() -> None:
    pytest.importorskip("ruckig")
    conditions = EpisodeConditions("command", delay_ms=50.0)
    assert run(conditions).end == run(conditions).end


def test_recorded_steps_end_in_the_same_state() -> None:
    ended = run()
    again = replay_episode(own_benchmark(), request(), ended.actions)
    assert again.success
    assert again.end == ended.end
    shifted = [each + 1e-9 for each in ended.actions]
    assert replay_episode(own_benchmark(), request(), shifted).end != ended.end


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"frame": "tcp"}, "frame is 'tcp', the benchmark's 'base'"),
        ({"rotation": "rpy"}, "rotation is 'rpy'"),
        ({"dt_s": 0.1}, "dt_s is 0.1, the benchmark's 0.05"),
        ({"kind": "velocity"}, "kind is 'velocity'"),
    ],
)
def test_actions_of_another_meaning_are_rejected_by_name(change: Any, named: str) -> None:
    with pytest.raises(SpecError, match=named):
        run(worker=Reacher(**change))


def test_another_unit_of_length_is_converted() -> None:
    ended = run(worker=Reacher(position_scale_m=0.01))
    assert ended.success
    assert ended.steps == run().steps


@pytest.mark.parametrize(
    ("opens_high", "threshold", "given", "raw"),
    [
        (False, 0.0, [-0.3, 0.7], [-0.3, 0.7]),  # the same meaning: the very numbers
        (True, 0.5, [0.9, 0.1], [-1.0, 1.0]),  # OpenVLA's: 1 opens, where LIBERO's -1 does
    ],
)
def test_a_gripper_of_another_sign_is_converted(
    opens_high: bool, threshold: float, given: list[float], raw: list[float]
) -> None:
    own = {"horizon": 2, "dt_s": 0.05, "gripper": "binary"}
    libero = ActionSpec(**own, gripper_open_is_high=False, gripper_threshold=0.0)
    model = ActionSpec(**own, gripper_open_is_high=opens_high, gripper_threshold=threshold)
    steps = np.zeros((2, 7), np.float32)
    steps[:, -1] = given
    assert raw_steps(steps, model, libero)[:, -1] == pytest.approx(raw)


def test_a_file_that_lacks_a_part_of_the_contract_says_which(tmp_path: Path) -> None:
    file = tmp_path / "half.py"
    file.write_text("class Half:\n    suites = ()\n    def observe(self, cameras): ...\n")
    with pytest.raises(WorkerError, match="lacks action, cameras, packages, tasks, reset, step"):
        make_benchmark(find_model(str(file)))


# -- what is kept ---------------------------------------------------------------------------


def ended(episode: int, *, success: bool = True) -> tuple[EpisodeRequest, EpisodeOutcome]:
    asked = request(episode=episode)
    out = run(episode=episode)
    return asked, replace(out, success=success, failure="" if success else "steps")


def test_a_run_goes_on_with_what_has_ended(tmp_path: Path) -> None:
    first = RunJournal(tmp_path / "run", PLAN)
    first.add(*ended(0))
    first.add(*ended(1, success=False))
    again = RunJournal(tmp_path / "run", PLAN)
    assert [each.success for each in again.ended.values()] == [True, False]


def test_a_line_that_was_cut_off_is_no_episode_and_the_next_one_is_whole(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    RunJournal(folder, PLAN).add(*ended(0))
    with (folder / EPISODES).open("ab") as file:
        file.write(b'{"suite": "reach", "task": "fa')
    again = RunJournal(folder, PLAN)
    assert len(again.ended) == 1
    again.add(*ended(1))
    assert len(RunJournal(folder, PLAN).ended) == 2


def test_nothing_is_counted_twice(tmp_path: Path) -> None:
    journal = RunJournal(tmp_path / "run", PLAN)
    journal.add(*ended(0))
    journal.add(*ended(0, success=False))
    assert [each.success for each in journal.ended.values()] == [True]
    assert (tmp_path / "run" / EPISODES).read_text().count("\n") == 1


@pytest.mark.parametrize("name", ["worker", "mode", "versions", "replan"])
def test_a_folder_of_another_run_is_left_alone(tmp_path: Path, name: str) -> None:
    RunJournal(tmp_path / "run", PLAN)
    with pytest.raises(OutputError, match=name):
        RunJournal(tmp_path / "run", {**PLAN, name: "another"})


def test_more_episodes_may_be_asked_for(tmp_path: Path) -> None:
    RunJournal(tmp_path / "run", PLAN).add(*ended(0))
    assert len(RunJournal(tmp_path / "run", {**PLAN, "episodes": 50}).ended) == 1


def test_a_page_names_every_task_and_its_interval(tmp_path: Path) -> None:
    result = summary(PLAN, [ended(0)[1], ended(1, success=False)[1]])
    write_page(tmp_path, result)
    page = (tmp_path / "index.html").read_text("utf-8")
    assert all(each in page for each in ("1 of 2", "far", "9.5 to 90.5 %"))


def test_two_results_are_compared_episode_by_episode() -> None:
    native = summary(PLAN, [ended(i)[1] for i in range(4)])
    plan = {**PLAN, "mode": "live", "delay_ms": 100.0}
    live = summary(plan, [ended(i, success=i > 1)[1] for i in range(4)])
    a, b = (read_run(json.dumps(each).encode(), "") for each in (native, live))
    found = compare(a, b, ("mode", "delay_ms"))
    assert (found.counts.both, found.counts.second, found.counts.difference) == (2, 2, -0.5)


@pytest.mark.parametrize("name", [each.name for each in fields(EpisodeConditions)])
def test_runs_under_another_condition_are_not_compared_unasked(name: str) -> None:
    other = {"mode": "live", "composition": "blend", "takeover": "expert"}.get(name, 2)
    runs = [summary(plan, [ended(0)[1]]) for plan in (PLAN, {**PLAN, name: other})]
    a, b = (read_run(json.dumps(each).encode(), "") for each in runs)
    with pytest.raises(RecordError, match=f"--differ {name}"):
        compare(a, b)


def test_runs_of_another_benchmark_or_its_options_are_not_compared_unasked() -> None:
    for name, other in (("benchmark", "another"), ("benchmark_options", {"size": "96"})):
        runs = [summary(plan, [ended(0)[1]]) for plan in (PLAN, {**PLAN, name: other})]
        a, b = (read_run(json.dumps(each).encode(), "") for each in runs)
        with pytest.raises(RecordError, match=f"--differ {name}"):
            compare(a, b)


# -- processes that die -----------------------------------------------------------------------


class Place:
    """Runs episodes; it is lost at those that `fatal` counts down."""

    def __init__(self, fatal: dict[int, int]) -> None:
        self._fatal = fatal

    def run(self, asked: EpisodeRequest) -> EpisodeOutcome:
        if self._fatal.get(asked.episode, 0) > 0:
            self._fatal[asked.episode] -= 1
            raise BenchmarkLost("killed")
        return EpisodeOutcome(asked.suite, asked.task.name, asked.episode, success=True)

    def close(self) -> None:
        pass


def at_places(fatal: dict[int, int], places: int = 2) -> dict[int, EpisodeOutcome]:
    asked = [request(episode=episode) for episode in range(6)]
    makers = [lambda: Place(fatal)] * places
    return {r.episode: o for r, o in run_at_places(makers, asked, threading.Event())}


def test_an_episode_that_lost_its_process_is_begun_again_and_counted_once() -> None:
    found = at_places({2: 1, 4: 2})
    assert sorted(found) == list(range(6))
    assert [found[episode].attempts for episode in range(6)] == [1, 1, 2, 1, 3, 1]


def test_a_worker_that_keeps_crashing_ends_the_run_while_an_episode_waits_for_it() -> None:
    left = threading.Event()

    class Waiting(Place):
        def run(self, asked: EpisodeRequest) -> EpisodeOutcome:
            left.wait()
            raise BenchmarkLost("closed")

        def close(self) -> None:
            left.set()

    def look() -> None:
        raise NodeError("worker-broken keeps crashing: no module")

    with pytest.raises(NodeError, match="worker-broken keeps crashing"):
        list(run_at_places([lambda: Waiting({})], [request()], threading.Event(), look))


def test_an_episode_that_always_loses_its_process_ends_the_run() -> None:
    with pytest.raises(NodeError, match="reach/far/3: 3 attempts, the last: killed"):
        at_places({3: 9})
