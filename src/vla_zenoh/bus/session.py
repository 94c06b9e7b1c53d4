"""Zenoh sessions: the one place that opens them, and how each kind of key is carried."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping
from typing import Any, Literal

import zenoh

from vla_zenoh.errors import SessionError
from vla_zenoh.keys import Kind
from vla_zenoh.profile import SessionProfile
from vla_zenoh.profile.session import SecurityProfile, second_link
from vla_zenoh.security.store import Store

Mode = Literal["client", "router"]
"""Peers are none of ours: a router does not forward them to each other."""
RETRY_S = 0.1
CLIENT, LINKED, FIRST = 1, 2, 3
"""Leases that a client, a router that connects to others, and one that does not announce: so long
the other side waits. Who connects has to wait longer than who is connected to. For who comes back
while the other still holds its old transport is taken for a second link of that, and its keys are
mixed up (Zenoh 1.10; eclipse-zenoh/zenoh#2806)."""
ROUTER_BLOCKS_US = 200_000
"""A router waits so long for a link that does not take what must arrive, then closes it."""
MAX_MESSAGE_BYTES = 160 * 1024 * 1024
"""Zenoh itself takes no larger sample from a link; the largest picture we read has 96 MiB."""

_DROP = zenoh.CongestionControl.DROP
_BLOCK = zenoh.CongestionControl.BLOCK
QOS: dict[Kind, dict[str, Any]] = {
    Kind.FRAME: {"congestion_control": _DROP, "priority": zenoh.Priority.DATA_LOW},
    Kind.STATE: {"congestion_control": _DROP, "priority": zenoh.Priority.INTERACTIVE_HIGH},
    Kind.CONTROL: {
        "congestion_control": _DROP,
        "priority": zenoh.Priority.REAL_TIME,
        "express": True,
    },
    Kind.ORDER: {
        "congestion_control": _BLOCK,
        "priority": zenoh.Priority.REAL_TIME,
        "express": True,
    },
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
    """Zenoh's configuration as plain data, before it is handed to its strict parser.

    Args:
        profile: the session section.
        mode: of the session.
        connect: overrides the profile's endpoints; of a router: other routers.
        identity: which node's certificate is shown; None: that of the people at this computer.
        access: section ``access_control``, of a router.
        pictures: of a client: the link that pictures have to themselves.

    Raises:
        SecurityError: the certificate is not there.
    """
    routes = mode == "router"
    targets = (connect or ()) if routes else (connect or profile.connect)
    leases = (LINKED if targets else FIRST) if routes else CLIENT
    blocks_us = ROUTER_BLOCKS_US if routes else FIRST * profile.lease_ms * 1000
    settings: dict[str, Any] = {
        "mode": mode,
        "listen": {"endpoints": _listening(profile) if routes else []},
        "connect": {
            "endpoints": [second_link(e) if images else e for e in targets],
            # A router waits for nobody, and goes on looking for the others.
            "timeout_ms": -1 if routes else 0,
            "exit_on_failure": not routes,
            "retry": {
                "period_init_ms": 100,
                "period_max_ms": 500,
                "period_increase_factor": 2,
            },
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": profile.shared_memory},
            "link": {
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
                "tx": {
                    "lease": leases * profile.lease_ms,
                    "keep_alive": 4,
                    "queue": {
                        "congestion_control": {"block": {"wait_before_close": blocks_us}},
                    },
                },
            },
        },
    }
    if profile.security is not None:
        settings["transport"]["link"]["tls"] = _tls(profile.security, identity, routes)
    if access is not None:
        settings["access_control"] = dict(access)
    return settings


def _listening(profile: SessionProfile) -> list[str]:
    if not profile.separate_links:
        return list(profile.listen)
    return [link for endpoint in profile.listen for link in (endpoint, second_link(endpoint))]


def _tls(security: SecurityProfile, identity: str | None, routes: bool) -> dict[str, Any]:
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
    """A session as the profile says.

    Args:
        profile: the session section.
        mode: of the session.
        connect: overrides the profile's endpoints; of a router: other routers.
        identity: which node this is, for its certificate; None: the people at this computer.
        access: who may do what, of a router.
        pictures: the link that pictures have to themselves, where ``separate_links``.
        wait_s: keep trying for this long.
        stop: give up at once when it is set.

    Raises:
        SecurityError: the certificate is not there.
        SessionError: nobody answers there, or the address is taken; says what to do.
    """
    settings = session_config(
        profile,
        mode=mode,
        connect=connect,
        identity=identity,
        access=access,
        images=images,
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


def _explain(settings: dict[str, Any], error: Exception) -> SessionError:
    if settings["mode"] == "router":
        where = ", ".join(settings["listen"]["endpoints"])
        if "access_control" in settings and "Access control" in str(error):
            return SessionError(f"the router does not take its rules of access: {error}")
        return SessionError(
            f"the router cannot listen on {where}: {error}. Is another router or program there? "
            "`vla-zenoh doctor` tells; choose another address with --listen or session.listen"
        )
    where = ", ".join(settings["connect"]["endpoints"])
    tls = settings["transport"]["link"].get("tls")
    if tls is not None:
        return SessionError(
            f"no Zenoh router answers at {where}, or it refuses the certificate "
            f"{tls['connect_certificate']}. `vla-zenoh secure show` says whether that is good; "
            "start a router with `vla-zenoh node router` or `vla-zenoh up`"
        )
    return SessionError(
        f"no Zenoh router answers at {where}. Start one with `vla-zenoh node router`, or all "
        "nodes with `vla-zenoh up`; another address is given with --connect or session.connect"
    )
