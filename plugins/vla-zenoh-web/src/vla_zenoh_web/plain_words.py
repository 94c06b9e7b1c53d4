"""What just happened to the arm and what to do now, in plain words. Pure."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from vla_zenoh.control.states import DEACTIVATED
from vla_zenoh.keys import ENDED

Level = Literal["good", "warn", "bad"]
HOLD = "Hold to run starts it again."


class Banner(NamedTuple):
    """Two sentences for a person: `what` happened, and what to `do`."""

    level: Level
    what: str
    do: str


class Meaning(NamedTuple):
    """Plain words for a reason of the command node that has `fragment` in it."""

    fragment: str
    what: str
    do: str


MEANINGS = (
    Meaning(
        "something presses against the arm",
        "The arm touched something, stopped and backed off.",
        f"See what it touched and free it. {HOLD}",
    ),
    Meaning(
        "the arm does not follow",
        "The arm could not follow its command, as if something held it.",
        f"See whether it is blocked, or stopped at the robot itself. {HOLD}",
    ),
    Meaning(
        "the measured arm is too near to a bound",
        "The arm came too near to the end of what it may do.",
        "Move it back: Home, or Take the arm and drive it by hand.",
    ),
    Meaning("deadman", "The button was let go, or its page lost the connection.", HOLD),
    Meaning(
        "no fresh chunk",
        "The model sends nothing new, so the arm stands and waits.",
        "It goes on by itself when the model answers. Else look at the model under Nodes.",
    ),
    Meaning(
        "without a fresh chunk",
        "The model sent nothing for too long: the run ended.",
        f"Look at the model under Nodes. {HOLD}",
    ),
    Meaning(
        "is gone",
        "A program that the arm needs has ended.",
        "`vla-zenoh up` starts it again: wait until Nodes lists it. " + HOLD,
    ),
    Meaning("was restarted", "The model was started anew.", f"Wait until it runs. {HOLD}"),
    Meaning(
        "is not alive",
        "A program that the arm needs does not run.",
        "Start it with `vla-zenoh up` on its host, or choose another model.",
    ),
    Meaning(
        "needs a prompt", "The model does not know what to do.", "Write a prompt and press Set."
    ),
    Meaning(
        "has published no chunk",
        "The model does not answer.",
        "Wait until it has started; else look at it under Nodes.",
    ),
    Meaning(
        "has sent no image",
        "A camera sends no pictures.",
        "Plug it in, or look at it under Nodes.",
    ),
    Meaning(
        "camera ",
        "The pictures of a camera cannot be trusted.",
        "Look whether it is covered, dark or frozen.",
    ),
    Meaning(
        "the clock",
        "The clocks of two computers differ too much.",
        "Synchronise them; Clocks between hosts has the figures.",
    ),
    Meaning(
        "robot state",
        "The robot's state comes too late, or not at all.",
        "Look whether the robot is on, and at the network.",
    ),
    Meaning(
        "the robot is not ready",
        "The robot is not ready for commands.",
        "Release its own stops, and bring it into its mode for external control.",
    ),
    Meaning(
        "outside the workspace",
        "The tool is outside the workspace.",
        "Move the arm inside by its own means.",
    ),
    Meaning(
        "the robot is still ",
        "The arm still settles.",
        "Wait a second, then hold again.",
    ),
    Meaning(
        "activation waits for",
        "The model has not answered the new prompt yet.",
        "Wait: it is judged within two seconds.",
    ),
)
"""The first one that fits counts."""

LOG = "The log below has more."
OWN_STOP = "Use the robot's own emergency stop if it must stop now."
REJECTED = "activate rejected: "
SILENT_S = 2.0
"""Statuses come twice a second."""


def holder_of(deadman: str) -> str:
    """Who holds the arm, by the name of a deadman: of a page, the name of the person."""
    return re.sub(r"^web-(.+)-[0-9a-f]+$", r"\1", deadman)


def banner(state: Mapping[str, Any]) -> Banner:
    """The banner of a robot.

    Args:
        state: `RobotLink.state`.
    """
    now, why, task = state["state"], str(state["why"]), state["task"]
    if now in ("no command node", ENDED):
        return Banner("bad", "Nothing drives this robot yet.", "Start it: `vla-zenoh up`.")
    if now == "dead":
        return Banner("bad", "The command node is gone; the robot brakes by itself.", OWN_STOP)
    if state["silent_s"] > SILENT_S:
        return Banner("bad", "Nothing comes from the robot any more.", OWN_STOP)
    if now == "stopped":
        rests = "The arm stands." if state["at_rest"] else "The arm comes to rest."
        return Banner("bad", f"Emergency stop. {rests}", "When the arm may move again: Reset.")
    if now == "fault":
        return Banner("bad", f"The robot has a fault: {why}.", "Clear it at the robot, then Reset.")
    if now == "active":
        return _active(state)
    if now == "holding":
        return Banner("warn", *(_meaning(why) or (f"The arm waits: {why}.", LOG)))
    if task is not None and not task["prompt"] and not state["jog"]:
        return Banner("warn", "The arm stands. There is no prompt.", "Write one and press Set.")
    ready = "press a direction." if state["jog"] else "hold to run."
    if why in ("", DEACTIVATED, "reset"):
        return Banner("good", "The arm stands.", f"Ready: {ready}")
    what, do = _meaning(why) or (f"The arm stands: {why.removeprefix(REJECTED)}.", LOG)
    return Banner("warn", f"Not started. {what}" if why.startswith(REJECTED) else what, do)


def _active(state: Mapping[str, Any]) -> Banner:
    task, holder = state["task"] or {}, state["holder"]
    who = "A person moves" if state["jog"] else f"The model {task.get('worker', '')} moves"
    end = "It brakes when the button is let go." if holder else "Deactivate or STOP ends it."
    if not task.get("speed_percent", 100.0):
        return Banner("warn", "The speed is 0 %: the arm stands.", "Raise the speed, or let go.")
    if state["done"]:
        return Banner("good", "The model says that it is done.", end)
    if state["limits"]:
        names = ", ".join(limit.partition(":")[0].replace("_", " ") for limit in state["limits"])
        return Banner("warn", f"{who} the arm, and a limit holds it back: {names}.", end)
    held = f"while {holder} holds the button" if holder else "without a hold"
    return Banner("good", f"{who} the arm, {held}.", end)


def _meaning(why: str) -> tuple[str, str] | None:
    return next(((each.what, each.do) for each in MEANINGS if each.fragment in why), None)
