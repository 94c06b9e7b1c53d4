"""vla-zenoh do: move-to, home, grip, run. Guarded motions, and the node that executes them."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated, Any

import typer

from vla_zenoh.cli.options import AnswerOption, NodeOptions, node_name, not_empty, options
from vla_zenoh.cli.plain import fail, say
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.client.answer import DEFAULT_TIMEOUT_S, Answer
from vla_zenoh.client.primitives import ask
from vla_zenoh.codec.settings import MAX_HELD_M, MIN_HELD_M
from vla_zenoh.errors import SessionError
from vla_zenoh.keys import PRIMITIVES, worker_node
from vla_zenoh.lab.cli.options import number_list
from vla_zenoh.runtime.process import run_node
from vla_zenoh_primitives.requests import FURTHEST_M, FURTHEST_RAD

TimeoutOption = Annotated[
    float, typer.Option("--timeout", min=0.1, max=3600, help="Seconds until the arm is braked.")
]
CONDITIONS = "gripper=closed|open, inside=X,Y,Z:X,Y,Z (m), force=N, still=S, done"


@options
def node(node: NodeOptions) -> None:
    """Answer queries for guarded motions: `vla-zenoh do`, scripts and agents."""
    from vla_zenoh_primitives.node import PrimitivesNode

    profile = node.load()
    run_node(
        profile,
        lambda session, stop: PrimitivesNode(profile, session).run(stop),
        identity=worker_node(PRIMITIVES),
    )


@options
def move_to(
    target: RobotTarget,
    at: Annotated[
        str | None, typer.Option("--at", help="x,y,z of the TCP in m, robot base frame.")
    ] = None,
    quat: Annotated[
        str | None, typer.Option("--quat", help="Its rotation x,y,z,w; default: as it is.")
    ] = None,
    joints: Annotated[
        str | None,
        typer.Option("--joints", help="All joints in rad, or NAME=RAD,.., instead of a pose."),
    ] = None,
    timeout_s: TimeoutOption = DEFAULT_TIMEOUT_S,
    as_json: AnswerOption = False,
) -> None:
    """Go straight to a pose, or to joints; rejected before it moves where that cannot be."""
    fields: dict[str, Any] = {}
    if at is not None:
        fields["position_m"] = number_list("--at", at, -FURTHEST_M, FURTHEST_M, 3)
    if quat is not None:
        fields["quat_xyzw"] = number_list("--quat", quat, -1.0, 1.0, 4)
    if joints is not None:
        fields["joints_rad"] = _joints(joints)
    if not fields:
        raise typer.BadParameter("give a target: --at X,Y,Z or --joints ..")
    _carry_out(target, "move_to", fields, timeout_s, as_json=as_json)


@options
def home(
    target: RobotTarget, timeout_s: TimeoutOption = DEFAULT_TIMEOUT_S, as_json: AnswerOption = False
) -> None:
    """Go to the joints robot.home_rad of the profile."""
    _carry_out(target, "home", {}, timeout_s, as_json=as_json)


@options
def grip(
    width: Annotated[str, typer.Argument(help="open, closed, or the width in m.")],
    target: RobotTarget,
    holds: Annotated[
        str | None,
        typer.Option(
            "--holds", help="Size X,Y,Z (m) of what it holds then, along the axes of the TCP."
        ),
    ] = None,
    timeout_s: TimeoutOption = DEFAULT_TIMEOUT_S,
    as_json: AnswerOption = False,
) -> None:
    """Open or close the gripper while the arm stands."""
    word = {"close": "closed"}.get(width, width)
    wanted = word if word in ("open", "closed") else _number("WIDTH (open, closed, m)", word, 1.0)
    holds_m = None if holds is None else number_list("--holds", holds, MIN_HELD_M, MAX_HELD_M, 3)
    fields = {"width_m": wanted, "holds_m": holds_m}
    _carry_out(target, "grip", fields, timeout_s, as_json=as_json)


@options
def run(
    worker: Annotated[str, typer.Argument(parser=node_name, help="Worker that moves the arm.")],
    target: RobotTarget,
    until: Annotated[
        list[str] | None,
        typer.Option("--until", help=f"Condition that ends it, repeatable: {CONDITIONS}."),
    ] = None,
    prompt: Annotated[
        str | None,
        typer.Option(
            "--prompt", parser=not_empty, help="For the worker; default: the present one."
        ),
    ] = None,
    timeout_s: TimeoutOption = DEFAULT_TIMEOUT_S,
    as_json: AnswerOption = False,
) -> None:
    """Let a worker move the arm until a condition holds or the time is over."""
    fields = {"worker": worker, "prompt": prompt, "until": _until(until or [])}
    _carry_out(target, "run", fields, timeout_s, as_json=as_json)


def _carry_out(
    target: RobotTarget, primitive: str, fields: dict[str, Any], timeout_s: float, *, as_json: bool
) -> None:
    try:
        with target.operator("do") as client:
            answer = ask(client, primitive, {**fields, "timeout_s": timeout_s}, who="person")
    except SessionError as error:
        if not as_json:
            raise
        answer = Answer(False, "unanswered", str(error))
    if as_json:
        print(json.dumps(asdict(answer)))
        raise SystemExit(0 if answer.ok else 1)
    if not answer.ok:
        fail(f"{primitive}: {answer.reason}{answer.why and f': {answer.why}'}. {_stands(answer)}")
    say(f"{answer.reason} after {answer.took_s:.1f} s. {_stands(answer)}")
    if answer.why:
        say(answer.why)


def _stands(answer: Answer) -> str:
    if answer.position_m is None:
        return ""
    at = ", ".join(f"{x:.4f}" for x in answer.position_m)
    width = "" if answer.width_m is None else f", gripper {1e3 * answer.width_m:.1f} mm"
    return f"TCP at ({at}) m{width}{', holding' if answer.holding else ''}"


def _number(option: str, text: str, most: float) -> float:
    return number_list(option, text, 0.0, most, 1)[0]


def _joints(text: str) -> list[float] | dict[str, float]:
    if "=" not in text:
        return number_list("--joints", text, -FURTHEST_RAD, FURTHEST_RAD)
    found: dict[str, float] = {}
    for part in text.split(","):
        name, _, value = part.partition("=")
        (found[name.strip()],) = number_list("--joints", value, -FURTHEST_RAD, FURTHEST_RAD, 1)
    return found


def _until(given: list[str]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for text in given:
        name, _, value = text.partition("=")
        if name == "done" and not value:
            found["done"] = True
        elif name == "gripper" and value in ("open", "closed"):
            found["gripper"] = value
        elif name in ("force", "still"):
            named = {"force": "force_n", "still": "still_s"}[name]
            found[named] = _number(f"--until {name}", value, 1000.0)
        elif name == "inside" and ":" in value:
            low, high = (
                number_list("--until inside", part, -FURTHEST_M, FURTHEST_M, 3)
                for part in value.split(":", 1)
            )
            found["inside"] = {"low_m": low, "high_m": high}
        else:
            raise typer.BadParameter(f"--until wants one of {CONDITIONS}; not {text!r}")
    return found
