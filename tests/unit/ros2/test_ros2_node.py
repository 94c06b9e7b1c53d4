"""The node ``ros2`` on a real bus; its robot has the wire form of a bridge, or of rmw_zenoh."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
import zenoh
from camera_rig import await_match
from panda_arm import ARM_JOINTS, HOME_RAD, panda
from ros2_rig import CAMERA, DEPTH, HEIGHT, WIDTH, Ros2Rig, ros2_rig

from vla_zenoh.bus.node import Publisher
from vla_zenoh.codec.image import decode_depth, decode_raw
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.types import (
    GripperCommand,
    GripperState,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
    Task,
)

POSITION_TOLERANCE_M = 1e-6
PERIOD_S = 0.01
BRAKED_M = 3e-5
SPEED_M_S = 0.02
RETURNED_RAD, ELSEWHERE_RAD = 0.05, 0.5
JUMP_M = 0.02
LATE = 5
"""Set-points of a motion that are on their way when the first state of a robot that came back is
told."""
BACK_M = 0.0002
"""What a test's thread that is held up between two clocks makes of a steady stream."""
SILENCE_S = 0.3
"""timing.command_timeout_s of the rig's profile."""
MOVE = "/panda_gripper/move/_action"
GOAL = "multi_mode_control_msgs/msg/CartesianImpedanceGoal"
BRIDGES = ("ros2dds", "rmw_zenoh")

pytestmark = pytest.mark.realtime

whatever_the_bridge = pytest.mark.parametrize("shared_rig", BRIDGES[:1], indirect=True)
"""Of a test about what the node makes of messages, however they came."""


@pytest.fixture(scope="module", params=BRIDGES)
def shared_rig(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Ros2Rig]:
    with ros2_rig(tmp_path_factory.mktemp("ros2"), request.param, "  services: true\n") as rig:
        rig.newest(JointState)
        yield rig


@pytest.fixture
def rig(shared_rig: Ros2Rig) -> Iterator[Ros2Rig]:
    """The module's robot, well and at home; nothing leads it."""
    robot = shared_rig.robot
    shared_rig.wait("it runs", lambda: shared_rig.statuses[-1].state == "running")
    yield shared_rig
    robot.silent = robot.frozen = False
    robot.alter = lambda fields: None


# -- state ----------------------------------------------------------------------------------------
def test_joint_states_become_our_states_with_the_robots_own_stamps(rig: Ros2Rig) -> None:
    joints: JointState = rig.newest(JointState)
    assert joints.names == ARM_JOINTS
    pose: PoseState = rig.newest(PoseState)
    rig.wait("a gripper state", lambda: rig.states[GripperState])
    assert rig.newest(GripperState).width_m == pytest.approx(rig.robot.width_m)
    expected = panda().forward(rig.robot.joints_rad).position_m
    assert np.abs(pose.position_m - expected).max() < POSITION_TOLERANCE_M
    stamps: list[int] = []
    rig.robot.alter = lambda fields: stamps.append(
        fields["header"].stamp.sec * 10**9 + fields["header"].stamp.nanosec
    )
    since = len(rig.states[JointState])
    rig.wait("ten states", lambda: len(rig.states[JointState]) > since + 10)
    heard = {kind: [h for h, _ in rig.states[kind]] for kind in (JointState, PoseState)}
    assert {h.stamp_wall_ns for h in heard[JointState][since + 2 :]} <= set(stamps)
    poses = {(h.stamp_wall_ns, h.seq) for h in heard[PoseState]}
    assert {(h.stamp_wall_ns, h.seq) for h in heard[JointState][:-1]} <= poses


@whatever_the_bridge
@pytest.mark.parametrize(
    ("field", "index", "value", "reason"),
    [
        ("position", 2, np.nan, "invalid"),
        ("velocity", 0, np.inf, "invalid"),
    ],
)
def test_what_is_not_finite_is_refused_and_no_state_comes_of_it(
    rig: Ros2Rig, field: str, index: int, value: float, reason: str
) -> None:
    before = rig.counted(f"refused.{reason}")

    def spoil(fields: dict[str, Any]) -> None:
        fields[field][index] = value

    rig.robot.alter = spoil
    rig.wait("it is refused", lambda: rig.counted(f"refused.{reason}") > before)
    since = len(rig.states[PoseState])
    rig.wait("the node says so", lambda: rig.statuses[-1].state == "silent")
    assert len(rig.states[PoseState]) == since


