"""The Franka Hand at work in the whole chain: a brick is grasped, lost, and asked for at 20 Hz."""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest
from franka_lab import Lab, running_lab

BRICK_M, EXACT_M = 0.04, 0.002
WISHES_S, WISH_HZ = 60.0, 20.0
LAST_S = 2.0
"""From the last wish until the fingers are there."""
SETTLED_S = 0.5
"""More than the steps of a chunk take."""
OPTIONS = ("horizon=4", f"dt_s={1 / WISH_HZ}")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: Any) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("fr3")
    given = ("--gripper-object-width", str(BRICK_M))
    with running_lab(folder, "joint", options=OPTIONS, hand=True, robot_options=given) as lab:
        yield lab


def test_a_grasp_and_the_loss_of_the_object_are_told(lab: Lab) -> None:
    chain = lab.chain
    chain.activate_when_ready()
    chain.client.set_prompt("HARD: close gripper x2")
    chain.until("the grasp is told", lambda: chain.events("grasped"))
    chain.until("the state says so", lambda: lab.hand[-1].holding)
    assert lab.hand[-1].width_m == pytest.approx(BRICK_M, abs=EXACT_M)
    assert not chain.events("object_lost")
    lab.robot.lose_object()
    chain.until("the loss is told", lambda: chain.events("object_lost"))
    chain.until("the state says so", lambda: not lab.hand[-1].holding)
    assert not lab.fault()


def test_an_object_that_is_let_go_is_not_lost(lab: Lab) -> None:
    chain = lab.chain
    chain.settle()
    chain.activate_when_ready()
    chain.client.pop_events()
    for prompt, width_m in (("open gripper x2", 0.08), ("close gripper x1", 0.03)):
        chain.client.set_prompt(f"HARD: {prompt}")
        chain.until("the fingers are there", lambda w=width_m: lab.hand_at(w, EXACT_M))
        # The next prompt continues from the goal in force, which the fingers reach first.
        time.sleep(SETTLED_S)
    assert not chain.events("object_lost")


@pytest.mark.slow
@pytest.mark.timeout(200)
def test_wishes_at_20_hz_for_a_minute_neither_stack_nor_hold_up_the_arm(lab: Lab) -> None:
    chain, since = lab.chain, len(lab.robot.lines)
    chain.settle()
    chain.activate_when_ready()
    chain.client.set_prompt("HARD: close gripper within 0.05")
    before = chain.counter("arm.commands_given", "arm")
    late = chain.counter("arm.missed_ticks", "arm")
    asked, began_s = len(lab.hand), time.monotonic()
    time.sleep(WISHES_S)
    chain.client.set_prompt("HARD: open gripper x2")
    ended_s = time.monotonic()
    chain.until("the last wish is done", lambda: lab.hand_at(0.08, EXACT_M))
    after_s = time.monotonic() - ended_s
    widths = [round(state.width_m, 3) for state in lab.hand[asked:]]
    changes = sum(a != b for a, b in pairwise(widths))
    ticks = chain.counter("arm.commands_given", "arm") - before
    print(
        f"\n{changes} motions of the fingers in {WISHES_S:g} s, the last one done after "
        f"{after_s:.2f} s; {ticks / (time.monotonic() - began_s):.0f} set-points a second, "
        f"{chain.counter('arm.missed_ticks', 'arm') - late} ticks missed;",
        lab.share(since),
    )
    assert after_s < LAST_S
    assert not lab.fault()
    assert not lab.robot.aborts(since), lab.share(since)
