"""A person's side of the bus, and `up`'s: strangers' names do not fill it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import zenoh
from camera_rig import PATIENCE_S, await_match, free_endpoint, until
from vla_zenoh_diagnose import inference_views
from vla_zenoh_diagnose.inference_views import MAX_SAMPLES, InferenceDebugSubscriber
from vla_zenoh_web.robot_link import RobotLink

from vla_zenoh import keys
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.drive import _reaches
from vla_zenoh.client.client import MAX_NODES, MAX_WHY, Client
from vla_zenoh.client.primitives import ask
from vla_zenoh.client.remote_robot import RemoteRobot
from vla_zenoh.codec import message, records
from vla_zenoh.errors import CodecError, SessionError
from vla_zenoh.keys import Kind, last_chunk
from vla_zenoh.policy import MAX_CAMERAS
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.types import Event, Header, InferenceDebug, JointState, NodeStatus, PoseState, Task

STRANGERS = 2000
TOKENS = 300
MAX_SEEN = 5
LARGEST = 2**16
SURELY = zenoh.CongestionControl.BLOCK

pytestmark = pytest.mark.realtime


def own_profile() -> Profile:
    endpoint = free_endpoint()
    where = {"listen": [endpoint], "connect": [endpoint]}
    return override(load_profile("panda_sim"), {"session": where})


@pytest.fixture
def profile() -> Iterator[Profile]:
    made = own_profile()
    with open_session(made.session, mode="router"):
        yield made


@pytest.mark.slow
def test_names_of_strangers_neither_fill_a_client_nor_hide_a_node(profile: Profile) -> None:
    keys, ghost = profile.keys, records.encode(NodeStatus("sim", "ok", "h", 1, 2))
    who = records.encode_header(Header(1, 2, "stranger#1"))
    with open_session(profile.session) as here, open_session(profile.session) as there:
        client = Client(profile, here).subscribe()
        tokens = [
            there.liveliness().declare_token(keys.alive(f"ghost{number}"))
            for number in range(TOKENS)
        ]
        for number in range(STRANGERS):
            there.put(
                keys.status(f"ghost{number}"), ghost, attachment=who, congestion_control=SURELY
            )
        until("all have come", lambda: client.dropped > STRANGERS - 2 * MAX_NODES)
        node = Node("sim", profile, there)
        node.publish_status("running", now=True)
        until("the node is there", lambda: "sim" in client.alive and client.status("sim"))
        found = client.snapshot()
        assert found["sim"][0].state == "running"
        assert found["sim"][2]
        assert len(found) <= MAX_NODES
        assert len(client.alive) <= MAX_NODES
        node.close()
        until("it is gone", lambda: "sim" not in client.alive)
        assert client.snapshot()["sim"][2] is False
        for token in tokens:
            token.undeclare()


@pytest.mark.parametrize(("theirs", "who"), [(-1, "the sender"), (1, "this side")])
def test_a_person_with_another_version_is_told_which_side_to_update(
    profile: Profile, monkeypatch: pytest.MonkeyPatch, theirs: int, who: str
) -> None:
    with open_session(profile.session) as here, open_session(profile.session) as there:
        client = Client(profile, here).subscribe()
        token = there.liveliness().declare_token(profile.keys.alive("command"))
        until("the node is there", lambda: "command" in client.alive)
        with monkeypatch.context() as patch:
            patch.setattr(keys, "SCHEMA", keys.SCHEMA + theirs)
            header = records.encode_header(Header(1, 2, "command#1"))
        status = records.encode(NodeStatus("command", "inactive", "h", 1, 2))
        ours = records.encode_header(Header(1, 2, "command#1"))
        there.put(profile.keys.status("command"), status, attachment=header)
        until("its status has come", lambda: client.other_version)
        with pytest.raises(SessionError, match=f"status/command: schema .* on {who}"):
            client.set_prompt("hold", 0.2)
        assert who in client.unreadable["command"]
        there.put(profile.keys.status("command"), status, attachment=ours)
        until("it was updated", lambda: not client.unreadable)
        token.undeclare()


@pytest.mark.parametrize(("runs", "why"), [(False, "does not run"), (True, "stood still")])
def test_a_primitive_that_nothing_answers_says_whether_its_node_runs(
    profile: Profile, runs: bool, why: str
) -> None:
    with open_session(profile.session) as here, open_session(profile.session) as there:
        client = Client(profile, here).subscribe()
        if runs:
            token = there.liveliness().declare_token(profile.keys.alive("primitives"))
            until("the node is there", lambda: "primitives" in client.alive)
        with pytest.raises(SessionError, match=f"primitives.*{why}"):
            ask(client, "home", {"timeout_s": ASK_S})
        if runs:
            token.undeclare()


ASK_S = 0.2
SETTINGS: tuple[Callable[[Client], object], ...] = (
    lambda client: client.set_prompt("go", ASK_S),
    lambda client: client.set_worker("scripted", ASK_S),
    lambda client: client.set_rate(4.0, ASK_S),
    lambda client: client.set_speed(40.0, ASK_S),
    lambda client: client.slow_down(40.0, ASK_S),
    lambda client: client.activate(ASK_S),
    lambda client: client.activate_with_deadman("test", ASK_S),
)


@pytest.mark.parametrize("theirs", ["another schema", "another task", "another since"])
def test_a_robot_whose_task_cannot_be_read_is_told_nothing_but_a_stop(
    profile: Profile, monkeypatch: pytest.MonkeyPatch, theirs: str
) -> None:
    """It would obey, and its client would say that it did not."""
    task = message.unpack(records.encode(Task(1, False, "hold", "scripted", 5.0)))
    with open_session(profile.session) as here, open_session(profile.session) as there:
        put: list[str] = []
        heard = there.declare_subscriber(
            profile.keys.all_keys, lambda sample: put.append(last_chunk(str(sample.key_expr)))
        )
        client = Client(profile, here).subscribe()
        token = there.liveliness().declare_token(profile.keys.alive("command"))
        until("the node is there", lambda: "command" in client.alive)
        await_match(here, profile.keys.active)
        with monkeypatch.context() as patch:
            if theirs == "another since":
                client.task = Task(1, False, "hold", "scripted", 5.0)
            if theirs != "another task":
                patch.setattr(keys, "SCHEMA", keys.SCHEMA + 1)
            else:
                del task["episode"]
            header = records.encode_header(Header(1, 2, "command#1"))
        publisher = there.declare_publisher(profile.keys.task)
        ends = threading.Event()

        def publish() -> None:
            while not ends.wait(0.05):
                publisher.put(message.pack(task), attachment=header)

        publishing = threading.Thread(target=publish)
        publishing.start()
        why = "Task lacks episode" if theirs == "another task" else "schema"
        until("its task has come", lambda: Task in client._unread)
        for setting in SETTINGS:
            with pytest.raises(SessionError, match=f"nothing was put, since .*: task: .*{why}"):
                setting(client)
        client.stop()
        until("a stop is put", lambda: "stop" in put)
        assert set(put) <= {"stop", "task"}
        ends.set()
        publishing.join()
        heard.undeclare()
        token.undeclare()


@pytest.mark.slow
def test_a_flood_of_long_events_is_kept_short(profile: Profile) -> None:
    with open_session(profile.session) as here, open_session(profile.session) as there:
        client = Client(profile, here).subscribe()
        node = Node("sim", profile, there)

        def told() -> bool:
            node.emit(Event("warning", "notice", "w" * 4096, "w" * 4096))
            return bool(client.events)

        until("an event has come", told)
        ((_, _, event), *_) = client.pop_events()
        assert len(event.why) == MAX_WHY
        node.close()


@pytest.mark.slow
def test_nobody_shows_what_another_worker_saw_nor_names_a_folder_elsewhere(
    profile: Profile,
) -> None:
    who = records.encode_header(Header(1, 2, "stranger#1"))
    key = profile.keys.seen_record("scripted")
    with open_session(profile.session) as here, open_session(profile.session) as there:
        listener = InferenceDebugSubscriber(here, profile.keys)
        seen: list[str] = []

        def shown() -> bool:
            for worker in ("../../scripted", "other", "scripted"):
                record = InferenceDebug(
                    worker, 1, "0" * 16, 1, 2, "up", np.zeros((1, 7), np.float32), 1.0
                )
                there.put(key, records.encode(record), attachment=who)
                there.put(f"{key}/..", b"", attachment=who)
            seen.extend(sight.record.worker for sight in listener.poll())
            return len(seen) > MAX_SEEN

        until("some are shown", shown)
        assert set(seen) == {"scripted"}
        listener.close()


def test_what_is_no_picture_does_not_wait_for_who_looks(
    profile: Profile, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As shipped it is 32 MiB, which a busy computer does not always send before a link gives up.
    monkeypatch.setattr(inference_views, "MAX_JPEG_BYTES", LARGEST)
    who = records.encode_header(Header(1, 2, "stranger#1"))
    key = profile.keys.seen("scripted", "front")
    with open_session(profile.session) as here, open_session(profile.session) as there:
        listener = InferenceDebugSubscriber(here, profile.keys)

        def deleted() -> bool:
            there.delete(key)
            return listener.left_out["deleted"] > 0

        until("a deletion is counted", deleted)  # though nobody takes anything
        there.put(key, bytes(LARGEST + 1), attachment=who, congestion_control=SURELY)
        until("so is what is too large", lambda: listener.left_out["oversize"] == 1)
        for number in range(MAX_SAMPLES + 1):
            there.put(f"{key}{number}", b"jpeg", attachment=who, congestion_control=SURELY)
        until("the oldest made room", lambda: listener.left_out["late"] == 1)
        assert listener.poll() == []
        assert listener.left_out["cameras"] == MAX_SAMPLES - MAX_CAMERAS
        listener.close()


def say(node: Node, state: str, client: Client) -> None:
    def heard() -> bool:
        node.publish_status(state)  # again only after a while
        status = client.status("command")
        return "command" in client.alive and status is not None and status.state == state

    until(f"it is heard that the command node is {state}", heard)


def unconfirmed(robot: RemoteRobot) -> None:
    """A stop and a reset raise, and say that nothing was heard since."""
    with pytest.raises(SessionError, match=r"^NOT CONFIRMED: no answer of robot "):
        robot.stop(0.2)
    with pytest.raises(SessionError, match="did not confirm it: it is silent"):
        robot.reset(0.2)


@pytest.mark.parametrize("state", ["stopped", "inactive"])
def test_what_is_lost_with_the_router_is_not_confirmed_by_an_older_status(state: str) -> None:
    profile = own_profile()
    router = open_session(profile.session, mode="router")
    with open_session(profile.session) as here, open_session(profile.session) as there:
        node, robot, link = Node("command", profile, there), RemoteRobot(profile, here), None
        try:
            say(node, state, robot.subscribe())
            link = RobotLink(profile, here)
            say(node, state, link.client)
            unconfirmed(robot)  # the command node has not repeated it
            router.close()
            until("the router is lost", lambda: "command" not in robot.alive)
            unconfirmed(robot)
            if state == "stopped":  # what a stop waits for; a reset waits for the other one
                robot.publish(robot.keys.stop, "stop")
                assert not _reaches(robot, robot.stopped)
                assert link.stop()["outcome"] == "not_confirmed"
                with pytest.raises(SessionError, match="not accepted"):
                    link.hold_box("", "")
        finally:
            if link is not None:
                link.close()
            node.close()


def test_a_stop_and_a_reset_are_confirmed_by_the_next_status(profile: Profile) -> None:
    with open_session(profile.session) as here, open_session(profile.session) as there:
        node, robot = Node("command", profile, there), RemoteRobot(profile, here)
        say(node, "stopped", robot.subscribe())
        with pytest.raises(SessionError, match="stop"):  # nothing shows that the arm stands
            robot.stop(0.5)
        node.close()
    with (
        open_session(profile.session) as here,
        open_session(profile.session) as there,
        standing(profile),
    ):
        node, robot = Node("command", profile, there), RemoteRobot(profile, here)
        say(node, "stopped", robot.subscribe())
        for request, state in ((robot.stop, "stopped"), (robot.reset, "inactive")):
            timer = threading.Timer(0.2, node.publish_status, (state,), {"now": True})
            timer.start()
            request(PATIENCE_S)
            timer.join()
        node.close()


def test_a_fault_that_stays_ends_the_wait_for_a_reset(profile: Profile) -> None:
    with open_session(profile.session) as here, open_session(profile.session) as there:
        node, robot = Node("command", profile, there), RemoteRobot(profile, here)
        say(node, "fault", robot.subscribe())
        with pytest.raises(SessionError, match="fault"), repeated(node, "fault"):
            robot.reset(1.0)
        node.close()


def test_a_command_node_that_crashed_clears_nothing(profile: Profile) -> None:
    with open_session(profile.session) as here, open_session(profile.session) as there:
        node, robot = Node("command", profile, there), RemoteRobot(profile, here)
        robot.subscribe()
        for state in ("crashed", "starting"):  # by `up`, in its name
            say(node, state, robot)
            with pytest.raises(SessionError, match="reset"), repeated(node, state):
                robot.reset(0.5)
        node.close()


@contextmanager
def standing(profile: Profile) -> Iterator[None]:
    """States of an arm that does not move."""
    names = profile.robot.arm_joints
    at_rest = JointState(names, np.zeros(len(names)), np.zeros(len(names)), None)
    over = threading.Event()

    def publish_states() -> None:
        with open_session(profile.session) as session:
            node = Node("sim", profile, session)
            publisher = node.declare_publisher(profile.keys.state_joint, Kind.STATE)
            while not over.wait(0.02):
                publisher.publish(at_rest)
            node.close()

    thread = threading.Thread(target=publish_states)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def repeated(node: Node, state: str) -> Iterator[None]:
    """The node says its state again and again."""
    over = threading.Event()

    def say_it() -> None:
        while not over.wait(0.05):
            node.publish_status(state, now=True)

    thread = threading.Thread(target=say_it)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def test_a_state_of_a_robot_that_is_gone_is_not_returned_as_where_it_is(profile: Profile) -> None:
    profile = override(profile, {"timing": {"state_timeout_s": 0.5}})
    pose = PoseState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(6))
    with open_session(profile.session) as here, open_session(profile.session) as there:
        node, robot = Node("sim", profile, there), RemoteRobot(profile, here)
        publisher = node.declare_publisher(profile.keys.state_pose, Kind.STATE)
        with pytest.raises(SessionError):
            robot.pose_state(0.0)  # from now on it listens
        await_match(there, profile.keys.state_pose)
        for _ in range(2):
            publisher.publish(pose)
            stamped = robot.pose_state()
            assert np.array_equal(stamped.record.position_m, pose.position_m)
            latency_s = (stamped.received_ns - stamped.header.stamp_wall_ns) / 1e9
            assert 0 <= latency_s < 1, "both are wall time"
            assert robot.pose_state(0.0) is robot.pose_state(0.0)
        publisher.publish(pose)  # arrives, but is read too late
        node.close()
        time.sleep(2 * profile.timing.state_timeout_s)
        for _ in range(2):
            with pytest.raises(SessionError, match="nothing was published on vla/panda/state/pose"):
                robot.pose_state(0.2)
        detail = {"complaint": "my_arm.py: read: nan"}
        said = NodeStatus("sim", "running", "here", 1, 1, {}, {}, {}, {}, detail)
        robot.status_received("sim", said, 100)
        with pytest.raises(SessionError, match=r"state/pose for 0.2 s: my_arm.py: read: nan"):
            robot.pose_state(0.2)
        with pytest.raises(CodecError, match="'fast' is not a percentage"):
            robot.set_speed("fast")  # pyright: ignore[reportArgumentType]
