"""Whatever names strangers write under, a person's tool keeps the lab's own nodes, and no flood."""

from __future__ import annotations

import dataclasses

from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.client.client import MAX_NODES, MAX_STATUS_BYTES, NodeRegistry
from vla_zenoh.types import NodeStatus

OURS = ("sim", "command")
FLOOD = 1000
SMALL = 500
"""Bytes."""


def status(name: str = "n") -> NodeStatus:
    return NodeStatus(name, "ok", "h", 1, 2)


def test_a_node_is_alive_from_its_token_on_and_its_last_words_stay() -> None:
    seconds = [10.0]
    here = NodeRegistry(OURS, lambda: seconds[0])
    here.status_received("sim", status("sim"), SMALL)
    here.token_appeared("sim")
    seconds[0] = 12.0
    assert here.snapshot() == {"sim": (status("sim"), 2.0, True)}
    here.token_gone("sim")
    assert here.snapshot() == {"sim": (status("sim"), 2.0, False)}
    assert here.status("sim") == status("sim")
    assert here.status("command") is None
    assert here.dropped == 0


def test_a_flood_of_names_leaves_the_lab_s_own_nodes_and_is_counted() -> None:
    here = NodeRegistry(OURS)
    for number in range(FLOOD):
        here.status_received(f"ghost{number}", status(), SMALL)
        here.token_appeared(f"ghost{number}")
    assert len(here.snapshot()) <= MAX_NODES
    assert len(here.alive) <= MAX_NODES
    assert here.dropped >= FLOOD
    for name in OURS:
        here.status_received(name, status(name), MAX_STATUS_BYTES)
        here.token_appeared(name)
        assert here.snapshot()[name][2]


def test_who_is_gone_makes_room_for_who_comes_and_who_lives_does_not() -> None:
    here = NodeRegistry()
    here.token_appeared("teleop")
    here.status_received("teleop", status(), SMALL)
    for number in range(FLOOD):
        here.status_received(f"ghost{number}", status(), SMALL)
    here.token_appeared("late")
    here.status_received("late", status("late"), SMALL)
    assert {"teleop", "late", f"ghost{FLOOD - 1}"} <= set(here.snapshot())
    assert "ghost0" not in here.snapshot()


def test_names_that_no_node_has_and_statuses_that_are_none_are_left_out() -> None:
    here = NodeRegistry(OURS)
    for name in ("", "x" * 1000, "a b", "[/x]", "..", "\x1b[2J", "ghost\n"):
        here.token_appeared(name)
        here.status_received(name, status(), SMALL)
        here.status_unreadable(name, "junk")
    here.status_received("sim", status("sim"), MAX_STATUS_BYTES + 1)
    assert here.snapshot() == here.unreadable == {}
    assert here.alive == frozenset()
    assert here.dropped == 22


def test_of_statuses_that_cannot_be_read_those_of_the_profile_s_nodes_stay() -> None:
    here = NodeRegistry(OURS)
    here.status_unreadable("sim", "schema 3")
    for number in range(FLOOD):
        here.status_unreadable(f"ghost{number}", "junk")
    assert len(here.unreadable) <= MAX_NODES
    assert here.unreadable["sim"] == "schema 3"
    assert here.dropped >= FLOOD - MAX_NODES
    here.status_received("sim", status("sim"), SMALL)
    assert "sim" not in here.unreadable


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["token_appeared", "token_gone", "said"]),
            st.sampled_from(["sim", *(f"n{number}" for number in range(300))]),
            st.integers(0, MAX_STATUS_BYTES + 1),
        ),
        max_size=400,
    )
)
def test_whatever_comes_no_more_is_kept_than_there_is_room_for(acts) -> None:
    here = NodeRegistry(OURS)
    for act, name, size in acts:
        if act == "said":
            here.status_received(name, dataclasses.replace(status(), pid=size), size)
        else:
            getattr(here, act)(name)
    others = [found.pid for name, (found, _, _) in here.snapshot().items() if name not in OURS]
    assert len(others) <= MAX_NODES
    assert all(size <= MAX_STATUS_BYTES for size in others)
    if any(
        act == "said" and name == "sim" and size <= MAX_STATUS_BYTES for act, name, size in acts
    ):
        assert "sim" in here.snapshot()
