"""Checks of access: the router, the certificates of this host, and the rules of the profile."""

from __future__ import annotations

import datetime as dt
import re
import socket
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import MissingExtraError, SecurityError, VlaZenohError
from vla_zenoh.lab.doctor.needs import HostFinding, judged
from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import is_loopback
from vla_zenoh.security.bridge import NODE as BRIDGE

if TYPE_CHECKING:
    from vla_zenoh.security.certificates import Entry

REPLY_S = 2.0
SERVERS = ("router", BRIDGE)
"""Nodes whose certificates are not presented to the router."""


def access(profile: Profile) -> Iterator[HostFinding]:
    """Certificates of this computer, and whether the running router takes them."""
    security = profile.session.security
    if security is None:
        yield _without(profile)
        return
    try:
        from vla_zenoh.security.certificates import CheckedStore, unfit_certificates

        store = CheckedStore(security.folder)
        host = store.this_host(security.host)
        entries = store.entries(dt.datetime.now(dt.UTC), host)
    except (MissingExtraError, SecurityError) as error:
        yield HostFinding("certificates", "fail", str(error))
        return
    yield certificates(host, entries)
    for path, why in unfit_certificates(profile, entries).items():
        yield HostFinding(f"certificate {path.name}", "warn", why)
    for entry in entries:
        if entry.node not in SERVERS and not entry.faults:
            yield _accepted(profile, entry)


def certificates(host: str, entries: Sequence[Entry]) -> HostFinding:
    """Validity of the certificates of this host."""
    name = f"certificates of {host}"
    if not entries:
        return HostFinding(name, "fail", "none", f"vla-zenoh secure add {host}")
    faults = [f"{entry.path.name} {fault}" for entry in entries for fault in entry.faults]
    soon = [f"{entry.path.name} {entry.warning}" for entry in entries if entry.warning]
    found, advice = "; ".join((*faults, *soon)), f"vla-zenoh secure add {host} --renew"
    if faults:
        return HostFinding(name, "fail", found, f"{advice}, and copy them")
    if soon:
        return HostFinding(name, "warn", found, advice)
    end = min(entry.certificate.not_after for entry in entries if entry.certificate)
    return HostFinding(name, "ok", f"{len(entries)}, all valid until {end:%Y-%m-%d}")


def _accepted(profile: Profile, entry: Entry) -> HostFinding:
    name = f"router takes {entry.node}@{entry.host}"
    try:
        why = _refusal(profile, entry.node)
    except VlaZenohError as error:
        return HostFinding(name, "warn", str(error))
    return judged(name, not why, why or "and grants it access", level="fail")


def _refusal(profile: Profile, node: str | None) -> str:
    """Why the running router does not serve this computer's certificate for `node` (None: the
    operator's); empty: it does.

    Raises:
        SessionError: no router answers, or it rejects the certificate.
        SecurityError: no such certificate.
    """
    with open_session(profile.session, identity=node) as session:
        for selector in (profile.keys.all_alive, profile.keys.all_holding):
            replies = session.liveliness().get(selector, timeout=REPLY_S)
            if any(reply.ok is not None for reply in replies):
                return ""
    return (
        "the router accepts the certificate but grants it no access: its rules lack this name. "
        "Restart the router with this profile, copy the new certificates of this host if it was "
        "revoked, or check that any node is up"
    )


def _without(profile: Profile) -> HostFinding:
    local = all(map(is_loopback, profile.session.listen))
    here = "no certificates; the router listens on this computer only"
    found = here if local else "anyone on the network can command this robot"
    return judged("access", local, found, "vla-zenoh secure init makes certificates and rules")


CONNECT_LIMIT_S = 1.0

_TCP = re.compile(r"(?:tcp|tls)/(?P<host>\[[^\]]+\]|[^:/?#]+):(?P<port>\d+)")


def router(endpoint: str, *, is_router: bool, try_zenoh: Callable[[str], str]) -> HostFinding:
    """A router answers at `endpoint`, or could be started there.

    Args:
        endpoint: as Zenoh writes it, ``tcp/127.0.0.1:7447``.
        try_zenoh: opens a session there and closes it; returns why that failed, or "".
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
            name, "fail", f"no host has the name {host!r}", "correct session.connect in the profile"
        )
    except OSError as error:
        return _silent(name, error.strerror or "no answer", is_router)
    if endpoint.startswith("tls/"):
        return HostFinding(name, "ok", "a server listens; nodes check its certificate")
    error = try_zenoh(endpoint)
    return judged(
        name,
        not error,
        f"the port is in use by another program than Zenoh ({error})" if error else "answers",
        f"find it: sudo ss -ltnp 'sport = :{port}'; stop it, or set another port in "
        "session.listen and session.connect of the profile",
        "fail",
    )


def _silent(name: str, reason: str, is_router: bool) -> HostFinding:
    found = f"none yet ({reason}); vla-zenoh up starts it" if is_router else f"no answer ({reason})"
    advice = "start vla-zenoh up on the router's host, and open the port in its firewall"
    return judged(name, is_router, found, advice)