@whatever_the_bridge
def test_a_robot_that_repeats_itself_is_frozen(rig: Ros2Rig) -> None:
    before = rig.counted("refused.frozen")
    rig.robot.frozen = True
    rig.wait("it is refused", lambda: rig.counted("refused.frozen") > before)
    rig.wait("the node says so", lambda: rig.statuses[-1].state == "silent")


@whatever_the_bridge
def test_a_robot_that_falls_silent_and_comes_back_is_told(rig: Ros2Rig) -> None:
    rig.events.clear()
    rig.robot.silent = True
    rig.wait("silence", lambda: rig.happened("running->silent"))
    rig.robot.silent = False
    rig.wait("voice", lambda: rig.happened("silent->running"))
    assert not rig.happened("robot_returned"), "no set-point was sent meanwhile"


def test_a_robot_that_returns_is_sent_no_older_set_point_than_one_where_it_is(
    rig: Ros2Rig,
) -> None:
    """A bridge keeps the last one for a subscriber that died, and may send it to its successor."""
    robot = rig.robot
    before = len(robot.goal_times_s)
    with Commander(rig):
        rig.wait("goals arrive", lambda: len(robot.goal_times_s) > before)
        rig.events.clear()
        robot.silent = True
        rig.wait("silence", lambda: rig.happened("running->silent"))
    rig.wait("it stands", lambda: time.monotonic() - robot.goal_times_s[-1] > 2 * SILENCE_S)
    told, sent = len(rig.happened("robot_returned")), len(robot.goals)
    reported: list[Any] = []

    def elsewhere(fields: dict[str, Any]) -> None:
        fields["position"][0] += RETURNED_RAD
        reported.append(fields["position"][:7].copy())

    robot.alter = elsewhere
    robot.silent = False
    rig.wait("voice", lambda: rig.statuses[-1].state == "running")
    bridge = rig.profile.ros2 is not None and rig.profile.ros2.bridge == "ros2dds"
    rig.wait("a set-point", lambda: len(robot.goals) == sent + bridge)
    time.sleep(2 * SILENCE_S)
    events = rig.happened("robot_returned")[told:]
    assert len(events) == bridge
    assert len(robot.goals) == sent + bridge
    if bridge:
        assert "best effort" in events[0].why
        at = robot.goals[-1].pose.position
        expected = panda().forward(reported[0]).position_m
        assert (at.x, at.y, at.z) == pytest.approx(expected, abs=POSITION_TOLERANCE_M)


@pytest.mark.parametrize("speed_m_s", [0.0, SPEED_M_S])
def test_a_robot_that_returns_elsewhere_is_not_led_to_where_another_one_stood(
    rig: Ros2Rig, speed_m_s: float
) -> None:
    """Its commands go on meanwhile, from a command node that has not noticed anything."""
    robot = rig.robot
    here_m = panda().forward(robot.joints_rad).position_m
    y_m = panda().forward(robot.joints_rad + ELSEWHERE_RAD * np.eye(7)[0]).position_m[1]
    rig.wait(
        "it is where it was led",
        lambda: np.abs(rig.newest(PoseState).position_m - here_m).max() < POSITION_TOLERANCE_M,
    )
    before = len(robot.goals)

    def elsewhere(fields: dict[str, Any]) -> None:
        fields["position"][0] += ELSEWHERE_RAD

    with Commander(rig, speed_m_s):
        rig.wait("goals arrive", lambda: len(robot.goals) > before + 50)
        rig.events.clear()
        robot.silent = True
        rig.wait("silence", lambda: rig.happened("running->silent"))
        time.sleep(0.1)
        robot.alter = elsewhere
        sent = len(robot.goals)
        robot.silent = False
        rig.wait("voice", lambda: rig.statuses[-1].state != "silent")
        turned_rad = robot.joints_rad[0] + ELSEWHERE_RAD
        rig.wait(
            "where it is now is read",
            lambda: abs(rig.states[JointState][-1][1].position_rad[0] - turned_rad) < RETURNED_RAD,
        )
        if speed_m_s:  # until then nobody knows better
            sent = len(robot.goals)
        time.sleep(SILENCE_S)
    late = sum(abs(goal.pose.position.y - y_m) > JUMP_M for goal in robot.goals[sent:])
    assert late <= (LATE if speed_m_s else 0), "what stands is sent to nobody"


