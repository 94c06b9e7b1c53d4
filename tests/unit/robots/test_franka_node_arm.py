"""A Franka behind franka-node, whose place a peer of our own takes (tests/franka_node_peer.py)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import franka_node_peer as peer
import numpy as np
import pytest
from driver_rig import DriverRig
from franka_node_peer import FrankaNode
from vla_zenoh_franka_node import wire

from vla_zenoh.errors import CodecError, NodeError, ProfileError
from vla_zenoh.kinematics.so3 import exp3, rotation_from_quat
from vla_zenoh.profile import load_profile
from vla_zenoh.types import GripperCommand
from vla_zenoh.types.records import JointReference, PoseReference

SOON_S, LOST_S = 5.0, 3.0
EXACT = 1e-6
KEPT_S = 0.2
"""The node holds after this long without a target."""
STILL = np.zeros(7)
HAND = np.eye(4)
HAND[:3, :3] = exp3(np.array([0.0, 0.0, 0.5]))
HAND[:3, 3] = [0.0, 0.01, 0.02]
"""From our TCP to the end effector that is set in Desk."""
PROFILE = """
extends: fr3_franka_node
robot: {{command: {command}}}
franka_node: {{endpoint: "{endpoint}"{options}}}
"""

pytestmark = pytest.mark.realtime


class Rig(DriverRig):
    """A driver, and what it reported."""

    soon_s = SOON_S

    def __init__(self, folder: Path, command: str = "joint", options: str = "") -> None:
        given = {"command": command, "endpoint": peer.ENDPOINT, "options": options}
        super().__init__(folder, PROFILE.format(**given))

    def move_joints(self, position_rad: Any) -> None:
        self.driver.move(JointReference(np.array(position_rad), STILL, STILL), 0)

    @property
    def status(self) -> Any:
        return self.driver.status().detail


def tcp_pose(rig: Rig, position_rad: Any) -> np.ndarray:
    pose, tcp = np.eye(4), rig.driver.forward(np.array(position_rad))
    pose[:3, :3], pose[:3, 3] = tcp.rotation, tcp.position_m
    return pose


def near(values: Any, wanted: Any) -> bool:
    return np.allclose(values, wanted, atol=EXACT)


@pytest.fixture
def node(tmp_path: Path) -> Iterator[FrankaNode]:
    rig = Rig(tmp_path)
    home_rad = rig.profile.robot.home_rad
    with FrankaNode(home_rad, tcp_pose(rig, home_rad) @ HAND) as node:
        yield node


@pytest.fixture
def rig(node: FrankaNode, tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    rig.driver.connect()
    yield rig
    rig.driver.close()


@pytest.fixture
def pose_rig(node: FrankaNode, tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path, "pose")
    rig.driver.connect()
    yield rig
    rig.driver.close()


# -- the lease ------------------------------------------------------------------------------------
def test_the_arm_is_taken_by_token_acquire_and_enable_and_given_back(
    node: FrankaNode, tmp_path: Path
) -> None:
    rig = Rig(tmp_path)
    rig.driver.connect()
    rig.ready()
    asked = dict(node.asked)
    assert asked["enable"]["mode"] == "joints"
    assert asked["enable"]["episode"] == rig.status["episode"]
    assert re.fullmatch(r"[A-Za-z0-9_-]{1,128}", rig.status["episode"])
    assert node.alive == {asked["acquire"]["client_id"]}
    rig.driver.close()
    assert node.verbs()[-2:] == ["stop", "release"]
    assert node.holder == 0


def test_an_arm_of_another_client_is_not_ready_until_it_lets_go(
    node: FrankaNode, tmp_path: Path
) -> None:
    node.holder, node.phase = 7, peer.ACTIVE
    rig = Rig(tmp_path)
    rig.driver.connect()
    rig.until(lambda: rig.newest is not None)
    assert rig.driver.away == "not_ready"
    assert "client 7 of franka-node has the lease" in rig.driver.gripper_mode
    assert node.asked == []
    rig.move_joints(node.q)
    assert node.targets == []
    node.holder, node.phase = 0, peer.IDLE
    rig.ready()
    rig.driver.close()


def test_what_the_node_says_to_a_verb_is_why_the_arm_is_not_ready(
    node: FrankaNode, rig: Rig
) -> None:
    node.denied = "libfranka: the brakes are closed"
    rig.until(lambda: "brakes are closed" in rig.driver.gripper_mode)
    assert rig.driver.away == "not_ready"
    node.denied = ""
    rig.ready()


def test_a_stop_of_anyone_is_obeyed_until_a_reset(node: FrankaNode, rig: Rig) -> None:
    rig.ready()
    rig.move_joints(node.q)
    node.phase = peer.IDLE
    rig.until(lambda: rig.driver.fault != "")
    assert "somebody asked it to stop" in rig.driver.fault
    count = node.verbs().count("enable")
    for _ in range(100):
        rig.tick()
    assert node.verbs().count("enable") == count
    rig.driver.recover()
    rig.ready()
    rig.until(lambda: rig.driver.fault == "")


def test_a_reflex_is_a_fault_and_a_reset_recovers_it(node: FrankaNode, rig: Rig) -> None:
    rig.ready()
    node.phase, node.mode = peer.FAULTED, peer.MODE_REFLEX
    rig.until(lambda: rig.driver.fault != "")
    assert "Reflex" in rig.driver.fault
    assert "recover" not in node.verbs()
    rig.driver.recover()
    rig.ready()
    assert node.verbs().count("recover") == 1
    assert node.verbs().count("enable") == 2


def test_an_arm_that_is_guided_by_hand_is_not_ready(node: FrankaNode, tmp_path: Path) -> None:
    node.mode = peer.MODE_GUIDING
    rig = Rig(tmp_path)
    rig.driver.connect()
    rig.until(lambda: rig.driver.gripper_mode == "guiding")
    assert "enable" not in node.verbs()
    node.mode = peer.MODE_IDLE
    rig.ready()
    rig.driver.close()


# -- motion ---------------------------------------------------------------------------------------
def test_joints_come_back_as_the_state_they_ask_for(node: FrankaNode, rig: Rig) -> None:
    rig.ready()
    wanted_rad = node.q + [0.01, -0.01, 0.02, 0.0, 0.01, -0.02, 0.01]
    rig.move_joints(wanted_rad)
    rig.until(lambda: np.allclose(rig.newest.joints.position_rad, wanted_rad, atol=EXACT))
    version, kind, flags, client, seq, _, *values = node.targets[-1]
    assert (version, kind, flags, client) == (1, 2, 0, rig.status["client_id"])
    assert seq >= 1
    np.testing.assert_allclose(values, wanted_rad)


def test_a_pose_of_our_tcp_is_a_target_of_their_end_effector(
    node: FrankaNode, pose_rig: Rig
) -> None:
    rig = pose_rig
    rig.ready()
    wanted = tcp_pose(rig, node.q)
    wanted[:3, 3] += [0.01, 0.0, -0.02]
    zero = np.zeros(6)
    rig.driver.move(PoseReference(wanted[:3, 3], wanted[:3, :3], zero, zero), 0)
    expected = wanted @ HAND
    rig.until(lambda: bool(node.targets) and near(node.targets[-1][6:9], expected[:3, 3]))
    values = np.array(node.targets[-1][6:])
    assert node.targets[-1][1] == 1
    np.testing.assert_allclose(rotation_from_quat(values[3:]), expected[:3, :3], atol=EXACT)


def test_at_rest_the_last_target_is_repeated_so_the_session_goes_on(
    node: FrankaNode, rig: Rig
) -> None:
    rig.ready()
    rig.move_joints(node.q)
    for _ in range(150):
        rig.tick()
    assert len(node.targets) > 3
    assert np.diff(node.target_times_s).max() < KEPT_S
    assert [target[4] for target in node.targets] == sorted({target[4] for target in node.targets})


@pytest.mark.parametrize(
    ("joint_rad", "why"), [(0.21, "steps from the last target by 0.210 rad at joint 1")]
)
def test_a_target_outside_the_bounds_is_not_sent_and_the_reason_is_told(
    node: FrankaNode, rig: Rig, joint_rad: float, why: str
) -> None:
    rig.ready()
    rig.move_joints(node.q)
    rig.until(lambda: bool(node.targets))
    begin_rad, count = node.q.copy(), 0
    while not rig.driver.fault:
        rig.move_joints(begin_rad + [joint_rad, 0, 0, 0, 0, 0, 0])
        rig.tick()
        count += 1
        assert count < 500
    assert why in rig.driver.fault
    np.testing.assert_allclose(node.q, begin_rad)
    rig.until(lambda: node.verbs()[-1] == "stop")
    assert rig.status["not_sent"] > 0


def test_a_pose_that_leads_the_arm_too_far_is_not_sent(node: FrankaNode, pose_rig: Rig) -> None:
    rig = pose_rig
    rig.ready()
    zero, node.stuck = np.zeros(6), True
    for step in range(200):
        wanted = tcp_pose(rig, node.q)
        wanted[2, 3] += 0.001 * step
        rig.driver.move(PoseReference(wanted[:3, 3], wanted[:3, :3], zero, zero), 0)
        rig.tick()
        if rig.driver.fault:
            break
    assert "leads the arm by" in rig.driver.fault
    highest_m = max(target[8] for target in node.targets)
    assert highest_m - node.ee[2, 3] <= 0.05 + EXACT


def test_targets_that_the_node_refuses_are_a_fault_of_ours(node: FrankaNode, rig: Rig) -> None:
    rig.ready()
    node.deaf = True
    rig.until(lambda: rig.driver.fault != "")
    assert "franka-node refuses our targets" in rig.driver.fault
    assert rig.status["refused"] > 0
    node.deaf = False
    rig.until(lambda: node.phase == peer.IDLE)
    rig.driver.recover()
    rig.ready()


# -- states ---------------------------------------------------------------------------------------
def test_silence_of_the_node_ends_ours(node: FrankaNode, rig: Rig) -> None:
    rig.ready()
    node.silent = True
    with pytest.raises(NodeError, match="no new state of 'fr3'"):
        rig.until(lambda: False, LOST_S)


def test_a_state_of_another_version_is_not_used(node: FrankaNode, rig: Rig) -> None:
    rig.ready()
    node.garbled = True
    rig.until(lambda: rig.status["rejected_states"] > 0)
    assert "version 9, wanted 1" in rig.status["complaint"]


def test_nobody_there_is_told_with_what_to_do(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    with pytest.raises(NodeError, match=r"set franka_node\.endpoint"):
        rig.driver.connect()
    rig.driver.close()


def test_a_node_without_the_arm_is_told(node: FrankaNode, tmp_path: Path) -> None:
    rig = Rig(tmp_path, options=", name: left")
    with pytest.raises(NodeError, match="has an arm 'left'"):
        rig.driver.connect()
    rig.driver.close()


@pytest.mark.parametrize("size", [0, 1, 473, 475])
def test_a_state_of_another_size_is_rejected(size: int) -> None:
    with pytest.raises(CodecError, match="bytes, wanted 474"):
        wire.decode_state(bytes([1] * size))


# -- gripper --------------------------------------------------------------------------------------
def test_shutting_grasps_and_opening_moves(node: FrankaNode, rig: Rig) -> None:
    rig.ready()
    rig.until(lambda: rig.newest.gripper.width_m == pytest.approx(0.04))
    rig.driver.grip(GripperCommand(0.0, 0.1, 20.0), 0)
    rig.until(lambda: bool(node.grips))
    assert node.grips[-1][1] == 2
    assert node.grips[-1][6:] == (0.0, 20.0)
    node.width_m, node.hand_flags = 0.03, 1 | 2
    rig.until(lambda: rig.newest.gripper.holding)
    rig.driver.grip(GripperCommand(0.08, 0.1, 20.0), 0)
    rig.until(lambda: len(node.grips) == 2)
    assert node.grips[-1][1] == 1
    assert node.grips[-1][4] > node.grips[0][4]


def test_what_keeps_closing_fingers_from_their_width_is_grasped_once(
    node: FrankaNode, rig: Rig
) -> None:
    rig.ready()
    rig.until(lambda: rig.newest.gripper.width_m == pytest.approx(0.04))
    rig.driver.grip(GripperCommand(0.02, 0.1, 20.0), 0)
    node.width_m = 0.03
    rig.until(lambda: len(node.grips) == 2)
    rig.until(lambda: rig.newest.gripper.holding)
    assert [grip[1] for grip in node.grips] == [1, 2]


# -- profiles -------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("timing: {command_hz: 250.0}", "refuses targets at more than 250 Hz"),
        (
            "limits: {translation: {velocity_m_s: 0.3, acceleration_m_s2: 0.28}}",
            "the node's budget allows 0.173 an axis",
        ),
        (
            "limits: {rotation: {acceleration_rad_s2: 3.0}}",
            "the node's budget allows 1 an axis",
        ),
    ],
)
def test_a_profile_that_the_node_would_refuse_is_not_loaded(
    tmp_path: Path, line: str, why: str
) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text(f"extends: fr3_franka_node\n{line}\n")
    with pytest.raises(ProfileError, match=why):
        load_profile(str(path))
