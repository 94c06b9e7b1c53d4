"""Checks of a profile's robot: kinematics, simulated world, Python class, ROS 2 messages."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vla_zenoh import plugins, resources
from vla_zenoh.errors import (
    MissingExtraError,
    PluginError,
    ProfileError,
    RecordError,
    ResourceError,
    VlaZenohError,
    nearest,
)
from vla_zenoh.profile import POSE_JOINTS, Profile, ReachLimits
from vla_zenoh.profile.section import Place
from vla_zenoh.types import FloatArray

if TYPE_CHECKING:
    from vla_zenoh.control.reachability import ReachabilityFilter
    from vla_zenoh.kinematics.kinematics import Kinematics

TOOL_M = 0.06
"""A TCP further from all shapes has a tool without one; between open fingers it is nearer."""
WIDTHS = 1.5
"""Factor between the widths of a description and a profile: one finger of two is twice as much."""
POSTURES = 8
"""At which the axes of an arm are looked at."""
SINGULAR_POSTURES, MOSTLY_SLOW, USUALLY_SLOW = 200, 0.8, 0.33
"""At so many the singular values are looked at; more of an arm slow than the first share is odd,
and the second is what the shipped arms have."""
LONG_BRAKE_S = 2.5
"""`up` ends a robot's node 2.8 s after Ctrl-C, less the time until the node gets the signal.
See `STOP_ORDER` in `vla_zenoh.runtime.supervisor`."""
SIM = "sim:"


class ProfileFault(NamedTuple):
    """A fault.

    Args:
        place: in the profile.
        why: continues ``PLACE: ``.
        node: the node that fails, as kind or worker; "": no computer can run this profile.
        other: place that contradicts it; its line is named where only that is in the checked file.
    """

    place: Place
    why: str
    node: str = ""
    other: Place | None = None


# -- command node -----------------------------------------------------------------------------
def arm(profile: Profile) -> Iterator[ProfileFault]:
    """The arm as the command node makes it."""
    place = ("robot", "description")
    try:
        from vla_zenoh.control.reachability import ReachabilityFilter
        from vla_zenoh.kinematics.plausibility import implausible

        reach = ReachabilityFilter(profile)
    except (ResourceError, MissingExtraError) as error:
        yield ProfileFault(place, str(error), "command")
        return
    except ImportError as error:
        yield ProfileFault(("robot",), f"its joints and links were not checked: {error}", "command")
        return
    except (ProfileError, RecordError) as error:
        yield ProfileFault(getattr(error, "place", ()) or ("robot",), str(error))
        return
    except ValueError as error:  # from Pinocchio, for a file that is no URDF
        yield ProfileFault(place, f"{profile.robot.description!r} cannot be read: {error}")
        return
    kinematics = reach.kinematics
    for why in implausible(kinematics, profile.limits, reach.barriers.collisions):
        yield ProfileFault(place, why)
    home_rad = _home_rad(profile, reach)
    for index, joint in enumerate(kinematics.arm_joints):
        low, high = float(kinematics.lower_rad[index]), float(kinematics.upper_rad[index])
        if not low <= home_rad[index] <= high:
            yield ProfileFault(
                ("robot", "home_rad"),
                f"puts {joint} at {home_rad[index]:.3g} rad, its range is {low:.3g} to {high:.3g}",
            )
            return
    where, outside_m = _home_tcp(profile, reach)
    if profile.robot.driver == "sim" and outside_m > profile.limits.step_m:
        box = profile.limits.tcp_box
        yield ProfileFault(
            ("robot", "home_rad"),
            f"puts the TCP at {where} m, {outside_m:.3f} m outside "
            f"limits.workspace x {box.x_m} y {box.y_m} z {box.z_m}: the simulated arm starts there "
            "and could not be activated",
            other=("limits", "workspace"),
        )


def _reach(profile: Profile) -> ReachabilityFilter | None:
    """The arm as the command node makes it; None: it cannot, and `arm` says why."""
    try:
        from vla_zenoh.control.reachability import ReachabilityFilter

        return ReachabilityFilter(profile)
    except (ImportError, ValueError, VlaZenohError):
        return None


def _home_rad(profile: Profile, reach: ReachabilityFilter) -> FloatArray:
    return reach.kinematics.ordered(profile.robot.arm_joints, profile.robot.home_rad)


def _home_tcp(profile: Profile, reach: ReachabilityFilter) -> tuple[str, float]:
    """Where the TCP is with the arm at home, in words, and how far outside the workspace, m."""
    from vla_zenoh.control.limits import into_workspace

    at_m = reach.kinematics.forward(_home_rad(profile, reach)).position_m
    _, outside_m = into_workspace(profile.limits, at_m)
    return f"({', '.join(f'{value:.3f}' for value in at_m)})", outside_m


def barriers_advice(profile: Profile) -> Iterator[str]:
    """Advice for a home that is too near to something, and for what no barrier protects."""
    for part in profile.parts or [""]:
        own = profile.of_part(part)
        reach = _reach(own)
        if reach is None:
            continue
        at = f"parts.{part}." if part else ""
        for hit in reach.barriers.inside(_home_rad(own, reach)):
            yield (
                f"{at}robot.home_rad: {hit.name}{hit.at} is "
                f"{hit.value:.4f} m with the arm at home, and must be over {hit.limit:.4g} m: from "
                "there the arm may only move away. Give another home_rad; or, if the convex hulls "
                "of two links touch and the links do not, name them in limits.reach.may_touch"
            )
        bare = ", ".join(reach.kinematics.described.shapeless)
        if bare:
            yield (
                f"{at}robot.description: links without a collision shape, which no barrier keeps "
                f"from table, keep-outs and the arm itself: {bare}"
            )
        beyond_m = reach.barriers.collisions.tcp_beyond_m(reach.kinematics)
        if beyond_m > TOOL_M:
            yield (
                f"{at}robot.tcp_frame: the TCP is {beyond_m:.3f} m from every collision shape of "
                "its link: the tool between them has no barrier; add its shape to the description"
            )


def table_advice(profile: Profile) -> Iterator[str]:
    """Advice for a table that is elsewhere than the simulated one."""
    table_z_m = profile.limits.reach.table_z_m
    if profile.robot.driver == "sim" and table_z_m:
        yield (
            f"limits.reach.table_z_m is {table_z_m:g} m, and the simulator's table stays at 0 m: "
            "the arm stops above what its cameras show; keep-outs are not shown either"
        )


def joints_advice(profile: Profile) -> Iterator[str]:
    """What the check assumes of joints that are not commanded, of home, and of too few joints.

    And which have no end.
    """
    reach = _reach(profile)
    if reach is None:
        return
    from vla_zenoh.control.policy_check import immovable_axes

    kinematics = reach.kinematics
    for name, (joint, multiplier, offset) in kinematics.followers.items():
        yield (
            f"robot.arm_joints: {name} is not commanded; poses assume that it follows {joint}, at "
            f"{multiplier:g} times its position plus {offset:g}"
        )
    for name, value in kinematics.locked_rad.items():
        yield (
            f"robot.locked_rad: {name} is not commanded, and every pose assumes it at {value:g}. "
            "States that have it elsewhere are rejected; a robot that does not publish it is "
            "believed"
        )
    if kinematics.endless.any():
        endless = ", ".join(compress(kinematics.arm_joints, kinematics.endless))
        yield (
            f"robot.arm_joints: no end, and the shortest way to every target: {endless}. "
            "robot.joint_range_rad gives them one, where a cable would wind up"
        )
    yield from _fingers_advice(profile, kinematics.fingers_m)
    where, outside_m = _home_tcp(profile, reach)
    if outside_m > 0 and profile.robot.driver != "sim":
        yield (
            f"robot.home_rad: the TCP is then at {where} m, {outside_m:.3f} m outside "
            "limits.workspace: the arm cannot be moved home. Are base_frame, tcp_frame and the "
            "units of the description right?"
        )
    joints = len(profile.robot.arm_joints)
    if joints >= POSE_JOINTS:
        yield from _axes_advice(kinematics)
        return
    fixed = immovable_axes(kinematics.jacobian(_home_rad(profile, reach)))
    axes = ", ".join(fixed) or "none"
    yield (
        f"robot.arm_joints: {joints} joints cannot reach every pose, as six can. At home the TCP "
        f"cannot move along or about these axes alone: {axes}. Steps of a model along them are "
        "shortened to nothing, activation is rejected while its newest chunk asks for one, and "
        "models with absolute poses are rejected altogether, with robot.command: pose those with "
        "joints as well"
    )


def singularity_limits(
    kinematics: Kinematics, limits: ReachLimits
) -> tuple[str, float, float] | None:
    """Why the limits of singularities are those of a larger arm, and slow and stop that suit.

    None: they suit it.
    """
    import numpy as np

    from vla_zenoh.kinematics.kinematics import smallest_singular_value

    random = np.random.default_rng(1)
    postures = random.uniform(*kinematics.sampled_rad, (SINGULAR_POSTURES, kinematics.size))
    values = np.array([smallest_singular_value(kinematics.jacobian(each)) for each in postures])
    slow, stop = (values < limits.singularity_slow).mean(), limits.singularity_stop
    if slow <= MOSTLY_SLOW:
        return None
    usual = float(np.quantile(values, USUALLY_SLOW))
    why = (
        f"the arm is slow in {slow:.0%} of its postures, and in {(values < stop).mean():.0%} below "
        "singularity_stop, where it does not go by itself"
    )
    return why, float(f"{usual:.1g}"), float(f"{0.3 * usual:.1g}")


def singular_advice(profile: Profile) -> Iterator[str]:
    """Advice where the limits of singularities are those of a larger arm."""
    reach = _reach(profile)
    found = reach and singularity_limits(reach.kinematics, profile.limits.reach)
    if reach and found:
        why, slow, stop = found
        yield (
            f"limits.reach.singularity_slow: {why}: these are limits of a larger arm. {slow:g} and "
            f"{stop:g} suit one of {reach.kinematics.length_m:.2f} m"
        )


def _axes_advice(kinematics: Kinematics) -> Iterator[str]:
    """Advice where enough joints cannot turn or move the TCP in every direction anywhere."""
    import numpy as np

    random = np.random.default_rng(1)
    postures = random.uniform(*kinematics.sampled_rad, (POSTURES, kinematics.size))
    most = max(np.linalg.matrix_rank(kinematics.jacobian(each), 1e-6) for each in postures)
    if most < POSE_JOINTS:
        yield (
            f"robot.arm_joints: {kinematics.size} joints move the TCP in {most} of six directions "
            "only, whatever their positions: are the axes of the description right?"
        )


def _fingers_advice(profile: Profile, described_m: float) -> Iterator[str]:
    """Advice where the sliding fingers of the description do not add up to the width."""
    gripper = profile.robot.gripper
    if gripper is None or gripper.joint_ends is not None or not profile.robot.finger_joints:
        return
    share = described_m / gripper.max_width_m
    if not 1 / WIDTHS < share < WIDTHS:
        yield (
            f"robot.gripper.max_width_m: is {gripper.max_width_m:g}, and finger_joints open by "
            f"{described_m:g} m in all, which counts as the width. Name every finger in "
            "finger_joints, or give joint_open_m and joint_shut_m"
        )


# -- robot node -------------------------------------------------------------------------------
def simulator(profile: Profile) -> Iterator[ProfileFault]:
    """The world as the simulator makes it."""
    simulated = any(camera.source.startswith(SIM) for camera in profile.cameras.values())
    running = {kind for part in profile.hosts.values() for kind in part.nodes}
    if profile.robot.driver != "sim" or not running & ({"sim", "camera"} if simulated else {"sim"}):
        return
    try:
        from vla_zenoh.simulation.scene import AppearanceSwitcher, scene_file
        from vla_zenoh.simulation.world import build_world
    except ImportError as error:
        yield ProfileFault(
            ("robot", "driver"), f"is sim: {MissingExtraError(str(error.name), 'sim')}"
        )
        return
    try:
        scene_file(profile.sim.scene)
    except ResourceError as error:
        yield ProfileFault(("sim", "scene"), str(error), "sim")
        yield ProfileFault(("sim", "scene"), str(error), "camera" if simulated else "sim")
        return
    try:
        resources.robot_urdf(profile.robot.description)
        world = build_world(profile)
    except (MissingExtraError, ProfileError):
        return  # `arm` says so
    except (ResourceError, RecordError) as error:
        if Path(profile.robot.description).name in str(error) or "description" in str(error):
            yield from _not_simulated(profile, error)
        else:
            yield ProfileFault(("sim",), str(error))
        return
    try:
        AppearanceSwitcher(world.model).apply(0, profile.sim.vary)
    except ResourceError as error:
        yield ProfileFault(("sim", "vary"), str(error))
    known = [world.model.camera(index).name for index in range(world.model.ncam)]
    for camera, settings in profile.cameras.items():
        view = settings.source.removeprefix(SIM)
        if settings.source.startswith(SIM) and view not in known:
            yield ProfileFault(
                ("cameras", camera, "source"),
                f"scene {profile.sim.scene!r} has no camera {view!r}{nearest(view, known)} "
                f"Known: {', '.join(known)}",
            )


def _not_simulated(profile: Profile, error: VlaZenohError) -> Iterator[ProfileFault]:
    if _reach(profile) is None:
        return
    urdf = resources.robot_urdf(profile.robot.description)
    yield ProfileFault(
        ("robot", "description"),
        f"the simulator (robot.driver: sim) cannot build {urdf.name}: {error}. A real arm has "
        "another driver, as arm or ros2",
        other=("robot", "driver"),
    )


def drivers(profile: Profile) -> Iterator[ProfileFault]:
    """What the plug-ins of the robot driver and of the node ``ros2`` find."""
    for name, node in profile.robot_nodes.items():
        try:
            robot = plugins.load(plugins.ROBOTS, name)
        except PluginError as error:
            place = ("robot", "driver") if name == profile.robot.driver else ("ros2",)
            yield ProfileFault(place, str(error), node)
            continue
        for place, why, *_ in plugins.faults_of(name, robot.check, profile, profile.driver_options):
            yield ProfileFault(place, why, node)


def mounts(profile: Profile) -> Iterator[ProfileFault]:
    """Links that cameras are mounted on."""
    if all(camera.mount is None for camera in profile.cameras.values()):
        return
    try:
        from vla_zenoh.kinematics.description import Description

        own = [profile.of_part(part).robot.description for part in profile.part_names]
        links = {link for each in own for link in Description(resources.robot_urdf(each)).links}
    except (ImportError, VlaZenohError):
        return  # `arm` says so
    for name, camera in profile.cameras.items():
        link = camera.mount.link if camera.mount is not None else ""
        if link and link not in links:
            why = f"is {link!r}, no link of robot.description{nearest(link, links)}"
            yield ProfileFault(("cameras", name, "mount", "link"), why)


def braking_advice(profile: Profile) -> Iterator[str]:
    """Advice where `up` would end the robot's node while it still brakes."""
    if profile.robot.driver == "sim":
        return
    try:
        from vla_zenoh.guard.arm_guard import max_braking_time_s
    except ImportError:
        return  # `arm` has already said so
    brake_s = max_braking_time_s(profile)
    if brake_s > LONG_BRAKE_S:
        yield (
            f"limits: braking from full speed may take {brake_s:.1f} s, but `vla-zenoh up` ends "
            "the robot's node within 3 s of Ctrl-C: lower the velocity, or raise acceleration and "
            "jerk"
        )
