"""Everything about an arm that its profile needs, from its description and a person's answers."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.profile import ReachLimits
from vla_zenoh_newarm.answers import Answers, Guess
from vla_zenoh_newarm.gripper import Gripper, gripper
from vla_zenoh_newarm.mended import Mended
from vla_zenoh_newarm.posture import Posture, limits_of_size, points_down, posture, tool_axis
from vla_zenoh_newarm.structure import Structure, structure

VELOCITY_SHARE, FASTEST_RAD_S, FASTEST_M_S = 0.5, 1.0, 0.2
"""Of the velocity that a description allows, and most of it."""
ACCELERATION_1_S, JERK_1_S = 3.0, 20.0
"""An acceleration as a multiple of the velocity, a jerk as one of the acceleration."""


class JointMotion(NamedTuple):
    """Limits of the joints: one number each, in rad or m."""

    velocity: tuple[float, ...]
    acceleration: tuple[float, ...]
    jerk: tuple[float, ...]


class Arm(NamedTuple):
    """An arm as its profile describes it.

    Args:
        file: its description.
        structure: its links and joints.
        gripper: its gripper.
        posture: its home and workspace.
        motion: limits of its joints.
        table_z_m: height of the table; None: there is none.
        of_size: limits of `ReachLimits` that go by the size of the arm.
        changes: what was changed in the description, and what is unusual in it.
        guesses: what nobody has confirmed.
    """

    file: Path
    structure: Structure
    gripper: Gripper
    posture: Posture
    motion: JointMotion
    table_z_m: float | None
    of_size: Mapping[str, float]
    changes: Sequence[str]
    guesses: Sequence[Guess]


def meshes_of(copy: Path) -> Path:
    """Folder beside a mended description for its meshes."""
    return copy.with_name(f"{copy.stem}_meshes")


def found_arm(source: Path, copy: Path, arguments: Mapping[str, str], answers: Answers) -> Arm:
    """The arm of a description.

    Args:
        source: the description.
        copy: where a mended one is written.
        arguments: of a xacro.
        answers: of the person.

    Raises:
        ResourceError: the description, or its shapes, cannot be read.
        ProfileError: no arm is found in it, or an answer does not fit; says what to do.
    """
    description = Mended(source, arguments, meshes_of(copy))
    links = _structure(description, answers)
    description.complete(links.arm, links.fingers)
    file = description.save(copy)
    for made_up in description.guesses:
        answers.guesses.append(Guess("robot.description", made_up))
    hand = _gripper(file, links, answers)
    kinematics = Kinematics(file, links.tcp, links.arm, base_frame=links.base)
    heights = answers.numbers(
        "table", [0.0], "limits.reach.table_z_m", "height of the table in the base frame, m", (1, 0)
    )
    table_z_m = heights[0] if heights else None
    of_size = limits_of_size(kinematics)
    reach = ReachLimits(table_z_m=table_z_m).model_copy(update=of_size)
    home = posture_of(kinematics, reach, answers)
    for name in of_size:
        what = f"by the size of the arm, {kinematics.length_m:.2f} m"
        answers.guesses.append(Guess(f"limits.reach.{name}", what))
    motion = _motion(kinematics, answers)
    changes = [*description.changes, *([hand.why] if hand.why else [])]
    if kinematics.endless.any():
        endless = ", ".join(itertools.compress(kinematics.arm_joints, kinematics.endless))
        changes.append(f"{endless}: no end, counted over turns; joint_range_rad gives one")
    return Arm(file, links, hand, home, motion, table_z_m, of_size, changes, answers.guesses)


def _structure(description: Mended, answers: Answers) -> Structure:
    described = description.described()
    base = answers.option("base")
    found = structure(described, base, answers.option("tcp"))
    if found.other_tcps:
        others = ", ".join(found.other_tcps)
        tcp = answers.text("tcp", found.tcp, "robot.tcp_frame", f"there are also: {others}")
        found = structure(described, base, tcp)
    elif answers.option("tcp") is None:
        what = "link that is controlled, the outermost that does not move with a finger"
        tcp = answers.text("tcp", found.tcp, "robot.tcp_frame", what)
        found = structure(described, base, tcp)
    if found.base != described.root and base is None:
        what = f"link of the first joint; what is before it stands still ({described.root})"
        base = answers.text("base", found.base, "robot.base_frame", what)
        found = structure(described, base, found.tcp)
    return found


def _gripper(file: Path, links: Structure, answers: Answers) -> Gripper:
    from vla_zenoh.kinematics.description import Description

    found = gripper(Description(file), links.fingers)
    names = tuple(found.values) or ("max_width_m",)
    what = f"{', '.join(names)} of {', '.join(found.joints)}"
    if not found.joints:
        what = f"{found.why or 'no joint of a finger was found'}: the robot has no gripper"
    values = answers.numbers(
        "gripper", list(found.values.values()), "robot.gripper", what, (len(names), 0)
    )
    if not values:
        return Gripper(why=found.why)
    return found._replace(values=dict(zip(names, values, strict=True)))


def posture_of(kinematics: Kinematics, reach: ReachLimits, answers: Answers) -> Posture:
    """Home and workspace: guessed, and then as the person wants them."""
    given = answers.option("home")
    size = kinematics.size
    home: tuple[float, ...] = ()
    if given is not None:
        home = answers.numbers("home", (), "robot.home_rad", "", (size,))
    found = posture(kinematics, reach, home)
    if given is None:
        what = "joint positions at home, away from singularities, itself and the table; the tool "
        axis = tool_axis(kinematics, kinematics.forward(np.array(found.home_rad)).rotation)
        along = ", ".join(f"{value:.2f}" for value in axis)
        what += "points down" if points_down(axis) else f"points along ({along}) of the base"
        home = answers.numbers("home", found.home_rad, "robot.home_rad", what, (size,))
        if home != found.home_rad:
            found = posture(kinematics, reach, home)
    if found.may_touch:
        pairs = "; ".join(" and ".join(pair) for pair in found.may_touch)
        what = f"{pairs}: their shapes overlap almost wherever the arm is"
        answers.guesses.append(Guess("limits.reach.may_touch", what))
    if not found.free:
        what = "no home was found that is away from singularities, the arm itself and the table"
        answers.guesses.append(Guess("robot.home_rad", what))
    box = [edge for span in found.workspace_m for edge in span]
    what = "box of the TCP, m: what the arm reaches"
    x0, x1, y0, y1, z0, z1 = answers.numbers("workspace", box, "limits.workspace", what, (6,))
    return found._replace(workspace_m=((x0, x1), (y0, y1), (z0, z1)))


def _motion(kinematics: Kinematics, answers: Answers) -> JointMotion:
    most = np.where(kinematics.slides, FASTEST_M_S, FASTEST_RAD_S)
    velocity = np.minimum(VELOCITY_SHARE * kinematics.velocity_rad_s, most)
    size = kinematics.size
    acceleration = answers.numbers(
        "acceleration",
        (ACCELERATION_1_S * velocity).tolist(),
        "limits.joint.acceleration_rad_s2",
        f"{ACCELERATION_1_S:g} times the velocity; the maker publishes it, or not",
        (1, size),
    )
    jerk = answers.numbers(
        "jerk",
        (JERK_1_S * np.array(acceleration)).tolist(),
        "limits.joint.jerk_rad_s3",
        f"{JERK_1_S:g} times the acceleration; the maker publishes it, or not",
        (1, size),
    )
    return JointMotion(tuple(velocity.tolist()), acceleration, jerk)
