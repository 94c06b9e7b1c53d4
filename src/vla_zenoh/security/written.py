"""The part of a profile that says how a lab is secured, as YAML text."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

from vla_zenoh.errors import SecurityError
from vla_zenoh.profile import HostProfile, Profile
from vla_zenoh.profile.session import ANYWHERE, address_of, host_of
from vla_zenoh.security.identity import Role

HEAD = """\
# {name}, secured: only who has a certificate of this lab is heard. Written by `vla-zenoh secure`.
# Every host of the lab uses this file, with its own folder of certificates:
#   {folder}/HOST
"""
PEOPLE = "    people:"


def secured(endpoint: str) -> str:
    """The endpoint with TLS in place of a plain protocol."""
    protocol, _, rest = endpoint.partition("/")
    return endpoint if protocol in ("tls", "quic") else f"tls/{rest}"


def serving_addresses(profile: Profile, more: Iterable[str] = ()) -> list[str]:
    """Names and addresses under which the routers of a profile are looked for."""
    session = profile.session
    endpoints = [*session.connect, *session.listen]
    for host in profile.hosts.values():
        endpoints += [*(host.connect or ()), *(host.listen or ()), *(host.link or ())]
    named = [host_of(e) for e in endpoints if not address_of(e).startswith(ANYWHERE)]
    return [name for name in dict.fromkeys([*named, "127.0.0.1", "localhost", *more]) if name]


def profile_text(profile: Profile, extends: str, folder: Path) -> str:
    """A profile file that extends `extends` and secures it.

    Args:
        profile: what `extends` leads to.
        extends: name of a profile, or a path.
        folder: of the certificates.
    """
    shown = _with_tilde(folder)
    session: dict[str, Any] = {
        "listen": _secured(profile.session.listen),
        "connect": _secured(profile.session.connect),
        "insecure": False,
        "security": {"folder": shown, "people": {}},
    }
    body: dict[str, Any] = {
        "extends": extends,
        "about": f"{profile.about}, with certificates" if profile.about else "with certificates",
        "session": session,
    }
    if any(host.connect or host.listen or host.link for host in profile.hosts.values()):
        # A profile's hosts are replaced whole, so all of them are written.
        body["hosts"] = {name: _host(host) for name, host in profile.hosts.items()}
    text = yaml.safe_dump(body, sort_keys=False, width=100, default_flow_style=None)
    return HEAD.format(name=profile.name, folder=shown) + _people_on_lines(text)


def with_person(text: str, host: str, role: Role) -> str:
    """The text of a profile, with what a person at `host` may do.

    Raises:
        SecurityError: it has no such list, in the form in which `profile_text` writes it.
    """
    lines = text.splitlines(keepends=True)
    for at, line in enumerate(lines):
        if line.rstrip() in (PEOPLE, f"{PEOPLE} {{}}"):
            lines[at] = f"{PEOPLE}\n"
            kept = [
                other
                for number, other in enumerate(lines)
                if number <= at or not re.fullmatch(rf"\s{{6}}{re.escape(host)}:.*\s*", other)
            ]
            kept.insert(at + 1, f"      {host}: {role.value}\n")
            return "".join(kept)
    raise SecurityError(
        f"has no list of people to add to. Write it by hand:\nsession:\n  security:\n{PEOPLE}\n"
        f"      {host}: {role.value}"
    )


def _people_on_lines(text: str) -> str:
    """The security section in block style, so that lines can be added to it."""
    found = re.search(r"^  security: \{folder: (?P<folder>.*), people: \{\}\}\n", text, re.M)
    if found is None:
        return text.replace("    people: {}\n", f"{PEOPLE} {{}}\n")
    block = f"  security:\n    folder: {found['folder']}\n{PEOPLE} {{}}\n"
    return text[: found.start()] + block + text[found.end() :]


def _host(host: HostProfile) -> dict[str, Any]:
    out: dict[str, Any] = {"nodes": list(host.nodes)}
    for name in ("connect", "listen", "link"):
        endpoints: Sequence[str] | None = getattr(host, name)
        if endpoints is not None:
            out[name] = _secured(endpoints)
    for name in ("cameras", "workers"):
        names = getattr(host, name)
        if names is not None:
            out[name] = list(names)
    return out


def _secured(endpoints: Sequence[str]) -> list[str]:
    return [secured(endpoint) for endpoint in endpoints]


def _with_tilde(folder: Path) -> str:
    try:
        return f"~/{folder.relative_to(Path.home())}"
    except ValueError:
        return str(folder)
