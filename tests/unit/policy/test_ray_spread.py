"""Replicas of a model: shared out, asked again where one is lost or slow, reset by themselves."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from vla_zenoh_ray import spread
from vla_zenoh_ray.model import RayServe
from vla_zenoh_ray.replica import Replica
from vla_zenoh_ray.spread import Spread

from vla_zenoh.errors import SpecError, WorkerError
from vla_zenoh.policy import ActionSteps, Observation
from vla_zenoh.policy.loader import find_model
from vla_zenoh.types import Task

MODEL = '''
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, ObservationSpec


class Counts:
    """Answers with how many observations of this episode a robot has had."""

    spec = ModelSpec(
        name="counts",
        observation=ObservationSpec(cameras=(), state=("pose",), prompt=False),
        action=ActionSpec(horizon=1, dt_s=0.1, gripper="none"),
    )

    def __init__(self, factor="1"):
        self.factor = float(factor)
        self.had = {}

    def reset(self, robot):
        self.had[robot] = 0

    def infer(self, observation):
        self.had[observation.robot] += 1
        return ActionSteps([[self.factor * self.had[observation.robot], 0, 0, 0, 0, 0]])
'''


def seen(robot: str, episode: int = 1) -> Observation:
    return Observation(1, 1, Task(episode, True, "go", "shared", 10.0), robot=robot)


def names(answers: Sequence[ActionSteps]) -> list[Any]:
    return [answer.steps for answer in answers]


Answer = Callable[[Sequence[Observation], Sequence[Any] | None], list[ActionSteps]]


@pytest.fixture
def made() -> Iterator[Callable[[Answer, int], Spread]]:
    every: list[Spread] = []

    def make(ask: Answer, replicas: int) -> Spread:
        every.append(Spread(ask, replicas))
        return every[-1]

    yield make
    for one in every:
        one.close()


def echo(observations: Sequence[Observation], _: Sequence[Any] | None) -> list[ActionSteps]:
    return [ActionSteps(one.robot) for one in observations]


def test_observations_are_shared_out_among_replicas_and_answers_keep_their_order(
    made: Callable[[Answer, int], Spread],
) -> None:
    sizes: list[int] = []

    def ask(observations: Sequence[Observation], given: Sequence[Any] | None) -> list[ActionSteps]:
        sizes.append(len(observations))
        assert given == [one.robot.upper() for one in observations]
        return echo(observations, given)

    found = made(ask, 2).answers([seen(robot) for robot in "abcde"], list("ABCDE"))
    assert names(found) == list("abcde")
    assert sorted(sizes) == [2, 3]


def test_a_lost_replica_costs_its_observations_one_more_request(
    made: Callable[[Answer, int], Spread],
) -> None:
    lost = threading.Event()

    def ask(observations: Sequence[Observation], given: Sequence[Any] | None) -> list[ActionSteps]:
        if not lost.is_set():
            lost.set()
            raise ConnectionError("the replica died")
        return echo(observations, given)

    asked = made(ask, 2)
    assert names(asked.answers([seen("a"), seen("b")])) == ["a", "b"]
    assert asked.asked_again == 1


def test_another_replica_is_asked_where_one_hangs(made: Callable[[Answer, int], Spread]) -> None:
    hangs, ended = threading.Event(), threading.Event()

    def ask(observations: Sequence[Observation], given: Sequence[Any] | None) -> list[ActionSteps]:
        if hangs.is_set():
            hangs.clear()
            ended.wait()
        return echo(observations, given)

    asked = made(ask, 2)
    asked.answers([seen("a")])
    hangs.set()
    assert names(asked.answers([seen("a")])) == ["a"]
    assert asked.asked_again == 1
    ended.set()


def test_without_any_replica_it_says_so_instead_of_answering_an_old_observation(
    made: Callable[[Answer, int], Spread], monkeypatch: pytest.MonkeyPatch
) -> None:
    def ask(*_: Any) -> list[ActionSteps]:
        raise ConnectionError("all are gone")

    monkeypatch.setattr(spread, "FIRST_PATIENCE_S", 0.05)
    with pytest.raises(WorkerError, match=r"no replica .*all are gone.*ray status"):
        made(ask, 2).answers([seen("a")])


def test_no_replica_that_answers_again_is_asked_for_old_observations(
    made: Callable[[Answer, int], Spread], monkeypatch: pytest.MonkeyPatch
) -> None:
    hang, asked = threading.Event(), list[str]()

    def ask(observations: Sequence[Observation], given: Sequence[Any] | None) -> list[ActionSteps]:
        asked.append(observations[0].robot)
        hang.wait()
        return echo(observations, given)

    monkeypatch.setattr(spread, "FIRST_PATIENCE_S", 0.002)
    replicas = made(ask, 1)
    for _ in range(8):
        with pytest.raises(WorkerError, match="no replica"):
            replicas.answers([seen("old")])
    hang.set()
    assert names(replicas.answers([seen("new")])) == ["new"]
    assert len(asked) - asked.count("new") <= 8, "as many as there are threads"


def test_what_the_model_raises_is_not_asked_again(made: Callable[[Answer, int], Spread]) -> None:
    def ask(*_: Any) -> list[ActionSteps]:
        raise ValueError("no such prompt")

    asked = made(ask, 2)
    with pytest.raises(ValueError, match="no such prompt"):
        asked.answers([seen("a")])
    assert asked.asked_again == 0


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "counts.py"
    path.write_text(MODEL)
    return path


def test_a_replica_resets_a_robot_whose_episode_it_has_not_seen(model: Path) -> None:
    front = RayServe(str(model))
    replica = Replica(str(model), {}, "", front.spec.hash)

    def count(*observations: Observation) -> list[float]:
        return [float(answer.steps[0][0]) for answer in replica.answers(observations, None)]

    assert count(seen("a"), seen("b")) == [1.0, 1.0]
    assert count(seen("a")) == [2.0]
    assert count(seen("a", episode=2), seen("b")) == [1.0, 2.0]


def test_each_answer_says_which_replica_gave_it(model: Path) -> None:
    replica = Replica(str(model), {}, "", RayServe(str(model)).spec.hash)
    (answer,) = replica.answers([seen("a")], None)
    assert answer.raw is not None
    assert ":" in answer.raw["replica"]


def test_a_replica_with_another_spec_is_refused_by_name(model: Path) -> None:
    front = RayServe(str(model), factor="2")
    # Of another length: Python knows a compiled file by its second and size.
    model.write_text(MODEL.replace("horizon=1", "horizon=20"))
    with pytest.raises(SpecError, match=f"the worker has {front.spec.hash}: give both hosts"):
        Replica(str(model), {}, "", front.spec.hash)


def test_its_environment_has_ray_and_what_the_model_asks_for(model: Path) -> None:
    model.write_text('# /// script\n# dependencies = ["torch==2.9.0"]\n# ///\n' + MODEL)
    brought = find_model("ray_serve").for_options({"model": str(model), "factor": "2"})
    assert brought.dependencies == ("ray[serve]>=2.60", "vla-zenoh-ray", "torch==2.9.0")


def test_a_model_that_remembers_one_robot_is_refused(model: Path) -> None:
    model.write_text(MODEL.replace("def reset(self, robot)", "def reset(self)"))
    with pytest.raises(WorkerError, match=r"give its reset the robot's name, reset\(robot\)"):
        RayServe(str(model))


def test_no_more_robots_at_once_than_replicas_where_a_model_has_no_batch(model: Path) -> None:
    assert RayServe(str(model), replicas="3").max_batch == 3