def test_bytes_that_are_no_message_are_counted(rig: Ros2Rig) -> None:
    before = rig.counted("refused.malformed")
    for payload in (b"", b"\x00\x01\x00\x00\xff\xff\xff\xff", bytes(100)):
        rig.peer.put_bytes("/joint_states", "sensor_msgs/msg/JointState", payload)
    rig.wait("they are refused", lambda: rig.counted("refused.malformed") >= before + 3)
    assert rig.statuses[-1].state == "running"


# -- pictures -------------------------------------------------------------------------------------
def image(rig: Ros2Rig, stamp_ns: int, encoding: str = "bgr8", value: int = 7) -> Any:
    pixels = np.full((HEIGHT, WIDTH, 3), (value, 0, 0), np.uint8)
    return rig.peer.message(
        "sensor_msgs/msg/Image",
        header=rig.peer.header(stamp_ns),
        height=HEIGHT,
        width=WIDTH,
        encoding=encoding,
        step=3 * WIDTH,
        data=pixels.ravel(),
    )


@whatever_the_bridge
def test_a_camera_that_shows_one_picture_again_and_again_is_said_to_be_bad(rig: Ros2Rig) -> None:
    dice = np.random.default_rng(2)
    pool = [dice.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8).ravel() for _ in range(5)]
    turn = count()

    def bad(check: str) -> bool:
        found = rig.detail("cameras")["front"].get("bad")
        return found is not None and found["check"] == check

    def send(stamp_ns: int, pixels: np.ndarray[Any, Any], done: bool) -> bool:
        message = image(rig, stamp_ns)
        message.data = pixels
        rig.peer.put(CAMERA, message)
        time.sleep(0.02)
        return done

    def newest() -> np.ndarray[Any, Any]:
        return pool[next(turn) % len(pool)]

    def good() -> bool:
        done = (
            rig.detail("cameras")["front"]["state"] == "ok"
            and "bad" not in rig.detail("cameras")["front"]
        )
        return send(time.time_ns(), newest(), done)

    rig.wait("a true camera", good)
    # A driver that stamps an old buffer anew, and one whose clock stands; nobody listens.
    rig.wait("frozen", lambda: send(time.time_ns(), pool[0], bad("same_s")))
    rig.wait("true again", good)
    stuck_ns = time.time_ns()
    rig.wait("its stamps", lambda: send(stuck_ns, newest(), bad("stamp_s")))
    rig.wait("true again", good)


def test_pictures_come_with_their_stamp_and_depth_is_refused(rig: Ros2Rig) -> None:
    heard: list[tuple[int, np.ndarray[Any, Any]]] = []

    def keep(sample: zenoh.Sample) -> None:
        from vla_zenoh.codec import records

        assert sample.attachment is not None
        header = records.decode_header(sample.attachment.to_bytes())
        schema = str(sample.encoding).partition(";")[2]
        heard.append((header.stamp_wall_ns, decode_raw(sample.payload.to_bytes(), schema).rgb))

    key = rig.profile.keys.camera_raw("front")
    subscriber = rig.session.declare_subscriber(key, zenoh.handlers.Callback(keep, indirect=False))
    sent: set[int] = set()

    def send() -> bool:
        stamp_ns = time.time_ns()
        sent.add(stamp_ns)
        rig.peer.put(CAMERA, image(rig, stamp_ns))
        time.sleep(0.02)
        return len(heard) > 3

    rig.wait("pictures", send)
    stamp_ns, rgb = heard[-1]
    assert stamp_ns in sent
    assert (rgb == (0, 0, 7)).all(), "blue came first"
    before = rig.counted("refused.encoding")

    def send_depth() -> bool:
        rig.peer.put(CAMERA, image(rig, time.time_ns(), "16UC1"))
        time.sleep(0.02)
        return rig.counted("refused.encoding") > before

    rig.wait("depth is refused", send_depth)
    rig.wait("the camera is lost", lambda: rig.detail("cameras")["front"]["state"] == "lost")
    assert "distances" in rig.detail("cameras")["front"]["why"]
    subscriber.undeclare()


