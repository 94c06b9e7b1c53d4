"""Profile text that secures another profile with TLS and certificates."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vla_zenoh.errors import SecurityError
from vla_zenoh.profile import HostProfile, Profile
from vla_zenoh.profile.load import write_yaml
from vla_zenoh.profile.schema import address_of, is_loopback
from vla_zenoh.security.certificates import router_names
from vla_zenoh.security.roles import Role

HEAD = """\
# {name}, secured: only clients with a certificate of this lab are let in.
# Written by `vla-zenoh secure`.
# Every host of the lab uses this file, with its own folder of certificates:
#   {folder}/HOST
"""
PEOPLE = "    people:"


def tls_endpoint(endpoint: str, places: Mapping[str, str] | None = None) -> str:
    """An endpoint with TLS in place of a plain protocol, moved as by `moved_hosts`."""
    protocol, _, rest = endpoint.partition("/")
    address = address_of(endpoint)
    rest = (places or {}).get(address, address) + rest[len(address) :]
    return f"{protocol if protocol in ('tls', 'quic') else 'tls'}/{rest}"


def moved_hosts(profile: Profile, at: Mapping[str, str]) -> dict[str, str]:
    """New addresses of routers: ``HOST:PORT`` of the profile -> the same port elsewhere.

    Args:
        at: host that runs a router -> its address on the network.

    Raises:
        SecurityError: no router runs there.
    """
    out: dict[str, str] = {}
    for name, address in at.items():
        host = profile.hosts.get(name)
        if host is None or "router" not in host.nodes:
            runs = [n for n, h in profile.hosts.items() if "router" in h.nodes]
            raise SecurityError(f"no router runs on {name!r}; it does on: {', '.join(runs)}")
        shown = f"[{address}]" if ":" in address else address
        for endpoint in host.listen or profile.session.listen:
            port = address_of(endpoint).rpartition(":")[2]
            out[address_of(endpoint)] = f"{shown}:{port}"
    return out


def serving_addresses(profile: Profile, more: Iterable[str] = ()) -> list[str]:
    """Names and addresses for the certificates of a profile's routers."""
    return list(dict.fromkeys([*router_names(profile), "127.0.0.1", "localhost", *more]))


def profile_text(
    profile: Profile, extends: str, folder: Path, places: Mapping[str, str] | None = None
) -> str:
    """A profile file that extends `extends` and secures it.

    Args:
        profile: what `extends` leads to.
        extends: name of a profile, or a path.
        folder: of the certificates.
        places: see `moved_hosts`.
    """
    home = Path.home()
    shown = f"~/{folder.relative_to(home)}" if folder.is_relative_to(home) else str(folder)

    def secure(endpoints: Sequence[str]) -> list[str]:
        return [tls_endpoint(endpoint, places) for endpoint in endpoints]

    session: dict[str, Any] = {
        "listen": secure(profile.session.listen),
        "connect": secure(profile.session.connect),
        "insecure": False,
        "security": {"folder": shown, "people": {}},
    }
    body: dict[str, Any] = {
        "extends": extends,
        "about": f"{profile.about}, with certificates" if profile.about else "with certificates",
        "session": session,
    }
    bridge = profile.ros2.connect if profile.ros2 is not None else None
    if not all(map(is_loopback, bridge or ())):
        body["ros2"] = {"connect": [tls_endpoint(endpoint) for endpoint in bridge or ()]}
    if any(host.connect or host.listen or host.link for host in profile.hosts.values()):
        # A profile's hosts are replaced whole, so all of them are written.
        body["hosts"] = {name: _host(host, secure) for name, host in profile.hosts.items()}
    return HEAD.format(name=profile.name, folder=shown) + write_yaml(body)


def with_operator(text: str, host: str, role: Role) -> str:
    """The text of a profile with the role of the people at `host`; comments stay.

    Raises:
        SecurityError: it has no such list in the form that `profile_text` writes.
    """
    lines, entry = text.splitlines(keepends=True), f"      {host}: {role.value}\n"
    at = next(
        (n for n, line in enumerate(lines) if line.rstrip() in (PEOPLE, f"{PEOPLE} {{}}")), None
    )
    if at is None:
        raise SecurityError(
            "has no list of people to add to. Write it by hand:\nsession:\n  security:\n"
            f"{PEOPLE}\n{entry.rstrip()}"
        )
    rest = [line for line in lines[at + 1 :] if not line.startswith(f"      {host}:")]
    return "".join([*lines[:at], f"{PEOPLE}\n", entry, *rest])


def without_operator(text: str, host: str) -> str:
    """The text of a profile without the people at `host`, as `with_operator` wrote them."""
    lines = text.splitlines(keepends=True)
    at = next((n for n, line in enumerate(lines) if line.rstrip() == PEOPLE), len(lines))
    rest = [line for line in lines[at + 1 :] if not line.startswith(f"      {host}:")]
    if at < len(lines) and not (rest and rest[0].startswith(" " * 6)):
        lines[at] = f"{PEOPLE} {{}}\n"
    return "".join([*lines[: at + 1], *rest])


def with_robot_name(text: str, name: str) -> str:
    """The text of a profile whose robot is called `name`; comments stay.

    Raises:
        SecurityError: its section ``robot`` has another form than one key a line.
    """
    lines, entry = text.splitlines(keepends=True), f"  name: {name}\n"
    at = next((n for n, line in enumerate(lines) if line.startswith("robot:")), None)
    if at is None:
        return f"{text.rstrip()}\nrobot:\n{entry}"
    if lines[at].partition("#")[0].strip() != "robot:":
        raise SecurityError(f"has its section robot in one line. Write by hand:\nrobot:\n{entry}")
    own = at + 1
    while own < len(lines) and lines[own].startswith((" ", "#", "\n")):
        if lines[own].startswith("  name:"):
            return "".join([*lines[:own], entry, *lines[own + 1 :]])
        own += 1
    return "".join([*lines[: at + 1], entry, *lines[at + 1 :]])


def _host(host: HostProfile, secure: Callable[[Sequence[str]], list[str]]) -> dict[str, Any]:
    out = host.model_dump(mode="json", exclude_none=True)
    return out | {name: secure(out[name]) for name in ("connect", "listen", "link") if name in out}
