"""Check of a profile: what `vla-zenoh up` would fail with, before anything is started.

The parts are made as the nodes make them: kinematics, simulated world, ROS 2 messages, models.
Nothing is connected, and no weights are loaded.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from vla_zenoh import resources
from vla_zenoh.cli.options import effective_profile
from vla_zenoh.errors import (
    MissingExtraError,
    ProfileError,
    RecordError,
    ResourceError,
    VlaZenohError,
    nearest,
)
from vla_zenoh.lab.profile.advice import advice
from vla_zenoh.policy import ModelSpec
from vla_zenoh.policy.loader import ConstructorOptions, find_worker, inspect_robot, make_policy
from vla_zenoh.profile import POSE_JOINTS, Profile, load_with_lines
from vla_zenoh.profile.section import Place, located, own_place
from vla_zenoh.profile.session import ends_at

LONG_BRAKE_S = 2.5
"""`up` ends a robot's node 2.8 s after Ctrl-C, less the time until the node gets the signal.
See `STOP_ORDER` in `vla_zenoh.runtime.supervisor`."""
SIM, FILE, DEVICE = "sim:", "file:", "v4l2:/dev/"


class ProfileReport(NamedTuple):
    """Result of a check.

    Args:
        errors: why `up` would fail, each with file, line and place.
        advice: what is questionable, or missing on a computer that does not need it.
    """

    errors: list[str]
    advice: list[str]


class _Found(NamedTuple):
    """A fault.

    Args:
        place: in the profile.
        why: continues ``PLACE: ``.
        node: the node that fails, as kind or worker; "": no computer can run this profile.
        other: place that contradicts it, and is named where only that is in the checked file.
    """

    place: Place
    why: str
    node: str = ""
    other: Place | None = None


def check_profile(
    name: str,
    host: str | None = None,
    connect: list[str] | None = None,
    listen: list[str] | None = None,
) -> ProfileReport:
    """Check a profile as `up` does before it starts the nodes.

    Args:
        name: of the profile, or its path.
        host: which of its hosts this computer is; None: the only one, or unknown. What a node needs
            is an error where it runs, and advice elsewhere.
        connect: in place of session.connect.
        listen: in place of session.listen.
    """
    try:
        loaded, lines = load_with_lines(name)
        profile = effective_profile(loaded, connect, listen)
    except ProfileError as error:
        return ProfileReport(str(error).splitlines(), [])
    if host is None and len(profile.hosts) == 1:
        host = next(iter(profile.hosts))
    if host is not None and host not in profile.hosts:
        known = ", ".join(profile.hosts)
        where = located(("hosts",), f"has no {host!r}{nearest(host, profile.hosts)}", lines)
        return ProfileReport([f"{where} It has: {known}"], [])
    here = _nodes(profile, host)
    errors: list[str] = []
    hints = advice(profile)
    for check in CHECKS:
        for place, why, node, other in check(profile, name, host):
            if not node or node in here:
                places = [place, *([other] if other else [])]
                errors.append(located(own_place(places, lines), why, lines))
            else:
                hints.append(f"{'.'.join(place)}: on this computer: {why}")
    hints += [*_joints(profile), *_braking(profile)]
    return ProfileReport(list(dict.fromkeys(errors)), list(dict.fromkeys(hints)))


def _nodes(profile: Profile, host: str | None) -> set[str]:
    """Kinds of nodes, and workers, that this computer runs as far as its host is known."""
    part = profile.hosts.get(host or "")
    return set() if part is None else {*part.nodes, *profile.workers_of(part)}


# -- command node -----------------------------------------------------------------------------
def _arm(profile: Profile, name: str, host: str | None) -> Iterator[_Found]:
    """The arm as the command node makes it."""
    place = ("robot", "description")
    try:
        from vla_zenoh.control.limits import into_workspace
        from vla_zenoh.control.reachability import make_reachability_filter

        reach = make_reachability_filter(profile)
    except (ResourceError, MissingExtraError) as error:
        yield _Found(place, str(error), "command")
        return
    except ImportError as error:
        yield _Found(("robot",), f"its joints and links were not checked: {error}", "command")
        return
    except (ProfileError, RecordError) as error:
        yield _Found(("robot",), str(error))
        return
    except ValueError as error:  # from Pinocchio, for a file that is no URDF
        yield _Found(place, f"{profile.robot.description!r} cannot be read: {error}")
        return
    kinematics = reach.kinematics
    home_rad = kinematics.ordered(profile.robot.arm_joints, profile.robot.home_rad)
    for index, joint in enumerate(kinematics.arm_joints):
        low, high = float(kinematics.lower_rad[index]), float(kinematics.upper_rad[index])
        if not low <= home_rad[index] <= high:
            yield _Found(
                ("robot", "home_rad"),
                f"puts {joint} at {home_rad[index]:.3g} rad, its range is {low:.3g} to {high:.3g}",
            )
            return
    at_m = kinematics.forward(home_rad).position_m
    _, outside_m = into_workspace(profile.limits, at_m)
    if profile.robot.driver == "sim" and outside_m > profile.limits.step_m:
        where = ", ".join(f"{value:.3f}" for value in at_m)
        box = profile.limits.workspace
        yield _Found(
            ("robot", "home_rad"),
            f"with robot.home_rad the TCP is at ({where}) m, {outside_m:.3f} m outside "
            f"limits.workspace x {box.x_m} y {box.y_m} z {box.z_m}: the simulated arm starts there "
            "and could not be activated",
            other=("limits", "workspace"),
        )


def _joints(profile: Profile) -> Iterator[str]:
    """Advice for an arm with too few joints for any pose."""
    joints = len(profile.robot.arm_joints)
    if joints >= POSE_JOINTS:
        return
    try:
        from vla_zenoh.control.policy_check import immovable_axes
        from vla_zenoh.kinematics.kinematics import make_kinematics

        kinematics = make_kinematics(profile)
    except (ImportError, ValueError, VlaZenohError):
        return  # `_arm` says so
    home_rad = kinematics.ordered(profile.robot.arm_joints, profile.robot.home_rad)
    axes = ", ".join(immovable_axes(kinematics.jacobian(home_rad))) or "none"
    yield (
        f"robot.arm_joints: {joints} joints cannot reach every pose, as six can. At home the TCP "
        f"cannot move along or about these axes alone: {axes}. Steps of a model along them are "
        "shortened to nothing, activation is rejected while its newest chunk asks for one, and "
        "models with absolute poses or joint positions are rejected altogether"
    )


# -- robot node -------------------------------------------------------------------------------
def _simulator(profile: Profile, name: str, host: str | None) -> Iterator[_Found]:
    """The world as the simulator makes it."""
    simulated = any(camera.source.startswith(SIM) for camera in profile.cameras.values())
    running = {kind for part in profile.hosts.values() for kind in part.nodes}
    if profile.robot.driver != "sim" or not running & ({"sim", "camera"} if simulated else {"sim"}):
        return
    try:
        from vla_zenoh.simulation.appearance import AppearanceSwitcher
        from vla_zenoh.simulation.scene import scene_file
        from vla_zenoh.simulation.world import build_world
    except ImportError as error:
        yield _Found(("robot", "driver"), f"is sim: {MissingExtraError(str(error.name), 'sim')}")
        return
    try:
        scene_file(profile.sim.scene)
    except ResourceError as error:
        yield _Found(("sim", "scene"), str(error), "sim")
        yield _Found(("sim", "scene"), str(error), "camera" if simulated else "sim")
        return
    try:
        resources.robot_urdf(profile.robot.description)
        world = build_world(profile)
    except MissingExtraError:
        return  # `_arm` says so
    except (ResourceError, RecordError) as error:
        if Path(profile.robot.description).name in str(error) or "description" in str(error):
            yield from _not_simulated(profile, error)
        else:
            yield _Found(("sim",), str(error))
        return
    try:
        AppearanceSwitcher(world.model).apply(0, profile.sim.vary)
    except ResourceError as error:
        yield _Found(("sim", "vary"), str(error))
    known = [world.model.camera(index).name for index in range(world.model.ncam)]
    for camera, settings in profile.cameras.items():
        view = settings.source.removeprefix(SIM)
        if settings.source.startswith(SIM) and view not in known:
            yield _Found(
                ("cameras", camera, "source"),
                f"scene {profile.sim.scene!r} has no camera {view!r}{nearest(view, known)} "
                f"Known: {', '.join(known)}",
            )


def _not_simulated(profile: Profile, error: VlaZenohError) -> Iterator[_Found]:
    from vla_zenoh.control.reachability import make_reachability_filter

    try:
        urdf = resources.robot_urdf(profile.robot.description)
        make_reachability_filter(profile)
    except (ValueError, VlaZenohError):
        return  # `_arm` says so
    yield _Found(
        ("robot", "description"),
        f"the simulator (robot.driver: sim) cannot build {urdf.name}: {error}. It simulates the "
        "Franka Panda (extends: panda_sim); a real arm of another kind has driver arm or ros2",
        other=("robot", "driver"),
    )


def _robot_file(profile: Profile, name: str, host: str | None) -> Iterator[_Found]:
    """The class in `arm.file`, which is not made: that may move something."""
    if profile.arm is None or profile.robot.driver != "arm":
        return
    path = Path(profile.arm.file).expanduser()
    if not path.is_file():
        yield _Found(("arm", "file"), f"there is no file {profile.arm.file}", "arm")
        return
    try:
        inspect_robot(path, profile.arm.options)
    except VlaZenohError as error:
        yield _Found(("arm",), str(error), "arm")


def _ros2(profile: Profile, name: str, host: str | None) -> Iterator[_Found]:
    """Messages of the node ros2."""
    if profile.ros2 is None:
        return
    try:
        from vla_zenoh.robots.ros2.driver import Ros2Driver

        driver = Ros2Driver(profile)
        output = getattr(profile.ros2, f"{profile.robot.command}_command")
        if driver.has_arm and output is not None:
            driver.writing(output)
    except ImportError as error:
        why = str(MissingExtraError(str(error.name), "ros2"))
        yield _Found(("ros2",), why, "ros2")
    except ProfileError as error:
        yield _Found(("ros2",), str(error), "ros2" if "cannot be read" in str(error) else "")


# -- cameras ----------------------------------------------------------------------------------
def _cameras(profile: Profile, name: str, host: str | None) -> Iterator[_Found]:
    """Files of recorded cameras."""
    part = profile.hosts.get(host or "")
    for camera in () if part is None else profile.cameras_of(part):
        source = profile.cameras[camera].source
        path = Path(source.removeprefix(FILE)).expanduser()
        if source.startswith(FILE) and not path.exists():
            why = f"there is no file or folder {path}"
            yield _Found(("cameras", camera, "source"), why, "camera")


# -- workers ----------------------------------------------------------------------------------
def _workers(profile: Profile, name: str, host: str | None) -> Iterator[_Found]:
    """Models, made as a worker makes them, and what they need of the profile."""
    for worker in profile.workers:
        place = ("models", worker) if worker in profile.models else ("workers",)
        options = profile.options.get(worker, {})
        try:
            _, model = find_worker(worker, profile.models)
        except VlaZenohError as error:
            yield _Found(place, str(error), worker)
            continue
        if worker in profile.options:
            place = ("options", worker)
        try:
            if model.missing():  # it gets an environment of its own, and is not made here
                declared = ConstructorOptions.declared(model.path)
                if declared is not None:
                    declared.check(options, str(model.path))
                continue
            with contextlib.redirect_stdout(sys.stderr):  # a model's output is not the result
                policy = make_policy(model, options, profile=name)
        except VlaZenohError as error:
            yield _Found(place, str(error), worker)
            continue
        yield from _spec_faults(profile, worker, policy.spec)


def _spec_faults(profile: Profile, worker: str, spec: ModelSpec) -> Iterator[_Found]:
    from vla_zenoh.control.policy_check import spec_errors

    place = ("models", worker) if worker in profile.models else ("workers",)
    for _, _, why in spec_errors(profile, spec):
        yield _Found(place, f"worker {worker!r}: {why}")


# -- network ----------------------------------------------------------------------------------
def _router(profile: Profile, name: str, host: str | None) -> Iterator[_Found]:
    """The router of this host, and whether its own nodes find it."""
    part = profile.hosts.get(host or "")
    session = profile.session
    if part is None or "router" not in part.nodes:
        return
    listen = session.listen if part.listen is None else part.listen
    connect = session.connect if part.connect is None else part.connect
    if not any(ends_at(target, endpoint) for target in connect for endpoint in listen):
        place = ("session", "connect") if part.connect is None else ("hosts", str(host), "connect")
        yield _Found(
            place,
            f"leads to {', '.join(connect)}, and the router of this host listens on "
            f"{', '.join(listen)}: its nodes would not find it. Give both the same port",
        )


def _certificates(profile: Profile, name: str, host: str | None) -> Iterator[_Found]:
    """Certificates of the nodes of this host."""
    security = profile.session.security
    if security is None or host is None:
        return
    from vla_zenoh.security.identity import PEOPLE, identities_of
    from vla_zenoh.security.store import Store

    people = {role.value for role in PEOPLE}
    for identity in identities_of(profile, host):
        if identity.node in people or identity.role in PEOPLE or identity.worker == "teleop":
            continue
        try:
            Store(security.folder).identity_files(host, identity.node, security.people)
        except VlaZenohError as error:
            yield _Found(("session", "security"), str(error))
            return


CHECKS: Sequence[Callable[[Profile, str, str | None], Iterator[_Found]]] = (
    _arm,
    _simulator,
    _robot_file,
    _ros2,
    _cameras,
    _workers,
    _router,
    _certificates,
)


def _braking(profile: Profile) -> Iterator[str]:
    """Advice where `up` would end the robot's node while it still brakes."""
    if profile.robot.driver == "sim":
        return
    try:
        from vla_zenoh.guard.arm_guard import max_braking_time_s
    except ImportError:
        return  # `_arm` has already said so
    brake_s = max_braking_time_s(profile)
    if brake_s > LONG_BRAKE_S:
        yield (
            f"limits: braking from full speed may take {brake_s:.1f} s, but `vla-zenoh up` ends "
            "the robot's node within 3 s of Ctrl-C: lower the velocity, or raise acceleration and "
            "jerk"
        )
