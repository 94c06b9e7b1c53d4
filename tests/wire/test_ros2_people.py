"""Services of ROS people: what an emergency stop that comes later does to those that wait."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import zenoh
from camera_rig import await_match, until
from ros2_peer import Ros2Peer
from ros2_rig import write_profile

from vla_zenoh.bus.client import Client
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session
from vla_zenoh.codec import records
from vla_zenoh.keys import Keys
from vla_zenoh.profile import load_profile
from vla_zenoh.robots.ros2.ros_graph import RosGraph
from vla_zenoh.robots.ros2.ros_services import RosServices
from vla_zenoh.ros2.messages import Messages
from vla_zenoh.types import Header, Task

PATIENCE_S = 30.0
TRIGGER, SET_BOOL = "std_srvs/srv/Trigger", "std_srvs/srv/SetBool"
TOO_LATE = "an emergency stop came after this request"


@dataclass
class Rig:
    """Callers, services that do not answer before `agreed`, and what is put on our keys."""

    people: RosServices
    peer: Ros2Peer
    callers: ThreadPoolExecutor
    operator: zenoh.Session
    keys: Keys
    heard: list[tuple[str, str]]
    agreed: threading.Event

    def ask(self, name: str, kind: str = TRIGGER, **values: Any) -> Future[Any]:
        return self.callers.submit(self.peer.call, f"/vla/{name}", kind, PATIENCE_S, **values)

    def expect(self, *wanted: tuple[str, str]) -> None:
        until(f"{wanted}", lambda: len(self.heard) >= len(wanted))
        assert self.heard == list(wanted)

    def queue_behind_a_reset(self) -> list[Future[Any]]:
        """A call that is being answered, and what waits for it."""
        first = self.ask("reset")
        self.expect(("reset", ""))
        waiting = [self.ask("reset"), self.ask("set_active", SET_BOOL, data=True)]
        until("two calls wait", lambda: self.people._calls.qsize() == 2)
        return [first, *waiting]


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    profile = load_profile(str(write_profile(tmp_path)))
    assert profile.ros2 is not None
    keys, heard = profile.keys, list[tuple[str, str]]()
    agreed, over = threading.Event(), threading.Event()

    def keep(sample: zenoh.Sample) -> None:
        heard.append((str(sample.key_expr).rsplit("/", 1)[-1], sample.payload.to_string()))

    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as ours,
        open_session(profile.session) as theirs,
        open_session(profile.session) as operator,
        ThreadPoolExecutor(8) as callers,
    ):
        messages = Messages(profile.ros2.distribution)
        link = RosGraph(ours, profile.ros2, messages, "vla_panda")
        # No command node is here: this is when it would have agreed.
        monkeypatch.setattr(Client, "wait_for", lambda *_: agreed.wait(PATIENCE_S))
        people = RosServices(profile, ours, link, messages, "/vla", lambda *_: None)
        peer = Ros2Peer(theirs)
        for key in (keys.active, keys.stop, keys.reset, keys.rate):
            theirs.declare_subscriber(key, zenoh.handlers.Callback(keep, indirect=False))
            await_match(ours, key)
        await_match(operator, keys.stop)
        await_match(operator, keys.task)
        thread = threading.Thread(target=people.run, args=(over,))
        thread.start()
        yield Rig(people, peer, callers, operator, keys, heard, agreed)
        agreed.set()
        over.set()
        thread.join()
        peer.close()
        link.close()


def test_what_was_asked_before_a_stop_is_not_done_after_it_and_what_was_asked_later_is(
    rig: Rig,
) -> None:
    first, *waiting = rig.queue_behind_a_reset()
    stop = rig.ask("stop")
    rig.expect(("reset", ""), ("stop", ""))
    rig.agreed.set()
    assert first.result().success
    for call in waiting:
        assert not call.result().success
        assert TOO_LATE in call.result().message
    assert stop.result().success
    assert rig.ask("reset").result().success
    rig.ask("set_active", SET_BOOL, data=True).result()
    asked = (("reset", ""), ("stop", ""), ("reset", ""), ("active", "true"))
    rig.expect(*asked, ("active", "false"))  # no answer came, so it is taken back


def test_a_stop_of_anybody_counts(rig: Rig) -> None:
    calls = rig.queue_behind_a_reset()
    rig.operator.put(rig.keys.stop, "stop")
    until("it is heard here", lambda: rig.people._others_stop_ns > 0)
    rig.agreed.set()
    answers = [call.result() for call in calls]
    assert [answer.success for answer in answers] == [True, False, False]
    assert rig.heard == [("reset", ""), ("stop", "stop")]


def test_what_comes_last_in_a_request_is_not_done_after_a_stop_in_between(rig: Rig) -> None:
    call = rig.ask("set_request", "vla_msgs/srv/SetRequest", prompt="", rate_hz=5.0, active=True)
    rig.expect(("rate", "5"))
    task = records.encode(Task(1, False, "", "scripted", 5.0))
    header = records.encode_header(Header(time.time_ns(), 1, "command#1"))
    rig.operator.put(rig.keys.task, task, attachment=header)
    until("the rate is agreed to", lambda: rig.people._client.task)
    stop = rig.ask("stop")
    rig.expect(("rate", "5"), ("stop", ""))
    rig.agreed.set()
    assert stop.result().success
    assert TOO_LATE in call.result().message
    assert len(rig.heard) == 2


def test_a_stop_is_not_confirmed_by_an_older_status(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    client = rig.people._client
    node = Node("command", client.profile, rig.operator)

    def heard() -> bool:
        node.publish_status("stopped")  # again only after a while
        return client.status("command") is not None and "command" in client.alive

    until("it is heard", heard)
    response = rig.ask("stop").result()
    assert not response.success
    assert response.message == (
        "the command node is silent, not stopped; use the emergency stop of the arm itself"
    )
    node.close()
