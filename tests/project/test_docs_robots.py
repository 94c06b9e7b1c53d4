"""The profile of docs/how-to/robots.md is valid, and its arm can do what the text says."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner
from vla_zenoh_ros2.writers import position
from wrong_profiles import CAMERA_SOURCES, DRIVERS

from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.policy.loader import make_robot
from vla_zenoh.profile import load_profile
from vla_zenoh.program.main import app
from vla_zenoh.resources import robot_urdf
from vla_zenoh.types import JointCommand

TEXT_FILE = Path(__file__).parents[2] / "docs" / "how-to" / "robots.md"
TEXT = TEXT_FILE.read_text("utf-8")
REFERENCE = (TEXT_FILE.parents[1] / "reference" / "profile.md").read_text("utf-8")
UR5 = "example-robot-data:ur_description/urdf/ur5_robot.urdf"
HOME_M = (0.49, 0.11, 0.43)
TEXT_M = 0.005
"""The text rounds to centimetres."""
DOWN = -0.999
SHIPPED = "example-robot-data/robots/ur_description/"
MESHES = "package://ur_description/"
"""How drivers of ROS name the folder of a robot's shapes."""


KNUCKLE = """
  <link name="robotiq_85_left_knuckle_link"/>
  <joint name="robotiq_85_left_knuckle_joint" type="revolute">
    <parent link="tool0"/><child link="robotiq_85_left_knuckle_link"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.8" effort="50" velocity="0.5"/>
  </joint>
</robot>"""
"""The joint of a 2F-85, as its driver describes it."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With all files of the text."""
    found = re.findall(r"```\w+\n# (\w+\.\w+)\n(.*?)```", TEXT, re.DOTALL)
    assert [name for name, _ in found] == [
        "ur5.yaml", "ur5e_2f85.yaml", "my_arm.py", "mine.yaml"
    ]  # fmt: skip
    for name, text in found:
        (tmp_path / name).write_text(text, "utf-8")
    return tmp_path


@pytest.fixture
def file(folder: Path) -> Path:
    return folder / "ur5.yaml"


@pytest.mark.parametrize("kind", CAMERA_SOURCES)
def test_every_camera_source_is_on_this_page_and_in_the_reference(kind: str) -> None:
    (paragraph,) = re.findall(r"^- \*\*Cameras\.\*\* .*?(?=^- )", TEXT, re.DOTALL | re.MULTILINE)
    assert f"`{kind}:" in paragraph
    (row,) = re.findall(r"^\| `source` .*$", REFERENCE, re.MULTILINE)
    assert f"``{kind}:" in row


@pytest.mark.parametrize("driver", DRIVERS)
def test_every_robot_driver_is_on_this_page_and_in_the_reference(driver: str) -> None:
    assert re.search(rf"driver: {driver}\b", TEXT)
    (row,) = re.findall(r"^\| `driver` .*$", REFERENCE, re.MULTILINE)
    assert f"``{driver}``: " in row


def test_its_robot_is_right_and_needs_no_second_look(file: Path) -> None:
    result = CliRunner().invoke(app, ["profile", "check", str(file)])
    assert result.exit_code == 0
    assert result.stderr == ""


def test_at_home_its_arm_is_where_the_text_says_and_free_to_move(file: Path) -> None:
    profile = load_profile(str(file))
    kinematics = make_kinematics(profile)
    assert kinematics.arm_joints == profile.robot.arm_joints
    home = kinematics.forward(kinematics.ordered(profile.robot.arm_joints, profile.robot.home_rad))
    assert home.position_m == pytest.approx(HOME_M, abs=TEXT_M)
    assert home.rotation[2, 2] < DOWN
    box, reach = profile.limits.workspace, profile.limits.reach
    for at_m, (low_m, high_m) in zip(home.position_m, (box.x_m, box.y_m, box.z_m), strict=True):
        assert low_m < at_m < high_m
    margins = ReachabilityFilter(profile, kinematics).margins
    assert margins.singular_value > reach.singularity_slow
    assert margins.self_m > reach.collision_slow_m


def test_a_description_of_the_robots_own_driver_needs_its_meshes_beside_it(folder: Path) -> None:
    shipped = robot_urdf(load_profile(str(folder / "ur5.yaml")).robot.description)
    package = shipped.parents[1]
    assert package.name == "ur_description"
    text, changed = re.subn(r"package://[^\"]*?/ur_description/", MESHES, shipped.read_text())
    assert changed
    (folder / "ur5e.urdf").write_text(text)
    (folder / "ur5e.yaml").write_text("extends: ur5\nrobot: {name: ur5e, description: ur5e.urdf}\n")
    words = ["check", str(folder / "ur5e.yaml")]
    result = CliRunner().invoke(app, ["profile", *words])
    assert result.exit_code == 1
    assert "looked for as NAME/... beside the URDF" in result.stderr

    (folder / "ur_description").symlink_to(package)
    result = CliRunner().invoke(app, ["profile", *words])
    assert (result.exit_code, result.stderr) == (0, "")


