"""Descriptions as makers write them: what is taken means what it says, the rest is named."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from described_arms import (
    JOINTS_6,
    SIX,
    SLIDE,
    TAKEN,
    TOOL,
    Row,
    Y,
    arm,
    finger,
    tcp_in_base,
    urdf,
)

from vla_zenoh.errors import CodecError, ProfileError
from vla_zenoh.kinematics.description import Description
from vla_zenoh.kinematics.fingers import Fingers
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.lab.profile.check import check_profile
from vla_zenoh.profile import GripperProfile
from vla_zenoh.resources import ROBOT_DATA_PREFIX, robot_urdf
from vla_zenoh.robots.joint_reading import JointReading
from vla_zenoh.types.records import Joints

EXACT = 1e-9


@pytest.mark.parametrize("name", TAKEN)
def test_poses_are_those_of_the_description(tmp_path: Path, name: str) -> None:
    case = TAKEN[name]
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(case.rows))
    kinematics = Kinematics(
        path,
        "tcp",
        case.joints,
        case.fingers,
        base_frame=case.base,
        finger_ends=case.ends,
        locked_rad=case.locked,
    )
    assert set(kinematics.arm_joints) == set(case.joints)
    assert tuple(kinematics.finger_signs) == case.signs
    random = np.random.default_rng(1)
    span = kinematics.upper_rad - kinematics.lower_rad
    for share in (*random.random((5, kinematics.size)), np.zeros(kinematics.size)):
        joints = kinematics.lower_rad + share * span
        positions = {**dict(zip(kinematics.arm_joints, joints, strict=True)), **case.locked}
        base = tcp_in_base(case.rows, case.base, positions)
        wanted = np.linalg.inv(base) @ tcp_in_base(case.rows, "tcp", positions)
        found = kinematics.forward(joints)
        assert np.allclose(found.position_m, wanted[:3, 3], atol=EXACT)
        assert np.allclose(found.rotation, wanted[:3, :3], atol=EXACT)
        numeric = np.array(
            [
                (
                    kinematics.forward(joints + step).position_m
                    - kinematics.forward(joints - step).position_m
                )
                / 2e-6
                for step in np.eye(kinematics.size) * 1e-6
            ]
        ).T
        assert np.allclose(kinematics.jacobian(joints)[:3], numeric, atol=1e-6)


@pytest.mark.parametrize("name", [name for name, case in TAKEN.items() if case.fingers])
def test_a_hand_is_as_wide_as_its_fingers_are_apart(tmp_path: Path, name: str) -> None:
    case = TAKEN[name]
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(case.rows))
    kinematics = Kinematics(path, "tcp", case.joints, case.fingers, finger_ends=case.ends)
    ends: dict[str, float] = {}
    if case.ends is not None:
        unit = case.ends.unit
        ends = {f"joint_open_{unit}": case.ends.open, f"joint_shut_{unit}": case.ends.shut}
    fingers = Fingers(GripperProfile(max_width_m=0.08, **ends), len(case.fingers))  # type: ignore[arg-type]
    opened = np.array(
        [
            kinematics.locked_position[
                kinematics.full_model.joints[kinematics.full_model.getJointId(each)].idx_q
            ]
            for each in case.fingers
        ]
    )
    shut = np.zeros(len(case.fingers))
    if case.ends is not None:
        shut = kinematics.finger_signs * case.ends.shut
    assert fingers.width_m(kinematics.finger_signs * opened) > 0.03
    assert fingers.width_m(kinematics.finger_signs * shut) == pytest.approx(0.0, abs=EXACT)


class Refused(NamedTuple):
    """A description that is refused by the check of a profile, and what it says.

    Args:
        text: the whole file.
        says: parts of the message.
        joints: that the profile commands.
        fingers: of its hand.
    """

    text: str | bytes
    says: tuple[str, ...]
    joints: tuple[str, ...] = JOINTS_6
    fingers: tuple[str, ...] = ()


WHOLE = urdf([*arm(SIX), TOOL])
BALL = '<sphere radius="0.02"/>'
NO_EFFORT = '<limit lower="-1" upper="1" velocity="2"/>'
DEGREES = [row._replace(ends=(-170.0, 170.0), velocity=150.0) for row in arm(SIX)]
MILLIMETRES = [row._replace(at_m=(0.0, 0.0, 200.0)) for row in arm(SIX)]
INERTIA = '<mass value="1"/><inertia ixx="1" iyy="1,0" izz="1" ixy="0" ixz="0" iyz="0"/>'
HOOK = Row("hook", parent="j6_link", child="j2_link", kind="fixed")
REFUSED: dict[str, Refused] = {
    "an empty file": Refused("", ("is empty",)),
    "spaces": Refused(" \n ", ("is empty",)),
    "no XML": Refused("robot: {name: x}", ("is no XML",)),
    "cut off": Refused(WHOLE[: len(WHOLE) // 2], ("is no XML",)),
    "latin-1": Refused(
        WHOLE.replace("made", "Gelenk für").encode("latin-1"), ("is not UTF-8 (line 1)",)
    ),
    "a compressed file": Refused(gzip.compress(WHOLE.encode()), ("is compressed", "unpack it")),
    "a xacro": Refused(
        '<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:arm prefix=""/></robot>',
        ("is a xacro", "xacrodoc arm.urdf"),
    ),
    "a xacro with links": Refused(
        WHOLE.replace('xyz="0.0 0.0 0.1"', 'xyz="0 0 ${length}"'), ("is a xacro",)
    ),
    "MJCF": Refused("<mujoco><worldbody/></mujoco>", ("is MJCF", "URDF")),
    "SDF": Refused("<sdf version='1.7'><model/></sdf>", ("is SDF",)),
    "a page": Refused("<html><body/></html>", ("begins with <html>",)),
    "a namespace": Refused(
        WHOLE.replace("<robot ", '<robot xmlns="http://robots.org" '),
        ("namespace 'http://robots.org'", "remove xmlns"),
    ),
    "a link with the name of the world": Refused(
        WHOLE.replace('"j3_link"', '"universe"'), ("link named 'universe'", "rename it")
    ),
    "no links": Refused("<robot name='x'/>", ("has no links",)),
    "no effort": Refused(
        urdf([*arm(SIX, j3=Row("j3", axis=Y, limit=NO_EFFORT)), TOOL]),
        ("joint 'j3' without effort",),
    ),
    "no limit": Refused(
        urdf([*arm(SIX, j3=Row("j3", axis=Y, limit="")), TOOL]),
        ("joint 'j3' without effort and velocity",),
    ),
    "no room": Refused(
        urdf([*arm(SIX, j3=Row("j3", axis=Y, ends=(0.0, 0.0))), TOOL]),
        ("joint 'j3'", "no room to move"),
    ),
    "a word for a number": Refused(
        WHOLE.replace('lower="-2.5"', 'lower="-pi"', 1), ("joint 'j1' with lower '-pi'",)
    ),
    "two roots": Refused(
        WHOLE.replace("</robot>", '<link name="table"/></robot>'), ("2 links", "base, table")
    ),
    "a closed chain": Refused(urdf([*arm(SIX), TOOL, HOOK]), ("closed chain", "'hook'")),
    "a ring": Refused(
        urdf([*arm(SIX), TOOL]).replace("</robot>", "")
        + '<joint name="ring" type="fixed"><parent link="tcp"/><child link="base"/></joint>'
        + "</robot>",
        ("closed chain",),
    ),
    "two joints of one name": Refused(
        WHOLE.replace('name="j2"', 'name="j3"'), ("2 joints named 'j3'",)
    ),
    "a link that is not there": Refused(
        WHOLE.replace('<parent link="j3_link"/>', '<parent link="j3_lnik"/>'),
        ("'j3_lnik'", "did you mean 'j3_link'"),
    ),
    "a type that is unknown": Refused(
        WHOLE.replace('type="revolute"', 'type="hinge"', 1), ("joint 'j1' of type 'hinge'",)
    ),
    "an endless wrist without a velocity": Refused(
        urdf([*arm(SIX, j6=Row("j6", kind="continuous", limit="")), TOOL]),
        ("'j6'", "velocity > 0"),
    ),
    "a torso that nobody named": Refused(
        urdf([SLIDE, *arm(SIX), TOOL]), ("'lift'", "locked_rad: {lift: 0.0}")
    ),
    "a joint that was forgotten": Refused(
        WHOLE, ("'j5'", "locked_rad"), ("j1", "j2", "j3", "j4", "j6")
    ),
    "a joint that follows is commanded": Refused(
        urdf([*arm(SIX, j5=Row("j5", axis=Y, mimic=("j3", -1.0, 0.0))), TOOL]),
        ("'j5'", "follows joint 'j3'", "leave it out of arm_joints"),
    ),
    "a joint that follows nothing known": Refused(
        urdf([*arm(SIX, j5=Row("j5", axis=Y, mimic=("j33", -1.0, 0.0))), TOOL]),
        ("'j5'", "'j33'"),
        ("j1", "j2", "j3", "j4", "j6"),
    ),
    "a joint that does not move the TCP": Refused(
        urdf([*arm(SIX), TOOL, Row("other", parent="base")]),
        ("'other'", "does not move tcp_frame"),
        (*JOINTS_6, "other"),
    ),
    "degrees": Refused(urdf([*DEGREES, TOOL]), ("-170 to 170 rad", "degrees", "'j1'")),
    "a velocity in degrees": Refused(
        urdf([*arm(SIX, j2=Row("j2", axis=Y, velocity=180.0)), TOOL]), ("180 rad/s", "degrees")
    ),
    "a velocity of almost nothing": Refused(
        urdf([*arm(SIX, j2=Row("j2", axis=Y, velocity=0.002)), TOOL]), ("0.002 rad/s", "'j2'")
    ),
    "an arm of a thousandth": Refused(
        urdf([row._replace(at_m=(0.0, 0.0, 0.0002)) for row in [*arm(SIX), TOOL]]).replace(
            BALL, '<sphere radius="0.00008"/>'
        ),
        ("m long from its first joint to the TCP", "divided by 1000"),
    ),
    "millimetres": Refused(urdf([*MILLIMETRES, TOOL]), ("200 m", "millimetres")),
    "a first link in millimetres": Refused(
        urdf([*arm(SIX, j2=Row("j2", axis=Y, at_m=(0.0, 0.0, 200.0))), TOOL]),
        ("'j2' 200 m from the joint before it", "millimetres"),
    ),
    "a mesh in millimetres": Refused(
        WHOLE.replace(
            f'<link name="j3_link"><collision><geometry>{BALL}',
            '<link name="j3_link"><collision><geometry><box size="60 60 90"/>',
        ),
        ("'j3_link'", "ends 61.8", "millimetres"),
    ),
    "a base on a map": Refused(
        urdf([*arm(SIX, j1=Row("j1", at_m=(2000.0, 0.0, 0.0))), TOOL]),
        ("limits.workspace", "2e+03 m"),
    ),
    "a velocity below 0": Refused(
        urdf([*arm(SIX, j2=Row("j2", axis=Y, velocity=-2.0)), TOOL]),
        ("joint 'j2' with velocity -2",),
    ),
    "an endless turn": Refused(
        WHOLE.replace('xyz="0.0 0.0 0.2"', 'xyz="0 0 0.2" rpy="inf 0 0"', 1),
        ("joint 'j1' with rpy 'inf'",),
    ),
    "a shape without a size": Refused(
        WHOLE.replace(BALL, "<sphere/>", 1), ("link 'base' with radius ''",)
    ),
    "a shape of a size below 0": Refused(
        WHOLE.replace(BALL, '<sphere radius="-0.02"/>', 1), ("link 'base' with radius '-0.02'",)
    ),
    "a shape of no size": Refused(
        WHOLE.replace(BALL, '<box size="0.1 nan 0.1"/>', 1), ("link 'base' with size 'nan'",)
    ),
    "a box of two numbers": Refused(
        WHOLE.replace(BALL, '<box size="0.1 0.1"/>', 1), ("size '0.1 0.1': give three numbers",)
    ),
    "a shape that is unknown": Refused(
        WHOLE.replace(BALL, '<cone radius="0.02" length="0.1"/>', 1),
        ("link 'base'", "<cone>; shapes are: box"),
    ),
    "a mesh without a file": Refused(
        WHOLE.replace(BALL, "<mesh/>", 1), ("link 'base' with a collision mesh without a filename",)
    ),
    "a mesh with a scale of one number": Refused(
        WHOLE.replace(BALL, '<mesh filename="a.stl" scale="0.001"/>', 1),
        ("link 'base' with scale '0.001': give three numbers",),
    ),
    "a mesh of no size": Refused(
        WHOLE.replace(BALL, '<mesh filename="a.stl" scale="1 1 0"/>', 1),
        ("link 'base' with scale '1 1 0': give three numbers other than 0",),
    ),
    "a shape as thin as nothing": Refused(
        WHOLE.replace(BALL, '<box size="0.1 0.1 1e-9"/>', 1),
        ("link 'base' of arm.urdf has a flat collision shape",),
    ),
    "an empty shape": Refused(WHOLE.replace(BALL, "", 1), ("link 'base'", "that is nothing")),
    "a mass that is none": Refused(
        WHOLE.replace("<collision>", '<inertial><mass value="nan"/></inertial><collision>', 1),
        ("link 'base' with mass 'nan': no number",),
    ),
    "an inertia that is none": Refused(
        WHOLE.replace("<collision>", f"<inertial>{INERTIA}</inertial><collision>", 1),
        ("link 'base' with iyy '1,0': no number",),
    ),
    "a place to look at that is none": Refused(
        WHOLE.replace("<collision>", '<visual><origin xyz="0 0 x"/></visual><collision>', 1),
        ("link 'base' with xyz 'x': no number",),
    ),
    "a turn in degrees": Refused(
        WHOLE.replace('xyz="0.0 0.0 0.2"', 'xyz="0 0 0.2" rpy="0 90 0"', 1),
        ("joint 'j1' with rpy '0 90 0'", "are these degrees?"),
    ),
    "a joint at the end of the world": Refused(
        WHOLE.replace('xyz="0.0 0.0 0.2"', 'xyz="0 0 1e300"', 1), ("xyz '0 0 1e300'", "metres")
    ),
    "a mesh of the network": Refused(
        WHOLE.replace(BALL, '<mesh filename="http://robots.org/a.stl"/>', 1),
        ("link 'base' has the mesh 'http://robots.org/a.stl', which is no file",),
    ),
    "a mesh that is not there": Refused(
        WHOLE.replace(BALL, '<mesh filename="package://made/a.stl"/>', 1),
        ("link 'base' has the mesh 'package://made/a.stl', which is not there", "beside the URDF"),
    ),
    "a mesh that is none": Refused(
        WHOLE.replace(BALL, '<mesh filename="package://my_arm.py"/>', 1),
        ("link 'base' has the mesh 'package://my_arm.py', which is no mesh that can be read",),
    ),
    "a finger that is shut nowhere": Refused(
        urdf([*arm(SIX), TOOL, finger("left", -0.03, 0.05)]),
        ("'left'", "joint_open_m"),
        fingers=("left",),
    ),
}
PROFILE = """
robot:
  name: made
  driver: arm
  command: joint
  description: arm.urdf
  base_frame: base
  tcp_frame: tcp
  arm_joints: [{joints}]
  finger_joints: [{fingers}]
  gripper: {gripper}
  home_rad: [{home}]
  {more}
