"""Section ``session`` of a profile: endpoints, links and security."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from vla_zenoh.errors import nearest
from vla_zenoh.profile.section import Distinct, Fault, Name, Section, Word

IP_PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws")
FILE_PROTOCOLS = ("unixsock-stream",)
TRUSTED_PROTOCOLS = ("tls", "quic")
"""Protocols that verify certificates."""
DEFAULT_FOLDER = "~/.config/vla-zenoh/lab"
ANYWHERE = ("0.0.0.0", "[::]")

_HOST_AND_PORT = re.compile(
    r"(?P<host>\[[0-9A-Fa-f:.]+(?:%[A-Za-z0-9_.-]+)?\]|[A-Za-z0-9_](?:[A-Za-z0-9_.-]*[A-Za-z0-9_])?)"
    r":(?P<port>[0-9]{1,5})"
)


def _endpoint(value: str) -> str:
    protocol, slash, _ = value.partition("/")
    known = (*IP_PROTOCOLS, *FILE_PROTOCOLS)
    if not slash:
        raise ValueError(f"{value!r} is not an endpoint: write tcp/HOST:PORT, as tcp/10.0.0.2:7447")
    if protocol not in known:
        raise ValueError(
            f"{value!r}: unknown protocol{nearest(protocol, known)} Known: {', '.join(known)}"
        )
    address = address_of(value)
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
    """The address of an endpoint: ``127.0.0.1:7447`` of ``tcp/127.0.0.1:7447``."""
    return re.split(r"[?#]", endpoint.partition("/")[2], maxsplit=1)[0]


def is_loopback(endpoint: str) -> bool:
    """Whether an endpoint is on this computer: a file, ``localhost``, or a loopback address."""
    return endpoint.startswith(FILE_PROTOCOLS) or is_loopback_address(host_of(endpoint))


def is_loopback_address(address: str) -> bool:
    """`is_loopback` for an address without protocol and port."""
    host = address.partition("%")[0]
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name, which may resolve to anything
        return host == "localhost"


def host_of(endpoint: str) -> str:
    """Host name or IP address of an endpoint, without brackets; empty for a file."""
    match = _HOST_AND_PORT.fullmatch(address_of(endpoint))
    return match["host"].strip("[]") if match else ""


def endpoint_faults(
    endpoints: Sequence[str], session: SessionProfile, *, listen: bool
) -> Iterator[tuple[int, str]]:
    """(index, sentence) for endpoints that contradict the session's security or links.

    If `listen`, a router listens on them; otherwise nodes connect to them.
    """
    for index, endpoint in enumerate(endpoints):
        protocol = endpoint.partition("/")[0]
        trusted = protocol in TRUSTED_PROTOCOLS
        if session.security is not None and not trusted:
            why = f"{protocol} verifies no certificate, but there is a section security: write tls/"
            yield index, why
        elif session.security is None and trusted:
            yield index, f"{protocol} needs certificates: make them with `vla-zenoh secure init`"
        elif listen and not (trusted or session.insecure or is_loopback(endpoint)):
            yield (
                index,
                "lets anyone on that network command the robot. Make certificates with "
                "`vla-zenoh secure init`, or listen on 127.0.0.1, or set insecure: true",
            )
        if session.separate_links and not _has_a_second(endpoint):
            yield index, "separate_links needs PROTOCOL/HOST:PORT, and the next port too"


def _has_a_second(endpoint: str) -> bool:
    match = _HOST_AND_PORT.fullmatch(endpoint.partition("/")[2])
    return match is not None and 0 < int(match["port"]) < 65535


class SecurityProfile(Section):
    """Mutual TLS and access control, written by ``vla-zenoh secure init``.

    Args:
        folder: has a folder with certificates for each host: ``HOST/ca.pem``, ``HOST/NODE.pem`` and
            ``HOST/NODE.key``.
        host: of the profile that this computer is; None: as noted in the folder, or its only one.
        people: computer -> permission of its users. Users of the host with the command node may
            operate the robot, those of other hosts of the profile may view. ``replay`` may publish
            everything that a recording contains, commands included.
    """

    folder: Word = DEFAULT_FOLDER
    host: Name | None = None
    people: dict[Name, Literal["operator", "viewer", "replay"]] = Field(default_factory=dict)


class SessionProfile(Section):
    """How the nodes of a robot reach each other.

    Args:
        connect: endpoints of the router; nodes use the first that answers, and the next one when it
            is lost.
        listen: endpoints on which the router listens.
        separate_links: images use connections of their own, to the router's next port, so that a
            reader that is stuck in an image does not delay the arm.
        shared_memory: processes of one host exchange large payloads through shared memory.
        lease_ms: a silent link is closed after this.
        security: certificates and permissions; null: none, and the router listens on this computer
            only.
        insecure: listen on a network without certificates.
    """

    connect: Endpoints = ("tcp/127.0.0.1:7447",)
    listen: Endpoints = ("tcp/127.0.0.1:7447",)
    separate_links: bool = False
    shared_memory: bool = True
    lease_ms: int = Field(default=1000, ge=200, le=60000)
    security: SecurityProfile | None = None
    insecure: bool = False

    def contradictions(self) -> Iterator[Fault]:
        if not self.connect:
            yield ("connect",), "is empty: nodes need a router, as tcp/10.0.0.2:7447"
        if not self.listen:
            yield ("listen",), "is empty: the router needs an address, as tcp/[::]:7447"
        for index, endpoint in enumerate(self.connect):
            if address_of(endpoint).endswith(":0"):
                yield ("connect", str(index)), "port 0 leads nowhere"
        for name, endpoints in (("connect", self.connect), ("listen", self.listen)):
            for index, why in endpoint_faults(endpoints, self, listen=name == "listen"):
                yield (name, str(index)), why
        if self.security is not None and self.insecure:
            yield ("insecure",), "is true, beside a section security: leave one out"