def test_depth_of_a_topic_of_its_own_goes_with_the_colours(tmp_path: Path) -> None:
    counts = np.arange(HEIGHT * WIDTH, dtype="<u2").reshape(HEIGHT, WIDTH)
    with ros2_rig(tmp_path, depth=True) as rig:
        heard: list[Any] = []

        def keep(sample: zenoh.Sample) -> None:
            schema = str(sample.encoding).partition(";")[2]
            heard.append(decode_depth(sample.payload.to_bytes(), schema))

        key = rig.profile.keys.camera_depth("front")
        handler = zenoh.handlers.Callback(keep, indirect=False)
        subscriber = rig.session.declare_subscriber(key, handler)

        def send() -> bool:
            stamp_ns = time.time_ns()
            message = image(rig, stamp_ns, "16UC1")
            message.step, message.data = 2 * WIDTH, counts.view(np.uint8).ravel()
            rig.peer.put(DEPTH, message)
            rig.peer.put(CAMERA, image(rig, stamp_ns))
            time.sleep(0.02)
            return bool(heard)

        rig.wait("depth", send)
        assert (heard[0].counts == counts).all()
        assert heard[0].unit_m == pytest.approx(0.001)
        subscriber.undeclare()


# -- commands -------------------------------------------------------------------------------------
FOLLOWED = 15
"""Goals at the place of a stream that stands: those of a brake are not so many."""


class Commander:
    """A command stream upwards, from where the robot is."""

    def __init__(self, rig: Ros2Rig, speed_m_s: float = SPEED_M_S) -> None:
        self._speed_m_s = speed_m_s
        # Until the stream of the test before is over, this one is foreign, and the goals of that
        # one look like answers to it.
        since = len(rig.statuses)
        rig.wait(
            "nothing leads it",
            lambda: len(rig.statuses) > since and not rig.statuses[-1].detail.get("following"),
        )
        self._stream: Publisher = rig.stream(rig.profile.keys.command_pose, f"command#{id(self)}")
        held: PoseState = rig.newest(PoseState)
        self._quat_xyzw = held.quat_xyzw
        at_m = held.reference_position_m
        self._at_m = np.array(held.position_m if at_m is None else at_m)
        self._goals, self._before = rig.robot.goals, len(rig.robot.goals)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        # It stands until it is followed: the first commands of a busy computer may be lost, and the
        # first goals may still be those of the test before.
        while not (self._stop.wait(PERIOD_S) or self._is_followed()):
            self.put(self._at_m)
        # A function of time, however late this thread is woken.
        began_s, start_m = time.monotonic(), self._at_m[2]
        while not self._stop.wait(PERIOD_S):
            self._at_m[2] = start_m + self._speed_m_s * (time.monotonic() - began_s)
            self.put(self._at_m, self._speed_m_s)

    def _is_followed(self) -> bool:
        newest = self._goals[self._before :][-FOLLOWED:]
        heights_m = [goal.pose.position.z for goal in newest]
        return (
            len(newest) == FOLLOWED and np.ptp([*heights_m, self._at_m[2]]) < POSITION_TOLERANCE_M
        )

    def put(self, at_m: Any, speed_m_s: float = 0.0) -> None:
        twist = np.array([0.0, 0.0, speed_m_s, 0.0, 0.0, 0.0])
        quat = self._quat_xyzw
        self._stream.publish(PoseCommand(at_m, quat, twist, np.zeros(6), at_m, quat, "active"))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


