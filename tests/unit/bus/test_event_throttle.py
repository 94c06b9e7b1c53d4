"""Which events of a node are written, and for how many others each of them stands."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.bus.metrics import LONGEST_S, PERIOD_S, EventThrottle
from vla_zenoh.types import Event

MADE_UP = 2000
REFUSED = Event("warning", "refusal", "activate_refused", "worker 'a' is not alive")
MALFORMED = Event("warning", "refusal", "malformed", "no map")
MOVED = Event("info", "transition", "inactive->active")


class Desk:
    """Somebody who reads the news, and sets the clock."""

    def __init__(self) -> None:
        self.read: list[Event] = []
        self.now_s = 0.0
        self.news = EventThrottle(self.read.append, lambda: self.now_s)

    @property
    def counts(self) -> list[int]:
        return [event.count for event in self.read]


def test_a_flood_is_told_at_once_and_then_now_and_then_with_its_count() -> None:
    desk = Desk()
    for _ in range(100):
        desk.news.emit(MALFORMED, "delta/a")
    assert desk.counts == [1]
    desk.now_s += PERIOD_S
    desk.news.emit(MALFORMED, "delta/a")
    assert desk.counts == [1, 100]


def test_a_flood_about_one_thing_does_not_silence_another_nor_a_transition() -> None:
    desk = Desk()
    for _ in range(3):
        desk.news.emit(MALFORMED, "delta/a")
        desk.news.emit(MALFORMED, "delta/b")
        desk.news.emit(MOVED)
    assert desk.read.count(MOVED) == 3
    assert len(desk.read) == 5


def test_every_reason_of_a_refused_setting_is_told() -> None:
    desk = Desk()
    other = Event("warning", "refusal", "activate_refused", "no camera")
    desk.news.emit(REFUSED)
    desk.news.emit(other)
    assert desk.read == [REFUSED, other]


def test_who_asks_again_at_once_is_answered_a_little_later() -> None:
    desk = Desk()
    for _ in range(3):
        desk.news.emit(REFUSED)
        desk.news.poll()
    assert desk.counts == [1]
    desk.now_s += PERIOD_S
    desk.news.poll()
    assert desk.counts == [1, 2]
    assert desk.read[-1].why == REFUSED.why
    desk.now_s += PERIOD_S
    desk.news.poll()
    assert len(desk.read) == 2


@given(st.lists(st.sampled_from(["ask", "tick", "wait"]), max_size=60))
def test_in_the_end_every_refusal_of_a_setting_is_counted_once(acts: list[str]) -> None:
    desk = Desk()
    for act in [*acts, "wait", "tick"]:
        if act == "ask":
            desk.news.emit(REFUSED)
        elif act == "tick":
            desk.news.poll()
        else:
            desk.now_s += PERIOD_S
    assert sum(desk.counts) == acts.count("ask")


def test_whoever_makes_up_reasons_takes_no_answer_from_another() -> None:
    desk = Desk()
    for _ in range(2):  # the second one is owed
        desk.news.emit(REFUSED)
    for number in range(MADE_UP):
        made_up = Event("warning", "refusal", "rate_refused", f"not {number}")
        for _ in range(2):
            desk.news.emit(made_up)
        desk.news.poll()
    desk.now_s += PERIOD_S
    desk.news.poll()
    assert sum(event.count for event in desk.read if event.why == REFUSED.why) == 2
    assert sum(desk.counts) == 2 + 2 * MADE_UP


def test_what_is_no_answer_is_counted_in_the_end_as_well() -> None:
    desk = Desk()
    for _ in range(5):
        desk.news.emit(MALFORMED, "delta/a")
    desk.now_s += PERIOD_S
    desk.news.poll()
    assert desk.counts == [1, 4]


def test_a_rejection_that_goes_on_for_an_hour_is_told_every_five_seconds_and_anew_after_it() -> (
    None
):
    desk = Desk()
    for _ in range(36_000):
        desk.news.emit(MALFORMED, "delta/a")
        desk.now_s += 0.1
        desk.news.poll()
    assert len(desk.read) < 3600 / LONGEST_S + 10
    desk.now_s += LONGEST_S
    desk.news.poll()
    assert sum(desk.counts) == 36_000
    desk.now_s += LONGEST_S
    desk.news.poll()
    desk.news.emit(MALFORMED, "delta/a")
    assert desk.counts[-1] == 1


@pytest.mark.parametrize("kind", ["limit", "notice", "fault"])
def test_what_limits_the_arm_is_told_four_times_a_second(kind: str) -> None:
    desk = Desk()
    for _ in range(100):
        desk.news.emit(Event("warning", kind, "joint_limit", "slower"))
        desk.now_s += 0.1
        desk.news.poll()
    assert len(desk.read) >= 10.0 / (PERIOD_S + 0.1)
