"""Requirements of a profile on its hosts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import Profile

Level = Literal["ok", "warn", "fail"]


@dataclass(frozen=True, slots=True)
class HostFinding:
    """Result of one check.

    Args:
        level: ``ok``; ``warn``: works, with limits; ``fail``: something will not work.
        advice: the package, command or setting that helps; empty with ``ok``.
    """

    name: str
    level: Level
    found: str
    advice: str = ""


def judged(
    name: str, well: bool, found: str, advice: str = "", level: Level = "warn"
) -> HostFinding:
    """``ok`` where it is `well`, else `level` with the advice."""
    return HostFinding(name, "ok", found) if well else HostFinding(name, level, found, advice)


Role = Literal["base", "camera", "control", "sim"]

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"


@dataclass(frozen=True, slots=True)
class Needs:
    """Requirements on one host.

    Args:
        roles: sets of libraries that are required; others only give a warning.
        is_router: the router runs here: its port has to be free, or a router's already.
    """

    roles: frozenset[Role] = frozenset({"base"})
    is_router: bool = True
    endpoints: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    devices: tuple[str, ...] = ()


def nodes_on(profile: Profile, host: str | None) -> set[str]:
    """Kinds of nodes of a host, or of all together when `host` is None."""
    hosts = [profile.hosts[host]] if host is not None else profile.hosts.values()
    return {node for part in hosts for node in part.nodes}


def needs_of(profile: Profile, host: str | None = None) -> Needs:
    """Requirements of `profile` on one of its hosts, or on all together when `host` is None.

    Raises:
        ProfileError: the profile has no such host; lists those it has.
    """
    if host is not None and host not in profile.hosts:
        raise ProfileError(
            f"profile {profile.name!r} has no host {host!r}; it has: {', '.join(profile.hosts)}"
        )
    hosts = [profile.hosts[host]] if host is not None else list(profile.hosts.values())
    nodes = nodes_on(profile, host)
    roles: set[Role] = {"base"}
    if nodes & {"camera", "ros2"}:
        roles.add("camera")
    if nodes & {"command", "arm", "ros2"}:
        roles.add("control")
    if "sim" in nodes:
        roles.add("sim")
    cameras: set[str] = set()
    for part in hosts:
        if "camera" in part.nodes:
            cameras.update(profile.cameras if part.cameras is None else part.cameras)
    return Needs(
        roles=frozenset(roles),
        is_router="router" in nodes,
        endpoints=(hosts[0].connect if host is not None else None) or profile.session.connect,
        devices=tuple(
            source.removeprefix("v4l2:")
            for source in (profile.cameras[name].source for name in sorted(cameras))
            if source.startswith("v4l2:")
        ),
    )
