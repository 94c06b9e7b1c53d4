"""A client of physicalai's as a worker: our arm as a robot of its own."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from physicalai_peer import PORT_OF_ARM_3, SO101, Client, unpacked

from vla_zenoh.errors import PeerError, WorkerError
from vla_zenoh.lab.check.examples import example_observation
from vla_zenoh.policy import Observation
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile
from vla_zenoh.robots.python_driver import PythonDriver
from vla_zenoh.types import GripperState, JointState

SOON_S = 4.0
PROFILE = load_profile("so101_sim")
HOME_RAD = np.array(PROFILE.robot.home_rad)
STILL = np.zeros(5)
EXACT_RAD = 1e-6

pytestmark = pytest.mark.realtime


def made(**options: str) -> Any:
    return make_policy(
        find_model("physicalai_client"), {"profile": "so101_sim", "name": "arm_3", **options}
    )


def seen(policy: Any, width_m: float = 0.04) -> Observation:
    example = example_observation(policy.spec, prompt="")
    joint = JointState(PROFILE.robot.arm_joints, HOME_RAD, STILL, STILL)
    gripper = GripperState(width_m, moving=False, holding=False)
    return replace(example, stamp_wall_ns=time.time_ns(), joint=joint, gripper=gripper)


class Pair:
    """The worker's model, and a client of it."""

    def __init__(self) -> None:
        self.policy = made()
        self.policy.load()
        self.policy.reset()
        self.client = Client("arm_3", PORT_OF_ARM_3)

    def state(self) -> dict[str, Any]:
        """A state, as the client gets it."""
        end_s = time.monotonic() + SOON_S
        while True:
            self.answer()
            sample = self.client.states.try_recv()
            if sample is not None:
                return msgpack.unpackb(sample.payload.to_bytes())
            assert time.monotonic() < end_s
            time.sleep(0.01)

    def answer(self) -> np.ndarray | str:
        """The step, or why there is none."""
        try:
            (step,) = self.policy.infer(seen(self.policy)).steps
        except PeerError as error:
            return f"{error.reason}: {error}"
        return step

    def acted(self, values: Any, **said: Any) -> np.ndarray | str:
        """The answer once this action has come."""
        before = self.policy._sent_s, self.policy._rejected
        end_s = time.monotonic() + SOON_S
        answer = self.answer()
        while (self.policy._sent_s, self.policy._rejected) == before:
            assert time.monotonic() < end_s
            self.client.act(values, **said)
            time.sleep(0.01)
            answer = self.answer()
        return answer

    def close(self) -> None:
        self.client.session.close()
        self.policy.close()


@pytest.fixture
def pair() -> Iterator[Pair]:
    pair = Pair()
    yield pair
    pair.close()


def test_a_client_finds_the_arm_and_its_state(pair: Pair) -> None:
    assert pair.client.metadata() | {"host": ""} == {
        "protocol_version": 1,
        "name": "arm_3",
        "robot_class": "vla_zenoh.normalised",
        "host": "",
        "joint_names": list(SO101),
        "num_joints": 6,
        "state_dim": 6,
    }
    state = pair.state()
    assert set(state) == {"joint_positions", "state", "timestamp", "sensor_data"}
    assert 0 <= time.monotonic() - state["timestamp"] < SOON_S
    joints = unpacked(state["joint_positions"])
    assert joints[5] == pytest.approx(40.0)
    assert np.all(np.abs(joints[:5]) < 100)


def test_an_action_is_the_step_it_asks_for(pair: Pair) -> None:
    joints = unpacked(pair.state()["joint_positions"])
    step = pair.acted(joints)
    assert not isinstance(step, str)
    np.testing.assert_allclose(step, [*HOME_RAD, 0.04], atol=EXACT_RAD)


def test_without_an_action_there_is_no_answer(pair: Pair) -> None:
    answer = pair.answer()
    assert isinstance(answer, str)
    assert "silent: no client of 'arm_3' put a valid action in the last 0.5 s" in answer


def test_a_client_that_falls_silent_is_obeyed_no_longer(pair: Pair) -> None:
    step = pair.acted(np.zeros(6))
    assert not isinstance(step, str)
    time.sleep(0.6)
    assert isinstance(pair.answer(), str)


def test_an_action_before_the_episode_moves_nothing_in_it(pair: Pair) -> None:
    sent_s = time.monotonic()
    assert not isinstance(pair.acted(np.zeros(6)), str)
    pair.policy.reset()
    assert isinstance(pair.answer(), str)
    assert "is not of this episode" in pair.acted(np.zeros(6), ts=sent_s)


@pytest.mark.parametrize(
    ("values", "said", "why"),
    [
        ([0.0, float("nan"), 0, 0, 0, 0], {}, "wanted finite numbers"),
        ([0.0] * 5, {}, "shape [5], wanted [6]"),
        ([0.0] * 6, {"ts": "now"}, "Expected `float`, got `str`"),
        ([0.0] * 6, {"ts": 1e12}, "is not of this episode"),
        ([0.0] * 6, {"goal_time": float("inf")}, "goal_time is inf"),
        ([0.0] * 6, {"action": [0.0] * 6}, "Expected `object`, got `array`"),
    ],
)
def test_a_wrong_action_is_told_and_moves_nothing(
    pair: Pair, values: list[float], said: dict[str, Any], why: str
) -> None:
    answer = pair.acted(values, **said)
    assert isinstance(answer, str)
    assert why in answer


def test_two_owners_of_one_name_are_told_apart(pair: Pair) -> None:
    with pytest.raises(WorkerError, match=f":{PORT_OF_ARM_3} is taken: does another owner"):
        made().load()


def test_options_are_checked() -> None:
    for why, wrong in {
        "units is 'ticks', allowed": {"units": "ticks"},
        "gripper is 'perhaps', allowed": {"gripper": "perhaps"},
        "dt_s is 'soon', wanted a number": {"dt_s": "soon"},
        "'a/b' is no robot of physicalai": {"name": "a/b"},
    }.items():
        with pytest.raises(WorkerError, match=why):
            made(**wrong)


def test_the_driver_and_the_worker_mean_the_same(pair: Pair, tmp_path: Path) -> None:
    """Our driver as the client of our worker: what it reads is where the arm is."""
    path = tmp_path / "lab.yaml"
    path.write_text("extends: so101_physicalai\nphysicalai: {name: arm_3}\n")
    driver = PythonDriver(load_profile(str(path)))
    driver.connect()
    pair.answer()
    end_s = time.monotonic() + SOON_S
    while (reading := driver.robot.read()) is None:
        assert time.monotonic() < end_s
        pair.answer()
        time.sleep(0.01)
    np.testing.assert_allclose(np.asarray(reading.position_rad), HOME_RAD, atol=EXACT_RAD)
    assert reading.width_m == pytest.approx(0.04)
    driver.close()
