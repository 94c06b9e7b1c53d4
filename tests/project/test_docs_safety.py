"""What docs/explanation/safety.md promises has its number, and that is the profile's."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from vla_zenoh.profile import Limits, Timing
from vla_zenoh.profile.schema import SessionProfile

PAGE = (Path(__file__).parents[2] / "docs" / "explanation" / "safety.md").read_text("utf-8")
TEXT = " ".join(PAGE.split())
TIMING, MOTION = Timing(), Limits().translation
SILENT_S = TIMING.max_open_loop_s + TIMING.watchdog_s
STOP_S = MOTION.velocity_m_s / MOTION.acceleration_m_s2 + (
    MOTION.acceleration_m_s2 / MOTION.jerk_m_s3
)


@pytest.mark.parametrize(
    "said",
    [
        # A word of a standard beside each thing that sounds like it, and what it is not.
        "a software stop",
        "resembles stop category 2 (IEC 60204-1), without a performance level",
        "an emergency stop (ISO 13850), which is hardware",
        "an enabling device (three positions, PL d)",
        "That is an automatic restart",
        "only a new activation moves the arm",
        "ISO 10218-1 wants 0.25 m/s at most",
        "the limit of each axis of the base frame",
        "a link or tool without one has no barrier, and `vla-zenoh profile check` names it",
        "first, second and third differences stay within **twice** the limits",
        f"up to {math.sqrt(3):.2f} times as much: {math.sqrt(3) * MOTION.velocity_m_s:.2f} m/s "
        f"with {MOTION.velocity_m_s:g}",
        f"`velocity_m_s: {0.25 / math.sqrt(3):.3f}`",
        "(max_open_loop_s / s + watchdog_s) + (v / a + a / j)",
        f"{TIMING.max_open_loop_s:g} + {TIMING.watchdog_s:g} + {STOP_S:.2f} = "
        f"{math.ceil(10 * (SILENT_S + STOP_S)) / 10:g} s with the defaults",
        f"a pulled cable or a dead laptop after `session.lease_ms` "
        f"({SessionProfile().lease_ms / 1000:g} s)",
        f"for up to `timing.max_hold_s` ({TIMING.max_hold_s:g} s",
        f"{TIMING.state_timeout_s:g} s (`timing.state_timeout_s`)",
        f"`timing.command_timeout_s` ({TIMING.command_timeout_s:g} s)",
    ],
)
def test_each_promise_is_there_with_the_number_of_the_profile(said: str) -> None:
    assert said in TEXT


def test_the_tests_that_the_page_names_are_there() -> None:
    named = re.findall(r"`(tests/[\w/]+\.py)`", PAGE)
    assert named
    for name in named:
        assert (Path(__file__).parents[2] / name).is_file(), name
