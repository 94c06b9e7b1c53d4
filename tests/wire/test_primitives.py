"""Guarded primitives on the simulated arm: what is asked for is reached, or a reason is told."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_rig import until
from chain import LONG_PATIENCE_S, Chain, command_line, running_chain

from vla_zenoh.client.answer import Answer, decode_answer
from vla_zenoh.client.primitives import PrimitiveError, ask
from vla_zenoh.client.remote_robot import RemoteRobot, connect
from vla_zenoh.keys import PRIMITIVES, worker_node
from vla_zenoh.kinematics.so3 import Pose, pose_distance, pose_of, rotation_from_quat

pytestmark = pytest.mark.long

NEAR_M, NEAR_RAD = 1e-3, 2e-3
HOSTS = "hosts: {here: {nodes: [router, sim, camera, command, worker, primitives]}}\n"
DOWN = (1.0, 0.0, 0.0, 0.0)
"""Quaternion of a tool that points straight down."""
FAR_M = (0.55, 0.2, 0.35)
HOME_M = (0.43, 0.0, 0.16)
GARBAGE = 200


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    folder = tmp_path_factory.mktemp("primitives")
    with running_chain(folder, more=HOSTS, patience_s=LONG_PATIENCE_S) as found:
        found.until("the node answers", lambda: worker_node(PRIMITIVES) in found.client.alive, 40)
        yield found


@pytest.fixture
def robot(chain: Chain) -> Iterator[RemoteRobot]:
    chain.settle()
    with connect(chain.profile) as found:
        until("the task is known", lambda: found.task is not None)
        if np.linalg.norm(here(found) - HOME_M) > 0.02:
            found.home()
        yield found


def here(robot: RemoteRobot) -> np.ndarray[Any, Any]:
    return robot.pose_state().record.position_m


def speed_m_s(robot: RemoteRobot) -> float:
    return float(np.linalg.norm(robot.pose_state().record.twist[:3]))


def in_background(call: Any) -> tuple[threading.Thread, list[Any]]:
    """A thread that makes the call, and what it returned or raised."""
    found: list[Any] = []

    def make() -> None:
        try:
            found.append(call())
        except PrimitiveError as error:
            found.append(error.answer)

    thread = threading.Thread(target=make)
    thread.start()
    return thread, found


def query(robot: RemoteRobot, primitive: str, payload: bytes) -> Answer:
    """As a client without our package asks."""
    replies = list(robot.session.get(robot.keys.primitive(primitive), payload=payload, timeout=20))
    assert len(replies) == 1
    assert replies[0].ok is not None
    return decode_answer(replies[0].ok.payload.to_bytes())


def test_move_to_goes_to_a_pose_and_tells_where_the_arm_stands(robot: RemoteRobot) -> None:
    for position_m in ((0.5, 0.1, 0.3), (0.4, -0.15, 0.25)):
        answer = robot.move_to(position_m, DOWN)
        assert (answer.ok, answer.reason) == (True, "reached")
        target = Pose(np.array(position_m), rotation_from_quat(np.array(DOWN)))
        off_m, off_rad = pose_distance(pose_of(robot.pose_state().record), target)
        assert off_m < NEAR_M
        assert off_rad < NEAR_RAD
        assert answer.position_m == pytest.approx(position_m, abs=NEAR_M)
    until("it is over", lambda: robot.task is not None and not robot.task.active)
    assert robot.task is not None
    assert robot.task.worker == "scripted"


def test_a_pose_without_a_rotation_keeps_the_tool_as_it_is(robot: RemoteRobot) -> None:
    before = pose_of(robot.pose_state().record)
    robot.move_to((0.5, 0.0, 0.3))
    _, turned_rad = pose_distance(before, pose_of(robot.pose_state().record))
    assert turned_rad < 2 * NEAR_RAD


def test_an_arm_that_takes_poses_goes_to_the_pose_of_its_joints(robot: RemoteRobot) -> None:
    answer = robot.move_to(joints_rad={"panda_joint1": 0.4})
    assert answer.reason == "reached"
    assert "this robot takes poses" in answer.why
    answer = robot.home()
    assert answer.position_m == pytest.approx(HOME_M, abs=2 * NEAR_M)


def test_an_arm_that_takes_joints_goes_to_them(tmp_path: Path) -> None:
    with running_chain(tmp_path, more=f"robot: {{command: joint}}\n{HOSTS}") as found:
        found.until("the node answers", lambda: worker_node(PRIMITIVES) in found.client.alive, 40)
        with connect(found.profile) as robot:
            until("the task is known", lambda: robot.task is not None)
            home = robot.joint_state().record.position_rad
            asked_rad = [0.4, -0.3, 0.2, -2.2, 0.1, 2.3, 0.9]
            answer = robot.move_to(joints_rad=asked_rad)
            assert list(answer.joints_rad.values()) == pytest.approx(asked_rad, abs=NEAR_RAD)
            robot.move_to((0.5, 0.1, 0.3))
            answer = robot.home()
            assert list(answer.joints_rad.values()) == pytest.approx(home, abs=3 * NEAR_RAD)


def test_the_gripper_opens_and_closes_while_the_arm_stands(robot: RemoteRobot) -> None:
    before_m = here(robot)
    assert robot.grip("open").width_m == pytest.approx(0.08, abs=0.003)
    assert robot.grip(0.03).width_m == pytest.approx(0.03, abs=0.003)
    closed = robot.grip("closed").width_m
    assert closed is not None
    assert closed < 0.005
    assert here(robot) == pytest.approx(before_m, abs=NEAR_M)


def test_what_a_grip_holds_bounds_the_arm_until_it_opens(robot: RemoteRobot) -> None:
    def holds() -> object:
        status = robot.status("command")
        return None if status is None else status.detail.get("gripper_holds")

    robot.grip("open")
    robot.grip("closed", holds_m=(0.04, 0.04, 0.3))
    until("the box is held", lambda: holds() == "0.04 0.04 0.3")
    with pytest.raises(PrimitiveError, match="table") as found:
        robot.move_to((0.45, 0.0, 0.12))
    assert found.value.answer.reason == "rejected"
    robot.grip("open")
    until("nothing is held", lambda: holds() is None)
    assert robot.move_to((0.45, 0.0, 0.12)).reason == "reached"
    robot.home()


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"position_m": [0.45, 0.0, -0.05]}, "workspace"),
        ({"position_m": [0.45, 0.0, 0.02], "quat_xyzw": [0.0, 0.7071, 0.0, 0.7071]}, "table"),
        ({"position_m": [0.7499, 0.4499, 0.85]}, "before the target"),
        ({"joints_rad": [0.0] * 6}, "the arm has 7 joints"),
        ({"joints_rad": {"elbow": 0.1}}, "no joint 'elbow'"),
        ({"joints_rad": {"panda_joint4": 1.0}}, "its range is"),
    ],
)
def test_a_target_out_of_bounds_is_rejected_and_nothing_moves(
    robot: RemoteRobot, asked: dict[str, Any], words: str
) -> None:
    before_m = here(robot)
    with pytest.raises(PrimitiveError, match=words) as error:
        robot.move_to(**asked)
    assert error.value.answer.reason == "rejected"
    assert here(robot) == pytest.approx(before_m, abs=2e-4)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"position_m": [450.0, 0.0, 300.0]}, "position_m.0: .*metres"),
        ({"joints_rad": [0, -40, 0, 90, 0, 90, 45]}, "joints_rad.*in rad"),
        ({"position_m": [0.4, float("nan"), 0.3]}, "position_m.1: wants a finite number"),
        ({"position_m": [0.4, 0.3]}, "position_m.2: is missing"),
        ({"position_m": [0.4, 0, 0.3], "quat_xyzw": [0, 0, 0, 0]}, "quat_xyzw: .*unit quaternion"),
        ({"joints_rad": [0.0] * 40}, "joints_rad.*at most 16"),
        ({}, "wants one target"),
    ],
)
def test_a_wrong_request_is_answered_by_its_field(
    robot: RemoteRobot, asked: dict[str, Any], words: str
) -> None:
    with pytest.raises(PrimitiveError, match=words) as error:
        robot.move_to(**asked)
    assert error.value.answer.reason == "invalid"


def test_a_stop_in_motion_ends_it_with_that_reason(robot: RemoteRobot) -> None:
    thread, found = in_background(lambda: robot.move_to(FAR_M))
    until("it moves", lambda: speed_m_s(robot) > 0.05)
    robot.stop()
    thread.join(20)
    assert found[0].reason == "stopped"
    assert speed_m_s(robot) < 0.01
    with pytest.raises(PrimitiveError, match="reset"):
        robot.home()
    robot.reset()


def test_a_deactivation_ends_it_with_that_reason(robot: RemoteRobot) -> None:
    thread, found = in_background(lambda: robot.move_to(FAR_M))
    until("it moves", lambda: speed_m_s(robot) > 0.05)
    robot.deactivate()
    thread.join(20)
    assert found[0].reason == "deactivated"


def test_time_over_brakes_short_of_the_target(robot: RemoteRobot) -> None:
    with pytest.raises(PrimitiveError) as error:
        robot.move_to(FAR_M, timeout_s=1.5)
    assert error.value.answer.reason == "timeout"
    assert error.value.answer.off_m is not None
    assert error.value.answer.off_m > 0.05
    assert speed_m_s(robot) < 0.01


def test_a_robot_that_falls_silent_in_motion_ends_it_with_the_command_node_s_reason(
    robot: RemoteRobot,
) -> None:
    thread, found = in_background(lambda: robot.move_to(FAR_M))
    until("it moves", lambda: speed_m_s(robot) > 0.05)
    simulator = robot.status("sim")
    assert simulator is not None
    os.kill(simulator.pid, signal.SIGSTOP)
    try:
        thread.join(20)
    finally:
        os.kill(simulator.pid, signal.SIGCONT)
    assert found[0].reason == "ended"
    assert "nothing was published" not in found[0].why


CLIENT = """
import sys
from vla_zenoh import connect
with connect(sys.argv[1]) as robot:
    print(robot.move_to((0.55, 0.2, 0.35)), flush=True)
