"""The node primitives alone: whatever goes wrong, who asked is answered."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
import zenoh
from camera_rig import free_endpoint, until
from vla_zenoh_primitives.endings import Arrival
from vla_zenoh_primitives.node import PrimitivesNode

from vla_zenoh.bus.buffers import CallbackRing
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session
from vla_zenoh.client.answer import Answer
from vla_zenoh.client.client import Client
from vla_zenoh.client.primitives import ask
from vla_zenoh.errors import NodeError
from vla_zenoh.keys import PRIMITIVES, Kind, worker_node
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.profile import load_profile, override
from vla_zenoh.types import GripperState, JointState, PoseState, Task

pytestmark = pytest.mark.long

DOWN = np.array([1.0, 0.0, 0.0, 0.0])
ARM = load_profile("panda_sim").robot.arm_joints


@contextmanager
def running(
    joints: tuple[str, ...], *, active: bool = False, silent: threading.Event | None = None
) -> Iterator[tuple[PrimitivesNode, Client, Future[None]]]:
    """The node, who asks it, and the node's end; a robot whose states have these joints.

    The command node takes every worker, and is active or not, whatever it is told. The robot says
    nothing more once it is `silent`.
    """
    where = [free_endpoint()]
    profile = override(load_profile("panda_sim"), {"session": {"listen": where, "connect": where}})
    keys, over, stop = profile.keys, threading.Event(), threading.Event()
    silent = silent or threading.Event()
    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as bus,
        open_session(profile.session) as ours,
        open_session(profile.session) as theirs,
        ThreadPoolExecutor(2) as threads,
    ):
        command = Node("command", profile, bus)
        zeros = np.zeros(len(joints))
        positions = np.array(profile.robot.home_rad) if joints == ARM else zeros
        task = command.declare_publisher(keys.task, Kind.STATE)
        workers = command.subscribe(keys.worker, CallbackRing(8))
        said = [
            (command.declare_publisher(key, Kind.STATE), record)
            for key, record in (
                (keys.state_joint, JointState(joints, positions, zeros, None)),
                (keys.state_pose, PoseState(np.array([0.4, 0.0, 0.3]), DOWN, np.zeros(6))),
                (keys.state_gripper, GripperState(0.04, moving=False, holding=False)),
            )
        ]

        def say(worker: str = "scripted") -> None:
            while not over.wait(0.02):
                for arrival in workers.drain():
                    worker = arrival.sample.payload.to_string()
                task.publish(Task(1, active, "", worker, 5.0))
                for publisher, record in said:
                    if not silent.is_set():
                        publisher.publish(record)

        saying, client = threads.submit(say), Client(profile, theirs).subscribe()
        node = PrimitivesNode(profile, ours)
        ended = threads.submit(node.run, stop)
        try:
            until(
                "the node and the task are known",
                lambda: worker_node(PRIMITIVES) in client.alive and node._robot.task,
            )
            yield node, client, ended
        finally:
            stop.set()
            over.set()
            saying.result()
            command.close()


def test_a_foreign_joint_state_is_a_reason_to_reject_and_the_node_still_answers() -> None:
    with running(("elbow",)) as (_, client, ended):
        for _ in range(2):
            answer = ask(client, "home", {"timeout_s": 1.0})
            assert (answer.ok, answer.reason) == (False, "rejected")
            assert "panda_joint1" in answer.why
        assert not ended.done()
    ended.result()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_an_unexpected_exception_is_answered_and_ends_the_node_with_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: Any) -> Answer:
        raise RuntimeError("unexpected")

    monkeypatch.setattr(PrimitivesNode, "_carry_out", fail)
    with running(("elbow",)) as (_, client, ended):
        answer = ask(client, "home", {"timeout_s": 1.0})
        assert (answer.ok, answer.reason) == (False, "ended")
        with pytest.raises(NodeError, match="primitives failed"):
            ended.result()


def test_a_chunk_that_cannot_be_published_ends_the_node_and_its_thread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with running(("elbow",)) as (_, _client, ended):

        def fail(_: PrimitivesNode) -> None:
            raise RuntimeError("unexpected")

        monkeypatch.setattr(PrimitivesNode, "_publish_chunk", fail)
        with pytest.raises(RuntimeError, match="unexpected"):
            ended.result(10.0)
        assert "primitive" not in [thread.name for thread in threading.enumerate()]


def test_a_motion_of_which_the_node_gets_no_states_ends() -> None:
    silent = threading.Event()
    with running(ARM, active=True, silent=silent) as (node, _, _ended):
        until("its states come", lambda: node._sight().joints_rad.size)
        silent.set()
        far = Arrival(Pose(np.array([0.6, 0.0, 0.3]), np.eye(3)))
        ending = node._watch(far, time.monotonic() + 30.0)
    assert ending == ("ended", "no state of the robot reaches the node primitives")


def test_a_node_that_fails_before_it_activates_does_not_activate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    publish = PrimitivesNode._publish_chunk

    def fail(node: PrimitivesNode) -> None:
        task = node._robot.task
        if task is not None and task.worker == PRIMITIVES:
            raise RuntimeError("unexpected")
        if node._policy.target.joints_rad is None:
            publish(node)

    monkeypatch.setattr(PrimitivesNode, "_publish_chunk", fail)
    with running(ARM) as (node, client, ended):
        activations: list[str] = []
        client.session.declare_subscriber(
            node._worker.node.keys.active,
            zenoh.handlers.Callback(
                lambda sample: activations.append(sample.payload.to_string()), indirect=False
            ),
        )
        answer = ask(client, "home", {"timeout_s": 10.0})
        assert (answer.ok, answer.reason, answer.why) == (
            False,
            "rejected",
            "the node primitives ends",
        )
        with pytest.raises(RuntimeError, match="unexpected"):
            ended.result(10.0)
        until("it is deactivated", lambda: activations)
        assert set(activations) == {"false"}


def test_what_a_person_has_chosen_meanwhile_stays_after_a_primitive() -> None:
    with running(ARM) as (node, client, _):
        robot = node._robot
        for chosen, afterwards in ((PRIMITIVES, "scripted"), ("teleop", "teleop")):
            with node._settings_kept(PRIMITIVES, None):
                client.set_worker(PRIMITIVES)
                client.set_worker(chosen)
                until("it is chosen", lambda w=chosen: robot.task and robot.task.worker == w)
            time.sleep(0.1)
            assert robot.task is not None
            assert robot.task.worker == afterwards