def test_a_gripper_that_turns_is_refused_until_its_two_angles_are_said(folder: Path) -> None:
    shipped = robot_urdf(load_profile(str(folder / "ur5.yaml")).robot.description)
    (folder / "ur_description").symlink_to(shipped.parents[1])
    text = re.sub(r"package://[^\"]*?/ur_description/", MESHES, shipped.read_text())
    (folder / "ur5e_2f85.urdf").write_text(text.replace("</robot>", KNUCKLE))
    (folder / "ur5e.yaml").write_text("extends: ur5\nrobot: {name: ur5e}\n")
    file = folder / "ur5e_2f85.yaml"
    result = CliRunner().invoke(app, ["profile", "check", str(file)])
    assert (result.exit_code, result.stderr) == (0, "")
    profile = load_profile(str(file))
    assert profile.ros2 is not None
    assert profile.ros2.gripper is not None
    sent = [position(profile.ros2.gripper, profile.robot.gripper, at_m) for at_m in (0.085, 0.0)]
    assert sent == pytest.approx([0.0, 0.7929])

    said = "".join(line for line in file.read_text().splitlines(True) if "_rad:" not in line)
    file.write_text(said.replace("GripperCommand}", "GripperCommand, position: width}"))
    result = CliRunner().invoke(app, ["profile", "check", str(file)])
    assert result.exit_code == 1
    assert "finger joint 'robotiq_85_left_knuckle_joint' of ur5e_2f85.urdf turns" in result.stderr
    assert "gripper: {joint_open_rad: ..., joint_shut_rad: ...}" in result.stderr


def test_its_own_arm_is_right_and_goes_where_it_is_told_to(folder: Path) -> None:
    result = CliRunner().invoke(app, ["profile", "check", str(folder / "mine.yaml")])
    assert result.exit_code == 0
    assert result.stderr == ""
    profile = load_profile(str(folder / "mine.yaml"))
    assert profile.arm is not None
    arm = make_robot(Path(profile.arm.file), profile.arm.options)
    target_rad = np.full(6, 0.3)
    still = np.zeros(6)
    arm.move(JointCommand(profile.robot.arm_joints, target_rad, still, still, "streaming"))
    reading = arm.read()
    assert reading is not None
    np.testing.assert_array_equal(reading.position_rad, target_rad)


def _like_the_makers(package: Path) -> None:
    """A package as the maker's: a xacro with an argument, and meshes by the package's name."""
    urdf = robot_urdf(UR5)
    (package / "urdf").mkdir(parents=True)
    (package / "package.xml").write_text("<package><name>ur_description</name></package>")
    text = urdf.read_text().replace(f"package://{SHIPPED}", MESHES)
    head = '<robot xmlns:xacro="http://ros.org/wiki/xacro" name="$(arg name)">'
    arguments = '<xacro:arg name="name" default="ur"/><xacro:arg name="ur_type" default="ur5"/>'
    text = re.sub(r"<robot[^>]*>", head + arguments, text, count=1)
    (package / "urdf" / "ur.urdf.xacro").write_text(text)
    shutil.copytree(urdf.parents[1] / "meshes", package / "meshes")


def test_the_steps_of_the_page_on_a_ur5e_are_right(tmp_path: Path) -> None:
    """From the maker's xacro on; for it stands one made of the UR5's URDF, which has its joints."""
    page = TEXT_FILE.with_name("ur5e-without-ros.md").read_text("utf-8")
    for name, text in re.findall(r"```\w+\n# (\w+\.\w+)\n(.*?)```", page, re.DOTALL):
        (tmp_path / name).write_text(text, "utf-8")
    _like_the_makers(tmp_path / "ur_description")
    lines = re.search(r"^    (xacrodoc .*\\\n.*)$", page, re.MULTILINE)
    assert lines is not None
    programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(
        lines[1], shell=True, check=True, cwd=tmp_path, env={**os.environ, "PATH": programs}
    )
    file = tmp_path / "ur5e.yaml"
    result = CliRunner().invoke(app, ["profile", "check", str(file)])
    assert result.exit_code == 0, result.output
    profile = load_profile(str(file))
    assert profile.arm is not None
    arm = make_robot(Path(profile.arm.file), profile.arm.options)
    target_rad, still = np.full(6, 0.3), np.zeros(6)
    arm.move(JointCommand(profile.robot.arm_joints, target_rad, still, still, "streaming"))
    reading = arm.read()
    assert reading is not None
    np.testing.assert_array_equal(reading.position_rad, target_rad)
