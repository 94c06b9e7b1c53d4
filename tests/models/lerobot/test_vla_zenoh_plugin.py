"""LeRobot's own commands drive an arm on the bus, through our plug-in for it."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="needs LeRobot's environment: make test-models")
sys.path.append(str(Path(__file__).parents[2]))  # what all tests share
from plugin_rig import (
    CAMERA_HZ,
    FPS,
    HEIGHT,
    HOME_DEG,
    JOINTS,
    NAMES,
    SOURCE,
    SWING_DEG,
    WIDTH,
    Leader,
    running_arm,
    write_leader,
)

sys.path.insert(0, str(SOURCE))
from chain import Chain
from lerobot.utils.errors import DeviceNotConnectedError
from lerobot_robot_vla_zenoh import (
    VlaZenoh,
    VlaZenohCamera,
    VlaZenohCameraConfig,
    VlaZenohConfig,
    VlaZenohTeleop,
    VlaZenohTeleopConfig,
)
from lerobot_robot_vla_zenoh.numbers import ArmNumbers

from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import load_profile, override
from vla_zenoh.types import GripperState, JointState

pytestmark = [pytest.mark.models, pytest.mark.timeout(280)]

REACHED_DEG, GRIPPED = 0.5, 1.0


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    with running_arm(tmp_path_factory.mktemp("arm")) as chain:
        yield chain


@pytest.fixture
def robot(arm: Chain) -> Iterator[VlaZenoh]:
    robot = VlaZenoh(VlaZenohConfig(profile=str(arm.profile_file), fps=FPS))
    robot.connect()
    try:
        yield robot
    finally:
        if robot.is_connected:
            robot.disconnect()


def go(robot: VlaZenoh, goal: dict[str, float], seconds: float) -> dict[str, Any]:
    """Send one action again and again; what is seen in the end."""
    for _ in range(round(seconds * FPS)):
        robot.send_action(goal)
        time.sleep(1 / FPS)
    return robot.get_observation()


def test_the_features_are_known_before_anything_is_connected(arm: Chain) -> None:
    robot = VlaZenoh(VlaZenohConfig(profile=str(arm.profile_file)))
    assert robot.action_features == dict.fromkeys(NAMES, float)
    assert robot.observation_features == {
        **dict.fromkeys(NAMES, float),
        "front": (HEIGHT, WIDTH, 3),
    }
    assert not robot.is_connected
    for use in (robot.get_observation, lambda: robot.send_action({}), robot.disconnect):
        with pytest.raises(DeviceNotConnectedError):
            use()


def test_an_action_moves_the_arm_there_in_degrees_and_percent(robot: VlaZenoh) -> None:
    seen = robot.get_observation()
    assert [*seen] == [*NAMES, "front"]
    assert seen["front"].dtype == np.uint8
    assert seen["front"].shape == (HEIGHT, WIDTH, 3)
    goal = {name: seen[name] for name in NAMES} | {"shoulder_pan.pos": 12.0, "gripper.pos": 40.0}
    assert robot.send_action(goal) == pytest.approx(goal)
    seen = go(robot, goal, 3.0)
    assert seen["shoulder_pan.pos"] == pytest.approx(12.0, abs=REACHED_DEG)
    assert seen["gripper.pos"] == pytest.approx(40.0, abs=GRIPPED)


def test_what_is_returned_ends_where_the_joint_does(robot: VlaZenoh, arm: Chain) -> None:
    here = robot.get_observation()
    far = {name: here[name] for name in NAMES} | {"wrist_roll.pos": 500.0, "gripper.pos": 130.0}
    sent = robot.send_action(far)
    assert 90.0 < sent["wrist_roll.pos"] < 180.0
    assert sent["gripper.pos"] == pytest.approx(100.0)
    assert arm.state() in ("active", "holding")


def test_the_arm_stands_and_stays_active_while_the_loop_pauses(robot: VlaZenoh, arm: Chain) -> None:
    here = robot.get_observation()
    goal = {name: here[name] for name in NAMES}
    goal["shoulder_pan.pos"] -= 6.0
    robot.send_action(goal)
    time.sleep(3.0)
    assert arm.state() == "active"
    assert robot.get_observation()["shoulder_pan.pos"] == pytest.approx(
        goal["shoulder_pan.pos"], abs=REACHED_DEG
    )
    robot.send_action(goal)


def test_an_action_that_is_incomplete_or_no_number_is_rejected_by_name(robot: VlaZenoh) -> None:
    here = robot.get_observation()
    goal = {name: here[name] for name in NAMES}
    with pytest.raises(ValueError, match=r"lacks gripper\.pos"):
        robot.send_action({name: goal[name] for name in NAMES[:-1]})
    with pytest.raises(ValueError, match=r"has no elbow\.pos"):
        robot.send_action({**goal, "elbow.pos": 1.0})
    with pytest.raises(ValueError, match=r"wrist_flex\.pos is nan"):
        robot.send_action({**goal, "wrist_flex.pos": math.nan})


def refused(robot: VlaZenoh, goal: dict[str, float], why: str) -> None:
    """Until the news has reached this client it may still send."""
    for _ in range(5 * FPS):
        try:
            robot.send_action(goal)
        except DeviceNotConnectedError as error:
            if why in str(error):
                return
        time.sleep(1 / FPS)
    raise AssertionError(f"never refused with {why!r}")


def test_a_stop_and_another_worker_are_errors_that_say_so(robot: VlaZenoh, arm: Chain) -> None:
    here = robot.get_observation()
    goal = {name: here[name] for name in NAMES}
    arm.client.set_worker("scripted_pick")
    refused(robot, goal, "follows worker 'scripted_pick'")
    arm.client.stop()
    refused(robot, goal, "not active: emergency stop")
    robot.disconnect()
    again = VlaZenoh(robot.config)
    with pytest.raises(DeviceNotConnectedError, match="emergency stop"):
        again.connect()
    assert not again.is_connected
    assert not again.cameras["front"].is_connected
    arm.client.reset()
    arm.until("cleared", arm.client.cleared)


def test_disconnecting_brakes_the_arm(robot: VlaZenoh, arm: Chain) -> None:
    robot.disconnect()
    assert not robot.is_connected
    assert arm.state() == "inactive"
    arm.until("it stands", lambda: arm.detail("at_rest"))


def test_a_camera_reads_new_images_and_names_what_does_not_fit(arm: Chain) -> None:
    profile = str(arm.profile_file)
    camera = VlaZenohCamera(VlaZenohCameraConfig(profile=profile, camera="front"))
    assert (camera.width, camera.height, camera.fps) == (WIDTH, HEIGHT, CAMERA_HZ)
    with pytest.raises(DeviceNotConnectedError):
        camera.read_latest()
    with camera:
        first, second = camera.read(), camera.async_read(2000)
        assert first.shape == second.shape == (HEIGHT, WIDTH, 3)
        assert first is not second
        assert camera.read_latest() is not None
        with pytest.raises(TimeoutError, match="ms old"):
            camera.read_latest(max_age_ms=-1)
    wrong = VlaZenohCameraConfig(profile=profile, camera="front", width=320, height=240)
    with pytest.raises(ValueError, match="160x120 pixels, not width=320, height=240"):
        VlaZenohCamera(wrong).connect()
    with pytest.raises(ProfileError, match="no camera 'fronts'"):
        VlaZenohCameraConfig(profile=profile, camera="fronts")
    with pytest.raises(ProfileError, match="20 images a second, not fps=30"):
        VlaZenohCameraConfig(profile=profile, camera="front", fps=30)


def test_an_image_that_is_late_is_waited_for(robot: VlaZenoh) -> None:
    own = vars(robot)
    own["_profile"] = override(own["_profile"], {"timing": {"max_observation_age_s": 0.001}})
    first, second = (robot.get_observation()["front"] for _ in range(2))
    assert first is not second


def test_a_leader_is_read_in_the_numbers_of_the_follower(arm: Chain, tmp_path: Path) -> None:
    leader = write_leader(tmp_path, arm)
    teleop = VlaZenohTeleop(VlaZenohTeleopConfig(profile=str(leader)))
    assert teleop.action_features == dict.fromkeys(NAMES, float)
    with pytest.raises(DeviceNotConnectedError, match="state/joint"):
        teleop.connect()
    with Leader(arm.profile), teleop:
        action = teleop.get_action()
        np.testing.assert_allclose([action[name] for name in NAMES[1:5]], HOME_DEG[1:], atol=1e-3)
        assert abs(action["shoulder_pan.pos"]) <= SWING_DEG
        assert action["gripper.pos"] == pytest.approx(50.0)


def test_arms_that_lerobot_has_no_numbers_for_are_rejected_by_name(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="has the parts left, right"):
        VlaZenohConfig(profile="two_pandas_sim")


def test_an_arm_without_a_gripper_has_its_joints_alone() -> None:
    bare = override(load_profile("so101_sim"), {"robot": {"gripper": None, "finger_joints": []}})
    numbers = ArmNumbers(bare, FPS)
    assert numbers.names == NAMES[:-1]
    assert numbers.action.gripper == "none"
    goal = dict(zip(NAMES, (10.0, -20.0, 30.0, 40.0, -500.0), strict=False))
    step = numbers.step(numbers.within_range(goal))
    np.testing.assert_allclose(step[:4], np.radians([10, -20, 30, 40]), atol=1e-12)
    assert len(step) == 5
    at = JointState(JOINTS, np.radians([1.0, 2, 3, 4, 5]), np.zeros(5), None)
    none = GripperState(None, moving=False, holding=False)
    header = SimpleNamespace(stamp_wall_ns=1, seq=1)
    remote: Any = SimpleNamespace(
        joint_state=lambda: SimpleNamespace(record=at, header=header),
        gripper_state=lambda: SimpleNamespace(record=none, header=header),
    )
    assert [*numbers.measured(remote).values()] == pytest.approx([1, 2, 3, 4, 5], abs=1e-5)
    with pytest.raises(ValueError, match=r"the arm has no gripper\.pos"):
        numbers.within_range({**goal, "gripper.pos": 1.0})


def test_positions_go_through_both_directions(tmp_path: Path) -> None:
    numbers = ArmNumbers(load_profile("so101_sim"), FPS)
    goal = dict(zip(NAMES, (10.0, -20.0, 30.0, 40.0, -50.0, 60.0), strict=True))
    step = numbers.step(numbers.within_range(goal))
    np.testing.assert_allclose(step, [*np.radians([10, -20, 30, 40, -50]), 0.6], atol=1e-12)
    assert numbers.action.joints == JOINTS
