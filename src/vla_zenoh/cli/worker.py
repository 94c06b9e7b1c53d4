"""vla-zenoh worker: runs a model."""

from __future__ import annotations

import os
import sys
from typing import Annotated, Literal

import typer

from vla_zenoh.cli.options import HostOption, ModelOptions, NodeOptions, effective_profile, options
from vla_zenoh.cli.plain import say
from vla_zenoh.keys import worker_node
from vla_zenoh.nodes.worker.node import WorkerNode
from vla_zenoh.policy.loader import make_policy
from vla_zenoh.profile import Profile
from vla_zenoh.runtime.environments import run_in_own_environment
from vla_zenoh.runtime.process import run_node


@options
def worker(
    model: Annotated[
        str, typer.Argument(help="A worker of the profile, name of a model, or path to one.")
    ],
    node: NodeOptions,
    model_options: ModelOptions,
    name: Annotated[
        str | None, typer.Option("--name", help="Name in its keys; default: the model's name.")
    ] = None,
    delay_ms: Annotated[
        float, typer.Option("--delay", min=0, help="Milliseconds added to every inference.")
    ] = 0.0,
    host: HostOption = None,
) -> None:
    """Run a model: observations in, action chunks out on its delta key."""
    profile = effective_profile(node.profile, node.connect, host=host)
    chosen = model_options.choose(profile, model, name)
    # Returns only if this environment has what the model's header asks for.
    run_in_own_environment(chosen.model, model_options.python)
    policy = make_policy(chosen.model, chosen.options, profile=node.profile)
    if sys.stdout.isatty():
        say(f"worker {chosen.name} of robot {profile.robot.name} is running; Ctrl-C stops it")
    run_node(
        profile,
        lambda session, stop: WorkerNode(
            profile,
            session,
            policy,
            chosen.name,
            images=_image_form(profile, host),
            host=host,
            delay_s=delay_ms / 1e3,
            robots=profile.serves.get(chosen.name, ()),
            another=lambda: make_policy(chosen.model, chosen.options, profile=node.profile),
        ).run(stop),
        identity=worker_node(chosen.name),
    )
    os._exit(0)  # threads of a model's library may keep the process alive


def _image_form(profile: Profile, host: str | None) -> Literal["raw", "jpeg"]:
    """Raw images within a host, JPEG from another one."""
    if host is None or host not in profile.hosts:
        return "raw"
    return "raw" if "camera" in profile.hosts[host].nodes else "jpeg"