@whatever_the_bridge
def test_a_stream_that_falls_silent_is_braked_and_then_nothing_more_is_sent(rig: Ros2Rig) -> None:
    goals = rig.robot.goals
    rig.events.clear()
    with Commander(rig):
        since = len(goals)
        rig.wait("goals arrive", lambda: len(goals) > since + 50)
        goal = goals[-1]
        assert goal.q_n.tolist() == pytest.approx(HOME_RAD.tolist())
    rig.wait("it brakes", lambda: rig.happened("running->braking"))
    rig.wait("it stands", lambda: rig.happened("braking->running"))
    time.sleep(0.1)
    count = len(goals)
    time.sleep(2 * SILENCE_S)
    assert len(goals) == count, "the controller holds what it was sent last"
    heights_m = np.array([goal.pose.position.z for goal in goals[since:]])
    steps_m = np.diff(heights_m)
    assert steps_m.min() > -BACK_M, "it never goes back"
    assert np.abs(np.diff(steps_m)).max() < 0.005, "and never jumps"
    held: PoseState = rig.newest(PoseState)
    assert held.reference_position_m is not None
    assert held.reference_position_m[2] == pytest.approx(heights_m[-1])
    assert rig.detail("held")


def no_more_goals(rig: Ros2Rig) -> bool:
    """Whether none has come for a while; the last ones may be on their way."""
    sent = len(rig.robot.goals)
    time.sleep(0.2)
    return len(rig.robot.goals) == sent


@whatever_the_bridge
def test_a_stream_that_begins_elsewhere_is_refused(rig: Ros2Rig) -> None:
    before = rig.counted("refused.pose_jump")
    with Commander(rig):
        pass
    rig.wait("silence", lambda: not rig.detail("following"))
    rig.wait("the last goal of the brake", lambda: no_more_goals(rig))
    sent = len(rig.robot.goals)
    pose = panda().forward(rig.robot.joints_rad)
    stream = rig.stream(rig.profile.keys.command_pose, "stranger#1")
    away = pose.position_m + (0, 0, 0.05)
    quat = quat_from_rotation(pose.rotation)
    order = PoseCommand(away, quat, np.zeros(6), np.zeros(6), away, quat, "active")

    def shout() -> bool:
        stream.publish(order)
        time.sleep(0.05)
        return rig.counted("refused.pose_jump") > before

    rig.wait("it is refused", shout)
    assert len(rig.robot.goals) == sent


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_whatever_breaks_in_the_loop_the_arm_is_braked_before_it_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ros2_rig(tmp_path) as rig:
        goals = rig.robot.goals

        def unforeseen() -> None:
            raise RuntimeError("unforeseen")

        with Commander(rig):
            rig.wait("goals arrive", lambda: len(goals) > 50)
            monkeypatch.setattr(rig.node._rate, "tick", unforeseen)
            rig.wait("it is told", lambda: rig.happened("broken"))
        steps_m = np.diff([goal.pose.position.z for goal in goals])
        assert steps_m[-1] < BRAKED_M < steps_m[-100:].max()
        assert rig.statuses[-1].state in ("braking", "running", "ended")


# -- gripper --------------------------------------------------------------------------------------
@whatever_the_bridge
def test_a_gripper_command_to_a_silent_robot_is_refused(rig: Ros2Rig) -> None:
    rig.robot.silent = True
    rig.wait("silence", lambda: rig.statuses[-1].state == "silent")
    before, goals = rig.counted("refused.robot_silent"), rig.counted("ros2.gripper_goals")
    stream = rig.stream(rig.profile.keys.command_gripper, "command#late")
    stream.publish(GripperCommand(0.0, 0.05, 10.0))
    rig.wait("it is refused", lambda: rig.counted("refused.robot_silent") > before)
    rig.robot.silent = False
    rig.wait("voice", lambda: rig.statuses[-1].state == "running")
    time.sleep(SILENCE_S)
    assert rig.counted("ros2.gripper_goals") == goals


