"""vla-zenoh ros2: the node, and the configuration of the robot's bridge."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.options import (
    DEFAULT_PROFILE,
    ConnectOption,
    ProfileOption,
    effective_profile,
)
from vla_zenoh.cli.output import errors
from vla_zenoh.profile import Profile

ros2_app = typer.Typer(invoke_without_command=True)
FILE = "bridge.json5"


@ros2_app.callback()
def ros2(
    context: typer.Context,
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
) -> None:
    """Drive a ROS 2 robot and serve its cameras, through a bridge or rmw_zenoh."""
    if context.invoked_subcommand is not None:
        for name in ("profile", "connect"):
            source = context.get_parameter_source(name)
            if source is not None and source.name == "COMMANDLINE":
                raise typer.BadParameter(f"give --{name} behind {context.invoked_subcommand}")
        return
    from vla_zenoh.robots.node import RobotNode  # loads kinematics; other commands do not wait
    from vla_zenoh.robots.ros2.driver import Ros2Driver
    from vla_zenoh.runtime.process import run_node

    loaded = effective_profile(profile, connect)
    run_node(
        loaded,
        lambda session, stop: RobotNode(Ros2Driver(loaded), session).run(stop),
        identity="ros2",
        preferred=True,
    )


@ros2_app.command("bridge-config")
def bridge_config(
    profile: ProfileOption = DEFAULT_PROFILE,
    connect: ConnectOption = None,
    beside: Annotated[
        bool,
        typer.Option(
            "--beside", help="The bridge is a client of our router; else it is a router itself."
        ),
    ] = False,
    certificates: Annotated[
        Path | None,
        typer.Option(
            "--certificates",
            help="Folder on the bridge's computer with ca.pem, bridge.pem and bridge.key, where "
            "it is reached by TLS; else that of the host which runs the node ros2.",
        ),
    ] = None,
) -> None:
    """Print the configuration of zenoh-bridge-ros2dds: it lets through what the profile uses.

    Redirect it into a file; the line that starts the bridge with it is told beside it.
    """
    from vla_zenoh.interop.ros2 import bridge

    loaded = effective_profile(profile, connect)
    start = bridge.bridge_command(loaded, FILE)
    locks, notes = None, [f"Start the bridge with, on the robot's computer:\n  {start}"]
    if bridge.is_locked(loaded):
        locks, note = _locks(loaded, certificates)
        notes.append(note)
    elif certificates is not None:
        raise typer.BadParameter("--certificates is for a bridge that is reached by tls/")
    text = bridge.bridge_text(loaded, bridge.bridge_config(loaded, locks, beside=beside))
    print(text, end="")
    for note in notes:
        errors().print(note, soft_wrap=True)


def _locks(profile: Profile, given: Path | None) -> tuple[dict[str, object], str]:
    """The bridge's sections for certificates and access, and what is to be said of them."""
    from vla_zenoh.security.bridge import NODE, bridge_locks, bridges
    from vla_zenoh.security.store import Store

    assert profile.session.security is not None
    store, hosts = Store(profile.session.security.folder), [b.host for b in bridges(profile)]
    if len(hosts) != 1:
        raise typer.BadParameter("no host of this profile runs the node ros2")
    source = store.folder / hosts[0]
    folder = (given or source).expanduser()
    if not folder.is_absolute():
        raise typer.BadParameter("--certificates wants a whole path, from / or ~ on")
    names = " ".join(str(source / name) for name in ("ca.pem", f"{NODE}.pem", f"{NODE}.key"))
    return bridge_locks(profile, folder), (
        f"It takes node ros2@{hosts[0]} alone, by certificate. If it is another computer:\n"
        f"  ssh ROBOT mkdir -p -m 700 {folder}\n  scp -p {names} ROBOT:{folder}/"
    )