limits: {{workspace: {{x_m: [-1, 1], y_m: [-1, 1], z_m: [0, 2]}}, reach: {{table_z_m: null}}}}
arm: {{file: my_arm.py}}
workers: [scripted]
options: {{scripted: {{camera: ""}}}}
hosts: {{here: {{nodes: [router, arm, command, worker]}}}}
"""
ARM = """
from vla_zenoh.robot import Command, Reading

class Arm:
    def read(self) -> Reading: ...
    def move(self, command: Command) -> None: ...
"""


def checked(
    folder: Path,
    text: str | bytes,
    joints: tuple[str, ...] = JOINTS_6,
    fingers: tuple[str, ...] = (),
    more: str = "",
) -> tuple[str, str]:
    """Errors and advice of the check of a profile with this description."""
    (folder / "arm.urdf").write_bytes(text if isinstance(text, bytes) else text.encode())
    (folder / "my_arm.py").write_text(ARM)
    home = ", ".join(str(round(0.1 * n, 1)) for n in range(1, len(joints) + 1))
    (folder / "lab.yaml").write_text(
        PROFILE.format(
            joints=", ".join(joints),
            fingers=", ".join(fingers),
            gripper="{max_width_m: 0.08}" if fingers else "null",
            home=home,
            more=more,
        )
    )
    report = check_profile(str(folder / "lab.yaml"))
    return "\n".join(report.errors), "\n".join(report.advice)


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_wrong_with_a_description_is_named(
    tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    case = REFUSED[name]
    errors, _ = checked(tmp_path, case.text, case.joints, case.fingers)
    assert all(part in errors for part in case.says), errors
    assert "valid URDF" not in errors
    assert capfd.readouterr().err == "", "nothing is left to Pinocchio's own words"


def test_what_is_assumed_of_joints_that_are_not_commanded_is_said(tmp_path: Path) -> None:
    rows = [SLIDE, *arm(SIX, j5=Row("j5", axis=Y, mimic=("j3", -1.0, 0.2))), TOOL]
    joints = ("j1", "j2", "j3", "j4", "j6")
    errors, advice = checked(tmp_path, urdf(rows), joints, more="locked_rad: {lift: 0.2}")
    assert not errors
    assert "lift is not commanded, and every pose assumes it at 0.2" in advice
    assert "j5 is not commanded; poses assume that it follows j3" in advice


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ("locked_rad: {lift: 0.5}", "goes from 0 to 0.4"),
        ("locked_rad: {lfit: 0.1}", "did you mean 'lift'"),
        ("locked_rad: {lift: 0.1, j2: 0.0}", "cannot stand still and move"),
        ("locked_rad: {lift: 0.1, tool: 0.0}", "leave it out"),
    ],
)
def test_a_locked_joint_is_one_that_can_be_there(tmp_path: Path, more: str, says: str) -> None:
    errors, _ = checked(tmp_path, urdf([SLIDE, *arm(SIX), TOOL]), more=more)
    assert says in errors


@pytest.mark.parametrize(
    ("far_m", "fingers", "wrong"),
    [
        (0.04, ("left", "right"), False),
        (0.05, ("left", "right"), False),
        (0.04, ("left",), True),
        (0.004, ("left", "right"), True),
        (0.4, ("left", "right"), True),
    ],
)
def test_fingers_that_do_not_add_up_to_the_width_are_told(
    tmp_path: Path, far_m: float, fingers: tuple[str, ...], wrong: bool
) -> None:
    rows = [*arm(SIX), TOOL, finger("left", 0.0, far_m), finger("right", -far_m, 0.0)]
    errors, advice = checked(tmp_path, urdf(rows), fingers=fingers)
    assert not errors
    assert ("finger_joints open by" in advice) is wrong


def test_a_home_outside_the_workspace_is_told_for_a_real_arm_too(tmp_path: Path) -> None:
    rows = [*arm(SIX, j2=Row("j2", axis=Y, at_m=(0.0, 0.0, 1.6))), TOOL]
    errors, advice = checked(tmp_path, urdf(rows))
    assert not errors
    assert "outside limits.workspace" in advice


def test_soft_limits_narrow_the_range(tmp_path: Path) -> None:
    soft = '<safety_controller k_velocity="1" soft_lower_limit="-1" soft_upper_limit="1.5"/>'
    path = tmp_path / "arm.urdf"
    path.write_text(urdf([*arm(SIX, j2=Row("j2", axis=Y, inside=soft)), TOOL]))
    kinematics = Kinematics(path, "tcp", JOINTS_6)
    assert (kinematics.lower_rad[1], kinematics.upper_rad[1]) == (-1.0, 1.5)


def test_a_joint_that_follows_keeps_its_own_limits(tmp_path: Path) -> None:
    follows = Row("j5", axis=Y, mimic=("j3", -2.0, 0.5), ends=(-1.0, 2.0), velocity=1.0)
    path = tmp_path / "arm.urdf"
    path.write_text(urdf([*arm(SIX, j5=follows), TOOL]))
    kinematics = Kinematics(path, "tcp", ("j1", "j2", "j3", "j4", "j6"))
    assert kinematics.lower_rad[2] == pytest.approx(-0.75)
    assert kinematics.upper_rad[2] == pytest.approx(0.75)
    assert kinematics.velocity_rad_s[2] == pytest.approx(0.5)


def test_states_with_a_locked_joint_elsewhere_are_rejected(tmp_path: Path) -> None:
    from vla_zenoh.kinematics.kinematics import make_kinematics
    from vla_zenoh.profile import load_profile

    checked(tmp_path, urdf([SLIDE, *arm(SIX), TOOL]), more="locked_rad: {lift: 0.2}")
    profile = load_profile(str(tmp_path / "lab.yaml"))
    reading = JointReading(profile, make_kinematics(profile))
    names, zeros = ("lift", *JOINTS_6), np.zeros(7)
    reading.take(Joints(0, names, np.array([0.201, *[0.1] * 6]), zeros, None), 1)
    with pytest.raises(CodecError, match=r"lift is at 0.25, and robot.locked_rad has it at 0.2"):
        reading.take(Joints(0, names, np.array([0.25, *[0.1] * 6]), zeros, None), 2)


def test_descriptions_of_a_public_collection_are_read() -> None:
    folder = robot_urdf(f"{ROBOT_DATA_PREFIX}panda_description/urdf/panda.urdf").parents[2]
    found = sorted(folder.rglob("*.urdf"))
    assert len(found) > 50
    refused: list[str] = []
    for path in found:
        try:
            Description(path)
        except ProfileError as error:
            refused.append(str(error))
    assert refused == ["ur3.urdf has no links"]


def test_joints_that_all_turn_about_one_axis_are_told(tmp_path: Path) -> None:
    parallel = [row._replace(axis=(0.0, 0.0, 1.0)) for row in arm(SIX)]
    for rows, told in ((parallel, True), (arm(SIX), False)):
        errors, advice = checked(tmp_path, urdf([*rows, TOOL]))
        assert errors == ""
        assert ("of six directions only, whatever their positions" in advice) is told
