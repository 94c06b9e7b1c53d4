"""A worker says what its model sees and does to whoever asks, whatever the model sees."""

from __future__ import annotations

import time

import numpy as np
import pytest
from camera_rig import routed_session

from vla_zenoh.bus.buffers import Wake, bytes_of
from vla_zenoh.codec import records
from vla_zenoh.errors import PromptError
from vla_zenoh.nodes.worker.robot_session import RobotSession
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.profile import load_profile
from vla_zenoh.types import Task

WAIT_S = 5.0


class Feel:
    """A model that reads states."""

    def __init__(self, cameras: tuple[str, ...], state: tuple[str, ...]) -> None:
        looks = ObservationSpec(
            cameras=tuple(CameraSpec(camera=name) for name in cameras),
            state=state,  # pyright: ignore[reportArgumentType]
        )
        action = ActionSpec(horizon=1, dt_s=0.1, rotation="rpy", gripper="none")
        self.spec = ModelSpec(name="feel", observation=looks, action=action)

    def infer(self, observation: object) -> ActionSteps:
        return ActionSteps(np.zeros((1, 6)))


@pytest.mark.parametrize(
    ("cameras", "state"), [((), ()), (("front",), ()), ((), ("pose",)), ((), ("joint", "gripper"))]
)
def test_a_worker_answers_a_query_of_its_spec(
    cameras: tuple[str, ...], state: tuple[str, ...]
) -> None:
    profile, model = load_profile("panda_sim"), Feel(cameras, state)
    with routed_session() as session:
        worker = RobotSession(
            profile, session, model, "feel", images="raw", host=None, changed=Wake()
        )
        replies = list(session.get(profile.keys.spec("feel"), timeout=WAIT_S))
        worker.close()
    (answer,) = (
        records.decode(ModelSpec, bytes_of(each.ok.payload)) for each in replies if each.ok
    )
    assert answer == model.spec


@pytest.mark.parametrize(("chosen", "counted"), [("feel", {"refused.contract": 1}), ("other", {})])
def test_only_a_worker_that_is_chosen_counts_a_prompt_that_it_does_not_know(
    chosen: str, counted: dict[str, int]
) -> None:
    profile, model = load_profile("panda_sim"), Feel((), ())
    with routed_session() as session:
        worker = RobotSession(
            profile, session, model, "feel", images="raw", host=None, changed=Wake()
        )
        worker.task = Task(1, False, "dance", chosen, 5.0)
        worker.failed(PromptError("it knows no 'dance'"))
        worker.close()
    assert worker.complaint == "contract: it knows no 'dance'"
    assert dict(worker.node.counters) == counted


def test_why_an_answer_was_rejected_is_told_until_the_next_good_one() -> None:
    profile, model = load_profile("panda_sim"), Feel((), ())
    with routed_session() as session:
        worker = RobotSession(
            profile, session, model, "feel", images="raw", host=None, changed=Wake()
        )
        seen = Observation(time.time_ns(), 1, Task(1, True, "go", "feel", 5.0))
        told = []
        for value in (np.nan, np.nan, 0.0):
            answer = ActionSteps(np.full((1, 6), value))
            worker.publish(seen, answer, (time.time_ns(),) * 3, 1)
            worker.task = seen.task
            worker._task_received_s = time.monotonic()
            assert worker.observe() is not None
            told.append(worker.complaint)
        worker.close()
    assert told[0] == told[1] == "contract: steps hold NaN or infinity"
    assert told[2] == ""
