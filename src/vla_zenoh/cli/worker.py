"""vla-zenoh worker."""

from __future__ import annotations

import os
from typing import Annotated, Literal

import typer

from vla_zenoh import keys
from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    HostOption,
    ProfileOption,
    effective_profile,
)
from vla_zenoh.cli.worker_choice import chosen_worker
from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import worker_node
from vla_zenoh.nodes.worker.node import WorkerNode
from vla_zenoh.policy.loader import make_policy
from vla_zenoh.profile import Profile
from vla_zenoh.runtime.environments import run_in_own_environment
from vla_zenoh.runtime.process import run_node


def worker(
    model: Annotated[
        str, typer.Argument(help="A worker of the profile, name of a model, or path to one.")
    ],
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    name: Annotated[
        str | None, typer.Option("--name", help="What its keys are called; the model's name else.")
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="Option of the model as name=value, before those of the profile; may be repeated.",
        ),
    ] = None,
    images: Annotated[
        Literal["auto", "raw", "jpeg"],
        typer.Option(help="Pictures to listen to; auto: raw when the cameras are on this host."),
    ] = "auto",
    delay_ms: Annotated[
        float, typer.Option("--delay", min=0, help="Let every inference take so many ms longer.")
    ] = 0.0,
    robots: Annotated[
        str | None,
        typer.Option(help="Serve these robots, names with commas; else those of the profile."),
    ] = None,
    host: HostOption = None,
    python: Annotated[
        str | None, typer.Option("--python", help="Interpreter of a prepared environment.")
    ] = None,
) -> None:
    """Run a model: observations in, action chunks out on its delta key."""
    loaded = effective_profile(profile, connect, host=host)
    chosen = chosen_worker(loaded, model, options or [], name)
    called = chosen.name
    served = robot_names(robots) or loaded.serves.get(called, ())
    # Comes back only where this environment has what the model's header asks for.
    run_in_own_environment(chosen.model, python)
    policy = make_policy(chosen.model, chosen.options, profile=profile)
    form = _image_form(loaded, host) if images == "auto" else images
    run_node(
        loaded,
        lambda session, stop: WorkerNode(
            loaded,
            session,
            policy,
            called,
            images=form,
            host=host,
            delay_s=delay_ms / 1e3,
            robots=served,
            another=lambda: make_policy(chosen.model, chosen.options, profile=profile),
        ).run(stop),
        identity=worker_node(called),
    )
    # A model's library may leave threads behind that would keep the process.
    os._exit(0)


def _image_form(profile: Profile, host: str | None) -> Literal["raw", "jpeg"]:
    """Raw pictures within a host, JPEG from another one."""
    if host is None or host not in profile.hosts:
        return "raw"
    return "raw" if "camera" in profile.hosts[host].nodes else "jpeg"


def robot_names(text: str | None) -> list[str]:
    """Names separated by commas; none of None.

    Raises:
        BadParameter: one cannot be part of a key, or is there twice.
    """
    names = [part.strip() for part in text.split(",")] if text is not None else []
    try:
        for name in names:
            keys.key_chunk(name, "robot name")
    except ProfileError as error:
        raise typer.BadParameter(f"--robots: {error}") from error
    if len(set(names)) != len(names):
        raise typer.BadParameter(f"--robots names one twice: {text}")
    return names
