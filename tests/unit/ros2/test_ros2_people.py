"""ROS users' topics and services: what a stop that comes later does to requests that wait, which
requests are answered how, and that nothing old sets an arm in motion."""

from __future__ import annotations

import json
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
from vla_zenoh_ros2 import operator_topics
from vla_zenoh_ros2.keys import BOOL, EMPTY, OPERATIONS, TEXT
from vla_zenoh_ros2.messages import Messages
from vla_zenoh_ros2.middleware import Bridges
from vla_zenoh_ros2.operator_topics import OperatorTopics
from vla_zenoh_ros2.ros_graph import RosGraph

from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.codec import records
from vla_zenoh.keys import Keys
from vla_zenoh.profile import load_profile
from vla_zenoh.types import Header, Task

PATIENCE_S = 30.0
TRIGGER, SET_BOOL = "std_srvs/srv/Trigger", "std_srvs/srv/SetBool"
TOO_LATE = "an emergency stop came after this request"

pytestmark = pytest.mark.realtime


@dataclass
class Rig:
    """Callers, services that do not answer before `agreed`, and what is put on our keys."""

    people: OperatorTopics
    peer: Ros2Peer
    callers: ThreadPoolExecutor
    operator: zenoh.Session
    keys: Keys
    heard: list[tuple[str, str]]
    agreed: threading.Event
    answers: list[dict[str, Any]]

    def ask(self, name: str, kind: str = TRIGGER, **values: Any) -> Future[Any]:
        return self.callers.submit(self.peer.call, f"/vla/{name}", kind, PATIENCE_S, **values)

    def put(self, name: str, kind: str, **values: Any) -> None:
        """Publish on a topic below /vla."""
        self.peer.put(f"/vla/{name}", self.peer.message(kind, **values))

    def tell_task(self, rate_hz: float) -> None:
        """As a command node does."""
        task = records.encode(Task(1, False, "", "scripted", rate_hz))
        header = records.encode_header(Header(time.time_ns(), round(rate_hz), "command#1"))
        self.operator.put(self.keys.task, task, attachment=header)

        def heard() -> bool:
            known = self.people._client.task
            return known is not None and known.rate_hz == rate_hz

        until("the task is heard", heard)

    def answer(self, nth: int) -> dict[str, Any]:
        """The nth answer."""
        until(f"answer {nth}", lambda: len(self.answers) > nth)
        return self.answers[nth]

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
        people = OperatorTopics(
            profile,
            ours,
            link,
            Bridges(ours, profile),
            messages,
            "/vla",
            lambda *_: None,
            services=True,
        )
        peer = Ros2Peer(theirs)
        for key in (keys.active, keys.stop, keys.reset, keys.rate):
            theirs.declare_subscriber(key, zenoh.handlers.Callback(keep, indirect=False))
            await_match(ours, key)
        await_match(operator, keys.stop)
        await_match(operator, keys.task)
        answers: list[dict[str, Any]] = []
        peer.on("/vla/answer", TEXT, lambda message: answers.append(json.loads(message.data)))
        for one in OPERATIONS:
            await_match(theirs, f"vla/{one.name}")
        thread = threading.Thread(target=people.run, args=(over,))
        thread.start()
        rig = Rig(people, peer, callers, operator, keys, heard, agreed, answers)
        rig.tell_task(1.0)
        yield rig
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
    rig.tell_task(5.0)
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
    assert response.message.startswith(f"NOT CONFIRMED: no answer of robot {client.keys.robot}")
    assert "USE THE ROBOT'S OWN EMERGENCY STOP" in response.message
    node.close()


# -- by topic -----------------------------------------------------------------------------------
def test_a_stop_by_topic_is_sent_at_once_whatever_waits_and_is_answered(rig: Rig) -> None:
    rig.put("reset", EMPTY)
    rig.expect(("reset", ""))
    rig.put("active", BOOL, data=True)
    until("it waits", lambda: rig.people._calls.qsize() == 1)
    rig.put("stop", EMPTY)
    rig.expect(("reset", ""), ("stop", ""))
    rig.agreed.set()
    assert rig.answer(0) == {"id": None, "what": "reset", "ok": True, "reason": "inactive"}
    late = rig.answer(1)
    assert (late["what"], late["ok"]) == ("active", False)
    assert TOO_LATE in late["reason"]
    assert (rig.answer(2)["what"], rig.answer(2)["ok"]) == ("stop", True)


