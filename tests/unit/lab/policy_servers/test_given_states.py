"""Whoever asks a model of ours is told which number of its state its arm cannot have."""

from __future__ import annotations

import http.client
import json
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import r2c_peer
from endless_arm import HOME_RAD as ENDLESS_HOME_RAD
from endless_arm import endless_arm
from model_wires import openpi
from vla_zenoh_r2c import wire
from vla_zenoh_r2c.answer import Answers
from vla_zenoh_r2c.declared import read_robot
from vla_zenoh_serve.openpi_server import OpenPiConversation, Tally
from vla_zenoh_serve.policy_server import PolicyServer
from vla_zenoh_serve.served_policy import make_served_policy
from websockets.sync.client import connect

from vla_zenoh.errors import VlaZenohError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.policy import ActionSpec, CameraSpec, ModelSpec, Observation, ObservationSpec
from vla_zenoh.profile import Profile, load_profile

SO101 = load_profile("so101_sim")
HOME_RAD = np.array(SO101.robot.home_rad)
OPENING = 0.4
IMAGE = np.zeros((48, 64, 3), np.uint8)


class Holds:
    """A model of joints that stays where it is, and keeps what it was asked."""

    def __init__(self, profile: Profile, state: Any = ("joint", "gripper")) -> None:
        joints = profile.robot.arm_joints
        gripper = "absolute_m" if "gripper" in state else "none"
        self.spec = ModelSpec(
            name="holds",
            observation=ObservationSpec(cameras=(CameraSpec(camera="front"),), state=state),
            action=ActionSpec(horizon=1, dt_s=0.1, space="joint", joints=joints, gripper=gripper),
        )
        self.asked: list[Observation] = []

    def infer(self, observation: Observation) -> Any:
        self.asked.append(observation)
        return np.zeros((1, self.spec.action.dimension), np.float32)


def by_openpi(joints: Any, opening: float, folder: Path) -> str:
    """What a client of openpi is told; empty: it has an answer. The opening is a width in m."""
    offer = make_served_policy(Holds(SO101), "", SO101)
    fields = {
        "observation/front": IMAGE,
        "observation/joint": np.array(joints),
        "observation/gripper": np.array([opening * SO101.robot.max_width_m]),
        "prompt": "go",
    }
    said = OpenPiConversation(offer, Tally()).reply(openpi.request(fields))
    return said if isinstance(said, str) else ""


def by_r2c(joints: Any, opening: float, folder: Path) -> str:
    """What is told of a robot of R2C; empty: it has an answer. The opening is a share."""
    file = folder / "robot.yaml"
    file.write_text(r2c_peer.DECLARED)
    answers = Answers(Holds(SO101), read_robot(file), SO101)
    names = (*r2c_peer.NAMES[: len(joints)], r2c_peer.NAMES[5])
    try:
        seen = r2c_peer.observation([*joints, opening], id=1, names=names)
        answers.answer(wire.decode_observation(seen), 0)
    except VlaZenohError as error:
        return str(error)
    return ""


SERVERS = [by_openpi, by_r2c]


@pytest.mark.parametrize("ask", SERVERS)
@pytest.mark.parametrize("opening", [OPENING, 1.05, -0.05])
def test_a_gripper_a_little_beyond_its_ends_is_answered(
    ask: Callable[..., str], opening: float, tmp_path: Path
) -> None:
    assert ask(HOME_RAD, opening, tmp_path) == ""


def test_a_joint_a_little_beyond_its_end_is_answered(tmp_path: Path) -> None:
    arm = make_kinematics(SO101)
    past_rad = arm.upper_rad[[arm.arm_joints.index(name) for name in SO101.robot.arm_joints]] + 0.1
    assert by_openpi(past_rad, OPENING, tmp_path) == ""


@pytest.mark.parametrize("ask", SERVERS)
@pytest.mark.parametrize(
    ("joints", "opening", "why"),
    [
        (HOME_RAD[:4], OPENING, r"wanted \(5,\)|declared are"),
        ([*HOME_RAD[:4], np.nan], OPENING, "NaN|not finite|wanted finite"),
        (np.rad2deg(HOME_RAD), OPENING, "joint '.*' is at .* and goes from .* is this in degrees"),
        (HOME_RAD, 4.0, "wide, and opens to"),
        (HOME_RAD, 40.0, "width_m"),
    ],
)
def test_a_state_that_the_arm_cannot_have_is_refused_by_name(
    ask: Callable[..., str], joints: Any, opening: float, why: str, tmp_path: Path
) -> None:
    assert re.search(why, ask(joints, opening, tmp_path))


@pytest.mark.parametrize(
    ("pose", "why"),
    [
        ([400.0, 0, 300.0, 3.14, 0, 0], "500 m from the base: is this in millimetres"),
        ([0.4, 0, 0.3, 180.0, 0, 0], "rpy has 180 rad: is it in degrees"),
    ],
)
def test_a_pose_in_other_units_is_refused_by_name(pose: Any, why: str) -> None:
    profile = load_profile("panda_sim")
    names = "observation/pose=position+rpy"
    offer = make_served_policy(Holds(profile, ("pose",)), names, profile)
    asked = {"observation/front": IMAGE, "observation/pose": np.array(pose), "prompt": "go"}
    with pytest.raises(VlaZenohError, match=why):
        offer.observe(asked, 5)


def test_a_joint_without_an_end_is_seen_as_the_model_declares_it(tmp_path: Path) -> None:
    """And half a turn in degrees is not taken for 28 turns."""
    profile = endless_arm(tmp_path, robot={"gripper": None})
    offer = make_served_policy(Holds(profile, ("joint",)), "", profile)
    asked = {"observation/front": IMAGE, "prompt": "go"}
    joints = np.array([*ENDLESS_HOME_RAD[:5], 3.3])
    seen = offer.observe({**asked, "observation/joint": joints}, 5)
    assert seen.joint is not None
    assert seen.joint.position_rad[5] == pytest.approx(3.3 - 2 * np.pi)
    joints[5] = 180.0
    with pytest.raises(VlaZenohError, match="joint6' turns without an end and is at 180 rad"):
        offer.observe({**asked, "observation/joint": joints}, 5)


def test_what_was_refused_is_counted_in_the_status() -> None:
    server = PolicyServer(make_served_policy(Holds(SO101), "", SO101), "127.0.0.1", 0)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    fields = {"observation/front": IMAGE, "observation/gripper": 0.04, "prompt": "go"}
    try:
        with connect(f"ws://127.0.0.1:{server.port}", compression=None, proxy=None) as client:
            client.recv(10)
            for joints_rad in (HOME_RAD, np.rad2deg(HOME_RAD)):
                client.send(openpi.request({**fields, "observation/joint": joints_rad}))
                told = client.recv(10)
        asking = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
        asking.request("GET", "/status")
        status = json.loads(asking.getresponse().read())
    finally:
        server.stop()
        thread.join()
    assert status["answered"] == 1
    assert status["refused"] == {"implausible_state": 1}
    assert status["last_refused"] == told
