"""vla-zenoh serve strands: our arm as a peer of the strands-robots mesh."""

from __future__ import annotations

import logging
from typing import Annotated

import typer

from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.options import node_name, options
from vla_zenoh.cli.output import console
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.client.remote_robot import RemoteRobot
from vla_zenoh.errors import ProfileError, SecurityError
from vla_zenoh.runtime.process import stop_on_signals
from vla_zenoh_strands import wire


@options
def serve(
    target: RobotTarget,
    name: Annotated[
        str | None,
        typer.Option("--name", parser=node_name, help="Of our peer; the robot's if left out."),
    ] = None,
    obey: Annotated[
        list[str] | None,
        typer.Option(
            "--obey", help="A peer that may move the arm; repeatable. Nobody if left out."
        ),
    ] = None,
    authorities: Annotated[
        str | None,
        typer.Option("--ca", help="Certificates that issue those of --obey, as a PEM file."),
    ] = None,
    unsigned: Annotated[
        bool,
        typer.Option("--unsigned", help="Believe names: everybody on the router can take one."),
    ] = False,
    certificate: Annotated[
        str | None, typer.Option("--certificate", help="Our own, to sign with; with --key.")
    ] = None,
    key: Annotated[str | None, typer.Option("--key", help="Of --certificate.")] = None,
    longest_s: Annotated[
        float, typer.Option("--longest", min=0.1, max=3600.0, help="Seconds of one order.")
    ] = 60.0,
    mesh: Annotated[
        str | None,
        typer.Option("--mesh", help="Router of the mesh as tcp/HOST:PORT, if it is another."),
    ] = None,
    namespace: Annotated[str, typer.Option("--namespace", help="Of the mesh.")] = wire.NAMESPACE,
) -> None:
    """Make our arm a peer of the strands-robots mesh.

    Anybody there can stop it; those of --obey can move it, one at a time. It is never reset from
    there.
    """
    from vla_zenoh_strands.identity import Authorities, Identity
    from vla_zenoh_strands.link import Link
    from vla_zenoh_strands.mandate import Mandate
    from vla_zenoh_strands.peer import Peer

    profile = target.load()
    us = name or profile.robot.name
    _check(us, obey or [], namespace)
    profile.require_one_arm("serve strands")
    if obey and authorities is None and not unsigned:
        raise SecurityError(
            "--obey needs --ca FILE, with which their certificates are checked; on a router that "
            "nobody else reaches, --unsigned believes their names"
        )
    if (certificate is None) != (key is None):
        raise SecurityError("--certificate and --key go together")
    known = None if authorities is None else Authorities.read(authorities)
    identity = None if not (certificate and key) else Identity.read(certificate, key)
    if identity is not None and identity.name != us:
        raise SecurityError(f"the certificate is of {identity.name!r}, the peer is {us!r}: --name")
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    stop = stop_on_signals()
    with open_session(profile.session) as session:
        robot = RemoteRobot(profile, session)
        robot.subscribe()
        theirs = session if mesh is None else open_session(profile.session, connect=(mesh,))
        link = Link(theirs, wire.MeshKeys(us, namespace), identity)
        peer = Peer(robot, link, Mandate(us, frozenset(obey or ()), known, longest_s))
        who = ", ".join(obey or ()) or "nobody"
        console().print(f"{us} on the mesh {namespace}; obeys {who}", highlight=False)
        peer.run(stop)
        told = ", ".join(f"{reason} {count}" for reason, count in sorted(peer.counts.items()))
        console().print(told or "nothing was asked", highlight=False)
        if theirs is not session:
            theirs.close()


def _check(us: str, obeyed: list[str], namespace: str) -> None:
    for peer in (us, *obeyed):
        if not wire.is_peer(peer):
            raise ProfileError(
                f"{peer!r} is no name of a peer: letters, digits, '.', '_' and '-', at most 128"
            )
    if us in obeyed:
        raise ProfileError(f"--obey {us}: that is our own name; see --name")
    if (
        not namespace
        or any(mark in namespace for mark in "*$?#")
        or namespace.strip("/") != namespace
    ):
        raise ProfileError(f"--namespace {namespace!r} cannot begin a key")
