"""A robot of physicalai's, whose owner is a peer of our own (tests/physicalai_peer.py)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from driver_rig import DriverRig
from physicalai_peer import PORT_OF_ARM_2, SO101, Client, Owner, packed, unpacked
from vla_zenoh_physicalai import wire

from vla_zenoh.errors import CodecError, NodeError, ProfileError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.types import GripperCommand, JointReference

SOON_S = 4.0
PROFILE = "extends: so101_physicalai\nphysicalai: {{{options}}}\n"
STILL = np.zeros(5)
EXACT_RAD = 1e-6
"""States are float32."""

pytestmark = pytest.mark.realtime


class Rig(DriverRig):
    """A driver, and what it reported."""

    soon_s = SOON_S

    def __init__(self, folder: Path, options: str = "name: arm_2") -> None:
        super().__init__(folder, PROFILE.format(options=options))

    def measured(self) -> Any:
        self.newest = None
        self.until(lambda: self.newest is not None)
        return self.newest

    @property
    def status(self) -> Any:
        return self.driver.status().detail

    def ends_rad(self) -> tuple[np.ndarray, np.ndarray]:
        kinematics = make_kinematics(self.profile)
        order = [kinematics.arm_joints.index(name) for name in self.profile.robot.arm_joints]
        return kinematics.lower_rad[order], kinematics.upper_rad[order]


@pytest.fixture
def owner() -> Iterator[Owner]:
    with Owner("arm_2") as owner:
        yield owner


@pytest.fixture
def rig(owner: Owner, tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    rig.driver.connect()
    yield rig
    rig.driver.close()


def refused(folder: Path, why: str, options: str = "name: arm_2", **metadata: Any) -> None:
    """Connect to an owner with this metadata, in vain."""
    rig = Rig(folder, options)
    with Owner("arm_2", **metadata):
        with pytest.raises(NodeError, match=why):
            rig.driver.connect()
        rig.driver.close()


# -- one meaning, both directions -----------------------------------------------------------------
def test_a_state_of_an_so101_is_joints_between_their_ends_and_a_width(rig: Rig) -> None:
    lower_rad, upper_rad = rig.ends_rad()
    shares = (np.array([0.0, -20.0, 20.0, 10.0, 0.0]) + 100) / 200
    measured = rig.measured()
    wanted_rad = lower_rad + shares * (upper_rad - lower_rad)
    np.testing.assert_allclose(measured.joints.position_rad, wanted_rad, atol=EXACT_RAD)
    assert measured.gripper.width_m == pytest.approx(0.03)


def test_a_command_comes_back_as_the_state_it_asks_for(rig: Rig, owner: Owner) -> None:
    begin_rad = rig.measured().joints.position_rad
    wanted_rad = begin_rad + [0.1, -0.1, 0.05, 0.2, -0.2]
    rig.driver.move(JointReference(wanted_rad, STILL, STILL), 0)
    rig.until(lambda: bool(owner.actions))
    rig.until(lambda: np.allclose(rig.measured().joints.position_rad, wanted_rad, atol=EXACT_RAD))
    assert unpacked(owner.actions[0]["action"])[5] == pytest.approx(30.0)
    assert set(owner.actions[0]) == {"action", "goal_time", "ts"}


def test_joints_are_found_by_name_whatever_their_order(tmp_path: Path) -> None:
    turned = tuple(reversed(SO101))
    with Owner("arm_2", joint_names=turned) as owner:
        owner.at = owner.at[::-1].copy()
        rig = Rig(tmp_path)
        rig.driver.connect()
        begin_rad = rig.measured().joints.position_rad
        rig.driver.move(JointReference(begin_rad, STILL, STILL), 0)
        rig.until(lambda: bool(owner.actions))
        sent = unpacked(owner.actions[0]["action"])
        rig.driver.close()
    np.testing.assert_allclose(sent, [30, 0, 10, 20, -20, 0], atol=1e-4)


def test_degrees_have_a_zero_and_a_direction(tmp_path: Path) -> None:
    options = (
        "name: arm_2, units: degrees, zero: [10, 0, 0, 0, 0], reversed: [elbow_flex], "
        "gripper_shut: 0.04, gripper_open: 0.0"
    )
    with Owner("arm_2", robot_class="lab.Arm") as owner:
        owner.at = np.array([20.0, -20.0, 20.0, 10.0, 0.0, 0.01])
        rig = Rig(tmp_path, options)
        rig.driver.connect()
        measured = rig.measured()
        np.testing.assert_allclose(
            np.degrees(measured.joints.position_rad), [10, -20, -20, 10, 0], atol=1e-4
        )
        assert measured.gripper.width_m == pytest.approx(0.075)
        rig.driver.move(JointReference(measured.joints.position_rad, STILL, STILL), 0)
        rig.until(lambda: bool(owner.actions))
        np.testing.assert_allclose(unpacked(owner.actions[0]["action"]), owner.at, atol=1e-4)
        rig.driver.close()


def test_the_gripper_goes_to_its_width_and_the_arm_stays(rig: Rig, owner: Owner) -> None:
    rig.measured()
    at = owner.at.copy()
    rig.driver.grip(GripperCommand(0.1, 0.1, 10.0), 0)
    rig.until(lambda: bool(owner.actions))
    sent = unpacked(owner.actions[0]["action"])
    assert sent[5] == pytest.approx(100.0)
    np.testing.assert_allclose(sent[:5], at[:5], atol=1e-4)


# -- what is missing or wrong ---------------------------------------------------------------------
@pytest.mark.parametrize(
    ("metadata", "why"),
    [
        ({"joint_names": None}, "missing required field `joint_names`"),
        ({"num_joints": None}, "missing required field `num_joints`"),
        ({"robot_class": None}, "missing required field `robot_class`"),
        ({"protocol_version": None}, "missing required field `protocol_version`"),
        ({"protocol_version": 2}, "protocol_version is 2, allowed: 1"),
        ({"num_joints": 7}, "num_joints is 7, but joint_names has 6"),
        ({"joint_names": ("a",) * 6}, "wanted names that differ"),
        ({"joint_names": "abcdef"}, "Expected `array`, got `str`"),
        ({"robot_class": "lab.Arm"}, "unit of lab.Arm's joints is not known: set physicalai.units"),
        (
            {"joint_names": ("a", *SO101[1:])},
            "missing: shoulder_pan, not of this arm: a. Set joints",
        ),
        (
            {"joint_names": (*SO101, "track"), "num_joints": 7},
            "missing: none, not of this arm: track",
        ),
    ],
)
def test_metadata_that_does_not_fit_ends_the_node_by_name(
    tmp_path: Path, metadata: dict[str, Any], why: str
) -> None:
    refused(tmp_path, why, **metadata)


def test_a_unit_is_never_assumed(tmp_path: Path) -> None:
    refused(tmp_path, "units is degrees, but .*SO101 has norm", "name: arm_2, units: degrees")
    refused(
        tmp_path,
        "set physicalai.gripper_shut and physicalai.gripper_open",
        robot_class="physicalai.robot.WidowXAI",
    )


def test_a_zero_of_joints_that_have_their_own_ends_the_node(tmp_path: Path) -> None:
    refused(tmp_path, "zero is given, but normalised", "name: arm_2, zero: [1, 0, 0, 0, 0]")


def test_without_an_owner_the_node_ends_with_what_to_start(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    with pytest.raises(NodeError, match=f"no owner of 'arm_2' at .*:{PORT_OF_ARM_2}: start"):
        rig.driver.connect()
    rig.driver.close()


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ({"joint_positions": packed([float("nan")] * 6)}, "wanted finite numbers"),
        ({"joint_positions": packed([0.0] * 5)}, r"shape \[5\], wanted \[6\]"),
        ({"joint_positions": packed([[0.0] * 6])}, r"shape \[1, 6\], wanted \[6\]"),
        ({"joint_positions": packed([0.0] * 6) | {"data": b""}}, "0 bytes for 6 of float32"),
        ({"joint_positions": packed([0.0] * 6) | {"dtype": "O"}}, "dtype 'O', wanted numbers"),
        ({"joint_positions": None}, "missing required field `joint_positions`"),
        ({"timestamp": 1.0}, "timestamp 1.000 is not after the last one"),
        ({"timestamp": float("nan")}, "timestamp is nan"),
        ({"timestamp": "now"}, "Expected `float`, got `str`"),
    ],
)
def test_a_wrong_state_is_rejected_by_name(
    rig: Rig, owner: Owner, said: dict[str, Any], why: str
) -> None:
    rig.measured()
    owner.said = said
    rig.until(lambda: rig.status["rejected_states"] > 0)
    assert re.search(why, rig.status["complaint"])


def test_wrong_states_alone_end_the_node_with_what_is_wrong(rig: Rig, owner: Owner) -> None:
    owner.said = {"joint_positions": packed([0.0] * 5)}
    with pytest.raises(NodeError, match=r"no valid state of 'arm_2' for 1 s: state: .*\[5\]"):
        rig.until(lambda: False)


def test_one_wrong_state_is_counted_and_forgotten(rig: Rig, owner: Owner) -> None:
    owner.said = {"joint_positions": packed([0.0] * 5)}
    rig.until(lambda: rig.status["rejected_states"] > 0)
    owner.said = {}
    rig.measured()
    assert "complaint" not in rig.status


def test_an_owner_that_is_gone_ends_the_node(rig: Rig, owner: Owner) -> None:
    rig.measured()
    owner.close()
    with pytest.raises(NodeError, match="no valid state of 'arm_2' for 1 s: is its owner runni"):
        rig.until(lambda: False)


def test_a_second_commander_is_a_fault_until_it_is_silent(rig: Rig, owner: Owner) -> None:
    begin_rad = rig.measured().joints.position_rad
    rig.driver.move(JointReference(begin_rad, STILL, STILL), 0)
    rig.until(lambda: bool(owner.actions))
    assert not rig.driver.fault, "an action of our own is none of somebody else"
    rig.until(lambda: not rig.driver.idle)
    client = Client("arm_2", PORT_OF_ARM_2)
    rig.until(lambda: client.states.try_recv() is not None)
    client.act(owner.at)
    rig.until(lambda: rig.driver.fault != "")
    assert "somebody else puts actions on physicalai/robot/arm_2/action" in rig.driver.fault
    assert rig.driver.idle, "the owner holds what another one commanded"
    rig.until(lambda: rig.driver.fault == "")
    client.session.close()


@pytest.mark.parametrize(("name", "port"), [("follower", 56572), ("arm", 38977)])
def test_a_robot_is_looked_for_where_physicalai_itself_puts_it(name: str, port: int) -> None:
    assert wire.local_endpoint(name) == f"tcp/127.0.0.1:{port}"


def test_options_that_do_not_fit_together_are_wrong_by_name(tmp_path: Path) -> None:
    options = "name: a, joints: [a, b], zero: [1], reversed: [x], gripper_open: 1, gripper_shut: 1"
    with pytest.raises(ProfileError) as caught:
        Rig(tmp_path, options)
    told = str(caught.value)
    for why in (
        "joints: has 2 entries for 5 arm_joints",
        "zero: has 1 entries for 5 arm_joints",
        "gripper_open: is the same as gripper_shut",
    ):
        assert f"physicalai.{why}" in told
    assert "'x'" in told or "x" in told.split("reversed")[1]


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x80", b"\x90", b"\xd9\x01\xff", bytes(2 << 20)])
def test_bytes_that_are_no_record_are_rejected(data: bytes) -> None:
    for decode in (
        wire.decode_metadata,
        lambda data: wire.decode_state(data, 6),
        lambda data: wire.decode_action(data, 6),
    ):
        with pytest.raises(CodecError):
            decode(data)
