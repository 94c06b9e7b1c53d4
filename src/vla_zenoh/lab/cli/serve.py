"""vla-zenoh serve policy, serve mcp: a model for foreign clients, the robot for agents."""

from __future__ import annotations

import logging
import os
import sys
import threading
from typing import Annotated, Literal

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ModelOptions,
    ProfileOption,
    bind_address,
    effective_profile,
    not_empty,
    options,
)
from vla_zenoh.cli.output import console
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.lab.cli.loopback import require_loopback
from vla_zenoh.lab.policy_servers.state_vector import home_reference
from vla_zenoh.lab.serve import openpi_server
from vla_zenoh.lab.serve.served_policy import DefaultNames, make_served_policy
from vla_zenoh.policy.loader import make_policy
from vla_zenoh.policy.meaning import IDENTITY
from vla_zenoh.runtime.environments import run_in_own_environment
from vla_zenoh.runtime.process import stop_on_signals
from vla_zenoh.security.roles import Role


@options
def serve(
    worker: Annotated[
        str,
        typer.Option(
            "--worker", "-w", help="A worker of the profile, name of a model, or path to one."
        ),
    ],
    model: ModelOptions,
    profile: ProfileOption = DEFAULT_PROFILE,
    wire: Annotated[
        Literal["openpi", "vla-eval"], typer.Option(help="Whose clients are served.")
    ] = "openpi",
    names: Annotated[
        str, typer.Option("--map", help="Other names, as observation/image=camera:front,...")
    ] = "",
    host: Annotated[
        str,
        typer.Option(
            parser=bind_address, help="Address to listen on; a network's only with --api-key."
        ),
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="0: any free one.")
    ] = openpi_server.PORT,
    api_key: Annotated[
        str | None,
        typer.Option(
            envvar="VLA_ZENOH_API_KEY", parser=not_empty, help="Key that clients must send."
        ),
    ] = None,
    execute: Annotated[
        int,
        typer.Option(
            min=0,
            max=100_000,
            help="vla-eval: steps of a chunk before the next one; 0: all of them.",
        ),
    ] = 0,
) -> None:
    """Serve a model of ours to clients of openpi, or to the benchmarks of vla-eval."""
    loaded = effective_profile(profile)
    if api_key is None:
        require_loopback(
            loaded,
            "--host",
            host,
            "use this model without a key",
            "give --api-key KEY (VLA_ZENOH_API_KEY; not encrypted), or leave it out and "
            f"type on the other computer `ssh -L {port}:127.0.0.1:{port} THIS_COMPUTER`",
        )
    robot, chosen = loaded.robot, model.choose(loaded, worker)
    run_in_own_environment(chosen.model, model.python, extra="serve")
    from vla_zenoh.lab.serve import vla_eval
    from vla_zenoh.lab.serve.policy_server import Conversation, PolicyServer

    openpi = wire == "openpi"
    policy = make_policy(chosen.model, chosen.options, profile=profile)
    offer = make_served_policy(
        policy,
        names,
        robot.arm_joints,
        robot.gripper.max_width_m,
        DefaultNames() if openpi else vla_eval.NAMES,
        home_reference(loaded) if "pose" in policy.spec.observation.state else IDENTITY,
    )
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    getattr(policy, "load", lambda: None)()
    stop = stop_on_signals()

    def converse() -> Conversation:
        if openpi:
            return openpi_server.OpenPiConversation(offer)
        return vla_eval.VlaEvalConversation(offer, execute)

    server = PolicyServer(
        converse,
        host,
        port,
        health=openpi_server.HEALTH_PATH if openpi else vla_eval.HEALTH_PATH,
        max_bytes=openpi_server.MAX_BYTES,
        api_key=api_key or "",
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    console().print(f"{chosen.name} for {wire}'s clients at ws://{host}:{server.port}")
    for name, what in offer.described().items():
        console().print(f"  {name}: {what}", highlight=False)
    stop.wait()
    server.stop()
    os._exit(0)  # threads of a model's library may keep the process alive


@options
def mcp(target: RobotTarget) -> None:
    """Serve the primitives, state and cameras to an agent: an MCP server on stdin and stdout.

    With the rights of this computer's certificate. It ends with its stdin; then the arm brakes.
    """
    from vla_zenoh.bus.session import open_session
    from vla_zenoh.client.remote_robot import RemoteRobot
    from vla_zenoh.lab.serve.mcp_server import McpServer
    from vla_zenoh.security.store import local_role

    profile = target.load()
    drives = local_role(profile) in (None, Role.OPERATOR)
    # What any library prints must not get between the answers.
    out = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    with open_session(profile.session) as session:
        robot = RemoteRobot(profile, session)
        robot.subscribe()
        McpServer(robot, out, drives=drives).serve(sys.stdin.buffer)
