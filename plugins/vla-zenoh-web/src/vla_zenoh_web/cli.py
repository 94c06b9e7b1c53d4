"""vla-zenoh web: a page for browsers to watch and drive the robot."""

from __future__ import annotations

import secrets
import socket
import ssl
from pathlib import Path
from typing import Annotated

import typer

from vla_zenoh.cli.options import bind_address, network_address, options
from vla_zenoh.cli.output import errors
from vla_zenoh.cli.target import RobotTarget
from vla_zenoh.errors import NodeError, SecurityError
from vla_zenoh.profile.schema import is_loopback_address
from vla_zenoh.runtime.process import run_node
from vla_zenoh.security.roles import Role
from vla_zenoh.security.store import local_role
from vla_zenoh_web.access import People, Person, read_people

PORT = 8088


@options
def web(
    target: RobotTarget,
    bind: Annotated[
        str,
        typer.Option(
            "--bind", parser=bind_address, help="Address to listen at; a network's only with TLS."
        ),
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0: any free one.")] = PORT,
    people: Annotated[
        Path | None,
        typer.Option(
            "--people",
            help="YAML file of people: NAME: {role: operator|viewer, token: ...}; who is taken out "
            "of it is out at once. Default: one operator, whose token is printed.",
        ),
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option("--certificate", help="TLS certificate of this server (PEM).")
    ] = None,
    key: Annotated[
        Path | None, typer.Option("--key", help="Private key of that certificate (PEM).")
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option(
            "--name",
            parser=network_address,
            help="Host name by which browsers reach this server; repeatable.",
        ),
    ] = None,
) -> None:
    """Serve a page that watches and drives the robot, for computer, tablet and phone.

    Stop, hold-to-run, prompt, cameras, the arm, latencies, log; /metrics for Prometheus. Each
    person has a token, and the rights of a viewer or operator.
    """
    _require_tls(bind, certificate, key)
    from vla_zenoh_web.serve import TlsFiles, serve_page

    tls = None if certificate is None or key is None else TlsFiles(certificate, key)
    profile = target.load()
    found = [Person("operator", "operator", secrets.token_urlsafe(24))]
    shown = f"#{found[0].token}" if people is None else ""
    if people is not None:
        found = read_people(people)
    try:
        listening = socket.create_server(
            (bind, port), family=socket.AF_INET6 if ":" in bind else socket.AF_INET
        )
    except OSError as error:
        raise NodeError(
            f"cannot listen at {bind}:{port}: {error.strerror}; give another --bind or --port"
        ) from error
    names = [*(name or ()), socket.gethostname(), f"{socket.gethostname()}.local"]
    where = f"[{bind}]" if ":" in bind else bind
    url = f"http{'s' if tls else ''}://{where}:{listening.getsockname()[1]}/{shown}"

    def run(session, stop) -> None:  # pyright: ignore  # as run_node gives them
        errors().print(f"page of robot {profile.robot.name}: {url}", soft_wrap=True)
        # No person on the page has more rights than the certificate here.
        most = "viewer" if local_role(profile) is Role.VIEWER else "operator"
        serve_page(profile, session, People(found, most, people), listening, names, tls, stop)

    with listening:
        run_node(profile, run, identity=None)


def _require_tls(bind: str, certificate: Path | None, key: Path | None) -> None:
    """Reject a network without TLS.

    Raises:
        SecurityError: no certificate for an address of a network, or half of one.
    """
    if (certificate is None) != (key is None):
        raise SecurityError("give --certificate and --key together, or neither")
    for file in (certificate, key):
        if file is not None and not file.is_file():
            raise SecurityError(f"{file} is not there")
    if certificate is not None and key is not None:
        try:
            ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(certificate, key)
        except OSError as error:
            raise SecurityError(
                f"--certificate {certificate} and --key {key} are no certificate and its key, "
                f"each as PEM: {error}"
            ) from error
    if certificate is None and not is_loopback_address(bind):
        raise SecurityError(
            f"--bind {bind or '(all interfaces)'}: without TLS anyone on that network could read "
            "the tokens and drive the robot. Give --certificate and --key (`openssl req -x509 "
            "-newkey rsa:2048 -nodes -keyout key.pem -out cert.pem -subj /CN=NAME` makes them), "
            "or leave --bind out and type on the other computer "
            f"`ssh -L {PORT}:127.0.0.1:{PORT} THIS_COMPUTER`"
        )
