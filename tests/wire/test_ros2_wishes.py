"""Topics of ROS people: what reaches our setting keys, in which order, and what does not."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
import zenoh
from camera_rig import await_match, until
from ros2_peer import Ros2Peer
from ros2_rig import write_profile

from vla_zenoh.bus.client import Client
from vla_zenoh.bus.session import open_session
from vla_zenoh.interop.ros2.activation_filter import QUIET_S, ActivationFilter
from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.profile import load_profile
from vla_zenoh.robots.ros2.ros_graph import RosGraph
from vla_zenoh.robots.ros2.ros_topics import ACTIVATION_NS, EstopOrder, RosTopics


class Rig(NamedTuple):
    """Somebody who publishes, what reads it, and what comes of it."""

    peer: Ros2Peer
    topics: RosTopics
    heard: list[tuple[str, str]]
    refused: list[str]
    stop: Callable[[], None]

    def say(self, *words: bool | str) -> None:
        for word in words:
            kind, topic = ("Bool", "active") if isinstance(word, bool) else ("String", "prompt")
            message = self.peer.message(f"std_msgs/msg/{kind}", data=word)
            self.peer.put(f"/vla/{topic}", message)

    def take_until(self, what: tuple[str, str]) -> None:
        def there() -> bool:
            self.topics.poll()
            return what in self.heard

        until(f"{what}", there)

    def expect(self, *wanted: tuple[str, str]) -> None:
        self.take_until(wanted[-1])
        assert self.heard == list(wanted)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    profile = load_profile(str(write_profile(tmp_path)))
    assert profile.ros2 is not None
    heard: list[tuple[str, str]] = []
    refused: list[str] = []

    def keep(sample: zenoh.Sample) -> None:
        heard.append((str(sample.key_expr).rsplit("/", 1)[-1], sample.payload.to_string()))

    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as ours,
        open_session(profile.session) as theirs,
    ):
        messages = Messages(profile.ros2.distribution)
        link = RosGraph(ours, profile.ros2, messages, "vla_panda")
        topics = RosTopics(
            Client(profile, ours),
            link,
            messages,
            "/vla",
            lambda reason, *_: refused.append(reason),
            EstopOrder(ours, profile.keys.stop),
        )
        peer = Ros2Peer(theirs)
        handler = zenoh.handlers.Callback(keep, indirect=False)
        for key in (profile.keys.active, profile.keys.prompt):
            theirs.declare_subscriber(key, handler)
            await_match(ours, key)
        await_match(theirs, profile.keys.stop)
        for topic in ("/vla/active", "/vla/prompt"):
            await_match(theirs, topic[1:])
        yield Rig(peer, topics, heard, refused, lambda: theirs.put(profile.keys.stop, ""))
        peer.close()
        link.close()


def test_words_are_obeyed_in_the_order_they_came_and_every_false_is(rig: Rig) -> None:
    rig.say(True, False)
    rig.take_until(("active", "false"))
    rig.heard.clear()
    rig.say("go up", True, "go down", False, "go up", False, "end")
    rig.expect(
        ("prompt", "go up"),
        ("prompt", "go down"),
        ("active", "false"),
        ("prompt", "go up"),
        ("active", "false"),
        ("prompt", "end"),
    )


def test_true_is_obeyed_once_and_what_is_repeated_is_told_once(rig: Rig) -> None:
    time.sleep(QUIET_S)
    rig.say(True)
    rig.expect(("active", "true"))
    time.sleep(1.2 * ACTIVATION_NS / 1e9)  # nobody agreed: the arm is not active
    rig.say(True, True, True, False)
    rig.expect(("active", "true"), ("active", "false"))
    assert rig.refused == ["repeated"]


def test_true_that_was_said_before_a_stop_is_not_obeyed_after_it(rig: Rig) -> None:
    rig.topics._filter = ActivationFilter(0)  # it was quiet for long
    rig.say(True)
    until("it waits", lambda: rig.topics._activations._arrivals)
    rig.stop()
    until("the stop is heard", lambda: rig.topics._stops.overtook(0))
    rig.say(False)
    rig.expect(("active", "false"))
    assert rig.refused == ["stopped"]
