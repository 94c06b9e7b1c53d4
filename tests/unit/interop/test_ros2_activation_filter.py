"""Who switches the arm on by a ROS topic: a person, never a program that repeats itself."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.interop.ros2.activation_filter import QUIET_S, ActivationFilter

SECOND_NS = 1_000_000_000
QUIET_NS = int(QUIET_S * SECOND_NS)
HOUR_NS = 3600 * SECOND_NS


class Topic:
    """A topic, listened to since time 0, and a clock."""

    def __init__(self) -> None:
        self.switch, self.now_ns = ActivationFilter(0), 0

    def say(self, word: bool, after_ns: int) -> bool:
        self.now_ns += after_ns
        return self.switch.take(word, self.now_ns)

    def repeat(self, word: bool, every_ns: int, times: int = 5) -> list[bool]:
        return [self.say(word, every_ns) for _ in range(times)]


def test_a_person_switches_on_and_after_a_loss_on_again() -> None:
    topic = Topic()
    assert topic.say(True, QUIET_NS)
    assert topic.say(True, QUIET_NS)
    assert topic.say(False, 1)
    assert topic.say(True, QUIET_NS)


@pytest.mark.parametrize("every_ns", [SECOND_NS // 1000, SECOND_NS // 10, SECOND_NS])
def test_what_is_repeated_switches_on_once_and_never_again(every_ns: int) -> None:
    topic = Topic()
    assert topic.say(True, QUIET_NS)
    assert not any(topic.repeat(True, every_ns))
    assert not topic.say(True, HOUR_NS), "nor when it is heard again after a link was gone"
    assert topic.say(False, QUIET_NS)
    assert topic.say(True, QUIET_NS)


def test_what_was_being_repeated_when_we_began_to_listen_does_not_switch_on() -> None:
    topic = Topic()
    assert not any(topic.repeat(True, SECOND_NS))


def test_one_false_amid_what_is_repeated_switches_off_for_good() -> None:
    topic = Topic()
    topic.say(True, QUIET_NS)
    topic.repeat(True, SECOND_NS)
    assert topic.say(False, SECOND_NS // 2)
    assert not any(topic.repeat(True, SECOND_NS))


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 3 * QUIET_NS)), max_size=40))
def test_every_false_is_obeyed_and_a_true_only_after_quiet(said: list[tuple[bool, int]]) -> None:
    topic, last_true_ns = Topic(), 0
    for word, after_ns in said:
        obeyed = topic.say(word, after_ns)
        assert obeyed or word
        if word:
            assert not obeyed or topic.now_ns - last_true_ns >= QUIET_NS
            last_true_ns = topic.now_ns
