"""An arm that obeys only while somebody is there: without him it brakes, and nobody else is him."""

from __future__ import annotations

from dataclasses import replace

import pytest
from command_rig import Rig
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.codec import settings
from vla_zenoh.control.commander import Setting
from vla_zenoh.errors import CodecError

ANNA, BEN = "anna-1", "ben-2"
FORTH = [0.04, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
NAMES = st.from_regex(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,20}", fullmatch=True)


def rig_with(*there: str) -> Rig:
    """A rig that is ready to be activated, where these hold a token."""
    rig = Rig()
    rig.peers = replace(rig.peers, holders=frozenset(there))
    rig.tick(chunks=[rig.chunk([[0.0] * 7])])
    return rig


def test_an_arm_in_motion_brakes_when_who_holds_it_is_gone() -> None:
    rig = rig_with(ANNA, BEN)
    rig.put("active", ANNA)
    assert rig.commander.why.endswith(f"while {ANNA!r} holds it")
    assert rig.state == "active", rig.commander.why
    for _ in range(6):
        rig.send([FORTH])
        rig.run(0.096)
    assert not rig.commander.at_rest
    rig.peers = replace(rig.peers, holders=frozenset({BEN}))
    rig.tick()
    assert rig.state == "inactive"
    assert rig.commander.why == "deadman 'anna-1' is gone"
    rig.settle()


def test_who_comes_back_does_not_activate_by_that() -> None:
    rig = rig_with(ANNA)
    rig.put("active", ANNA)
    rig.peers = replace(rig.peers, holders=frozenset())
    rig.tick()
    rig.peers = replace(rig.peers, holders=frozenset({ANNA}))
    rig.run(0.5)
    assert rig.state == "inactive"


def test_nobody_activates_in_the_name_of_one_who_is_not_there() -> None:
    rig = rig_with(BEN)
    rig.put("active", ANNA)
    assert rig.state == "inactive"
    assert rig.refused == {"activate_refused": 1}
    assert "the deadman of this activation, 'anna-1', is not there" in rig.commander.why


def test_what_one_holds_is_not_taken_over_by_others_or_by_nobody() -> None:
    rig = rig_with(ANNA, BEN)
    rig.put("active", ANNA)
    rig.put("active", True)
    rig.put("active", BEN)
    assert rig.refused == {"activate_refused": 1}
    assert rig.commander.deadman.name == ANNA
    rig.peers = replace(rig.peers, holders=frozenset({BEN}))
    rig.tick()
    assert rig.state == "inactive"


def test_an_arm_that_obeys_already_can_be_held_as_well() -> None:
    rig = rig_with(ANNA)
    rig.put("active", True)
    rig.put("active", ANNA)
    assert rig.state == "active"
    told = [event.what for event in rig.events if event.kind == "notice"]
    assert [what for what in told if what != "contact_not_told"] == ["held"]
    rig.peers = replace(rig.peers, holders=frozenset())
    rig.tick()
    assert rig.state == "inactive"


def test_the_next_activation_is_nobodys_again() -> None:
    rig = rig_with(ANNA)
    rig.put("active", ANNA)
    rig.put("active", False)
    rig.peers = replace(rig.peers, holders=frozenset())
    rig.settle()
    rig.activate()
    rig.run(0.2)
    assert rig.state == "active"


def test_a_stop_in_the_same_tick_wins_over_it() -> None:
    rig = rig_with(ANNA)
    rig.tick(Setting("active", ANNA), "stop")
    assert rig.state == "stopped"


@given(NAMES)
def test_a_name_is_read_as_it_was_written(name: str) -> None:
    assert settings.decode_activation(f"true while {name}".encode()) == name


@pytest.mark.parametrize(("text", "value"), [("true", True), ("OFF", False), ("1", True)])
def test_without_a_name_it_is_a_truth(text: str, value: bool) -> None:
    assert settings.decode_activation(text.encode()) is value


@pytest.mark.parametrize(
    "text",
    ["true while", "while anna", "false while anna", "true while a/b", "true while a b", "*"],
)
def test_what_is_neither_is_refused(text: str) -> None:
    with pytest.raises(CodecError):
        settings.decode_activation(text.encode())
