"""R2C on a bus: a robot asks a model of ours, and a policy of theirs is a worker of ours."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import r2c_peer as peer
import zenoh
from peer_rig import free_port
from vla_zenoh_r2c import link, wire
from vla_zenoh_r2c.answer import Answers
from vla_zenoh_r2c.declared import read_robot
from vla_zenoh_r2c.gateway import Gateway

from vla_zenoh.errors import PeerError, WorkerError
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import ActionSpec, ModelSpec, Observation, ObservationSpec
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile
from vla_zenoh.types import GripperState, JointState

SO101 = load_profile("so101_sim")
HOME_RAD = np.array(SO101.robot.home_rad)
HOME = [*HOME_RAD, 0.4]
SOON_S = 4.0
STILL = np.zeros(5)

pytestmark = pytest.mark.realtime


def until(what: Callable[[], bool]) -> None:
    end_s = time.monotonic() + SOON_S
    while not what():
        assert time.monotonic() < end_s
        time.sleep(0.01)


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """Of a router."""
    port, config = free_port(), zenoh.Config()
    settings = {"mode": "router", "listen/endpoints": [f"tcp/127.0.0.1:{port}"]}
    for name, value in (settings | {"scouting/multicast/enabled": False}).items():
        config.insert_json5(name, json.dumps(value))
    with zenoh.open(config):
        yield port


@pytest.fixture
def declared(tmp_path: Path) -> Path:
    path = tmp_path / "robot.yaml"
    path.write_text(peer.DECLARED)
    return path


# -- a robot of theirs, our model -----------------------------------------------------------------
class Up:
    """Moves each joint by 0.01 rad."""

    spec = ModelSpec(
        name="up",
        observation=ObservationSpec(state=("joint",)),
        action=ActionSpec(
            horizon=1,
            dt_s=1 / 30,
            space="joint",
            joints=SO101.robot.arm_joints,
            gripper="none",
        ),
    )

    def infer(self, observation: Observation) -> Any:
        if observation.prompt == "break":
            raise ValueError("a model that breaks")
        return np.full((1, 5), 0.01)


class Served:
    """A gateway that runs, and a robot beside it."""

    def __init__(self, port: int, declared: Path) -> None:
        robot = read_robot(declared)
        self.session = link.connected(SO101, f"tcp/127.0.0.1:{port}")
        self.gateway = Gateway(self.session, robot, Answers(Up(), robot, SO101))
        self.counts = self.gateway.counts
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.gateway.run, args=(self._stop,))
        self._thread.start()
        self.robot = peer.Robot(port)
        self._id = 0

    def ask(self, position: Any = HOME, **more: Any) -> None:
        self._id += 1
        self.robot.ask(peer.observation(position, id=self._id, **more))

    def answered(self, **more: Any) -> tuple[int, int, np.ndarray]:
        """The answer to the next question, asked again until it comes."""
        before, end_s = len(self.robot.answers), time.monotonic() + SOON_S
        while len(self.robot.answers) == before:
            assert time.monotonic() < end_s, self.counts
            self.ask(**more)
            time.sleep(0.1)
        return self.robot.answers[-1]

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.session.close()
        self.robot.session.close()


@pytest.fixture
def served(port: int, declared: Path) -> Iterator[Served]:
    served = Served(port, declared)
    yield served
    served.close()


def test_a_robot_is_answered_with_its_own_id(served: Served) -> None:
    identity, size, rows = served.answered()
    assert 1 <= identity <= served._id
    assert size == 1
    np.testing.assert_allclose(rows, [[*(HOME_RAD + 0.01), 0.4]], atol=1e-6)


def test_an_observation_that_is_wrong_is_counted_and_not_answered(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    served.answered()
    before = len(served.robot.answers)
    stamp_ms = served.gateway._admission._stamp_ms
    for reason, ask in {
        "not_finite": lambda: served.ask([float("nan")] * 6),
        "shape": lambda: served.ask([0.0] * 5, names=()),
        "stale": lambda: served.ask(timestamp=peer.now_ms() - 5_000),
        "replayed": lambda: served.robot.ask(peer.observation(HOME, id=1, timestamp=stamp_ms)),
        "oversize": lambda: served.robot.ask(bytes(wire.MAX_BYTES + 1)),
        "malformed": lambda: served.robot.ask(b"{}"),
        "model_failed": lambda: served.ask(task="break"),
    }.items():
        ask()
        until(lambda reason=reason: served.counts[reason] == 1)
    assert len(served.robot.answers) == before
    assert "joint_states.position is [nan" in caplog.text
    assert "a model that breaks" in caplog.text
    served.answered()


def test_a_deletion_is_no_observation(served: Served) -> None:
    served.answered()
    served.robot.session.delete(peer.OBSERVATIONS)
    until(lambda: served.counts["deleted"] == 1)


def test_beside_another_policy_there_is_no_answer_of_ours(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    served.answered()
    served.robot.session.put(peer.ACTIONS, peer.actions([HOME]))
    until(lambda: served.counts["second_policy"] == 1)
    before = served.counts["answered"]
    served.ask()
    until(lambda: served.counts["quiet"] == 1)
    assert served.counts["answered"] == before
    assert "somebody else answers on lab/so101/inference/actions" in caplog.text


def test_a_second_robot_of_one_name_is_told(served: Served) -> None:
    served.answered()
    served.ask()
    served.robot.ask(peer.observation(HOME, id=1, timestamp=peer.now_ms() + 5))
    until(lambda: served.counts["foreign"] >= 1)


# -- a policy of theirs, our arm ------------------------------------------------------------------
def made(declared: Path, port: int, **options: str) -> Any:
    given = {
        "robot": str(declared),
        "profile": "so101_sim",
        "endpoint": f"tcp/127.0.0.1:{port}",
        **options,
    }
    return make_policy(find_model("r2c_policy"), given)


class Asking:
    """The worker's model, and a policy that answers as `reply` says."""

    def __init__(self, declared: Path, port: int) -> None:
        self.model = made(declared, port, timeout_s="0.3")
        self.model.load()
        self.reply: Any = lambda asked: None
        self.policy = peer.Policy(port, lambda asked: self.reply(asked))

    def answer(self) -> Any:
        """The steps, or why there are none."""
        example = example_observation(self.model.spec, prompt="pick")
        seen = replace(
            example,
            stamp_wall_ns=time.time_ns(),
            joint=JointState(SO101.robot.arm_joints, HOME_RAD, STILL, STILL),
            gripper=GripperState(0.04, moving=False, holding=False),
        )
        try:
            return np.array(self.model.infer(seen).steps)
        except PeerError as error:
            return f"{error.reason}: {error}"

    def steps(self) -> Any:
        """The steps, once both know each other."""
        end_s = time.monotonic() + SOON_S
        while isinstance(found := self.answer(), str):
            assert time.monotonic() < end_s, found
        return found

    def close(self) -> None:
        self.policy.session.close()
        self.model.close()