"""


def test_a_client_that_is_killed_in_motion_brakes_the_arm(chain: Chain, robot: RemoteRobot) -> None:
    client = subprocess.Popen([sys.executable, "-c", CLIENT, str(chain.profile_file)])
    try:
        until("it moves", lambda: speed_m_s(robot) > 0.05, 20)
        client.kill()
        until("it stands", lambda: robot.task is not None and not robot.task.active)
        chain.wait_still()
        assert float(np.linalg.norm(here(robot) - FAR_M)) > 0.05
    finally:
        client.kill()
        client.wait()
    assert robot.home().ok


def test_a_second_client_is_told_who_is_served(chain: Chain, robot: RemoteRobot) -> None:
    thread, found = in_background(lambda: robot.move_to(FAR_M))
    until("it moves", lambda: speed_m_s(robot) > 0.05)
    with connect(chain.profile) as other, pytest.raises(PrimitiveError, match="move_to of 'script"):
        other.home()
    thread.join(20)
    assert found[0].reason == "reached"


def test_an_arm_that_a_model_moves_is_not_taken(chain: Chain, robot: RemoteRobot) -> None:
    chain.activate_when_ready()
    with pytest.raises(PrimitiveError, match="worker 'scripted' moves the arm"):
        robot.home()
    assert robot.task is not None
    assert robot.task.active


def test_without_its_token_a_client_moves_nothing(robot: RemoteRobot) -> None:
    answer = query(robot, "home", json.dumps({"holder": "nobody", "timeout_s": 1}).encode())
    assert answer.reason == "rejected"
    assert "liveliness token" in answer.why


def test_a_client_that_lets_go_brakes_the_arm(robot: RemoteRobot) -> None:
    asked = {"position_m": list(FAR_M)}
    answer = ask(robot, "move_to", asked, cancelled=lambda: speed_m_s(robot) > 0.05)
    assert answer.reason == "ended"
    assert not answer.ok
    assert "client" in answer.why


def test_garbage_is_counted_and_nothing_dies(chain: Chain, robot: RemoteRobot) -> None:
    rng = np.random.default_rng(0)
    before = chain.counter("refused.malformed", worker_node(PRIMITIVES))
    for number in range(GARBAGE):
        payload = rng.bytes(int(rng.integers(0, 200)))
        assert (
            query(robot, ("move_to", "grip", "nonsense")[number % 3], payload).reason == "invalid"
        )
    assert query(robot, "run", b"x" * 100_000).reason == "invalid"
    counted = chain.until(
        "they are counted",
        lambda: chain.counter("refused.malformed", worker_node(PRIMITIVES)) - before,
    )
    assert counted > 0
    assert robot.home().ok


def test_a_model_runs_until_a_condition_holds(robot: RemoteRobot) -> None:
    box = {"low_m": [0.2, -0.4, 0.22], "high_m": [0.7, 0.4, 0.6]}
    answer = robot.run("scripted", {"inside": box}, prompt="HARD: go up")
    assert (answer.ok, answer.reason) == (True, "inside")
    assert here(robot)[2] > 0.22
    answer = robot.run("scripted", {"done": True}, prompt="HARD: go up x3")
    assert answer.reason == "done"
    answer = robot.run("scripted", {"still_s": 1.0}, prompt="HARD: go down x3")
    assert answer.reason == "still_s"
    until("the prompt is back", lambda: robot.task is not None and robot.task.prompt == "hold")


def test_the_example_moves_the_arm(chain: Chain, robot: RemoteRobot) -> None:
    example = Path(__file__).parents[2] / "examples" / "move_by_script.py"
    said = subprocess.run(
        [sys.executable, example, str(chain.profile_file)],
        capture_output=True,
        text=True,
        check=True,
        timeout=90,
    ).stdout
    assert said.count("reached") == 2
    assert "nothing moved: move_to: rejected: workspace" in said
    assert "the model was stopped: inside" in said


def test_the_command_line_moves_the_arm(chain: Chain, robot: RemoteRobot) -> None:
    def do(*words: str) -> tuple[int, str]:
        done = command_line("do", *words, profile=chain.profile_file)
        return done.returncode, done.stdout + done.stderr

    code, said = do("move-to", "--at", "0.5,0.1,0.3", "--json")
    assert code == 0
    assert json.loads(said)["reason"] == "reached"
    code, said = do("move-to", "--at", "0.5,0.1,-0.3")
    assert code == 1
    assert "workspace" in said
    code, said = do("grip", "0.02")
    assert code == 0
    assert "gripper 20" in said
    code, said = do("run", "scripted", "--prompt", "HARD: go up", "--until", "still=x")
    assert code == 2
    code, said = do("run", "scripted", "--prompt", "HARD: go up x2", "--until", "done")
    assert code == 0
    assert said.startswith("done")


def test_a_run_whose_time_is_over_says_so(robot: RemoteRobot) -> None:
    answer = robot.run("scripted", {"force_n": 500}, prompt="HARD: go up", timeout_s=2)
    assert (answer.ok, answer.reason) == (False, "timeout")
    with pytest.raises(PrimitiveError, match="'nobody' is not alive"):
        robot.run("nobody")
