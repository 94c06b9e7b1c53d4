"""Whether strangers are kept out, and whether everybody else can do their part."""

from __future__ import annotations

import datetime as dt
import re
import socket
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from vla_zenoh.errors import MissingExtraError, SecurityError, VlaZenohError
from vla_zenoh.lab.doctor.finding import HostFinding
from vla_zenoh.profile import Profile
from vla_zenoh.profile.session import is_loopback
from vla_zenoh.security.bridge import NODE as BRIDGE
from vla_zenoh.security.identity import Identity
from vla_zenoh.security.store import Entry, Store
from vla_zenoh.security.unused_certificates import unused_certificates

SHOWN_FAULTS = 6
SERVERS = ("router", BRIDGE)
"""Whose certificates are not shown to the router."""


class Tried(Protocol):
    """What came of trying everything in the name of one identity."""

    @property
    def identity(self) -> Identity: ...
    @property
    def must(self) -> int: ...
    @property
    def must_not(self) -> int: ...
    @property
    def faults(self) -> tuple[str, ...]: ...


def access(
    profile: Profile,
    now: dt.datetime,
    check_access: Callable[[], Sequence[Tried]],
    try_identity: Callable[[str], str],
) -> Iterator[HostFinding]:
    """The certificates of this computer, the rules of the profile, and what the router makes of it.

    Args:
        profile: the lab.
        now: UTC.
        rehearse: tries the rules with real sessions.
        try_identity: shows the certificate of a node of this computer to the running router;
            returns what is wrong.
    """
    security = profile.session.security
    if security is None:
        yield _without(profile)
        return
    try:
        store = Store(security.folder)
        host = store.this_host(security.host)
        entries = store.entries(now, host)
    except (MissingExtraError, SecurityError) as error:
        yield HostFinding("certificates", "fail", str(error))
        return
    yield certificates(host, entries)
    for path, why in unused_certificates(profile, entries).items():
        yield HostFinding(f"certificate {path.name}", "warn", why)
    try:
        yield from map(rules, check_access())
    except VlaZenohError as error:
        yield HostFinding("access", "fail", f"the rules could not be tried: {error}")
    for entry in entries:
        if entry.node not in SERVERS and not entry.faults:
            yield _accepted(entry, try_identity)


def certificates(host: str, entries: Sequence[Entry]) -> HostFinding:
    """Whether those of this host are good, and for how long."""
    name = f"certificates of {host}"
    if not entries:
        return HostFinding(name, "fail", "there are none", f"vla-zenoh secure add {host}")
    faults = [f"{entry.path.name} {fault}" for entry in entries for fault in entry.faults]
    soon = [f"{entry.path.name} {entry.warning}" for entry in entries if entry.warning]
    if faults:
        said = "; ".join((*faults, *soon))
        return HostFinding(
            name, "fail", said, f"vla-zenoh secure add {host} --renew, and copy them"
        )
    if soon:
        return HostFinding(name, "warn", "; ".join(soon), f"vla-zenoh secure add {host} --renew")
    end = min(entry.certificate.not_after for entry in entries if entry.certificate)
    return HostFinding(name, "ok", f"{len(entries)}, all valid until {end:%Y-%m-%d}")


def rules(tried: Tried) -> HostFinding:
    """What one identity could and could not do."""
    name = f"access {tried.identity.common_name}"
    if not tried.faults:
        said = f"can do all {tried.must} things of its role, none of {tried.must_not} others"
        return HostFinding(name, "ok", said)
    shown = list(tried.faults[:SHOWN_FAULTS])
    if len(tried.faults) > SHOWN_FAULTS:
        shown.append(f"and {len(tried.faults) - SHOWN_FAULTS} more")
    return HostFinding(
        name,
        "fail",
        "\n".join(shown),
        "write the router's rules anew: vla-zenoh node router --config > FILE",
    )


def _accepted(entry: Entry, try_identity: Callable[[str], str]) -> HostFinding:
    name = f"router takes {entry.node}@{entry.host}"
    try:
        why = try_identity(entry.node)
    except VlaZenohError as error:
        return HostFinding(name, "warn", str(error))
    return HostFinding(name, "fail" if why else "ok", why or "and knows it")


def _without(profile: Profile) -> HostFinding:
    if all(map(is_loopback, profile.session.listen)):
        said = "no certificates; the router listens on this computer only"
        return HostFinding("access", "ok", said)
    return HostFinding(
        "access",
        "warn",
        "everybody on the network can command this robot",
        "vla-zenoh secure init makes certificates and rules",
    )


CONNECT_LIMIT_S = 1.0

_TCP = re.compile(r"(?:tcp|tls)/(?P<host>\[[^\]]+\]|[^:/?#]+):(?P<port>\d+)")


def router(endpoint: str, *, is_router: bool, try_zenoh: Callable[[str], str]) -> HostFinding:
    """A router answers at `endpoint`, or could be started there.

    Args:
        endpoint: as Zenoh writes it, ``tcp/127.0.0.1:7447``.
        is_router: the router is to run on this host.
        try_zenoh: opens a session there and closes it; returns the reason when it cannot.
    """
    name = f"router {endpoint}"
    match = _TCP.match(endpoint)
    if match is None:
        error = try_zenoh(endpoint)
        return _silent(name, error, is_router) if error else HostFinding(name, "ok", "answers")
    host, port = match["host"].strip("[]"), int(match["port"])
    try:
        socket.create_connection((host, port), timeout=CONNECT_LIMIT_S).close()
    except socket.gaierror:
        return HostFinding(
            name, "fail", f"no host is called {host!r}", "correct session.connect in the profile"
        )
    except OSError as error:
        return _silent(name, error.strerror or "no answer", is_router)
    if endpoint.startswith("tls/"):
        return HostFinding(
            name, "ok", "something listens; its certificate is looked at by the nodes"
        )
    error = try_zenoh(endpoint)
    if not error:
        return HostFinding(name, "ok", "answers")
    return HostFinding(
        name,
        "fail",
        f"the port is taken by something that does not speak Zenoh ({error})",
        f"see what it is: sudo ss -ltnp 'sport = :{port}'; stop it, or take another port in "
        "session.listen and session.connect of the profile",
    )


def _silent(name: str, reason: str, is_router: bool) -> HostFinding:
    if is_router:
        return HostFinding(name, "ok", f"none yet ({reason}); vla-zenoh up starts it")
    return HostFinding(
        name,
        "warn",
        f"no answer ({reason})",
        "start vla-zenoh up on the router's host, and open the port in its firewall",
    )
