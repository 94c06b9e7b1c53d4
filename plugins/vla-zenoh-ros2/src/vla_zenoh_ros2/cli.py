"""vla-zenoh node ros2, and profile bridge-config."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.nodes import run_robot
from vla_zenoh.cli.options import NodeOptions, options
from vla_zenoh.cli.output import errors
from vla_zenoh.profile import Profile

FILE = "bridge.json5"


@options
def node(node: NodeOptions) -> None:
    """Drive a ROS 2 robot and serve its cameras, through a bridge or rmw_zenoh."""
    from vla_zenoh_ros2.driver import Ros2Driver

    run_robot(node, "ros2", Ros2Driver)


@options
def bridge_config(
    node: NodeOptions,
    beside: Annotated[
        bool,
        typer.Option(
            "--beside", help="The bridge is a client of our router; default: a router itself."
        ),
    ] = False,
    certificates: Annotated[
        Path | None,
        typer.Option(
            "--certificates",
            help="Folder on the bridge's computer with ca.pem, bridge.pem and bridge.key, for a "
            "bridge reached by TLS; default: that of the host which runs the node ros2.",
        ),
    ] = None,
) -> None:
    """Print the configuration of zenoh-bridge-ros2dds that lets through what a profile uses.

    Redirect stdout into a file; stderr says how to start the bridge with it.
    """
    from vla_zenoh_ros2 import bridge_config as bridge

    profile = node.load()
    start = bridge.bridge_command(profile, FILE)
    locks, notes = None, [f"Start the bridge with, on the robot's computer:\n  {start}"]
    if bridge.is_locked(profile):
        locks, note = _locks(profile, certificates)
        notes.append(note)
    elif certificates is not None:
        raise typer.BadParameter("--certificates is for a bridge that is reached by tls/")
    text = bridge.bridge_text(profile, bridge.bridge_config(profile, locks, beside=beside))
    print(text, end="")
    for note in notes:
        errors().print(note, soft_wrap=True)


def _locks(profile: Profile, given: Path | None) -> tuple[dict[str, object], str]:
    """The bridge's sections for certificates and access, and how to copy the certificates."""
    from vla_zenoh.security.bridge import NODE, bridges
    from vla_zenoh.security.names import read_names
    from vla_zenoh.security.store import Store
    from vla_zenoh_ros2.bridge_config import bridge_locks

    assert profile.session.security is not None
    store, hosts = Store(profile.session.security.folder), [b.host for b in bridges(profile)]
    if len(hosts) != 1:
        raise typer.BadParameter("no host of this profile runs the node ros2")
    source = store.folder / hosts[0]
    folder = (given or source).expanduser()
    if not folder.is_absolute():
        raise typer.BadParameter("--certificates wants an absolute path, from / or ~")
    files = " ".join(str(source / name) for name in ("ca.pem", f"{NODE}.pem", f"{NODE}.key"))
    names = read_names(store.folder)
    user = names.current(f"ros2@{hosts[0]}")
    return bridge_locks(profile, folder, names), (
        f"It accepts only node {user}, by certificate. If it is another computer:\n"
        f"  ssh ROBOT mkdir -p -m 700 {folder}\n  scp -p {files} ROBOT:{folder}/"
    )
