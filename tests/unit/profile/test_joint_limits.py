"""What a profile may say of a robot that is commanded by joint positions."""

from __future__ import annotations

from pathlib import Path

import pytest

from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import JointLimits, Profile, load_profile, override, to_yaml

# Franka's published limits of the Panda, joint 1 to 7.
PUBLISHED = {
    "velocity_rad_s": (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
    "acceleration_rad_s2": (15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
    "jerk_rad_s3": (7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0),
}
SHARES = {"velocity_rad_s": 0.5, "acceleration_rad_s2": 0.3, "jerk_rad_s3": 0.05}
JOINTS = 7


def loaded(tmp_path: Path, text: str) -> Profile:
    path = tmp_path / "lab.yaml"
    path.write_text(f"extends: panda_sim\n{text}\n")
    return load_profile(str(path))


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_pandas_limits_are_shares_of_what_franka_publishes(name: str) -> None:
    expected = [SHARES[name] * limit for limit in PUBLISHED[name]]
    assert load_profile("panda_sim").limits.joint.of(name, JOINTS) == pytest.approx(expected)


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_profile_that_says_nothing_has_the_weakest_joints_share_everywhere(name: str) -> None:
    values = JointLimits().of(name, 6)
    assert values == pytest.approx([SHARES[name] * min(PUBLISHED[name])] * 6)


def test_one_number_stands_for_every_joint(tmp_path: Path) -> None:
    profile = loaded(tmp_path, "limits: {joint: {velocity_rad_s: 1}}")
    assert profile.limits.joint.of("velocity_rad_s", JOINTS) == (1.0,) * JOINTS


def test_an_effective_profile_is_read_back_as_it_was(tmp_path: Path) -> None:
    profile = loaded(tmp_path, "robot: {command: joint}\nlimits: {joint: {jerk_rad_s3: 90}}")
    path = tmp_path / "effective.yaml"
    path.write_text(to_yaml(profile))
    again = load_profile(str(path))
    assert again.robot.command == "joint"
    assert again.limits == profile.limits


def test_a_robot_is_commanded_by_poses_unless_told_otherwise() -> None:
    profile = load_profile("panda_sim")
    assert profile.robot.command == "pose"
    assert override(profile, {"robot": {"command": "joint"}}).robot.command == "joint"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("velocity_rad_s: [1, 2]", "velocity_rad_s: has 2 numbers for 7 arm_joints: give one for"),
        ("velocity_rad_s: 3.0", "velocity_rad_s.0: must be at most 2.61 (given: 3.0)"),
        ("acceleration_rad_s2: 21", "acceleration_rad_s2.0: must be at most 20 (given: 21)"),
        ("jerk_rad_s3: [1, 2, 3, -4, 5, 6, 7]", "jerk_rad_s3.3: must be at least 0.1 (given: -4"),
        ("jerk_rad_s3: 0", "jerk_rad_s3.0: must be at least 0.1 (given: 0)"),
        ("velocity_rad_s: .nan", "velocity_rad_s.0: wants a finite number (given: nan)"),
        ("velocity_rad_s: '1'", "velocity_rad_s: wants a list (given: '1')"),
        ("velocity_rad_s: true", "velocity_rad_s: wants a list (given: True)"),
        ("velocity_rad_s: [true]", "velocity_rad_s.0: wants a number (given: True)"),
        ("velocity_rad_s: []", "velocity_rad_s: is empty: give one number for all joints, or one"),
        ("velocity: 1", "velocity: unknown key; did you mean 'velocity_rad_s'? Known here: accele"),
    ],
)
def test_a_limit_that_means_nothing_is_refused_by_name(
    tmp_path: Path, text: str, said: str
) -> None:
    with pytest.raises(ProfileError) as caught:
        loaded(tmp_path, f"limits: {{joint: {{{text}}}}}")
    lines = str(caught.value).splitlines()
    assert len(lines) == 1
    assert f"lab.yaml:2: limits.joint.{said}" in lines[0]


def test_an_unknown_way_of_commanding_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match=r"robot.command: wants 'pose' or 'joint'"):
        loaded(tmp_path, "robot: {command: torque}")