@pytest.mark.parametrize("payload", [b"", b"\x00", bytes(1000), b"\xff" * 20_000])
def test_a_stop_by_topic_acts_whatever_its_bytes(rig: Rig, payload: bytes) -> None:
    rig.peer.put_bytes("/vla/stop", EMPTY, payload)
    rig.expect(("stop", ""))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("go up", "no JSON"),
        ("[1]", "no JSON object"),
        ('{"promt": "go up"}', "'promt' is none of id, prompt, worker, rate_hz, active"),
        ('{"active": 1}', "active is '1'"),
        ('{"rate_hz": true}', "rate_hz is 'True'"),
        ('{"rate_hz": NaN}', "rate 'nan'"),
        ('{"id": "7", "rate_hz": 1e9}', "out of range"),
    ],
)
def test_a_request_by_topic_that_cannot_be_meant_is_answered_with_the_reason(
    rig: Rig, text: str, reason: str
) -> None:
    rig.put("request", TEXT, data=text)
    answer = rig.answer(0)
    assert not answer["ok"]
    assert reason in answer["reason"]
    assert rig.heard == []


def test_the_answer_of_a_request_by_topic_has_its_id(rig: Rig) -> None:
    rig.agreed.set()
    rig.put("request", TEXT, data='{"id": "7", "rate_hz": 5}')
    answer = rig.answer(0)
    assert (answer["id"], answer["what"]) == ("7", "request")
    rig.expect(("rate", "5"))


def test_an_activation_or_reset_that_goes_on_being_published_is_executed_once(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(OperatorTopics, "_check_stops", lambda *_: None)
    monkeypatch.setattr(operator_topics, "REPEAT_NS", 60_000_000_000)
    rig.agreed.set()
    for nth in range(3):
        rig.put("reset", EMPTY)
        rig.answer(nth)
    assert [answer["ok"] for answer in rig.answers] == [True, False, False]
    assert "repeated" in rig.answers[1]["reason"]
    assert rig.heard == [("reset", "")]
    monkeypatch.setattr(operator_topics, "REPEAT_NS", 0)
    rig.put("reset", EMPTY)
    assert rig.answer(3)["ok"]


@pytest.mark.parametrize(
    ("topic", "kind", "values"),
    [
        ("active", BOOL, {"data": True}),
        ("reset", EMPTY, {}),
        ("request", TEXT, {"data": '{"active": true}'}),
    ],
)
def test_what_a_transient_local_publisher_sends_again_sets_nothing_in_motion_but_stops(
    rig: Rig, topic: str, kind: str, values: dict[str, Any]
) -> None:
    durability = ["TRANSIENT_LOCAL"]

    def describe(query: zenoh.Query) -> None:
        qos = {"durability": {"kind": durability[0]}}
        for name in (topic, "stop"):
            key = f"@/b1/ros2/dds/010f00/writer/010f0001/rt/vla/{name}"
            if query.key_expr.intersects(zenoh.KeyExpr(key)):
                query.reply(key, json.dumps({"key": "010f0001", "qos": qos}))
        query.drop()

    rig.agreed.set()
    bridge = rig.operator.declare_queryable(
        "@/b1/ros2/**", zenoh.handlers.Callback(describe, indirect=False)
    )
    until("the bridge is asked", lambda: rig.people._bridges.has_transient_local(f"/vla/{topic}"))
    rig.put(topic, kind, **values)
    answer = rig.answer(0)
    assert not answer["ok"]
    assert "transient_local" in answer["reason"]
    assert rig.heard == []
    rig.put("stop", EMPTY)
    rig.expect(("stop", ""))
    assert rig.answer(1)["ok"]
    durability[0] = "VOLATILE"
    rig.put(topic, kind, **values)
    until("it is executed", lambda: len(rig.heard) > 1)
    bridge.undeclare()
