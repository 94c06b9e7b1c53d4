"""vla-zenoh camera."""

from __future__ import annotations

from typing import Annotated

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    ProfileOption,
    effective_profile,
)
from vla_zenoh.runtime.process import run_node


def camera(
    cameras: Annotated[
        list[str] | None, typer.Argument(help="Cameras of the profile; all when none is named.")
    ] = None,
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    name: Annotated[
        str, typer.Option("--name", help="Node name; a second camera host needs another one.")
    ] = "camera",
) -> None:
    """Run cameras: V4L2 devices, RTSP streams, files and the simulator's."""
    from vla_zenoh.nodes.camera.node import CameraNode

    loaded = effective_profile(profile, connect)
    for wanted in cameras or ():
        if wanted not in loaded.cameras:
            raise typer.BadParameter(
                f"no camera {wanted!r} in profile {loaded.name}; it has: "
                + ", ".join(loaded.cameras)
            )
    chosen = tuple(cameras) if cameras else None
    run_node(
        loaded,
        lambda session, stop: CameraNode(loaded, session, name=name, cameras=chosen).run(stop),
        identity=name,
    )
