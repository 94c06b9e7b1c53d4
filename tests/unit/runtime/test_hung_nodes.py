"""Which nodes are ended because they hang."""

from __future__ import annotations

from vla_zenoh.runtime.supervisor import HANG_S, HEARD_S, hung_nodes, is_hearing

RUNNING = {
    "router": ("router", 1),
    "sim": ("sim", 2),
    "command": ("command", 3),
    "worker-big": ("worker", 4),
}
FRESH_S, LONG_S = 0.3, HANG_S + 1.0


def said(**ages_s: float) -> dict[str, tuple[int, float]]:
    """Everybody was heard just now, but those named."""
    heard = {name: FRESH_S for name in RUNNING}
    heard.update({name.replace("_", "-"): age_s for name, age_s in ages_s.items()})
    return {name: (RUNNING[name][1], age_s) for name, age_s in heard.items()}


def test_nobody_hangs_while_all_speak() -> None:
    assert hung_nodes(RUNNING, said(), LONG_S) == []


def test_a_node_that_is_silent_while_others_speak_hangs() -> None:
    assert hung_nodes(RUNNING, said(sim=LONG_S), LONG_S) == ["sim"]
    assert hung_nodes(RUNNING, said(sim=HANG_S - 1.0), LONG_S) == []


def test_a_worker_may_think_as_long_as_it_likes() -> None:
    assert hung_nodes(RUNNING, said(worker_big=600.0), LONG_S) == []


def test_a_node_that_was_started_anew_is_not_blamed_for_what_ran_before() -> None:
    before = {**said(), "sim": (17, LONG_S)}
    assert hung_nodes(RUNNING, before, LONG_S) == []


def test_a_node_that_has_said_nothing_yet_is_starting() -> None:
    heard = said()
    del heard["command"]
    assert hung_nodes(RUNNING, heard, LONG_S) == []


def test_when_nobody_is_heard_the_router_is_ended_alone() -> None:
    silence = said(router=LONG_S, sim=LONG_S, command=LONG_S, worker_big=LONG_S)
    assert hung_nodes(RUNNING, silence, 0.0) == ["router"]


def test_when_nobody_is_heard_and_the_router_is_elsewhere_nothing_is_ended() -> None:
    silence = said(router=LONG_S, sim=LONG_S, command=LONG_S, worker_big=LONG_S)
    here = {name: RUNNING[name] for name in ("sim", "command")}
    assert hung_nodes(here, silence, 0.0) == []


def test_when_the_router_comes_back_the_first_that_speaks_makes_nobody_hang() -> None:
    back = said(sim=LONG_S, command=LONG_S)
    assert hung_nodes(RUNNING, back, FRESH_S) == []
    assert hung_nodes(RUNNING, back, HANG_S) == []
    assert hung_nodes(RUNNING, back, LONG_S) == ["command", "sim"]


def test_only_a_live_node_that_spoke_lately_shows_that_the_router_is_there() -> None:
    lost = {"command": (None, LONG_S, False), "sim": (None, HEARD_S, True)}
    assert not is_hearing({})
    assert not is_hearing(lost)
    assert not is_hearing({**lost, "camera": (None, FRESH_S, False)}), "`up` speaks for it"
    assert is_hearing({**lost, "camera": (None, FRESH_S, True)})
