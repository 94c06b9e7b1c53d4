"""vla-zenoh teleop: a person as a worker."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Literal

import typer

from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.options import model_options, node_name, options
from vla_zenoh.cli.output import errors
from vla_zenoh.cli.plain import warn
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import SecurityError
from vla_zenoh.keys import worker_node
from vla_zenoh.runtime.process import run_node


@options
def teleop(
    target: RobotTarget,
    device: Annotated[
        Literal["keyboard", "gamepad", "spacemouse"],
        typer.Option("--device", "-d", help="Input besides the keyboard, which always works."),
    ] = "keyboard",
    leader: Annotated[
        Path | None,
        typer.Option(
            "--leader",
            help="Follow the joints of this arm: a Python file with a class of a robot (see "
            "`vla_zenoh.robot`), of which only read() is called.",
        ),
    ] = None,
    leader_options: Annotated[
        list[str] | None,
        typer.Option("--set", help="Option of the leader's class as name=value; repeatable."),
    ] = None,
    frame: Annotated[
        Literal["base", "tcp"], typer.Option(help="Axes of the motion: robot base or TCP.")
    ] = "base",
    speed: Annotated[int, typer.Option("--speed", min=1, max=5, help="Initial speed level.")] = 3,
    name: Annotated[
        str, typer.Option("--name", parser=node_name, help="Name of the worker.")
    ] = "teleop",
) -> None:
    """Drive the arm by hand, as a worker whose model is you.

    `vla-zenoh use teleop` (or Tab, Y of a gamepad, the second button of a SpaceMouse) selects it,
    also while a model moves the arm; Tab again gives the arm back. It is recorded as any worker is.
    """
    from vla_zenoh_teleop.leader import LeaderArm
    from vla_zenoh_teleop.node import Teleop
    from vla_zenoh_teleop.sticks import DEVICES

    loaded = target.load()
    if leader is not None:
        loaded.require_one_arm("--leader")
    with ExitStack() as stack:
        stick = DEVICES[device]() if device in DEVICES else None
        if stick is not None:
            stack.callback(stick.close)
            errors().print(f"using {stick.name} and the keyboard")
        arm = None
        if leader is not None:
            given = model_options(leader_options or [])
            arm = LeaderArm(leader, given, len(loaded.robot.arm_joints))
            stack.callback(arm.close)
            errors().print(f"following {arm.name}")

        def run(session, stop) -> None:  # pyright: ignore  # as run_node gives them
            settings = None  # with the operator's certificate: a worker may not publish them
            try:
                settings = stack.enter_context(open_session(loaded.session))
            except SecurityError as error:
                warn(f"enter, tab and x will do nothing: {error}")
            node = Teleop(
                loaded,
                session,
                settings,
                name,
                device=stick,
                frame=frame,
                level=speed - 1,
                leader=arm,
            )
            node.run(stop)

        run_node(loaded, run, identity=worker_node(name))
