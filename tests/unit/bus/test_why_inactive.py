"""The reason of an inactive arm belongs to the transition that made it so."""

from __future__ import annotations

import threading
from typing import Any, cast

from vla_zenoh.client.client import Client
from vla_zenoh.profile import load_profile
from vla_zenoh.types import NodeStatus, Task


def client() -> Client:
    made = Client(load_profile("panda_sim"), cast(Any, None))
    made.token_appeared("command")
    return made


def says(one: Client, state: str, why: str, episode: int = 5) -> None:
    detail = {"why": why, "episode": episode}
    one.status_received("command", NodeStatus("command", state, "here", 1, 1, detail=detail), 100)


def task(*, active: bool, episode: int = 5) -> Task:
    return Task(episode, active, "go up", "scripted", 5.0, 100.0)


def test_an_active_arm_has_no_reason() -> None:
    one = client()
    one.task = task(active=True)
    says(one, "active", "fresh chunk")
    assert one.why_inactive() == ""


def test_the_reason_of_an_older_transition_is_not_taken() -> None:
    one = client()
    one.task = task(active=False)
    says(one, "active", "fresh chunk")
    late = threading.Timer(0.1, says, (one, "inactive", "robot state lost: pose 0.300 s old"))
    late.start()
    assert one.why_inactive(5.0) == "robot state lost: pose 0.300 s old"


def test_the_reason_of_an_older_episode_is_not_taken() -> None:
    one = client()
    one.task = task(active=False)
    says(one, "inactive", "not activated yet", episode=4)
    late = threading.Timer(0.1, says, (one, "inactive", "node 'sim' is gone"))
    late.start()
    assert one.why_inactive(5.0) == "node 'sim' is gone"


def test_without_a_newer_status_nothing_is_made_up() -> None:
    one = client()
    one.task = task(active=False)
    says(one, "active", "fresh chunk")
    assert one.why_inactive(0.05) == "the command node does not say why"
    one.token_gone("command")
    assert one.why_inactive(0.05) == "no command node is running"
