"""Check of a profile: what `vla-zenoh up` would fail with, before anything is started.

The parts are made as the nodes make them: kinematics, simulated world, ROS 2 messages, models.
Nothing is connected, and no weights are loaded.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from vla_zenoh import plugins
from vla_zenoh.cli.options import effective_profile
from vla_zenoh.errors import PluginError, ProfileError, VlaZenohError, nearest
from vla_zenoh.lab.profile.robot_check import (
    ProfileFault,
    arm,
    barriers_advice,
    braking_advice,
    drivers,
    joints_advice,
    mounts,
    simulator,
    singular_advice,
    table_advice,
)
from vla_zenoh.policy.loader import find_worker, make_policy
from vla_zenoh.profile import HostProfile, Profile, load_with_lines
from vla_zenoh.profile.schema import ANYWHERE, address_of, host_of, is_loopback, names_file
from vla_zenoh.profile.section import located, located_fault


class ProfileReport(NamedTuple):
    """Result of a check.

    Args:
        errors: why `up` would fail, each with file, line and place.
        advice: what is questionable, or missing on a computer that does not need it.
    """

    errors: list[str]
    advice: list[str]


def check_profile(
    name: str,
    host: str | None = None,
    connect: list[str] | None = None,
    listen: list[str] | None = None,
    *,
    sim: bool = False,
) -> ProfileReport:
    """Check a profile as `up` does before it starts the nodes.

    Args:
        name: of the profile, or its path.
        host: which of its hosts this computer is; None: the only one, or unknown. What a node needs
            is an error where it runs, and advice elsewhere.
        sim: with its robot simulated.
    """
    try:
        loaded, lines = load_with_lines(name)
        profile = effective_profile(loaded, connect, listen, sim=sim)
    except ProfileError as error:
        return ProfileReport(str(error).splitlines(), [])
    if host is None and len(profile.hosts) == 1:
        host = next(iter(profile.hosts))
    if host is not None and host not in profile.hosts:
        known = ", ".join(profile.hosts)
        where = located(("hosts",), f"has no {host!r}{nearest(host, profile.hosts)}", lines)
        return ProfileReport([f"{where} It has: {known}"], [])
    found = [*arm(profile), *mounts(profile), *simulator(profile), *drivers(profile)]
    found += _workers(profile, name)
    here: set[str] = set()  # nodes and workers of this computer, as far as its host is known
    if host is not None:
        part = profile.hosts[host]
        here = {*part.nodes, *profile.workers_of(part)}
        found += [*_cameras(profile, part), *_router(profile, host), *_certificates(profile, host)]
    ours = {kind for part in profile.hosts.values() for kind in part.nodes}
    errors: list[str] = []
    hints = advice(profile)
    for place, why, node, other in found:
        if node == "arm" and node not in ours:  # another program is the robot
            continue
        if not node or node in here:
            fault = (place, why, (other,)) if other else (place, why)
            errors.append(located_fault(fault, lines))
        else:
            hints.append(f"{'.'.join(place)}: on this computer: {why}")
    hints += [
        *barriers_advice(profile),
        *table_advice(profile),
        *joints_advice(profile),
        *singular_advice(profile),
        *braking_advice(profile),
    ]
    return ProfileReport(list(dict.fromkeys(errors)), list(dict.fromkeys(hints)))


# -- cameras ----------------------------------------------------------------------------------
def _cameras(profile: Profile, part: HostProfile) -> Iterator[ProfileFault]:
    """Cameras that no plug-in reads, and files of recorded ones."""
    for camera in profile.cameras_of(part):
        source = profile.cameras[camera].source
        path = Path(source.partition(":")[2]).expanduser()
        place = ("cameras", camera, "source")
        try:
            plugins.load(plugins.CAMERAS, source.partition(":")[0])
        except PluginError as error:
            yield ProfileFault(place, str(error), "camera")
        if names_file(source) and not path.exists():
            yield ProfileFault(place, f"there is no file or folder {path}", "camera")


# -- workers ----------------------------------------------------------------------------------
def _workers(profile: Profile, name: str) -> Iterator[ProfileFault]:
    """Models, made as a worker makes them, and what they need of the profile."""
    for worker in profile.workers:
        place = own = ("models", worker) if worker in profile.models else ("workers",)
        options = profile.options.get(worker, {})
        try:
            _, model = find_worker(worker, profile.models)
        except VlaZenohError as error:
            yield ProfileFault(place, str(error), worker)
            continue
        if worker in profile.options:
            place = ("options", worker)
        try:
            if model.missing():  # it gets an environment of its own, and is not made here
                model.check_options(options)
                continue
            with contextlib.redirect_stdout(sys.stderr):  # a model's output is not the result
                policy = make_policy(model, options, profile=name)
        except VlaZenohError as error:
            yield ProfileFault(place, str(error), worker)
            continue
        from vla_zenoh.control.policy_check import spec_errors

        for _, _, why in spec_errors(profile, policy.spec):
            yield ProfileFault(own, f"worker {worker!r}: {why}")


# -- network ----------------------------------------------------------------------------------
def _router(profile: Profile, host: str) -> Iterator[ProfileFault]:
    """The router of this host, and whether its own nodes find it."""
    part, session = profile.hosts[host], profile.session
    if "router" not in part.nodes:
        return
    listen = session.listen if part.listen is None else part.listen
    connect = session.connect if part.connect is None else part.connect
    if not any(_ends_at(target, endpoint) for target in connect for endpoint in listen):
        place = ("session", "connect") if part.connect is None else ("hosts", host, "connect")
        yield ProfileFault(
            place,
            f"leads to {', '.join(connect)}, and the router of this host listens on "
            f"{', '.join(listen)}: its nodes would not find it. Give both the same port",
        )


def _ends_at(target: str, listening: str) -> bool:
    """Whether a connection to `target` on this computer can end at an endpoint `listening`."""
    there, here = address_of(target), address_of(listening)
    if not (host_of(target) and host_of(listening)):
        return there == here
    same_protocol = target.partition("/")[0] == listening.partition("/")[0]
    return same_protocol and there.rpartition(":")[2] == here.rpartition(":")[2]


def _certificates(profile: Profile, host: str) -> Iterator[ProfileFault]:
    """Certificates of the nodes of this host."""
    security = profile.session.security
    if security is None:
        return
    from vla_zenoh.security.roles import PEOPLE, identities_of
    from vla_zenoh.security.store import Store

    people = {role.value for role in PEOPLE}
    for identity in identities_of(profile, host):
        if identity.node in people or identity.role in PEOPLE or identity.worker == "teleop":
            continue
        try:
            Store(security.folder).identity_files(host, identity.node, security.people)
        except VlaZenohError as error:
            yield ProfileFault(("session", "security"), str(error))
            return


# -- advice -----------------------------------------------------------------------------------
def advice(profile: Profile) -> list[str]:
    """Warnings about a valid profile, each beginning with the path that it is about."""
    return [*_guesses(profile), *_network(profile), *_placement(profile), *_timing(profile)]


def _guesses(profile: Profile) -> Iterator[str]:
    if profile.unconfirmed:
        yield (
            f"unconfirmed: guessed and not confirmed: {', '.join(profile.unconfirmed)}. A "
            "simulated arm is activated all the same, a real one is not: look at each, correct "
            "it, and delete its line"
        )


def _network(profile: Profile) -> Iterator[str]:
    session = profile.session
    if session.insecure:
        anywhere = any(address_of(each).startswith(ANYWHERE) for each in session.listen)
        where = "any network" if anywhere else "the network"
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
            yield (
                f"hosts: none runs the node {node}, and robot.driver is {profile.robot.driver}; "
                "start it, or the program that is the robot, by hand"
            )
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
