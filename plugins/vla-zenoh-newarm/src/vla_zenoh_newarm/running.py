"""A running ROS 2 robot as the source of a profile: its description, and what drives it.

What knows ROS 2 is the package vla-zenoh-ros2; it is imported where it is used.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vla_zenoh import plugins
from vla_zenoh.cli.options import DEFAULT_PROFILE, ConnectOption, effective_profile
from vla_zenoh.errors import PluginError, ProfileError, nearest
from vla_zenoh_newarm.answers import Answers, Guess
from vla_zenoh_newarm.arm import Arm
from vla_zenoh_newarm.profile_text import Drive

if TYPE_CHECKING:
    from vla_zenoh_ros2.proposal import Topic
    from vla_zenoh_ros2.survey import Survey

PACKAGE = "vla-zenoh-ros2"
SCHEME = "package://"
LONGEST_S = 600.0


@dataclass(frozen=True)
class Running:
    """A running ROS 2 robot, and where to look for it."""

    ros2: Annotated[
        bool,
        typer.Option(
            "--ros2",
            help="Of a running ROS 2 robot, through zenoh-bridge-ros2dds or rmw_zenoh: its "
            "description (DESCRIPTION, if given, replaces it), topics and cameras.",
        ),
    ] = False
    connect: ConnectOption = None
    namespace: Annotated[
        str | None,
        typer.Option("--namespace", help="With --ros2: which of several robots, as /left."),
    ] = None
    domain: Annotated[
        int | None,
        typer.Option("--domain", min=0, max=232, help="With --ros2: which of several ROS domains."),
    ] = None
    timeout_s: Annotated[
        float,
        typer.Option(
            "--timeout", min=1.0, max=LONGEST_S, help="With --ros2: s to wait for each thing."
        ),
    ] = 10.0


def look(
    running: Running, command: str | None, tell: Callable[[str], None], *, describe: bool
) -> Survey:
    """What is found of the robot.

    Args:
        running: where to look.
        command: the topic that is to command it; None: any.
        tell: is told what is waited for.
        describe: find its description, too.

    Raises:
        PluginError: the package for ROS 2 is not installed.
        SessionError: there is no ROS 2 to be reached.
        ResourceError: there is no description, or there are several.
        ProfileError: `command` is no topic that commands an arm.
    """
    if "ros2" not in plugins.installed(plugins.ROBOTS):
        raise PluginError(f"`profile new --ros2` {plugins.lacking_package([PACKAGE])}")
    from vla_zenoh_ros2.survey import survey

    found = survey(
        effective_profile(DEFAULT_PROFILE, running.connect).session,
        namespace=running.namespace,
        number=running.domain,
        describe=describe,
        timeout_s=running.timeout_s,
        tell=tell,
    )
    if command is not None:
        _command(found, command)
    return found


def _command(found: Survey, name: str) -> Topic:
    """The topic of this name that commands an arm; a `ProfileError` names those there are."""
    from vla_zenoh_ros2.proposal import arm_commands

    topics = {each.name: each for each in arm_commands(found.domain, found.namespace)}
    if name in topics:
        return topics[name]
    raise ProfileError(
        f"--command {name!r}: no node takes commands of an arm there{nearest(name, topics)} "
        f"Found: {', '.join(topics) or 'none'}"
    )


def robot_name(description: str) -> str:
    """The name that a URDF gives its robot; empty: none."""
    try:
        return ElementTree.fromstring(description).get("name", "")
    except ElementTree.ParseError:
        return ""


def absent_packages(file: Path) -> list[str]:
    """Packages whose meshes a URDF names and that are in no folder above it."""
    try:
        meshes = [each.get("filename", "") for each in ElementTree.parse(file).iter("mesh")]
    except ElementTree.ParseError:
        return []
    named = [mesh.removeprefix(SCHEME) for mesh in meshes if mesh.startswith(SCHEME)]
    packages = dict.fromkeys(name.partition("/")[0] for name in named)
    folders = file.resolve().parents
    return [each for each in packages if not any((up / each).is_dir() for up in folders)]


def driven(
    found: Survey, arm: Arm, answers: Answers, connect: Sequence[str] | None
) -> tuple[Drive, list[str]]:
    """What drives an arm in its profile, and what was found, as sentences.

    Args:
        found: of the robot.
        arm: of its description.
        answers: of the person.
        connect: where the robot was found; None: where the profile's own nodes meet.

    Raises:
        ProfileError: the topic that was chosen does not command an arm.
    """
    from vla_zenoh_ros2.proposal import DescribedArm, arm_commands, command_guess, proposal

    joints, hand = arm.structure.arm, arm.gripper
    described = DescribedArm(joints, hand.joints, hand.values)
    topics = arm_commands(found.domain, found.namespace, joints, found.controllers)
    if not topics:
        return Drive(), [
            "no topic was found that commands the arm (a JointTrajectory, a Float64MultiArray, a "
            "pose): the profile is one of the simulator. Start the robot's controllers, and do "
            "this again"
        ]
    first, *others = topics
    place, what = command_guess(first, others, described, found.controllers.get(first.name))
    given = answers.option("command") or first.name
    command = _command(found, answers.text("command", first.name, place, what) if what else given)
    made = proposal(found.domain, found.namespace, described, command, found.joints, found.images)
    answers.guesses += [Guess(place, what) for place, what in made.guesses]
    section = dict(made.section)
    if connect:
        section = {"bridge": section.pop("bridge"), "connect": [*connect], **section}
    drive = Drive("ros2", made.command, section, made.cameras)
    shown = [f"camera {name}: {_shown(row)}" for name, row in made.cameras.items()]
    known = command == first and not what
    active = ", whose controller is active and has the joints of the arm" if known else ""
    return drive, [f"commands: {command.name} ({command.type}{active})", *made.notes, *shown]


def home_of(found: Survey, joints: Sequence[str]) -> str:
    """Where the arm stands, as the option that makes it home; empty: it is not known."""
    for heard in found.joints.values():
        if all(joint in heard.position for joint in joints):
            where = ",".join(f"{heard.position[joint]:.3f}" for joint in joints)
            return f"--home={where}"
    return ""


def _shown(row: Mapping[str, Any]) -> str:
    size = f", {row['width']}x{row['height']}" if "width" in row else ""
    return f"{row['source']}{size}"
