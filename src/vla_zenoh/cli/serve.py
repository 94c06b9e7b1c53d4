"""vla-zenoh serve openpi."""

from __future__ import annotations

import logging
import os
import threading
from typing import Annotated

import typer

from vla_zenoh.cli.bind_check import refuse_beyond_here
from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ProfileOption,
    effective_profile,
)
from vla_zenoh.cli.output import console
from vla_zenoh.cli.worker_choice import chosen_worker
from vla_zenoh.interop.openpi import PORT
from vla_zenoh.interop.served_policy import make_served_policy
from vla_zenoh.policy.loader import make_policy
from vla_zenoh.runtime.environments import run_in_own_environment
from vla_zenoh.runtime.process import stop_on_signals

serve_app = typer.Typer(help="Serve a model to other systems.", no_args_is_help=True)


@serve_app.callback()
def _group() -> None:
    """Serve a model to other systems."""


@serve_app.command("openpi")
def openpi(
    worker: Annotated[
        str,
        typer.Option(
            "--worker", "-w", help="A worker of the profile, name of a model, or path to one."
        ),
    ],
    profile: ProfileOption = DEFAULT_PROFILE,
    options: Annotated[
        list[str] | None,
        typer.Option("--set", help="Option of the model as name=value; may be repeated."),
    ] = None,
    names: Annotated[
        str, typer.Option("--map", help="Other names, as observation/image=camera:front,...")
    ] = "",
    host: Annotated[
        str, typer.Option(help="Address to listen on; with --api-key, also one of a network.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free.")] = PORT,
    api_key: Annotated[
        str, typer.Option(envvar="VLA_ZENOH_API_KEY", help="What clients have to bring.")
    ] = "",
    python: Annotated[
        str | None, typer.Option("--python", help="Interpreter of a prepared environment.")
    ] = None,
) -> None:
    """Answer openpi's clients with a model of ours; whoever asks drives the robot."""
    loaded = effective_profile(profile)
    if not api_key:
        refuse_beyond_here(
            loaded,
            "--host",
            host,
            "drive with this model, and no key is asked",
            "give --api-key KEY (VLA_ZENOH_API_KEY), which is not encrypted, or leave it out, and "
            f"type on the other computer `ssh -L {port}:127.0.0.1:{port} THIS_COMPUTER`",
        )
    robot, chosen = loaded.robot, chosen_worker(loaded, worker, options or [])
    run_in_own_environment(chosen.model, python, extra="serve")
    from vla_zenoh.nodes.openpi_server import OpenPiServer

    policy = make_policy(chosen.model, chosen.options, profile=profile)
    offer = make_served_policy(policy.spec, names, robot.arm_joints, robot.gripper.max_width_m)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    getattr(policy, "load", lambda: None)()
    stop = stop_on_signals()
    server = OpenPiServer(policy, offer, host, port, api_key=api_key)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    console().print(f"{chosen.name} for openpi's clients at ws://{host}:{server.port}")
    for name, what in offer.described().items():
        console().print(f"  {name}: {what}", highlight=False)
    stop.wait()
    server.stop()
    # A model's library may leave threads behind that would keep the process.
    os._exit(0)
