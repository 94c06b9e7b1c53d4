"""Opens Zenoh sessions, with a quality of service for each kind of key, and finds live nodes."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import zenoh

from vla_zenoh.bus.shared_memory import LARGE_BYTES, POOL_BYTES, obstacle
from vla_zenoh.errors import NodeError, SessionError
from vla_zenoh.keys import Keys, Kind, last_chunk

if TYPE_CHECKING:
    from vla_zenoh.profile import SessionProfile
    from vla_zenoh.profile.schema import SecurityProfile

Mode = Literal["client", "router"]
"""No peers: a router does not forward between them."""
RETRY_S = 0.1
CLIENT, LINKED, FIRST = 1, 2, 3
"""Leases announced by a client, by a router that connects to others, and by one that does not: how
long the other side waits. The connecting side must wait longer than the listening one. A client
that reconnects while its old transport is still held is taken for a second link of it, and its keys
get mixed up (Zenoh 1.10; eclipse-zenoh/zenoh#2806)."""
ROUTER_BLOCKS_US = 200_000
"""A router blocks this long on a link for samples that must not be dropped, then closes it."""
MAX_MESSAGE_BYTES = 160 * 1024 * 1024
"""Zenoh accepts no larger message from a link; the largest image we decode has 96 MiB."""

_DROP = zenoh.CongestionControl.DROP
_BLOCK = zenoh.CongestionControl.BLOCK
_EXPRESS = {"priority": zenoh.Priority.REAL_TIME, "express": True}
QOS: dict[Kind, dict[str, Any]] = {
    Kind.FRAME: {"congestion_control": _DROP, "priority": zenoh.Priority.DATA_LOW},
    Kind.STATE: {"congestion_control": _DROP, "priority": zenoh.Priority.INTERACTIVE_HIGH},
    Kind.CONTROL: {"congestion_control": _DROP, **_EXPRESS},
    Kind.ORDER: {"congestion_control": _BLOCK, **_EXPRESS},
    Kind.TELEMETRY: {"congestion_control": _DROP, "priority": zenoh.Priority.DATA},
}


def session_config(
    profile: SessionProfile,
    *,
    mode: Mode = "client",
    connect: tuple[str, ...] | None = None,
    identity: str | None = None,
    access: Mapping[str, Any] | None = None,
    images: bool = False,
) -> dict[str, Any]:
    """Configuration of a Zenoh session, as plain data for its strict parser.

    Args:
        connect: overrides the profile's endpoints; of a router: other routers.
        identity: node whose certificate is used; None: the operator at this computer.
        access: section ``access_control`` of a router.
        images: a client's separate link for images.

    Raises:
        SecurityError: the certificate is missing.
    """
    routes = mode == "router"
    targets = (connect or ()) if routes else (connect or profile.connect)
    leases = (LINKED if targets else FIRST) if routes else CLIENT
    blocks_us = ROUTER_BLOCKS_US if routes else FIRST * profile.lease_ms * 1000
    listens = profile.listen if routes else ()
    if profile.separate_links:
        listens = [link for endpoint in listens for link in (endpoint, second_link(endpoint))]
    settings: dict[str, Any] = {
        "mode": mode,
        "listen": {"endpoints": list(listens)},
        "connect": {
            "endpoints": [second_link(e) if images else e for e in targets],
            # A router starts at once, and keeps trying to reach the others.
            "timeout_ms": -1 if routes else 0,
            "exit_on_failure": not routes,
            "retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        },
        # Nothing is scouted for, so a router waits for no answers before it opens.
        "scouting": {
            "delay": 0,
            "multicast": {"enabled": False},
            "gossip": {"enabled": False},
        },
        "transport": {
            "shared_memory": {
                "enabled": profile.shared_memory and not obstacle(),
                "transport_optimization": {
                    "pool_size": POOL_BYTES,
                    "message_size_threshold": LARGE_BYTES,
                },
            },
            "link": {
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
                "tx": {
                    "lease": leases * profile.lease_ms,
                    "keep_alive": 4,
                    "queue": {"congestion_control": {"block": {"wait_before_close": blocks_us}}},
                },
            },
        },
    }
    if profile.security is not None:
        settings["transport"]["link"]["tls"] = _tls(profile.security, identity, routes)
    if access is not None:
        settings["access_control"] = dict(access)
    return settings


def second_link(endpoint: str) -> str:
    """The same endpoint at the next port, for images on a link of their own."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    return f"{protocol}/{host}:{int(port) + 1}"


def _tls(security: SecurityProfile, identity: str | None, routes: bool) -> dict[str, Any]:
    from vla_zenoh.security.store import Store

    files = Store(security.folder).identity_files(security.host, identity, security.people)
    own = {"private_key": str(files.key), "certificate": str(files.certificate)}
    sides = ("connect", "listen") if routes else ("connect",)
    return {
        "root_ca_certificate": str(files.authority),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        **{f"{side}_{what}": path for side in sides for what, path in own.items()},
    }


def open_session(
    profile: SessionProfile,
    *,
    mode: Mode = "client",
    connect: tuple[str, ...] | None = None,
    identity: str | None = None,
    access: Mapping[str, Any] | None = None,
    images: bool = False,
    wait_s: float = 0.0,
    stop: threading.Event | None = None,
) -> zenoh.Session:
    """Open a session, see `session_config`; retry for `wait_s`, or until `stop` is set.

    Raises:
        SecurityError: the certificate is missing.
        SessionError: no router answers, or the address is in use; says what to do.
    """
    settings = session_config(
        profile, mode=mode, connect=connect, identity=identity, access=access, images=images
    )
    give_up = time.monotonic() + wait_s
    stop = stop or threading.Event()
    while True:
        try:
            return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
        except zenoh.ZError as error:
            if time.monotonic() < give_up and not stop.wait(RETRY_S):
                continue
            raise _explain(settings, error) from error


_RUST_PLACE = re.compile(r"\.? at \S+\.rs:\d+\.?")
"""Where in Zenoh's source an error was raised, on the computer that built it."""


def _explain(settings: dict[str, Any], error: Exception) -> SessionError:
    if settings["mode"] == "router":
        where = ", ".join(settings["listen"]["endpoints"])
        if "access_control" in settings and "Access control" in str(error):
            return SessionError(f"the router rejects its access control rules: {error}")
        return SessionError(
            f"the router cannot listen on {where}: {_RUST_PLACE.sub('', str(error))}. Is another "
            "program using that address? Run `vla-zenoh doctor`, or choose another address with "
            "--listen or session.listen"
        )
    where = ", ".join(settings["connect"]["endpoints"])
    tls = settings["transport"]["link"].get("tls")
    if tls is not None:
        return SessionError(
            f"no Zenoh router answers at {where}, or it and {tls['connect_certificate']} with its "
            "key and ca.pem do not fit. Check both with `vla-zenoh secure show`, here and on the "
            "router's host; start a router with `vla-zenoh node router` or `vla-zenoh up`"
        )
    return SessionError(
        f"no Zenoh router answers at {where}. Start one with `vla-zenoh node router`, or all "
        "nodes with `vla-zenoh up`; set another address with --connect or session.connect"
    )


def put_text(session: zenoh.Session, key: str, text: str) -> None:
    """Put plain text on a setting's key, as any Zenoh client could, with this session's source."""
    author = zenoh.SourceInfo(session.id, 0)
    encoding = zenoh.Encoding.TEXT_PLAIN
    session.put(key, text, encoding=encoding, source_info=author, **QOS[Kind.ORDER])


def covers(wide: str, narrow: str) -> bool:
    """Whether the expression `wide` includes every key of `narrow`; no invalid one does."""
    try:
        return zenoh.KeyExpr.autocanonize(wide).includes(zenoh.KeyExpr.autocanonize(narrow))
    except zenoh.ZError:
        return False


PATIENCE_S, ATTEMPTS = 1.0, 5
ANSWERS = 2
"""A single answer in time may lack a node that is alive; this has been observed."""


def alive_nodes(
    session: zenoh.Session, keys: Keys, name: str | None = None, *, routes: bool = False
) -> set[str]:
    """Names of a robot's nodes that are alive; with `name`, of this one only.

    `routes` means a router's session, which asks itself.

    Raises:
        NodeError: the router does not answer in time, so more nodes may be alive.
    """
    expression = keys.all_alive if name is None else keys.alive(name)
    found: set[str] = set()
    answers = 0
    for _ in range(ATTEMPTS):
        began_s = time.monotonic()
        replies = list(session.liveliness().get(expression, timeout=PATIENCE_S))
        found |= {last_chunk(str(r.ok.key_expr)) for r in replies if r.ok is not None}
        # A query that timed out ends like one that was answered completely.
        in_time = time.monotonic() - began_s < PATIENCE_S and all(r.ok for r in replies)
        # And one of a session that lost its router ends at once, without a reply.
        linked = routes or bool(session.info.routers_zid())
        answers += in_time and linked
        if answers == ANSWERS:
            return found
        if not linked:
            time.sleep(max(0.0, began_s + PATIENCE_S - time.monotonic()))
    raise NodeError(
        f"the router does not report within {PATIENCE_S:g} s which nodes of {keys.robot!r} are "
        "alive; it may be overloaded, or its access control may not know us. Try again"
    )


def alive_robots(session: zenoh.Session, keys: Keys) -> list[str]:
    """Names of robots below the root of `keys` whose command node is alive and visible to us, in
    order; incomplete if the router does not answer in time."""
    found: set[str] = set()
    for _ in range(ANSWERS):
        replies = session.liveliness().get(keys.all_robots, timeout=PATIENCE_S)
        named = [Keys.of(str(r.ok.key_expr), keys.root) for r in replies if r.ok is not None]
        found |= {one.robot for one in named if one is not None}
    return sorted(found)
