"""An emergency stop outlives the command node that heard it."""

from __future__ import annotations

import fcntl
import os
import signal

import pytest
from chain import READY_PATIENCE_S, Chain

from vla_zenoh.errors import SessionError


def test_a_command_node_that_is_started_again_is_still_stopped(chain: Chain) -> None:
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
