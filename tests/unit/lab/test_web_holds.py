"""Who moves the arm by the page, and for how long: each press for itself, no page for another."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import pytest
import zenoh
from camera_rig import PATIENCE_S, free_endpoint, until
from vla_zenoh_teleop.policy import OperatorInput
from vla_zenoh_web import requests, robot_link
from vla_zenoh_web.robot_link import NOT_YOURS, RobotLink

from vla_zenoh.bus.buffers import CallbackRing
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session
from vla_zenoh.client.answer import Answer
from vla_zenoh.errors import SessionError
from vla_zenoh.keys import Kind, last_chunk
from vla_zenoh.profile import load_profile, override
from vla_zenoh.types import Task

pytest.importorskip("starlette", reason="needs vla-zenoh-web")

pytestmark = pytest.mark.realtime

ONE, OTHER = 1, 2
BRAKE_S = 0.2
"""The arm of this robot stands so long after it was let go."""


class Robot:
    """A command node that obeys at once, and primitives that go on until who asked lets go.

    Attributes:
        put: what came on ``active``, and on the other settings.
        asked: primitives, in turn: name, and how it ended.
    """

    def __init__(self, link: RobotLink, there: zenoh.Session) -> None:
        self.link, self.put, self.asked = link, list[str](), list[list[str]]()
        self.active = False
        self._node, self._there = Node("command", link.profile, there), there
        self._keys, self._over = link.keys, threading.Event()
        self._holders: set[str] = set()
        self._task = self._node.declare_publisher(self._keys.task, Kind.STATE)
        self._settings = {
            name: self._node.subscribe(getattr(self._keys, name), CallbackRing(32))
            for name in ("active", "worker", "prompt", "rate", "speed", "held")
        }
        self._tokens = there.liveliness().declare_subscriber(
            self._keys.all_holding, zenoh.handlers.Callback(self._on_token, indirect=False)
        )
        self._queries = there.declare_queryable(
            self._keys.all_primitives, zenoh.handlers.Callback(self._on_query, indirect=False)
        )
        self._threads = ThreadPoolExecutor(4)
        self._saying = self._threads.submit(self._say)

    def _on_token(self, sample: zenoh.Sample) -> None:
        name = last_chunk(str(sample.key_expr))
        change = self._holders.add if sample.kind == zenoh.SampleKind.PUT else self._holders.discard
        change(name)

    def _on_query(self, query: zenoh.Query) -> None:
        self._threads.submit(self._carry_out, query)

    def _carry_out(self, query: zenoh.Query) -> None:
        assert query.payload is not None
        holder = json.loads(query.payload.to_string())["holder"]
        name = [last_chunk(str(query.key_expr)), "goes on"]
        if self.active:
            name[1] = "rejected: the arm is active"
        self.asked.append(name)
        until("who asked holds", lambda: self._over.is_set() or holder in self._holders)
        until("who asked has let go", lambda: self._over.is_set() or holder not in self._holders)
        name[1] = "let go"
        time.sleep(BRAKE_S)
        with query:
            answer = Answer(False, "ended", f"deadman {holder!r} is gone")
            query.reply(query.key_expr, answer.encode())

    def _say(self) -> None:
        holder, worker, moved_s = "", "scripted", 0.0
        while not self._over.wait(0.02):
            for name, ring in self._settings.items():
                for arrival in ring.drain():
                    text = arrival.sample.payload.to_string()
                    self.put.append(f"{name}: {text.partition(' ')[0]}")
                    if name == "active":
                        self.active, holder = text.startswith("true"), text.rpartition(" ")[2]
                    elif name == "worker":
                        worker = text
            if self.active and holder.startswith("web-") and holder not in self._holders:
                self.active = False
                self.put.append("the deadman is gone")
            self._task.publish(Task(1, self.active, "go", worker, 5.0))
            now_s = time.monotonic()
            moved_s = now_s if self.active else moved_s
            rests = {"at_rest": now_s - moved_s > BRAKE_S}
            state = "active" if self.active else "inactive"
            self._node.publish_status(state, detail=rests, now=True)

    def close(self) -> None:
        self._over.set()
        self._saying.result()
        self._threads.shutdown()
        self._tokens.undeclare()
        self._queries.undeclare()
        self._node.close()


@pytest.fixture
def robot() -> Iterator[Robot]:
    where = [free_endpoint()]
    profile = override(load_profile("panda_sim"), {"session": {"listen": where, "connect": where}})
    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as here,
        open_session(profile.session) as there,
    ):
        link = RobotLink(profile, here)
        robot = Robot(link, there)
        try:
            until("the task is known", lambda: link.client.task is not None)
            yield robot
        finally:
            link.close()
            robot.close()


def tick() -> int:
    return int(time.monotonic() * 1e3)


@contextmanager
def echoing(link: RobotLink, page: int, *presses: int) -> Iterator[None]:
    """Echoes of a page, for whichever of these presses is in force."""
    over = threading.Event()

    def beat() -> None:
        while not over.wait(0.05):
            for press in presses:
                link.beat(page, press, tick(), OperatorInput())

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def failed(call: Future[Any]) -> str:
    error = call.exception(PATIENCE_S)
    assert isinstance(error, SessionError)
    return str(error)


def primitive(name: Any, press: int) -> requests.PrimitivePress:
    return requests.PrimitivePress(press, tick(), name)


def hold(press: int, *, hand: bool = False) -> requests.HoldRequest:
    return requests.HoldRequest(press, tick(), hand)


def test_a_primitive_ends_with_its_press_and_not_with_another(robot: Robot) -> None:
    link = robot.link
    with ThreadPoolExecutor(2) as threads, echoing(link, ONE, 1, 2):
        link.press(ONE, 1, tick())
        home = threads.submit(link.primitive, ONE, primitive("home", 1), "anna")
        until("it goes home", lambda: robot.asked)
        link.release(ONE)
        link.press(ONE, 2, tick())  # in the same burst: the next button
        gripper = threads.submit(link.primitive, ONE, primitive("open", 2), "anna")
        until("the first has ended", lambda: robot.asked[0][1] == "let go")
        assert "deadman" in failed(home)
        until("the second has begun", lambda: len(robot.asked) == 2)
        time.sleep(2 * BRAKE_S)
        assert robot.asked == [["home", "let go"], ["grip", "goes on"]]
        link.release(ONE)
        assert "deadman" in failed(gripper)


def test_the_arm_brakes_between_two_presses_however_short_the_gap(robot: Robot) -> None:
    link = robot.link
    with ThreadPoolExecutor(1) as threads, echoing(link, ONE, 1, 2, 3):
        link.press(ONE, 1, tick())
        assert link.activate_held(ONE, hold(1), "anna").active
        link.release(ONE)
        link.press(ONE, 2, tick())
        assert link.activate_held(ONE, hold(2), "anna").active
        time.sleep(0.3)  # the end of the first does not come late
        assert [line for line in robot.put if line.startswith(("active", "the"))] == [
            "active: true",
            "active: false",
            "active: true",
        ]
        assert link.holds(ONE, 2)
        link.release(ONE)
        link.press(ONE, 3, tick())
        home = threads.submit(link.primitive, ONE, primitive("home", 3), "anna")
        until("it goes home", lambda: robot.asked)
        assert robot.asked == [["home", "goes on"]]
        link.release(ONE)
        assert "deadman" in failed(home)


def test_a_deactivation_that_waits_does_not_end_the_next_press(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(robot_link, "STAND_S", 3 * BRAKE_S)
    link = robot.link
    with ThreadPoolExecutor(1) as threads, echoing(link, ONE, 1, 2):
        link.press(ONE, 1, tick())
        link.activate_held(ONE, hold(1), "anna")
        deactivating = threads.submit(link.deactivate)
        until("it is deactivated", lambda: "active: false" in robot.put)
        link.press(ONE, 2, tick())
        link.activate_held(ONE, hold(2), "anna")
        assert "does not say" in failed(deactivating)  # it moves again
        time.sleep(0.1)
        assert link.holds(ONE, 2)
    assert "the deadman is gone" not in robot.put


CHANGES: list[requests.Changes] = [
    requests.PromptRequest("another"),
    requests.WorkerRequest("scripted"),
    requests.RateRequest(9.0),
    requests.SpeedRequest(100.0),
    requests.HeldRequest("", "0.1 0.1 0.1"),
    requests.ActivateRequest(),
    requests.JogRequest(True, "base", 4, ""),
    requests.JogRequest(False, "base", 1, ""),
    requests.GuideRequest("begin", "another", 1),
    requests.GuideRequest("scene", "", 1),
]


def test_a_page_that_does_not_hold_changes_nothing_for_the_one_that_does(robot: Robot) -> None:
    link, mine = robot.link, OperatorInput((1.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    with ThreadPoolExecutor(1) as threads, echoing(link, ONE):
        link.press(ONE, 1, tick())
        link.activate_held(ONE, hold(1), "anna")
        assert link.beat(ONE, 1, tick(), mine)
        before, chosen = list(robot.put), link.hand.chosen
        for change in CHANGES:
            with pytest.raises(SessionError, match=NOT_YOURS.partition(":")[0]):
                link.set(OTHER, change)
        with pytest.raises(SessionError, match="another page holds the arm"):
            link.press(OTHER, 1, tick())
        link.release(OTHER)
        assert not link.beat(OTHER, 1, tick(), OperatorInput())
        assert link._read_hand() == mine
        link.beat(ONE, 1, tick(), mine)
        time.sleep(0.1)
        assert (robot.put, link.hand.chosen) == (before, chosen)
        braked = threads.submit(link.set, OTHER, requests.DeactivateRequest())
        assert braked.result(PATIENCE_S) == "inactive, the arm stands"
    assert robot.put[-1] == "active: false"


def test_a_change_that_had_to_wait_is_not_made_once_another_page_holds(robot: Robot) -> None:
    link = robot.link
    with ThreadPoolExecutor(1) as threads, echoing(link, ONE, 1):
        with link._activating:  # as long as a primitive that was let go still brakes
            change = threads.submit(link.set, OTHER, requests.SpeedRequest(50.0))
            time.sleep(0.1)
            link.press(ONE, 1, tick())
        assert failed(change) == NOT_YOURS
    assert not robot.put


def test_no_model_moves_the_arm_for_a_direction_after_another_page_handed_it_back(
    robot: Robot,
) -> None:
    link = robot.link
    with echoing(link, ONE, 1):
        link.press(ONE, 1, tick())
        with pytest.raises(SessionError, match="take it again"):
            link.activate_held(ONE, hold(1, hand=True), "anna")
        assert not link.holds(ONE)
    assert "active: true" not in robot.put
