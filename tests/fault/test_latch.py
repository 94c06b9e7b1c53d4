"""An emergency stop outlives the command node that heard it, and so does what the gripper holds."""

from __future__ import annotations

import fcntl
import os
import signal

import pytest
from chain import READY_PATIENCE_S, Chain

from vla_zenoh.errors import SessionError


def holds(chain: Chain) -> object:
    status = chain.client.status("command")
    return status and status.detail.get("gripper_holds", "")


def test_a_command_node_that_is_started_again_is_still_stopped_and_knows_what_it_holds(
    chain: Chain,
) -> None:
    chain.client.publish(chain.client.keys.held, "0.04 0.05 0.12")
    chain.until("it holds the box", lambda: holds(chain) == "0.04 0.05 0.12")
    chain.client.publish(chain.client.keys.stop, "stop")
    chain.until("it stops", lambda: chain.state() == "stopped")
    old_pid = chain.pid("command")
    os.kill(old_pid, signal.SIGKILL)
    chain.until(
        "it says so again",
        lambda: (
            (status := chain.client.status("command")) is not None
            and status.pid != old_pid
            and status.state == "stopped"
        ),
        READY_PATIENCE_S,
    )
    chain.until("it still holds the box", lambda: holds(chain) == "0.04 0.05 0.12")
    chain.client.publish(chain.client.keys.held, "")
    chain.until("it holds nothing", lambda: holds(chain) == "")
    assert robot_state(chain) == "latched"
    with pytest.raises(SessionError, match="stopped before this node was started"):
        chain.client.activate()
    chain.client.publish(chain.client.keys.reset, "reset")
    chain.until("it is reset", lambda: chain.state() == "inactive")
    chain.activate_when_ready()


def test_refusals_while_stopped_do_not_pile_up(chain: Chain) -> None:
    chain.client.publish(chain.client.keys.stop, "stop")
    chain.until("it stops", lambda: chain.state() == "stopped")
    pid = chain.pid("command")
    for _ in range(3000):
        chain.client.publish(chain.client.keys.active, "true")
    status = chain.client.status("command")
    assert status is not None
    assert len(status.detail["why"]) < 200
    assert chain.pid("command") == pid
    assert chain.state() == "stopped"
    chain.client.publish(chain.client.keys.reset, "reset")
    chain.until("it is reset", lambda: chain.state() == "inactive")


def test_the_folder_of_a_lab_is_locked_against_whoever_tidies_up(chain: Chain) -> None:
    folder = os.open(chain.host.profile_file.parents[1], os.O_RDONLY)
    try:
        with pytest.raises(BlockingIOError):
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    finally:
        os.close(folder)


def test_a_stop_in_motion_is_heard_by_the_robot_node_alone(chain: Chain) -> None:
    chain.activate_when_ready()
    pid = chain.pid("command")
    os.kill(pid, signal.SIGSTOP)
    try:
        chain.client.publish(chain.client.keys.stop, "stop")
        chain.until("the robot node is latched", lambda: robot_state(chain) == "latched")
    finally:
        os.kill(pid, signal.SIGCONT)
    chain.until("the command node is stopped", lambda: chain.state() == "stopped")
    clear(chain)


def test_a_stop_in_motion_outlives_robot_and_command_node(chain: Chain) -> None:
    chain.activate_when_ready()
    chain.client.publish(chain.client.keys.stop, "stop")
    chain.until("the robot node is latched", lambda: robot_state(chain) == "latched")
    chain.until("the command node is stopped", lambda: chain.state() == "stopped")
    before = {name: chain.pid(name) for name in ("sim", "command")}
    for pid in before.values():
        os.kill(pid, signal.SIGKILL)
    for name, pid in before.items():
        chain.until(
            f"{name} says something again",
            lambda name=name, pid=pid: (
                (status := chain.client.status(name)) is not None and status.pid != pid
            ),
            READY_PATIENCE_S,
        )
    chain.until("the robot is latched", lambda: robot_state(chain) == "latched", READY_PATIENCE_S)
    chain.until("it is stopped", lambda: chain.state() == "stopped", READY_PATIENCE_S)
    clear(chain)


def robot_state(chain: Chain) -> str:
    return chain.state("sim") if "sim" in chain.client.alive else ""


def clear(chain: Chain) -> None:
    chain.client.publish(chain.client.keys.reset, "reset")
    chain.until("it is reset", lambda: chain.state() == "inactive")
    chain.until("the robot runs", lambda: robot_state(chain) == "running")