def test_the_newest_gripper_goal_wins_and_never_two_run_at_once(rig: Ros2Rig) -> None:
    peer, running, most = rig.peer, set[bytes](), [0]
    widths: list[float] = []
    cancelled: dict[bytes, threading.Event] = {}

    def accept(asked: Any) -> Any:
        identity = bytes(asked.goal_id.uuid)
        cancelled[identity] = threading.Event()
        running.add(identity)
        most[0] = max(most[0], len(running))
        widths.append(asked.goal.width)
        return peer.message("franka_msgs/action/Move_SendGoal_Response", accepted=True)

    def finish(asked: Any) -> Any:
        identity = bytes(asked.goal_id.uuid)
        # The first goal takes until it is cancelled: the newer ones may come late.
        interrupted = cancelled[identity].wait(5.0 if len(widths) == 1 else 0.6)
        running.discard(identity)
        return peer.message(
            "franka_msgs/action/Move_GetResult_Response",
            status=5 if interrupted else 4,
            result=peer.message("franka_msgs/action/Move_Result", success=not interrupted),
        )

    def cancel(asked: Any) -> Any:
        cancelled[bytes(asked.goal_info.goal_id.uuid)].set()
        return peer.message("action_msgs/srv/CancelGoal_Response")

    for name, kind, answer in (
        ("send_goal", "franka_msgs/action/Move_SendGoal", accept),
        ("get_result", "franka_msgs/action/Move_GetResult", finish),
        ("cancel_goal", "action_msgs/srv/CancelGoal", cancel),
    ):
        peer.serve(f"{MOVE}/{name}", kind, answer)
        rig.wait_for_service(f"{MOVE}/{name}", kind)
    stream = rig.stream(rig.profile.keys.command_gripper)
    stream.publish(GripperCommand(0.01, 0.1, 20.0))
    rig.wait("the first goal", lambda: widths)
    rig.wait("the gripper moves", lambda: rig.newest(GripperState).moving)
    for width_m in (0.02, 0.03, 0.04):
        stream.publish(GripperCommand(width_m, 0.1, 20.0))
    rig.wait("the newest goal", lambda: widths[-1] == 0.04)
    rig.wait("it is done", lambda: not running and not rig.newest(GripperState).moving)
    assert most[0] == 1
    assert widths[0] == 0.01
    assert len(widths) <= 3, "wishes that were overtaken are not sent"
    rig.wait("it is counted", lambda: rig.counted("ros2.gripper_cancelled") >= 1)


# -- the ROS graph --------------------------------------------------------------------------------
def test_our_ends_are_seen_in_the_ros_graph(rig: Ros2Rig) -> None:
    ros2 = rig.profile.ros2
    assert ros2 is not None
    rmw = ros2.bridge == "rmw_zenoh"
    selector = "@ros2_lv/0/**" if rmw else "@/*/@ros2_lv/**"
    tokens = [
        str(reply.ok.key_expr)
        for reply in rig.session.liveliness().get(selector, timeout=2.0)
        if reply.ok is not None
    ]
    roles = ("MP", "MS", "SS", "SC", "AC", "NN")
    seen = {role: [t for t in tokens if f"/{role}/" in t] for role in roles}
    assert any("desired_pose" in token for token in seen["MP"])
    assert any("joint_states" in token for token in seen["MS"])
    assert any("image_raw" in token for token in seen["MS"])
    for service in ("set_active", "stop", "reset", "set_prompt", "set_request"):
        assert any(service in token for token in seen["SS"]), service
    if rmw:
        assert any("vla_panda" in token for token in seen["NN"])
        assert len([t for t in seen["SC"] if "_action" in t]) == 3
    else:
        assert any("panda_gripper§move" in token for token in seen["AC"])
    assert len(set(tokens)) == len(tokens)


def test_the_status_of_all_nodes_is_a_diagnostic_array(rig: Ros2Rig) -> None:
    heard: list[Any] = []
    rig.peer.on("/vla/status", "diagnostic_msgs/msg/DiagnosticArray", heard.append)
    rig.wait("an array", lambda: heard and heard[-1].status)
    assert "vla-zenoh/panda: ros2" in [entry.name for entry in heard[-1].status]


def test_a_service_without_a_command_node_says_what_is_missing(rig: Ros2Rig) -> None:
    answer = rig.peer.call("/vla/set_prompt", "vla_msgs/srv/SetPrompt", prompt="go up")
    assert answer is not None
    assert not answer.success
    assert "no command node" in answer.message
    refused = rig.peer.call("/vla/set_prompt", "vla_msgs/srv/SetPrompt", prompt="a\x07b")
    assert not refused.success
    assert "control characters" in refused.message


