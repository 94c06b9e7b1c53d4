"""Whether the sections of a profile fit each other."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator

from vla_zenoh.profile.ros2 import JOINT_COMMANDS, Ros2Gripper
from vla_zenoh.profile.schema import HostProfile, ProfileFields
from vla_zenoh.profile.section import Place
from vla_zenoh.profile.session import TRUSTED_PROTOCOLS, endpoint_faults, is_loopback
from vla_zenoh.pydantic_errors import nearest

Fault = tuple[Place, str]

ONLY_ONE = {
    "command": "the robot obeys one command node",
    "sim": "there is one simulated robot",
    "ros2": "the robot has one driver",
    "arm": "the robot has one driver",
}


def faults(profile: ProfileFields) -> list[Fault]:
    """(place, sentence) of everything that does not fit."""
    return [
        *_robot(profile),
        *_cameras(profile),
        *_ros2(profile),
        *_task(profile),
        *_serves(profile),
        *_unknown(("models",), profile.models, "workers", profile.workers),
        *_unknown(("options",), profile.options, "workers", profile.workers),
        *_hosts(profile),
    ]


def cameras_of(profile: ProfileFields, host: HostProfile) -> tuple[str, ...]:
    """Names of the cameras that `host` runs."""
    if "camera" not in host.nodes:
        return ()
    return tuple(profile.cameras) if host.cameras is None else host.cameras


def workers_of(profile: ProfileFields, host: HostProfile) -> tuple[str, ...]:
    """Names of the workers that `host` runs."""
    if "worker" not in host.nodes:
        return ()
    return profile.workers if host.workers is None else host.workers


def node_name(profile: ProfileFields, host: str, kind: str) -> str:
    """What a node of this kind is called on the bus: two hosts may each have one."""
    hosts = [name for name, part in profile.hosts.items() if kind in part.nodes]
    return kind if len(hosts) < 2 else f"{kind}-{host}"


def _robot(profile: ProfileFields) -> Iterator[Fault]:
    if profile.robot.driver == "ros2" and profile.ros2 is None:
        yield ("ros2",), "is missing: robot.driver is ros2"
    if profile.robot.driver == "arm" and profile.arm is None:
        yield ("arm",), "is missing: robot.driver is arm. Name the Python file, as arm: {file: ...}"
    joints = len(profile.robot.arm_joints)
    for name, values in profile.limits.joint:
        if len(values) not in (1, joints):
            yield (
                ("limits", "joint", name),
                f"has {len(values)} numbers for {joints} arm_joints: give one for all, or one each",
            )


def _cameras(profile: ProfileFields) -> Iterator[Fault]:
    for name, camera in profile.cameras.items():
        place = ("cameras", name, "source")
        if camera.source.startswith("ros2:") and profile.ros2 is None:
            yield place, f"is {camera.source!r}, which needs a section ros2"
        if camera.source.startswith("ros2:") and camera.fit_for_workers:
            yield ("cameras", name, "fit_for_workers"), "cannot be done for a camera of ROS 2"
        if camera.source.startswith("sim:") and profile.robot.driver != "sim":
            yield (
                place,
                f"is {camera.source!r}, and robot.driver is {profile.robot.driver}: nothing is "
                f"simulated. Give another source, or leave an inherited camera out: {name}: null",
            )
    if profile.ros2 is not None:
        yield from _unknown(("ros2", "cameras"), profile.ros2.cameras, "cameras", profile.cameras)


def _ros2(profile: ProfileFields) -> Iterator[Fault]:
    ros2, robot = profile.ros2, profile.robot
    if ros2 is None:
        return
    wanted = f"{robot.command}_command"
    if robot.driver == "ros2" and getattr(ros2, wanted) is None:
        yield ("ros2",), f"lacks {wanted}: robot.command is {robot.command}"
    for name, camera in ros2.cameras.items():
        source = profile.cameras[name].source if name in profile.cameras else ""
        if source.startswith("ros2:") and source.removeprefix("ros2:") != camera.topic:
            yield ("ros2", "cameras", name, "topic"), f"is not that of cameras.{name}: {source!r}"
    yield from _way_to_ros2(profile)
    joints = ros2.joint_command
    if joints is not None and joints.type not in JOINT_COMMANDS:
        wanted = " or ".join(JOINT_COMMANDS)
        yield ("ros2", "joint_command", "type"), f"is {joints.type}: joints are sent as {wanted}"
    gripper = ros2.gripper
    if gripper is not None and gripper.grasp and gripper.type != "franka_msgs/action/Move":
        yield ("ros2", "gripper", "grasp"), "goes with type franka_msgs/action/Move only"
    if gripper is not None:
        yield from _gripper_position(gripper, robot.gripper.joint_ends is not None)


def _gripper_position(gripper: Ros2Gripper, has_ends: bool) -> Iterator[Fault]:
    """A number that the gripper takes for another one opens it where it should close."""
    place = ("ros2", "gripper", "position")
    ends = "joint_open_rad and joint_shut_rad (_m where it slides) in robot.gripper"
    if gripper.says_width and gripper.position is not None:
        yield place, f"is not for {gripper.type}, which takes the width"
    elif gripper.position == "joint" and not has_ends:
        yield place, f"is joint, which needs {ends}"
    elif not (gripper.says_width or gripper.position or has_ends):
        yield (
            place,
            f"is missing: does the driver take the m between the fingers (width), those of one "
            f"finger (finger), or what its joint goes by (joint, with {ends})?",
        )


def _way_to_ros2(profile: ProfileFields) -> Iterator[Fault]:
    """Whoever speaks to the bridge moves the robot past our command node."""
    assert profile.ros2 is not None
    places, secured = profile.ros2.connect, profile.session.security is not None
    used = any("ros2" in host.nodes for host in profile.hosts.values())
    if places is None and secured and used:
        yield (
            ("ros2", "connect"),
            "is missing: in a secured lab the bridge has a router of its own. On the computer that "
            "runs the node ros2: connect: [tcp/127.0.0.1:7450]; on another one, where it takes "
            "this lab's certificates: connect: [tls/ADDRESS:7450]",
        )
    trusted = [endpoint.partition("/")[0] in TRUSTED_PROTOCOLS for endpoint in places or ()]
    for index, endpoint in enumerate(places or ()):
        why = ""
        if trusted[index] and not secured:
            why = "needs certificates: make them with `vla-zenoh secure init`"
        elif secured and not trusted[index] and (any(trusted) or not is_loopback(endpoint)):
            why = "lets everybody on the way command the robot: write tls/, or tcp/127.0.0.1:7450"
        if why:
            yield ("ros2", "connect", str(index)), why


def _task(profile: ProfileFields) -> Iterator[Fault]:
    if profile.task.worker not in profile.workers:
        yield (
            ("task", "worker"),
            f"{profile.task.worker!r} is not among workers"
            f"{nearest(profile.task.worker, profile.workers)} "
            f"Known: {', '.join(profile.workers) or 'none'}",
        )


def _serves(profile: ProfileFields) -> Iterator[Fault]:
    yield from _unknown(("serves",), profile.serves, "workers", profile.workers)
    for worker, robots in profile.serves.items():
        if profile.robot.name not in robots:
            yield (
                ("serves", worker),
                f"lacks {profile.robot.name}, the robot of this profile: name all that the worker "
                "serves, or leave it out",
            )


def _hosts(profile: ProfileFields) -> Iterator[Fault]:
    if not profile.hosts:
        yield ("hosts",), "is empty: name at least one host and its nodes"
    runs: dict[tuple[str, str], list[str]] = defaultdict(list)
    for name, host in profile.hosts.items():
        place = ("hosts", name)
        yield from _unknown((*place, "cameras"), host.cameras or (), "cameras", profile.cameras)
        yield from _unknown((*place, "workers"), host.workers or (), "workers", profile.workers)
        for kind in ("sim", "arm"):
            if kind in host.nodes and profile.robot.driver != kind:
                yield (*place, "nodes"), f"has {kind}, and robot.driver is {profile.robot.driver}"
        if "ros2" in host.nodes and profile.ros2 is None:
            yield (*place, "nodes"), "has ros2, which needs a section ros2"
        if host.pictures is not None and not workers_of(profile, host):
            yield (*place, "pictures"), "is for workers, and this host runs none"
        elif host.pictures is not None and "camera" in host.nodes:
            yield (*place, "pictures"), "is for cameras elsewhere, and this host has its own"
        for kind in host.nodes:
            if kind in ONLY_ONE:
                runs["nodes", kind].append(name)
        for camera in cameras_of(profile, host):
            runs["cameras", camera].append(name)
        for worker in workers_of(profile, host):
            runs["workers", worker].append(name)
        yield from _endpoints(profile, name, host)
    yield from _routers(profile)
    for (what, name), hosts in runs.items():
        if len(hosts) > 1:
            why = ONLY_ONE.get(name) if what == "nodes" else "each key has one writer"
            hint = "" if what == "nodes" else f". Say on each host which {what} it runs"
            yield (
                ("hosts", hosts[-1], what),
                f"{name} runs on {' and '.join(hosts)}: {why}{hint}",
            )


def _endpoints(profile: ProfileFields, name: str, host: HostProfile) -> Iterator[Fault]:
    for what in ("connect", "listen", "link"):
        endpoints = getattr(host, what)
        for index, why in endpoint_faults(
            endpoints or (), profile.session, listen=what == "listen"
        ):
            yield ("hosts", name, what, str(index)), why
        if endpoints is not None and what != "connect" and "router" not in host.nodes:
            yield ("hosts", name, what), "is for a router, and this host runs none"


def _routers(profile: ProfileFields) -> Iterator[Fault]:
    """Every router but one has to be told of another: they do not find each other."""
    alone = [n for n, host in profile.hosts.items() if "router" in host.nodes and not host.link]
    for name in alone[1:]:
        yield (
            ("hosts", name, "link"),
            f"is missing: routers do not find each other, and {alone[0]} runs one as well. Name "
            "its address, as link: [tcp/10.0.0.2:7447]",
        )


def _unknown(
    place: Place, named: Iterable[str], what: str, known: Iterable[str]
) -> Iterator[Fault]:
    for name in named:
        if name not in known:
            yield (
                place,
                f"{name!r} is not among {what}{nearest(name, known)} "
                f"Known: {', '.join(known) or 'none'}",
            )
