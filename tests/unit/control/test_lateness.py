"""A loss while the computer is too busy says so, with figures."""

from __future__ import annotations

from dataclasses import replace

import pytest
from command_rig import MS, OFTEN, START_NS, Rig, profile

from vla_zenoh.control.lateness import WINDOW_S, Lateness


def test_a_loss_after_late_ticks_says_how_late_they_were() -> None:
    rig = Rig(profile(timing=OFTEN))
    rig.activate()
    rig.silent = True
    late = round(0.08 * rig.profile.timing.command_hz)
    for _ in range(20):
        rig.tick(ticks=late)
        if rig.state != "active":
            break
    assert rig.state == "inactive"
    why = rig.commander.why
    assert why.startswith("robot state lost"), why
    assert "this computer is too busy" in why
    assert "0.076 s late" in why, why


def test_a_node_that_is_gone_is_not_blamed_on_the_computer() -> None:
    rig = Rig()
    rig.activate()
    rig.tick(ticks=round(0.08 * rig.profile.timing.command_hz))
    rig.peers = replace(rig.peers, alive=rig.peers.alive - {"sim"})
    rig.tick()
    assert rig.state == "inactive"
    assert rig.commander.why == "node 'sim' is gone"


def test_a_loss_without_late_ticks_blames_nobody() -> None:
    rig = Rig()
    rig.activate()
    rig.silent = True
    rig.run(1.0)
    assert rig.commander.why.startswith("robot state lost")
    assert "busy" not in rig.commander.why


def test_a_hold_for_want_of_a_chunk_says_that_ticks_were_late() -> None:
    rig = Rig()
    rig.activate()
    late = round(0.08 * rig.profile.timing.command_hz)
    for _ in range(60):
        rig.tick(ticks=late)
        if rig.state != "active":
            break
    assert rig.state == "holding"
    assert "no fresh chunk within the watchdog; this computer is too busy" in rig.commander.why


@pytest.mark.parametrize("later_s", [WINDOW_S + 0.1, -WINDOW_S - 0.1])
def test_what_was_long_ago_explains_nothing(later_s: float) -> None:
    lateness = Lateness(0.004)
    lateness.add(50, START_NS)
    assert "10% of the ticks" in lateness.explains()
    assert "0.200 s late" in lateness.explains()
    lateness.add(0, START_NS + round(later_s * 1000) * MS)
    assert lateness.explains() == ""