def test_a_prompt_on_a_topic_becomes_our_prompt(rig: Ros2Rig) -> None:
    heard: list[str] = []
    tasks = rig.stream(rig.profile.keys.task, "command#1")

    def obey(sample: zenoh.Sample) -> None:
        heard.append(sample.payload.to_string())

    def tell() -> None:
        tasks.publish(Task(1, False, heard[-1] if heard else "", "scripted", 5.0))

    subscriber = rig.session.declare_subscriber(
        rig.profile.keys.prompt, zenoh.handlers.Callback(obey, indirect=False)
    )

    await_match(rig.peer.session, rig.peer.key("/vla/prompt", "std_msgs/msg/String"))
    for words in ("go up", "stay"):
        rig.peer.put("/vla/prompt", rig.peer.message("std_msgs/msg/String", data=words))
    rig.wait("the last prompt", lambda: tell() or "stay" in heard)
    assert heard == ["go up", "stay"]
    before = rig.counted("refused.invalid")
    rig.peer.put("/vla/prompt", rig.peer.message("std_msgs/msg/String", data="a\x07b"))
    rig.wait("it is rejected", lambda: rig.counted("refused.invalid") > before)
    assert heard == ["go up", "stay"]
    subscriber.undeclare()


# -- other robots ---------------------------------------------------------------------------------
def test_a_robots_clock_that_differs_is_measured_and_told(tmp_path: Path) -> None:
    with ros2_rig(tmp_path, clock_ns=-2_500_000_000) as rig:
        rig.wait("it is told", lambda: rig.happened("robot_clock"))
        # The first states have waited for the node.
        rig.wait("a figure", lambda: rig.detail("robot_clock_behind_s") == pytest.approx(2.5, 0.08))
        header, _ = rig.states[JointState][-1]
        assert time.time_ns() - header.stamp_wall_ns > 2.4e9, "stamps are kept"


SIMULATED = """\
  use_sim_time: true
  pose_command: {topic: /target, type: geometry_msgs/msg/PoseStamped}
"""
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"


# -- simulated time -------------------------------------------------------------------------------
class SimulatedTime:
    """Stamps of a simulation that began now."""

    def __init__(self, rig: Ros2Rig, rate: float = 1.0) -> None:
        self._peer, self._rate, self._began_s = rig.peer, rate, time.monotonic()
        rig.robot.alter = self._stamp

    def _stamp(self, fields: dict[str, Any]) -> None:
        elapsed_s = (time.monotonic() - self._began_s) * self._rate
        fields["header"] = self._peer.header(int(elapsed_s * 1e9) + 1)


def test_stamps_that_look_like_simulated_time_have_that_remedy(tmp_path: Path) -> None:
    with ros2_rig(tmp_path) as rig:
        SimulatedTime(rig)
        event = rig.wait("it is told", lambda: rig.happened("robot_clock"))[-1]
        assert "simulated time" in event.why
        assert "ros2.use_sim_time: true" in event.why


def test_simulated_time_becomes_ours_at_any_rate_and_when_it_is_set_back(tmp_path: Path) -> None:
    with ros2_rig(tmp_path, more=SIMULATED) as rig:

        def ages_s() -> list[float]:
            since = len(rig.states[JointState])
            rig.wait("states", lambda: len(rig.states[JointState]) > since + 50)
            now_ns = time.time_ns()
            return [(now_ns - h.stamp_wall_ns) / 1e9 for h, _ in rig.states[JointState][since:]]

        for rate in (1.0, 0.3, 3.0):
            SimulatedTime(rig, rate)  # each begins at 0 again
            assert max(map(abs, ages_s())) < 5.0
            rig.wait(
                "its rate", lambda r=rate: rig.detail("sim_time_rate") == pytest.approx(r, 0.1)
            )
        assert rig.statuses[-1].state == "running"
        assert not rig.happened("robot_clock")
        stamps: list[Any] = []
        rig.peer.on("/target", POSE_STAMPED, lambda goal: stamps.append(goal.header.stamp))
        with Commander(rig):
            rig.wait("goals", lambda: len(stamps) > 20)
        assert stamps[-1].sec < 1000, "in the time of the robot"
        rig.robot.frozen = True
        rig.robot.alter = lambda fields: fields.update(header=rig.peer.header(10**9))
        rig.wait("a paused one is silent", lambda: rig.statuses[-1].state == "silent")