@pytest.fixture
def asking(declared: Path, port: int) -> Iterator[Asking]:
    asking = Asking(declared, port)
    yield asking
    asking.close()


def test_a_policy_is_asked_and_its_answer_is_our_steps(asking: Asking) -> None:
    asking.reply = lambda asked: peer.actions(
        [asked["position"], asked["position"] + 0.01], id=asked["id"]
    )
    steps = asking.steps()
    asked = asking.policy.seen[-1]
    assert (asked["task"], asked["encoding"], list(asked["images"])) == ("pick", "raw", ["front"])
    assert asked["names"] == list(peer.NAMES)
    np.testing.assert_allclose(asked["position"], [*HOME_RAD, 0.4])
    wanted = [[*HOME_RAD, 0.04], [*(HOME_RAD + 0.01), 0.041]]
    np.testing.assert_allclose(steps, wanted, atol=1e-6)


def test_a_policy_that_is_silent_is_told(asking: Asking) -> None:
    answer = asking.answer()
    assert "peer_timeout: no policy answered observation" in answer
    assert "within 0.3 s" in answer


def test_an_answer_to_another_question_moves_nothing(asking: Asking) -> None:
    asking.reply = lambda asked: peer.actions([HOME], id=asked["id"] - 1)
    until(lambda: "an answer to" in asking.answer())


@pytest.mark.parametrize(
    ("reply", "why"),
    [
        (lambda asked: peer.actions([[float("nan")] * 6], id=asked["id"]), "wanted finite"),
        (lambda asked: peer.actions([[0.0] * 4], id=asked["id"], names=()), "has 4 numbers"),
        (lambda asked: peer.actions([HOME], id=asked["id"], chunk_size=9), "chunk_size is 9"),
        (lambda asked: bytes(wire.MAX_ACTION_BYTES + 1), "are accepted"),
    ],
)
def test_a_wrong_answer_moves_nothing_and_is_told(asking: Asking, reply: Any, why: str) -> None:
    asking.reply = reply
    until(lambda: why in str(asking.answer()))


def test_of_two_policies_neither_is_followed(asking: Asking) -> None:
    asking.reply = lambda asked: peer.actions([asked["position"]], id=asked["id"])
    asking.steps()
    second = asking.policy.seen[-1]["id"]
    asking.policy.session.put(peer.ACTIONS, peer.actions([HOME], id=second))
    until(lambda: "second_policy" in str(asking.answer()))


def test_what_is_not_declared_is_missing_by_name() -> None:
    for name in ("robot", "profile"):
        other = {"robot": "profile", "profile": "robot"}[name]
        with pytest.raises(WorkerError, match=name):
            make_policy(find_model("r2c_policy"), {other: "so101_sim"})
