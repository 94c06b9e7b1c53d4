"""Arms of 1 to 16 joints that turn or slide: what a policy asks of them is what they do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from joint_rig import Joints
from made_arm import SLIDE_M, made_arm

from vla_zenoh.control.commander import Setting
from vla_zenoh.control.joint_follower import JointFollower, JointMotion
from vla_zenoh.control.limits import LimitHit
from vla_zenoh.control.plan_timeline import joint_goal
from vla_zenoh.errors import ProfileError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import Pose, exp3
from vla_zenoh.profile import override

EXACT = 1e-6
MIXED = "sztytzsx"
"""A lift, two joints that turn, and a slide at the end."""


@pytest.mark.parametrize("chain", ["sx", MIXED, "sx" + "tytz" * 7 + "ty"])
def test_joints_of_any_number_and_kind_are_reached_exactly(tmp_path: Path, chain: str) -> None:
    arm = Joints(made_arm(tmp_path, chain, 0.15 if len(chain) < 20 else 0.05))
    arm.activate()
    away = np.where(arm.kinematics.slides, 0.08, 0.15) * (-1) ** np.arange(arm.kinematics.size)
    goal = arm.joints_rad + away
    arm.follow(arm.home_rad + np.linspace(0, 1, 21)[1:, None] * away)
    arm.settle(goal)
    assert arm.rig.state == "active", arm.rig.commander.why
    assert np.abs(arm.joints_rad - goal).max() < EXACT, arm.hits()
    arm.assert_within_limits()
    arm.assert_tcp_within()


def test_deltas_of_a_joint_that_slides_are_metres(tmp_path: Path) -> None:
    arm = Joints(made_arm(tmp_path, MIXED), kind="delta")
    arm.activate()
    arm.send(*[[0.01, 0.0, 0.0, -0.01]] * 5)
    arm.run(2.0)
    assert arm.joints_rad - arm.home_rad == pytest.approx([0.05, 0, 0, -0.05], abs=EXACT)


def test_a_joint_that_slides_keeps_its_own_margin_in_metres(tmp_path: Path) -> None:
    arm = Joints(made_arm(tmp_path, MIXED))
    margin_m = arm.profile.limits.reach.joint_margin_m
    near, end = arm.home_rad.copy(), arm.home_rad.copy()
    near[0], end[0] = SLIDE_M - margin_m - 0.05, SLIDE_M + 0.05
    arm.at(near)
    arm.activate()
    arm.settle(end)
    assert arm.joints_rad[0] == pytest.approx(SLIDE_M - margin_m, abs=EXACT)
    assert "joint_limit" in arm.hits()


def test_a_far_target_of_a_joint_that_slides_is_approached_in_metres_per_second(
    tmp_path: Path,
) -> None:
    arm = Joints(made_arm(tmp_path, MIXED))
    start = arm.home_rad.copy()
    start[0] = 0.05
    arm.at(start)
    arm.activate()
    far = start + [0.4, 0, 0, 0]
    arm.settle(far, 2.4)
    fastest = max(abs(command.velocity_rad_s[0]) for command in arm.joints)
    most = arm.profile.limits.approach_m_s
    arm.settle(far, 4.0)
    assert 0.9 * most < fastest < 1.01 * most
    assert arm.joints_rad == pytest.approx(far, abs=EXACT)


def test_its_goal_is_on_a_leash_of_metres(tmp_path: Path) -> None:
    arm = Joints(made_arm(tmp_path, MIXED), kind="delta", dt_s=0.02)
    arm.activate()
    ahead = []
    for _ in range(4):
        arm.send(*[[0.02, 0.0, 0.0, 0.0]] * 8)
        for _ in range(40):
            arm.tick()
            goal = arm.rig.commander.parts[0].motion.goal
            if goal is not None and goal.joints_rad is not None:
                ahead.append(abs(goal.joints_rad[0] - arm.joints_rad[0]))
    assert max(ahead) < arm.profile.limits.lead_m + 1e-3
    assert "lead_m" in arm.hits()


def test_the_goal_of_an_arm_that_is_held_leads_a_joint_that_slides_by_metres(
    tmp_path: Path,
) -> None:
    arm = Joints(made_arm(tmp_path, MIXED))
    path = arm.rig.commander.parts[0].motion._path
    assert path is not None
    path.stand(arm.home_rad)
    for far, near in (([0.1, 0, 0, 0], [0.01, 0, 0, 0]), ([0, 0.1, 0, 0.005], [0, 0.02, 0, 1e-3])):
        goal = path.near(joint_goal(path.kinematics, arm.home_rad + far, 0.0))
        assert goal.known_rad - arm.home_rad == pytest.approx(near, abs=EXACT)


def test_millimetres_are_rejected_with_the_joint_and_its_unit(tmp_path: Path) -> None:
    arm = Joints(made_arm(tmp_path, MIXED))
    arm.send([5.0, 0.1, 0.1, 0.25])
    arm.tick(Setting("active", True))
    assert arm.rig.state == "inactive"
    assert "a target of joint1 at 5 m, whose range is 0.01 to 0.49" in arm.rig.commander.why


def test_a_measured_joint_that_slides_away_from_its_command_ends_the_activation(
    tmp_path: Path,
) -> None:
    """0.12 m is little for a joint that turns, in radians."""
    arm = Joints(made_arm(tmp_path, MIXED))
    arm.activate()
    arm.run(0.2)
    arm.rig.blocked = True
    pushed = arm.joints_rad + [0.0, 0.0, 0.0, 0.12]
    arm.at(pushed)
    for _ in range(100):
        arm.tick()
    assert arm.rig.state == "inactive"


def test_no_joint_is_faster_than_its_description_says_whatever_the_profile_allows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("made_arm.TURN_RAD_S", 0.3)
    monkeypatch.setattr("made_arm.SLIDE_M_S", 0.05)
    quick = {"joint": {"velocity_rad_s": [0.2, 1.0, 1.0]}, "step_rad": 0.8, "lead_rad": 1.5}
    profile = override(made_arm(tmp_path, "sztytz"), {"limits": quick})
    arm = Joints(profile)
    arm.activate()
    arm.settle(arm.joints_rad + [0.1, 0.7, 0.7], 1.2)
    fastest = np.abs([command.velocity_rad_s for command in arm.joints]).max(axis=0)
    assert np.all(fastest < 1.001 * arm.kinematics.velocity_rad_s)
    assert np.all(fastest[1:] > 0.9 * arm.kinematics.velocity_rad_s[1:])


def test_an_arm_has_sixteen_joints_at_most(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="arm_joints"):
        made_arm(tmp_path, "ty" * 17)


@pytest.mark.parametrize("chain", ["sx", "sxty", MIXED])
def test_of_a_pose_beyond_the_ends_of_all_its_joints_an_arm_names_each_and_stands_there(
    tmp_path: Path, chain: str
) -> None:
    kinematics = make_kinematics(made_arm(tmp_path, chain))
    follower = JointFollower(kinematics, np.zeros(kinematics.size))
    end = follower.upper_rad
    here, jacobian = kinematics.pose_and_jacobian(end)
    beyond = jacobian @ np.where(kinematics.slides, 0.02, 0.1)
    target = Pose(here.position_m + beyond[:3], exp3(beyond[3:]) @ here.rotation)
    motion, hits = JointMotion.standing(end), list[LimitHit]()
    for _ in range(50):
        motion, hits = follower.step(motion, target, np.zeros(6), 0.004)
    assert motion.position_rad == pytest.approx(end, abs=EXACT)
    assert {hit.where for hit in hits if hit.name == "joint_limit"} == {*kinematics.arm_joints}
