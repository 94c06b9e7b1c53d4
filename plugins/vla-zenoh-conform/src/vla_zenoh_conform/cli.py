"""vla-zenoh conform: what a robot, worker or camera of others does right and wrong on the wire."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated

import typer

from vla_zenoh.cli.options import MAX_SECONDS, JsonOption, node_name, options
from vla_zenoh.cli.output import console, fail, styled
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import NodeError, counted
from vla_zenoh.keys import worker_node
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.lab.cli.output import print_json, progress
from vla_zenoh_conform import rules
from vla_zenoh_conform.peer import Mover, look
from vla_zenoh_conform.rules import RuleFinding

SecondsOption = Annotated[
    float, typer.Option("--seconds", "-s", min=1.0, max=MAX_SECONDS, help="How long to listen.")
]
MARKS = {True: ("right", "green"), False: ("wrong", "red"), None: ("-", "dim")}


@options
def robot(
    target: RobotTarget,
    name: Annotated[
        str | None, typer.Argument(parser=node_name, help="Its node; default: the profile's.")
    ] = None,
    seconds: SecondsOption = 3.0,
    move: Annotated[
        bool,
        typer.Option(
            "--move",
            help="Move the arm by 3 cm upwards, or its last joint by 0.1 rad, and stop it. The "
            "command node must not run.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Say line by line what a robot node does right and wrong on the wire.

    It listens to states, clock and liveliness token. With --move it also sends commands, right ones
    and wrong ones, lets them fall silent, and puts a stop and a reset. Exit status 1: something is
    wrong.
    """
    with target.client() as client:
        profile, session = client.profile, client.session
        mover = Mover(session, profile) if move else None
        with progress(f"listening for {seconds:g} s"):
            node = name or profile.robot.node
            seen = look(session, profile.keys, node, rules.ROBOT_KEYS, seconds)
        findings = list(rules.robot(seen, profile, make_kinematics(profile)))
        if mover is not None and all(found.right is not False for found in findings):
            with progress("moving it"):
                findings += rules.moved(list(mover.run()))
        elif move:
            findings.append(RuleFinding("moves", None, "not tried: its states are wrong"))
    _report(findings, as_json=as_json)


@options
def worker(
    target: RobotTarget,
    name: Annotated[str, typer.Argument(parser=node_name, help="The worker.")],
    seconds: SecondsOption = 5.0,
    as_json: JsonOption = False,
) -> None:
    """Say line by line what a worker does right and wrong on the wire.

    It listens to its spec and its chunks, which need a command node; nothing moves. Exit status 1:
    something is wrong.
    """
    with target.client() as client, progress(f"listening for {seconds:g} s"):
        keys = client.keys
        wanted = [keys.spec(name), keys.delta(name), keys.task]
        seen = look(client.session, keys, worker_node(name), wanted, seconds)
    _report(rules.worker(seen, client.profile), as_json=as_json)


@options
def camera(
    target: RobotTarget,
    name: Annotated[str, typer.Argument(parser=node_name, help="The camera.")],
    node: Annotated[
        str, typer.Option("--node", parser=node_name, help="The node that serves it.")
    ] = "camera",
    seconds: SecondsOption = 3.0,
    as_json: JsonOption = False,
) -> None:
    """Say line by line what a camera node does right and wrong on the wire.

    It takes its raw images, its JPEG images and, where the profile declares it, its depth. Exit
    status 1: something is wrong.
    """
    with target.client() as client:
        keys, cameras = client.keys, client.profile.cameras
        if name not in cameras:
            raise NodeError(f"no camera {name!r} in the profile; known: {', '.join(cameras)}")
        with progress(f"listening for {seconds:g} s"):
            wanted = rules.camera_keys(name, cameras[name])
            seen = look(client.session, keys, node, wanted, seconds)
    _report(rules.camera(seen, name, client.profile), as_json=as_json)


def _report(findings: Iterable[RuleFinding], *, as_json: bool) -> None:
    found: Sequence[RuleFinding] = list(findings)
    if as_json:
        print_json([finding._asdict() for finding in found])
    else:
        width = max(len(finding.rule) for finding in found)
        for rule, right, text in found:
            word, style = MARKS[right]
            console().print(styled(f"{word:<5}", style), f"{rule:<{width}}", text)
    wrong = sum(finding.right is False for finding in found)
    if wrong:
        fail(f"of {counted(len(found), 'rule')}, {wrong} broken")
