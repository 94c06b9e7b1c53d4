"""The part of a profile that says how nodes reach each other."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from vla_zenoh.errors import nearest
from vla_zenoh.profile.section import Distinct, Name, Section, Word, reject

IP_PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws")
FILE_PROTOCOLS = ("unixsock-stream",)
TRUSTED_PROTOCOLS = ("tls", "quic")
"""What certificates are checked on."""
DEFAULT_FOLDER = "~/.config/vla-zenoh/lab"
ANYWHERE = ("0.0.0.0", "[::]")

_HOST_AND_PORT = re.compile(
    r"(?P<host>\[[0-9A-Fa-f:.]+(?:%[A-Za-z0-9_.-]+)?\]|[A-Za-z0-9_](?:[A-Za-z0-9_.-]*[A-Za-z0-9_])?)"
    r":(?P<port>[0-9]{1,5})"
)


def _endpoint(value: str) -> str:
    protocol, slash, rest = value.partition("/")
    known = (*IP_PROTOCOLS, *FILE_PROTOCOLS)
    if not slash:
        raise ValueError(f"{value!r} is not an endpoint: write tcp/HOST:PORT, as tcp/10.0.0.2:7447")
    if protocol not in known:
        raise ValueError(
            f"{value!r}: unknown protocol{nearest(protocol, known)} Known: {', '.join(known)}"
        )
    address = re.split(r"[?#]", rest, maxsplit=1)[0]
    if protocol in FILE_PROTOCOLS:
        if not address:
            raise ValueError(f"{value!r}: write {protocol}/PATH")
        return value
    match = _HOST_AND_PORT.fullmatch(address)
    if match is None:
        raise ValueError(f"{value!r}: write {protocol}/HOST:PORT, as {protocol}/10.0.0.2:7447")
    if int(match["port"]) > 65535:
        raise ValueError(f"{value!r}: a port is at most 65535")
    return value


Endpoint = Annotated[str, Field(max_length=512), AfterValidator(_endpoint)]
Endpoints = Annotated[tuple[Endpoint, ...], Field(strict=False, max_length=16), Distinct]


def address_of(endpoint: str) -> str:
    """What stands behind the protocol: ``127.0.0.1:7447`` of ``tcp/127.0.0.1:7447``."""
    return re.split(r"[?#]", endpoint.partition("/")[2], maxsplit=1)[0]


def is_loopback(endpoint: str) -> bool:
    """Whether only this computer can be meant: a file, ``localhost``, or an address of loopback."""
    if endpoint.startswith(FILE_PROTOCOLS):
        return True
    return is_loopback_address(host_of(endpoint))


def is_loopback_address(address: str) -> bool:
    """Likewise for an address without protocol and port."""
    host = address.partition("%")[0]
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name, which leads wherever its resolver says
        return host == "localhost"


def host_of(endpoint: str) -> str:
    """Name or IP address in an endpoint, without brackets; empty for a file."""
    match = _HOST_AND_PORT.fullmatch(address_of(endpoint))
    return match["host"].strip("[]") if match else ""


def second_link(endpoint: str) -> str:
    """The same endpoint at the next port: where pictures go when links are separate."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    return f"{protocol}/{host}:{int(port) + 1}"


def endpoint_faults(
    endpoints: Sequence[str], session: SessionProfile, *, listen: bool
) -> list[tuple[int, str]]:
    """(index, sentence) of endpoints that do not fit what the session says of security and links.

    Args:
        endpoints: of the session or of one host.
        session: the session section.
        listen: a router listens there; else somebody connects to them.
    """
    out: list[tuple[int, str]] = []
    for index, endpoint in enumerate(endpoints):
        protocol = endpoint.partition("/")[0]
        trusted = protocol in TRUSTED_PROTOCOLS
        if session.security is not None and not trusted:
            why = f"{protocol} checks no certificate, and there is a section security: write tls/"
            out.append((index, why))
        elif session.security is None and trusted:
            why = f"{protocol} needs certificates: make them with `vla-zenoh secure init`"
            out.append((index, why))
        elif listen and not (trusted or session.insecure or is_loopback(endpoint)):
            why = (
                "lets everybody on that network command the robot. Make certificates with "
                "`vla-zenoh secure init`, or listen on 127.0.0.1, or say insecure: true"
            )
            out.append((index, why))
        if session.separate_links and not _has_a_second(endpoint):
            out.append((index, "separate_links needs PROTOCOL/HOST:PORT, and the next port too"))
    return out


def _has_a_second(endpoint: str) -> bool:
    match = _HOST_AND_PORT.fullmatch(endpoint.partition("/")[2])
    return match is not None and 0 < int(match["port"]) < 65535


class SecurityProfile(Section):
    """Mutual TLS and access control. Written by ``vla-zenoh secure init``.

    Args:
        folder: a folder for each host in it, with its certificates: ``HOST/ca.pem``,
            ``HOST/NODE.pem`` and ``HOST/NODE.key``.
        host: which host this computer is; None: as noted in the folder, or the only one there.
        people: computer -> what a person there may do. A host that runs the command node may
            drive the robot, the others of the profile may look. Who may replay may say all that
            a recording holds, commands too.
    """

    folder: Word = DEFAULT_FOLDER
    host: Name | None = None
    people: dict[Name, Literal["operator", "viewer", "replay"]] = Field(default_factory=dict)


class SessionProfile(Section):
    """How nodes of this profile reach each other.

    Args:
        connect: where nodes look for the router, the first that answers is taken; when it is
            gone, the next.
        listen: where the router listens.
        router: ``own``: in a Python process of ours; ``zenohd``: the program of that name, with
            the same configuration.
        separate_links: pictures travel over connections of their own, to the router's next port.
            A reader that is stuck in a picture then does not hold up the arm.
        shared_memory: move large payloads through shared memory between processes of one host.
        lease_ms: a silent link is given up after this.
        security: certificates and who may do what; null: there are none, and the router listens
            on this computer only.
        insecure: listen on a network without certificates all the same.
    """

    connect: Endpoints = ("tcp/127.0.0.1:7447",)
    listen: Endpoints = ("tcp/127.0.0.1:7447",)
    router: Literal["own", "zenohd"] = "own"
    separate_links: bool = False
    shared_memory: bool = True
    lease_ms: int = Field(default=1000, ge=200, le=60000)
    security: SecurityProfile | None = None
    insecure: bool = False

    @model_validator(mode="after")
    def _somewhere_to_meet(self) -> SessionProfile:
        faults = []
        if not self.connect:
            faults.append((("connect",), "is empty: nodes need a router, as tcp/10.0.0.2:7447"))
        if not self.listen:
            faults.append((("listen",), "is empty: the router needs an address, as tcp/[::]:7447"))
        faults += [
            (("connect", str(index)), "port 0 leads nowhere")
            for index, endpoint in enumerate(self.connect)
            if address_of(endpoint).endswith(":0")
        ]
        for name, endpoints in (("connect", self.connect), ("listen", self.listen)):
            faults += [
                ((name, str(index)), why)
                for index, why in endpoint_faults(endpoints, self, listen=name == "listen")
            ]
        if self.security is not None and self.insecure:
            faults.append((("insecure",), "is true, beside a section security: leave one out"))
        reject(faults)
        return self
