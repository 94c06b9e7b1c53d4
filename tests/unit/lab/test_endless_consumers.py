"""Everything that computes with the ranges of joints is right where a joint has no end.

Numpy's warnings are errors here: an infinite range that becomes no number fails a test.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from endless_arm import ENDLESS, HOME_RAD, endless_arm
from made_arm import made_arm
from vla_zenoh_conform.rules import RuleFinding, _joints
from vla_zenoh_inspect.targets import Targets
from vla_zenoh_lerobot.arm import LeRobotArm
from vla_zenoh_lerobot.plugin import LeRobotOptions
from vla_zenoh_newarm.posture import posture
from vla_zenoh_physicalai.layout import Layout
from vla_zenoh_primitives.endings import Arrival, Sight
from vla_zenoh_primitives.target_check import TargetCheck

from vla_zenoh.control.joint_follower import JointFollower, JointMotion
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.errors import NodeError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import Pose, quat_from_rotation
from vla_zenoh.lab.profile.robot_check import arm as check_arm
from vla_zenoh.lab.profile.robot_check import joints_advice
from vla_zenoh.profile import Profile, override
from vla_zenoh.simulation.impedance import CartesianImpedance, ImpedanceGains
from vla_zenoh.types import FloatArray, GripperState, JointState, PoseState

ROOT = Path(__file__).parents[3]
HOME = np.array(HOME_RAD)
TURN = 2 * math.pi
AWAY = HOME + np.array([0, 0, 0, 0, 0, 5]) * TURN

HERE = "unit/lab/test_endless_consumers.py"
FIXED = "an arm of one maker, whose joints all have ends"
TRIED = {
    "src/vla_zenoh/control/joint_follower.py": "sim/test_endless_joints.py",
    "src/vla_zenoh/control/joint_space.py": "unit/control/test_endless_targets.py",
    "src/vla_zenoh/control/reachability.py": "unit/kinematics/test_endless_ranges.py",
    "src/vla_zenoh/control/watchdog.py": "sim/test_endless_joints.py",
    "src/vla_zenoh/guard/stream_guard.py": "sim/test_endless_joints.py",
    "src/vla_zenoh/kinematics/collision.py": "unit/kinematics/test_endless_ranges.py",
    "src/vla_zenoh/kinematics/kinematics.py": "unit/kinematics/test_endless_ranges.py",
    "src/vla_zenoh/kinematics/plausibility.py": "unit/kinematics/test_endless_ranges.py",
    "src/vla_zenoh/lab/profile/robot_check.py": HERE,
    "src/vla_zenoh/robots/driver.py": "unit/ros2/test_ros2_endless.py",
    "src/vla_zenoh/simulation/any_arm.py": "sim/test_endless_joints.py",
    "src/vla_zenoh/simulation/impedance.py": "sim/test_endless_joints.py",
    "src/vla_zenoh/simulation/world.py": "sim/test_endless_joints.py",
    "plugins/lerobot_robot_vla_zenoh/src/lerobot_robot_vla_zenoh/numbers.py": "clips to its ends",
    "plugins/vla-zenoh-conform/src/vla_zenoh_conform/rules.py": HERE,
    "plugins/vla-zenoh-franka/src/vla_zenoh_franka/check.py": FIXED,
    "plugins/vla-zenoh-inspect/src/vla_zenoh_inspect/targets.py": HERE,
    "plugins/vla-zenoh-lerobot/src/vla_zenoh_lerobot/arm.py": HERE,
    "plugins/vla-zenoh-newarm/src/vla_zenoh_newarm/posture.py": HERE,
    "plugins/vla-zenoh-physicalai/src/vla_zenoh_physicalai/layout.py": HERE,
    "plugins/vla-zenoh-primitives/src/vla_zenoh_primitives/target_check.py": HERE,
    "plugins/vla-zenoh-r2c/src/vla_zenoh_r2c/answer.py": "compares with its ends",
    "plugins/vla-zenoh-trossen/src/vla_zenoh_trossen/arm.py": FIXED,
    "plugins/vla-zenoh-trossen/src/vla_zenoh_trossen/bounds.py": FIXED,
}
"""File that reads the ends of ranges -> the test of it with joints that have none, or why not."""


def test_every_file_that_reads_the_ends_of_ranges_is_tried_without_them() -> None:
    found = {
        str(file.relative_to(ROOT))
        for folder in ("src", "plugins")
        for file in (ROOT / folder).rglob("*.py")
        if ".venv" not in file.parts and ".upper_rad" in file.read_text()
    }
    # These are given the ends by others.
    inner = ("guard/stream_guard", "simulation/impedance", "simulation/world")
    found |= {f"src/vla_zenoh/{name}.py" for name in inner}
    assert found == TRIED.keys()
    tests = [test for test in TRIED.values() if test.endswith(".py")]
    assert all((ROOT / "tests" / test).exists() for test in tests)


COUNTED = "both are counted over turns, as everything on the bus and in a plan is"
NEAREST = "one of them is the nearest turn to the other"
APART = {
    "src/vla_zenoh/control/actions.py": "unit/policy/test_turns.py",
    "src/vla_zenoh/control/joint_follower.py": NEAREST,
    "src/vla_zenoh/control/joint_space.py": COUNTED,
    "src/vla_zenoh/control/motion_pipeline.py": COUNTED,
    "src/vla_zenoh/control/part_spacing.py": COUNTED,
    "src/vla_zenoh/control/plan_timeline.py": COUNTED,
    "src/vla_zenoh/control/pose_to_joint.py": NEAREST,
    "src/vla_zenoh/control/preflight.py": COUNTED,
    "src/vla_zenoh/control/reachability.py": COUNTED,
    "src/vla_zenoh/control/step_space.py": COUNTED,
    "src/vla_zenoh/guard/arm_guard.py": COUNTED,
    "src/vla_zenoh/guard/stream_guard.py": COUNTED,
    "src/vla_zenoh/lab/check/fit.py": "unit/policy/test_turns.py",
    "src/vla_zenoh/policy/frozen.py": "unit/policy/test_turns.py",
    "src/vla_zenoh/simulation/impedance.py": COUNTED,
    "plugins/vla-zenoh-primitives/src/vla_zenoh_primitives/endings.py": HERE,
    "plugins/vla-zenoh-primitives/src/vla_zenoh_primitives/node.py": NEAREST,
    "plugins/vla-zenoh-primitives/src/vla_zenoh_primitives/target_check.py": HERE,
    "plugins/vla-zenoh-r2c/src/vla_zenoh_r2c/answer.py": NEAREST,
    "plugins/vla-zenoh-trossen/src/vla_zenoh_trossen/arm.py": FIXED,
    "plugins/vla-zenoh-trossen/src/vla_zenoh_trossen/bounds.py": FIXED,
    "models/scripted_pair.py": FIXED,
    "models/scripted_pick.py": FIXED,
}
"""File that subtracts angles of joints -> the test of it over half a turn, or why it is right."""
ANGLES = re.compile(
    r"(joints?|position|target|here|measured|start|before|after|asked|wanted|reference|leader|home|"
    r"goal|at|held|known|others|end|rows?)_rad\b|\bjoints\b"
)


def subtracts_joints(node: ast.AST) -> bool:
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub):
        return all(ANGLES.search(ast.unparse(side)) for side in (node.left, node.right))
    if not isinstance(node, ast.Call) or getattr(node.func, "attr", "") != "diff":
        return False
    return bool(re.match(r"np\.diff\((steps|joints|rows_rad|ways)\b", ast.unparse(node)))


def test_every_file_that_subtracts_angles_of_joints_is_right_over_half_a_turn() -> None:
    found = {
        str(file.relative_to(ROOT))
        for folder in ("src", "plugins", "models")
        for file in (ROOT / folder).rglob("*.py")
        if ".venv" not in file.parts
        and ((" - " in (text := file.read_text()) and ANGLES.search(text)) or "np.diff(" in text)
        and any(map(subtracts_joints, ast.walk(ast.parse(text))))
    }
    assert found == APART.keys()
    tests = [test for test in APART.values() if test.endswith(".py")]
    assert all((ROOT / "tests" / test).exists() for test in tests)


@pytest.fixture
def profile(tmp_path: Path) -> Profile:
    return endless_arm(tmp_path)


def test_the_check_of_a_profile_finds_nothing_wrong(profile: Profile) -> None:
    assert not list(check_arm(profile))
    assert any(
        "no end" in why and "joint1, joint4, joint6" in why for why in joints_advice(profile)
    )


def test_a_home_is_found_within_a_turn(profile: Profile) -> None:
    found = posture(make_kinematics(profile), profile.limits.reach, ())
    assert np.isfinite(found.home_rad).all()
    assert np.abs(found.home_rad).max() < math.pi


def test_a_target_of_a_motion_is_checked_on_the_shortest_way(profile: Profile) -> None:
    check = TargetCheck(profile, ReachabilityFilter(profile))
    assert check.joints_fault(AWAY, HOME + 0.1) == ""
    assert "joint_limit: joint2" in check.joints_fault(AWAY, HOME + [0, 9, 0, 0, 0, 0])


def test_a_motion_is_over_where_its_target_is_after_some_turns(profile: Profile) -> None:
    arm = make_kinematics(profile)
    pose = arm.forward(HOME)
    measured = PoseState(pose.position_m, quat_from_rotation(pose.rotation), np.zeros(6))
    gripper = GripperState(None, moving=False, holding=False)
    arrival = Arrival(Pose(*pose), HOME, arm)
    checks = [arrival.check(Sight(now_s, measured, AWAY, gripper)) for now_s in (0.0, 1.0, 2.0)]
    assert "reached" in checks


def test_an_agent_is_told_a_turn_and_goes_the_shortest_way(tmp_path: Path) -> None:
    gripper = {"max_width_m": 0.08, "joint_open_m": 0.04, "joint_shut_m": 0.0}
    profile = endless_arm(tmp_path, robot={"gripper": gripper})
    targets = Targets(profile, 10.0)
    assert np.isfinite([targets.low, targets.high]).all()
    assert (targets.high - targets.low)[[0, 3, 5]] == pytest.approx(TURN)
    here, there = np.array([*AWAY, 0.5]), np.array([*HOME, 0.5])
    there[5] += 0.3
    assert targets.refusal(here, there) == ""
    way = targets.way(here, there)
    assert way[-1] == pytest.approx([*AWAY[:5], AWAY[5] + 0.3, 0.5])


def test_an_agent_moves_an_arm_without_a_gripper_by_its_joints(tmp_path: Path) -> None:
    profile = endless_arm(tmp_path, robot={"gripper": None})
    targets = Targets(profile, 10.0)
    assert targets.labels == profile.robot.arm_joints
    assert targets.action.gripper == "none"
    assert len(targets.low) == len(targets.high) == len(targets.most) == 6
    there = HOME + np.array([0, 0, 0, 0, 0, 0.3])
    assert targets.refusal(HOME, there) == ""
    assert targets.way(HOME, there)[-1] == pytest.approx(there)


def test_joints_after_many_turns_conform(profile: Profile) -> None:
    still = np.zeros(6)
    state = JointState(profile.robot.arm_joints, AWAY, still, still, endless=ENDLESS)
    findings: list[RuleFinding] = list(_joints([state], profile, make_kinematics(profile)))
    assert all(finding.right for finding in findings), findings


def lerobot_arm(profile: Profile, units: str) -> LeRobotArm:
    given = {"robot": "any", "port": "/dev/null", "id": "one", "gripper": "", "units": units}
    return LeRobotArm(profile, LeRobotOptions.model_validate(given))


def physicalai_layout(profile: Profile, unit: str) -> Layout:
    names = profile.robot.arm_joints
    ends = {"gripper": "", "gripper_ends": (0.0, 1.0), "zero": (), "reversed": ()}
    return Layout(profile, names, joints=names, unit=unit, **ends)  # type: ignore[arg-type]


@pytest.mark.parametrize("make", [lerobot_arm, physicalai_layout])
def test_units_from_end_to_end_need_ends_and_degrees_need_a_turn(
    make: Callable[[Profile, str], object], profile: Profile, tmp_path: Path
) -> None:
    without = override(profile, {"robot": {"gripper": None}})
    with pytest.raises(NodeError, match="joint1, joint4, joint6 turns without"):
        make(without, "normalised")
    make(without, "degrees")
    lift = made_arm(tmp_path, "sztytz")
    with pytest.raises(NodeError, match="joint1 slides"):
        make(lift, "degrees")
    make(lift, "normalised")


SEVEN = "eztyeztytzexty"
POSTURE = np.array([0.3, -0.8, 0.1, 1.6, 0.2, 3.0, 0.7])


def test_a_redundant_arm_is_pulled_to_its_posture_as_if_it_had_never_turned(
    tmp_path: Path,
) -> None:
    arm = make_kinematics(made_arm(tmp_path, SEVEN, 0.2))
    turns = np.array([3, 0, -2, 0, 0, 9, 0]) * TURN
    assert np.array_equal(arm.endless, turns != 0)
    away = POSTURE + 0.2 * np.array([1, -1, 1, 1, -1, 1, 1])
    follower = JointFollower(arm, POSTURE)
    law = CartesianImpedance(
        ImpedanceGains(),
        lower_rad=arm.lower_rad,
        upper_rad=arm.upper_rad,
        effort_nm=np.full(7, 50.0),
        posture_rad=POSTURE,
        period_s=0.001,
    )
    pulls: list[FloatArray] = []
    for at in (away, away + turns):
        here = JointMotion.standing(at)
        motion, hits = follower.step(here, arm.forward(at), np.zeros(6), 0.004)
        state: Any = SimpleNamespace(position_rad=at, velocity_rad_s=np.zeros(7))
        torque = law._posture_torque(state)
        assert not hits
        pulls += [motion.velocity_rad_s, torque]
    assert np.abs(pulls[0]).max() > 1e-3
    assert pulls[2] == pytest.approx(pulls[0], abs=1e-6)
    assert pulls[3] == pytest.approx(pulls[1], abs=1e-6)
