"""What the page says in plain words, for what the command node says in its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from vla_zenoh_web.plain_words import MEANINGS, Banner, banner, holder_of

import vla_zenoh.control
from vla_zenoh.control.states import State

TASK = {"prompt": "lift the brick", "worker": "brick", "speed_percent": 100.0}
CONTROL = Path(vla_zenoh.control.__file__).parent


def said(state: str, why: str = "", **more: Any) -> Banner:
    given = {
        "state": state,
        "why": why,
        "task": TASK,
        "silent_s": 0.1,
        "at_rest": True,
        "holder": "",
        "jog": False,
        "done": False,
        "limits": [],
    }
    return banner(given | more)


def test_an_arm_that_stands_says_how_to_start_it() -> None:
    assert said("inactive", "deactivated") == ("good", "The arm stands.", "Ready: hold to run.")
    assert said("inactive", jog=True).do == "Ready: press a direction."


def test_without_a_prompt_it_asks_for_one() -> None:
    assert "There is no prompt." in said("inactive", task={**TASK, "prompt": ""}).what


def test_an_active_arm_says_who_moves_it_and_how_it_ends() -> None:
    held = said("active", holder="anna")
    assert held.what == "The model brick moves the arm, while anna holds the button."
    assert held.do == "It brakes when the button is let go."
    free = said("active")
    assert free.what.endswith("without a hold.")
    assert free.do == "Deactivate or STOP ends it."


def test_a_limit_that_holds_the_arm_back_is_named() -> None:
    found = said("active", limits=["contact_force: 30% of the speed", "table: stand"])
    assert found.level == "warn"
    assert "contact force, table" in found.what


def test_an_arm_at_speed_zero_and_a_model_that_is_done_are_told() -> None:
    assert "0 %" in said("active", task={**TASK, "speed_percent": 0.0}).what
    assert "done" in said("active", done=True).what


def test_a_stop_says_whether_the_arm_stands_and_that_reset_clears_it() -> None:
    assert said("stopped").what == "Emergency stop. The arm stands."
    assert "comes to rest" in said("stopped", at_rest=False).what
    assert "Reset" in said("stopped").do


def test_the_reason_for_a_brake_is_told_with_what_to_do() -> None:
    why = "left: something presses against the arm: contact_force 31.0 N, at most 30 N; it retreats"
    found = said("inactive", why)
    assert found.level == "warn"
    assert found.what == "The arm touched something, stopped and backed off."
    assert "free it" in found.do


def test_a_rejected_activation_says_that_nothing_started() -> None:
    found = said("inactive", "activate rejected: worker 'brick' is not alive; alive are: none")
    assert found.what == "Not started. A program that the arm needs does not run."
    assert "vla-zenoh up" in found.do


def test_a_reason_without_plain_words_is_told_as_it_is() -> None:
    assert "the moon is full" in said("inactive", "the moon is full").what


@pytest.mark.parametrize("state", [*(each.value for each in State), "dead", "no command node"])
def test_every_state_says_what_happened_and_what_to_do(state: str) -> None:
    found = said(state, "something")
    assert found.what
    assert found.do


def test_a_silent_robot_is_no_good_news_whatever_it_said_last() -> None:
    assert said("active", silent_s=5.0).level == "bad"


@pytest.mark.parametrize("fragment", [each.fragment for each in MEANINGS])
def test_plain_words_are_for_what_the_command_node_says(fragment: str) -> None:
    """A reworded reason has to be reworded here as well."""
    assert any(fragment in path.read_text("utf-8") for path in CONTROL.glob("*.py"))


def test_a_hold_of_a_page_is_of_its_person() -> None:
    assert holder_of("web-anna-b68ee657") == "anna"
    assert holder_of("gamepad-12ab34cd") == "gamepad-12ab34cd"
    assert holder_of("") == ""
