"""Warnings about a valid profile."""

from __future__ import annotations

from collections.abc import Iterator

from vla_zenoh.profile.profile import Profile
from vla_zenoh.profile.session import ANYWHERE, address_of, is_loopback


def advice(profile: Profile) -> list[str]:
    """One warning a line, each beginning with the path that it is about."""
    return [
        *_network(profile),
        *_placement(profile),
        *_timing(profile),
    ]


def _network(profile: Profile) -> Iterator[str]:
    session = profile.session
    if session.insecure:
        where = "any network" if any(map(_is_anywhere, session.listen)) else "the network"
        yield (
            f"session.insecure: anyone on {where} of the router's computer can command this "
            "robot; make certificates with `vla-zenoh secure init`"
        )
    if len(profile.hosts) < 2:
        return
    routers = [name for name, host in profile.hosts.items() if "router" in host.nodes]
    if routers and all(is_loopback(endpoint) for endpoint in session.listen):
        yield (
            f"session.listen: the router on {routers[0]} is reachable on that computer only; "
            "give its address on the network"
        )
    for name, host in profile.hosts.items():
        endpoints = session.connect if host.connect is None else host.connect
        if routers and name not in routers and all(is_loopback(e) for e in endpoints):
            yield (
                f"hosts.{name}: looks for the router on itself, and it runs on {routers[0]}; "
                f"give that computer's address in hosts.{name}.connect (a tunnel excepted)"
            )


def _is_anywhere(endpoint: str) -> bool:
    return address_of(endpoint).startswith(ANYWHERE)


def _placement(profile: Profile) -> Iterator[str]:
    hosts = profile.hosts.values()
    running = {kind for host in hosts for kind in host.nodes}
    if "router" not in running:
        yield "hosts: none runs the router; start one elsewhere, at session.connect"
    if "command" not in running:
        yield "hosts: none runs the command node; nothing will move"
    if "sim" not in running and profile.robot.driver == "sim":
        yield "hosts: none runs the simulator, and robot.driver is sim"
    for node in ("ros2", "arm"):
        if node not in running and profile.robot.node == node:
            yield f"hosts: none runs the node {node}, and robot.driver is {profile.robot.driver}"
    for what, known, used in (
        (
            "cameras",
            tuple(profile.cameras),
            {c for host in hosts for c in profile.cameras_of(host)},
        ),
        ("workers", profile.workers, {w for host in hosts for w in profile.workers_of(host)}),
    ):
        from_ros2 = {n for n, c in profile.cameras.items() if c.source.startswith("ros2:")}
        idle = [name for name in known if name not in used and name not in from_ros2]
        if idle:
            yield f"{what}: no host runs {', '.join(idle)}"
    for name, host in profile.hosts.items():
        for kind, named in (("camera", host.cameras), ("worker", host.workers)):
            if named is not None and kind not in host.nodes:
                yield f"hosts.{name}.{kind}s: has no effect without {kind} in hosts.{name}.nodes"


def _timing(profile: Profile) -> Iterator[str]:
    for name, camera in profile.cameras.items():
        if camera.rate_hz * profile.timing.max_observation_age_s < 1:
            yield (
                f"cameras.{name}.rate_hz: a picture every {1 / camera.rate_hz:.3g} s is older than "
                "timing.max_observation_age_s before the next one comes"
            )
