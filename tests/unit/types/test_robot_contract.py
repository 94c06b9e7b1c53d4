"""A robot in a Python file: how it is found, and what is told where it is not one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vla_zenoh.errors import ProfileError, WorkerError
from vla_zenoh.policy.loader import make_robot
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.robot import Reading, numbers

ARM = """
from vla_zenoh.robot import Command, Reading

class Arm:
    def __init__(self, address: str = "here") -> None:
        self.address = address
    def read(self) -> Reading:
        return Reading([0.0] * 7)
    def move(self, command: Command) -> None:
        pass
"""
PROFILE = """
extends: panda_sim
robot: {{driver: arm}}
arm: {{file: {file}, options: {{address: 10.0.0.3}}}}
cameras: {{front: null, wrist: null}}
hosts:
  here: {{nodes: [router, arm, command, worker]}}
"""


def written(folder: Path, text: str, name: str = "my_arm.py") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def profile(folder: Path, text: str) -> Profile:
    return load_profile(str(written(folder, text, "lab.yaml")))


def test_the_class_that_moves_is_made_with_the_options_of_the_profile(tmp_path: Path) -> None:
    robot = make_robot(written(tmp_path, ARM), {"address": "10.0.0.3"})
    assert getattr(robot, "address") == "10.0.0.3"  # noqa: B009  # its type is not known here
    assert robot.read() == Reading([0.0] * 7)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("import nothing_of_that_name", "cannot be imported.*nothing_of_that_name"),
        ("x = 1", "wanted one class with a method move, found: none"),
        (ARM + ARM.replace("class Arm", "class Other"), "found: Arm, Other.*ROBOT = ClassName"),
        (ARM.replace("def read", "def look"), "needs methods `read\\(\\)`"),
        (ARM.replace("def read(self", "def read(self, more"), "needs methods `read\\(\\)`"),
        (ARM.replace("def move(self, command", "def move(self"), "needs methods `read\\(\\)`"),
        (
            ARM.replace("address: str", "port: str"),
            "Arm has no option 'address'. Its options: port",
        ),
    ],
)
def test_a_file_without_an_arm_is_refused_by_name(tmp_path: Path, text: str, why: str) -> None:
    with pytest.raises(WorkerError, match=f"my_arm.py.*{why}"):
        make_robot(written(tmp_path, text), {"address": "10.0.0.3"})


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(WorkerError, match=r"nowhere\.py is not a file"):
        make_robot(tmp_path / "nowhere.py")


def test_a_profile_of_an_own_arm_is_whole(tmp_path: Path) -> None:
    arm = written(tmp_path, ARM)
    loaded = profile(tmp_path, PROFILE.format(file="my_arm.py"))  # beside the profile
    assert loaded.arm is not None
    assert (loaded.arm.file, loaded.arm.options) == (str(arm), {"address": "10.0.0.3"})


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("arm: {{file: {file}, options: {{address: 10.0.0.3}}}}", "", "arm.*is missing"),
        ("robot: {{driver: arm}}", "", "has arm, and robot.driver is sim"),
        ("address: 10", "'an address': 10", "cannot be the name of an option"),
        ("router, arm", "router, sim", "has sim, and robot.driver is arm"),
    ],
)
def test_a_profile_that_does_not_fit_says_what_is_wrong(
    tmp_path: Path, old: str, new: str, why: str
) -> None:
    text = PROFILE.replace(old, new)
    assert text != PROFILE
    with pytest.raises(ProfileError, match=why):
        profile(tmp_path, text.format(file="my_arm.py"))


def test_numbers_of_the_wrong_form_are_named() -> None:
    np.testing.assert_array_equal(numbers("position_rad", [1, 2], 2), [1.0, 2.0])
    with pytest.raises(ValueError, match="position_rad has shape \\(3,\\), wanted \\(2,\\)"):
        numbers("position_rad", [1, 2, 3], 2)
    with pytest.raises(ValueError, match="velocity_rad_s is not a list of numbers"):
        numbers("velocity_rad_s", ["fast", "slow"], 2)
