"""Checks of access: the router, the certificates of this host, and the rules of the profile."""

from __future__ import annotations

import datetime as dt
import re
import socket
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vla_zenoh.errors import MissingExtraError, SecurityError, VlaZenohError
from vla_zenoh.lab.certificates.bridge import NODE as BRIDGE
from vla_zenoh.lab.certificates.lab_certificates import unused_certificates
from vla_zenoh.lab.doctor.access_check import AccessVerdict, check_access, read_access, try_identity
from vla_zenoh.lab.doctor.needs import HostFinding, judged
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.profile.schema import is_loopback

if TYPE_CHECKING:
    from vla_zenoh.security.certificates import Entry

SHOWN_FAULTS = 6
SERVERS = ("router", BRIDGE)
"""Nodes whose certificates are not presented to the router."""


def access(profile: Profile, file: Path | None, also: Sequence[str]) -> Iterator[HostFinding]:
    """Certificates of this computer, rules of the profile, and the running router.

    Args:
        file: Zenoh's configuration with other rules; None: those of the profile.
        also: profiles of other robots of the router.
    """
    security = profile.session.security
    if security is None:
        yield _without(profile)
        return
    try:
        from vla_zenoh.security.certificates import CheckedStore

        store = CheckedStore(security.folder)
        host = store.this_host(security.host)
        entries = store.entries(dt.datetime.now(dt.UTC), host)
    except (MissingExtraError, SecurityError) as error:
        yield HostFinding("certificates", "fail", str(error))
        return
    yield certificates(host, entries)
    for path, why in unused_certificates(profile, entries).items():
        yield HostFinding(f"certificate {path.name}", "warn", why)
    try:
        given = None if file is None else read_access(file)
        yield from map(rules, check_access(profile, given, [load_profile(name) for name in also]))
    except VlaZenohError as error:
        yield HostFinding("access", "fail", f"the rules could not be checked: {error}")
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


def rules(verdict: AccessVerdict) -> HostFinding:
    """Finding on the access of one identity."""
    name = f"access {verdict.identity.common_name}"
    if not verdict.faults:
        found = f"can do all {verdict.must} acts of its role, none of {verdict.must_not} others"
        return HostFinding(name, "ok", found)
    shown = list(verdict.faults[:SHOWN_FAULTS])
    if len(verdict.faults) > SHOWN_FAULTS:
        shown.append(f"and {len(verdict.faults) - SHOWN_FAULTS} more")
    return HostFinding(
        name,
        "fail",
        "\n".join(shown),
        "regenerate the router's rules: vla-zenoh node router --config > FILE",
    )


def _accepted(profile: Profile, entry: Entry) -> HostFinding:
    name = f"router takes {entry.node}@{entry.host}"
    try:
        why = try_identity(profile, entry.node)
    except VlaZenohError as error:
        return HostFinding(name, "warn", str(error))
    return judged(name, not why, why or "and grants it access", level="fail")


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
