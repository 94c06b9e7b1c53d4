"""The part of a profile that says how nodes reach each other."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from vla_zenoh.faults import nearest
from vla_zenoh.profile.section import Distinct, Section, refuse

IP_PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws")
FILE_PROTOCOLS = ("unixsock-stream",)
LOOPBACK = ("127.", "localhost", "[::1]")
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
    """Whether only this computer can be meant."""
    return endpoint.startswith(FILE_PROTOCOLS) or address_of(endpoint).startswith(LOOPBACK)


class SessionProfile(Section):
    """How nodes of this profile reach each other.

    Args:
        mode: ``client`` of a router (peers are not forwarded to each other by a router), or
            ``peer`` for a direct pair on one host.
        connect: where clients look for the router.
        listen: where the router listens.
        shared_memory: move large payloads through shared memory between processes of one host.
        lease_ms: a silent link is given up after this.
    """

    mode: Literal["client", "peer"] = "client"
    connect: Endpoints = ("tcp/127.0.0.1:7447",)
    listen: Endpoints = ("tcp/127.0.0.1:7447",)
    shared_memory: bool = True
    lease_ms: int = Field(default=1000, ge=200, le=60000)

    @model_validator(mode="after")
    def _somewhere_to_meet(self) -> SessionProfile:
        faults = []
        if self.mode == "client" and not self.connect:
            faults.append((("connect",), "is empty: a client needs a router, as tcp/10.0.0.2:7447"))
        if not self.listen:
            faults.append((("listen",), "is empty: the router needs an address, as tcp/[::]:7447"))
        faults += [
            (("connect", str(index)), "port 0 leads nowhere")
            for index, endpoint in enumerate(self.connect)
            if address_of(endpoint).endswith(":0")
        ]
        refuse(faults)
        return self
