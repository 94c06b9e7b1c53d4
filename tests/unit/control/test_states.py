"""The state machine: every edge of its table, and the event that the commander makes of it."""

from __future__ import annotations

from dataclasses import replace

import pytest
from command_rig import Rig

from vla_zenoh.control.states import MODES, OBEYING, TABLE, MotionMode, State, Trigger

# Written down once more, so that an edge cannot come or go unnoticed.
EDGES = [
    ("inactive", "activate", "active"),
    ("inactive", "stop", "stopped"),
    ("inactive", "fault", "fault"),
    ("active", "deactivate", "inactive"),
    ("active", "starve", "holding"),
    ("active", "lose", "inactive"),
    ("active", "stop", "stopped"),
    ("active", "fault", "fault"),
    ("holding", "fresh", "active"),
    ("holding", "deactivate", "inactive"),
    ("holding", "lose", "inactive"),
    ("holding", "stop", "stopped"),
    ("holding", "fault", "fault"),
    ("stopped", "reset", "inactive"),
    ("fault", "reset", "inactive"),
    ("fault", "stop", "stopped"),
]

FAULTY, WELL = ("motor 3 is hot",), ()


def test_the_table_has_these_edges_and_no_others() -> None:
    assert {(a.value, t.value, b.value) for (a, t), b in TABLE.items()} == set(EDGES)


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("trigger", Trigger)
def test_where_the_table_has_no_edge_nothing_changes(state: State, trigger: Trigger) -> None:
    expected = TABLE.get((state, trigger), state)
    assert state.after(trigger) is expected


@pytest.mark.parametrize("state", State)
def test_a_stop_is_obeyed_from_every_state(state: State) -> None:
    assert state.after(Trigger.STOP) is State.STOPPED


@pytest.mark.parametrize("state", [state for state in State if state not in OBEYING])
def test_chunks_are_obeyed_after_an_activation_only(state: State) -> None:
    leading_in = {s for (s, t), new in TABLE.items() if new in OBEYING and s not in OBEYING}
    assert leading_in == {State.INACTIVE}
    assert state.after(Trigger.FRESH) is state


def test_the_motion_follows_goals_while_active_only_and_retreats_while_inactive_only() -> None:
    assert set(MODES) == set(State)
    assert [state for state in State if MotionMode.FOLLOW in MODES[state]] == [State.ACTIVE]
    assert [state for state in State if MotionMode.RETREAT in MODES[state]] == [State.INACTIVE]
    assert all(MotionMode.BRAKE in MODES[state] for state in State if state is not State.ACTIVE)


def test_the_motion_pauses_at_speed_0_goes_on_and_brakes_when_it_is_deactivated() -> None:
    rig = Rig()
    rig.activate()
    rig.send([[0.02, 0, 0, 0, 0, 0, 0]] * 8)
    motion = rig.commander.parts[0].motion
    assert motion.mode is MotionMode.FOLLOW
    rig.put("speed", 0.0)
    assert motion.mode is MotionMode.PAUSE
    rig.put("speed", 100.0)
    assert motion.mode is MotionMode.FOLLOW
    rig.put("active", False)
    assert motion.mode is MotionMode.BRAKE


def set_faults(rig: Rig, faults: tuple[str, ...]) -> None:
    rig.gripper = replace(rig.gripper, faults=faults)
    rig.tick()


def lead_to(state: str) -> Rig:
    rig = Rig()
    if state in ("active", "holding"):
        rig.activate()
    if state == "holding":
        rig.run(2.0)
    if state == "stopped":
        rig.tick("stop")
    if state == "fault":
        set_faults(rig, FAULTY)
        rig.gripper = replace(rig.gripper, faults=WELL)
    assert rig.state == state
    return rig


def pull(rig: Rig, trigger: str) -> None:
    if trigger == "activate":
        rig.activate()
    elif trigger == "deactivate":
        rig.put("active", False)
    elif trigger == "fresh":
        rig.send([[0.01, 0, 0, 0, 0, 0, 0]])
    elif trigger == "starve":
        rig.run(2.0)
    elif trigger == "lose":
        rig.peers = replace(rig.peers, alive=frozenset({"sim", "camera"}))
        rig.tick()
    elif trigger in ("stop", "reset"):
        rig.tick(trigger)
    elif trigger == "fault":
        set_faults(rig, FAULTY)


@pytest.mark.parametrize(("before", "trigger", "new"), EDGES)
def test_every_edge_is_taken_by_the_commander_and_told_with_its_reason(
    before: str, trigger: str, new: str
) -> None:
    rig = lead_to(before)
    rig.events.clear()
    pull(rig, trigger)
    assert rig.state == new
    events = [event for event in rig.events if event.kind == "transition"]
    assert [event.what for event in events] == [f"{before}->{new}"]
    assert events[0].why
    if trigger in ("stop", "fault", "lose"):
        assert events[0].level == "warning"


@pytest.mark.parametrize("state", [state.value for state in State])
def test_the_task_says_active_exactly_while_chunks_are_obeyed(state: str) -> None:
    rig = lead_to(state)
    assert rig.commander.task.active == (State(state) in OBEYING)