WIDTHS = """\
  wrench: {topic: /wrench}
  gripper: {topic: /width, type: std_msgs/msg/Float64, position: finger}
  pose_command: {topic: /target, type: geometry_msgs/msg/PoseStamped, frame: base}
"""


@pytest.mark.parametrize(
    ("wrench_yaml", "force_n"),
    [("topic: /wrench", -9.0), ("topic: /wrench, exerted_by: arm", 9.0)],
)
def test_a_wrench_is_taken_in_the_base_frame_and_the_gripper_may_take_widths(
    tmp_path: Path, wrench_yaml: str, force_n: float
) -> None:
    with ros2_rig(tmp_path, more=WIDTHS.replace("topic: /wrench", wrench_yaml)) as rig:
        peer = rig.peer
        force = peer.message("geometry_msgs/msg/Vector3", z=-9.0)
        wrench = peer.message("geometry_msgs/msg/Wrench", force=force)

        def send() -> bool:
            now_ns = time.time_ns()
            for frame in ("panda_link0", "somewhere"):
                stamped = peer.message(
                    "geometry_msgs/msg/WrenchStamped",
                    header=peer.header(now_ns, frame),
                    wrench=wrench,
                )
                peer.put("/wrench", stamped)
            time.sleep(0.01)
            return bool(rig.states[PoseState]) and rig.newest(PoseState).wrench is not None

        rig.wait("a pose with a wrench", send)
        pose: PoseState = rig.newest(PoseState)
        assert pose.wrench is not None
        assert pose.wrench.tolist() == [0, 0, force_n, 0, 0, 0]
        rig.wait("the other frame is refused", lambda: rig.counted("refused.frame"))
        widths: list[float] = []
        peer.on("/width", "std_msgs/msg/Float64", lambda message: widths.append(message.data))
        stream = rig.stream(rig.profile.keys.command_gripper)

        def ask() -> bool:
            stream.publish(GripperCommand(0.06, 0.1, 10.0))
            time.sleep(0.05)
            return bool(widths)

        rig.wait("a width", ask)
        assert widths[0] == 0.03
        targets: list[Any] = []
        peer.on("/target", "geometry_msgs/msg/PoseStamped", targets.append)
        poses = rig.stream(rig.profile.keys.command_pose)

        def order() -> bool:
            send()
            at, quat = pose.position_m, pose.quat_xyzw
            poses.publish(PoseCommand(at, quat, np.zeros(6), np.zeros(6), at, quat, "active"))
            return bool(targets)

        rig.wait("a target", order)
        assert targets[0].header.frame_id == "base"
        assert targets[0].pose.position.x == pytest.approx(pose.position_m[0], abs=1e-6)


JOINTS = """\
  joint_command: {topic: /joint_goal, type: trajectory_msgs/msg/JointTrajectory}
robot: {command: joint}
"""


def test_an_arm_that_takes_joints_is_sent_trajectories_of_one_point(tmp_path: Path) -> None:
    with ros2_rig(tmp_path, more=JOINTS) as rig:
        goals: list[Any] = []
        rig.peer.on("/joint_goal", "trajectory_msgs/msg/JointTrajectory", goals.append)
        rig.newest(JointState)
        stream = rig.stream(rig.profile.keys.command_joint)
        still = np.zeros(len(ARM_JOINTS))

        def order() -> bool:
            stream.publish(JointCommand(ARM_JOINTS, HOME_RAD, still, still, "active"))
            time.sleep(PERIOD_S)
            return bool(goals)

        rig.wait("a trajectory", order)
        (point,) = goals[0].points
        assert tuple(goals[0].joint_names) == ARM_JOINTS
        assert point.positions.tolist() == pytest.approx(HOME_RAD.tolist())
        before = rig.counted("refused.joint_jump")

        def jump() -> bool:
            stream.publish(JointCommand(ARM_JOINTS, HOME_RAD + 0.5, still, still, "active"))
            time.sleep(PERIOD_S)
            return rig.counted("refused.joint_jump") > before

        rig.wait("a jump is refused", jump)
        assert max(np.abs(goal.points[0].positions - HOME_RAD).max() for goal in goals) < 1e-6
