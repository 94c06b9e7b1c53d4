"""Runs the Zenoh router that the sessions of a profile connect to."""

from __future__ import annotations

import errno
import os
import socket
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import zenoh

from vla_zenoh.bus.bounded import Bounded
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session, session_config
from vla_zenoh.errors import NodeError, SecurityError
from vla_zenoh.profile import Profile
from vla_zenoh.profile.load import as_robot
from vla_zenoh.profile.schema import address_of, is_loopback
from vla_zenoh.runtime.certificate_expiry import CertificateExpiry
from vla_zenoh.security.names import UNCHANGED, Names, read_names
from vla_zenoh.security.roles import access_control
from vla_zenoh.security.store import Store

POLL_S = 0.25
REOPEN_S = 10.0
APART_S = 2.0
"""Between two routers that open anew for the same names. Where linked routers do so at once, Zenoh
1.9 can lose what the sessions of one subscribe to at the other, until they open anew themselves."""
MAX_CLIENTS = 64
RUNTIME_VARIABLE, RUNTIME = "ZENOH_RUNTIME", "(rx: (worker_threads: 16))"
"""A sample is forwarded by the thread that received it, which blocks on a stuck link. With Zenoh's
default of two threads, one bad link would delay all others, the arm's among them."""


def run_router(
    profile: Profile,
    stop: threading.Event,
    *,
    host: str | None = None,
    also: Sequence[Profile] = (),
) -> None:
    """Run a Zenoh router until `stop` is set, which serves the robots `also` as well.

    Zenoh reads its access rules when a session opens. So whenever names are revoked, renamed or
    retired it closes all links and opens anew: active arms brake, and wait to be activated.

    `host` is the name of this one; it matters if several have a router.

    Raises:
        SecurityError: the router's certificate is missing, or the names cannot be read.
        SessionError: the address is in use.
    """
    os.environ.setdefault(RUNTIME_VARIABLE, RUNTIME)
    wait_s = 0.0
    while not stop.is_set():
        names = _names(profile)
        seen, options = _session_of(profile, host, also, names)
        with open_session(seen.session, **options, wait_s=wait_s, stop=stop) as session:
            node = Node(options["identity"], seen, session, host=host, routes=True)
            _route(node, names, stop, _place(profile, options["identity"]) * APART_S)
            node.close()
        wait_s = REOPEN_S


def _place(profile: Profile, identity: str) -> int:
    """Place of this router among those of the profile's hosts."""
    hosts = [host for host, part in profile.hosts.items() if "router" in part.nodes]
    names = [profile.node_name(host, "router") for host in hosts]
    return names.index(identity) if identity in names else 0


def _route(node: Node, names: Names, stop: threading.Event, wait_s: float) -> None:
    """Report, until `stop` is set or there have been newer names for `wait_s`."""
    profile, session = node.profile, node.session
    expiry = CertificateExpiry(profile.session.security)
    clients = Clients(session)
    detail: dict[str, Any] = {"listen": list(profile.session.listen)}
    if profile.session.security is not None:
        # Certificates are required.
        detail |= {"security": "tls", "names": names.revision}
    else:
        here = all(map(is_loopback, profile.session.listen))
        detail["security"] = "loopback" if here else "insecure"
    newer_since_s: float | None = None
    while not stop.wait(POLL_S):
        detail |= {"clients": clients.known(), "links": len(list(session.info.links()))}
        if profile.session.security is not None:
            detail["certificates"] = expiry.outlook._asdict()
        node.publish_status("routing", detail=detail)
        now_s = time.monotonic()
        with suppress(SecurityError):  # it is being copied
            if newer_since_s is None and _names(profile).revision > names.revision:
                newer_since_s = now_s
        if newer_since_s is not None and now_s >= newer_since_s + wait_s:
            return


def _names(profile: Profile) -> Names:
    """Names that changed in a secured lab, noted beside the router's certificate."""
    security = profile.session.security
    if security is None:
        return UNCHANGED
    store = Store(security.folder)
    return read_names(store.folder / store.this_host(security.host))


class Clients:
    """Clients of a router, with those that left: a CLI command connects only for a moment."""

    def __init__(self, session: zenoh.Session) -> None:
        self._lock = threading.Lock()
        self._known: Bounded[str, list[str]] = Bounded(MAX_CLIENTS)
        handler = zenoh.handlers.Callback(self._heard, indirect=False)
        self._listener = session.info.declare_link_events_listener(handler, history=True)

    def _heard(self, event: zenoh.LinkEvent) -> None:
        if event.kind != zenoh.SampleKind.PUT:
            return
        number = str(event.link.zid)
        with self._lock:
            self._known[number] = [event.link.auth_identifier or "", str(event.link.dst)]

    def known(self) -> dict[str, list[str]]:
        """Session number -> [name of the certificate or empty, address] of the last
        `MAX_CLIENTS`."""
        with self._lock:
            return dict(self._known)


def reject_taken(endpoints: Sequence[str]) -> None:
    """Make sure that a router can listen on TCP endpoints.

    Raises:
        NodeError: another program uses the port, or this computer lacks the address.
    """
    for endpoint in endpoints:
        host, _, port = address_of(endpoint).rpartition(":")
        if endpoint.partition("/")[0] not in ("tcp", "tls") or not port.isdigit() or port == "0":
            continue
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            with socket.socket(family) as free:
                free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                free.bind((host.strip("[]"), int(port)))
        except OSError as error:
            hint = (
                f"another program has port {port} (`ss -ltnp 'sport = :{port}'` names it), and it "
                "is not a Zenoh router that this profile can use. End it, or choose another port"
                if error.errno == errno.EADDRINUSE
                else f"{error.strerror or error}. Choose another address"
            )
            raise NodeError(
                f"the router cannot listen on {endpoint}: {hint} with session.listen and "
                "session.connect"
            ) from error


def router_config(
    profile: Profile, *, host: str | None = None, also: Sequence[Profile] = ()
) -> dict[str, Any]:
    """Zenoh configuration of the profile's router, for `run_router` or the program ``zenohd``.

    Raises:
        SecurityError: the router's certificate is missing.
    """
    profile, options = _session_of(profile, host, also, _names(profile))
    return session_config(profile.session, **options)


def _session_of(
    profile: Profile, host: str | None, also: Sequence[Profile], names: Names
) -> tuple[Profile, dict[str, Any]]:
    """The profile as seen from `host`, and the router's options for `open_session`.

    The router of a retired robot reports to the next one: nobody may hear the former.
    """
    served = [
        as_robot(each, now)
        for each in (profile, *also)
        if (now := names.robots.get(each.robot.name, each.robot.name))
    ]
    access = None if profile.session.security is None else access_control(served, names)
    profile = as_robot(profile, served[0].robot.name) if served else profile
    options: dict[str, Any] = {"mode": "router", "identity": "router", "access": access}
    if host is None:
        hosts = [name for name, part in profile.hosts.items() if "router" in part.nodes]
        host = hosts[0] if len(hosts) == 1 else None
    if host is None or host not in profile.hosts:
        return profile, options
    part = profile.hosts[host]
    if part.listen is not None:
        session = profile.session.model_copy(update={"listen": part.listen})
        profile = profile.model_copy(update={"session": session})
    return profile, {**options, "identity": profile.node_name(host, "router"), "connect": part.link}
