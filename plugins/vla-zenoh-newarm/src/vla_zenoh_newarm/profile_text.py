"""The text of a profile, with comments where a person must look."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from vla_zenoh.profile import write_yaml
from vla_zenoh_newarm.arm import Arm

SMALL_M = 0.55
"""Reach below which an arm is simulated on the desk of the small arm."""
FIRST = """\
# {name}, made by `vla-zenoh profile new {source}`.
# What is listed under `unconfirmed`, at the end, was guessed. The simulated arm works with it; a
# real one is not activated while anything is listed there: look at each, correct it, delete its
# line.
"""
DRIVER = """\
  # The simulator, until you say what drives the real arm: arm (a Python class with read and move),
  # ros2, franka, ur or lerobot; see docs/how-to/own-arm.md. `vla-zenoh up FILE --sim` simulates it
  # all the same.
"""
OF_ROS2 = """\
  # `vla-zenoh up FILE --sim` simulates it all the same.
"""
LIMITS = """\
limits: # half the velocity of the description, at most 1 rad/s
"""
UNCONFIRMED = """\
# Look at each, correct it above, and delete its line.
"""


class Drive(NamedTuple):
    """What drives an arm in its profile: the simulator, or ``ros2``.

    Args:
        driver: of the robot.
        command: ``joint`` or ``pose``.
        ros2: section of that name; empty: none.
        cameras: section of that name, of ROS 2.
    """

    driver: str = "sim"
    command: str = "joint"
    ros2: Mapping[str, Any] = {}
    cameras: Mapping[str, Mapping[str, Any]] = {}


SCENE: Mapping[str, Mapping[str, Any]] = {
    "front": {"source": "sim:front"},
    "wrist": {"source": "sim:wrist"},
}
WATCHED = "front"
"""Camera whose images the scripted worker waits for."""


def profile_text(name: str, source: str, description: str, arm: Arm, drive: Drive) -> str:
    """The profile of an arm.

    Args:
        name: of the robot.
        source: what it was made from.
        description: path that the profile names.
        arm: what is known and guessed.
        drive: what drives it.
    """
    simulated = drive.driver == "sim"
    about = "on a table, simulated until its driver is named" if simulated else "in ROS 2"
    links, motion, home = arm.structure, arm.motion, arm.posture
    guessed = {guess.place for guess in arm.guesses}

    def mark(place: str) -> str:
        return " # a guess" if place in guessed else ""

    x_m, y_m, z_m = (_row(span) for span in home.workspace_m)
    lines = [
        FIRST.format(name=name, source=source).rstrip(),
        f"about: {_text(name)} {about}",
        "",
        "robot:",
        f"  name: {_text(name)}",
        (DRIVER if simulated else OF_ROS2).rstrip(),
        f"  driver: {drive.driver}",
        f"  command: {drive.command}",
        *(f"  # {change}" for change in arm.changes),
        f"  description: {_text(description)}{mark('robot.description')}",
        f"  base_frame: {_text(links.base)}{mark('robot.base_frame')}",
        f"  tcp_frame: {_text(links.tcp)}{mark('robot.tcp_frame')}",
        "  arm_joints:",
        *(f"    - {_text(joint)}" for joint in links.arm),
        f"  home_rad: {_row(home.home_rad)}{mark('robot.home_rad')}",
    ]
    if arm.gripper.joints:
        lines += ["  finger_joints:", *(f"    - {_text(joint)}" for joint in arm.gripper.joints)]
    if not arm.gripper.values:
        lines += [f"  gripper: null{mark('robot.gripper')}"]
    else:
        lines += [f"  gripper:{mark('robot.gripper')}"]
        lines += [f"    {key}: {value:g}" for key, value in arm.gripper.values.items()]
    table = "null" if arm.table_z_m is None else f"{arm.table_z_m:g}"
    acceleration, jerk = "limits.joint.acceleration_rad_s2", "limits.joint.jerk_rad_s3"
    lines += [
        "",
        LIMITS.rstrip(),
        f"  workspace: {{x_m: {x_m}, y_m: {y_m}, z_m: {z_m}}}{mark('limits.workspace')}",
        "  translation: {velocity_m_s: 0.25, acceleration_m_s2: 1.0, jerk_m_s3: 10.0}",
        "  rotation: {velocity_rad_s: 0.7, acceleration_rad_s2: 3.0, jerk_rad_s3: 30.0}",
        "  joint:",
        f"    velocity_rad_s: {_row(motion.velocity)}",
        f"    acceleration_rad_s2: {_row(motion.acceleration)}{mark(acceleration)}",
        f"    jerk_rad_s3: {_row(motion.jerk)}{mark(jerk)}",
        "  reach:",
        f"    table_z_m: {table}{mark('limits.reach.table_z_m')}",
        *(
            f"    {name}: {value:g}{mark(f'limits.reach.{name}')}"
            for name, value in arm.of_size.items()
        ),
        *_may_touch(home.may_touch),
        "",
        *_driven(drive, mark),
        f"sim: {{scene: {'desk' if home.reach_m < SMALL_M else 'bricks'}}}",
        "",
        "workers: [scripted]",
        "task: {prompt: hold, rate_hz: 5, worker: scripted}",
        *_watched(drive),
        "hosts:",
        "  here:",
        f"    nodes: [router, {'sim, camera' if simulated else 'ros2'}, command, worker]",
    ]
    if arm.guesses:
        lines += ["", UNCONFIRMED.rstrip(), "unconfirmed:"]
        for place in dict.fromkeys(guess.place for guess in arm.guesses):
            what = [guess.what for guess in arm.guesses if guess.place == place]
            lines += [f"  # {each}" for each in what]
            lines += [f"  - {place}"]
    return "\n".join(lines) + "\n"


def _driven(drive: Drive, mark: Callable[[str], str]) -> list[str]:
    """Cameras, and what drives the arm."""
    if drive.driver == "sim":
        head, cameras = "cameras: # of the scene; a real arm has others", SCENE
    else:
        head, cameras = "cameras:" if drive.cameras else "cameras: {}", drive.cameras
    lines = [
        head,
        *(f"  {name}: {_flow(row)}{mark(f'cameras.{name}')}" for name, row in cameras.items()),
    ]
    if drive.ros2:
        lines += ["", "ros2:"]
    for key, value in drive.ros2.items():
        if key == "cameras":
            lines += ["  cameras:", *(f"    {name}: {_flow(row)}" for name, row in value.items())]
        else:
            lines.append(f"  {key}: {_flow(value)}{mark(f'ros2.{key}')}")
    return [*lines, ""] if drive.ros2 else lines


def _watched(drive: Drive) -> list[str]:
    """Options of the scripted worker where no camera has the name that it waits for."""
    if drive.driver == "sim" or WATCHED in drive.cameras:
        return []
    return [f"options: {{scripted: {{camera: {_flow(next(iter(drive.cameras), ''))}}}}}"]


def _flow(value: Any) -> str:
    """A value on one line."""
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key}: {_flow(each)}' for key, each in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_flow, value))}]"
    if isinstance(value, str):
        return json.dumps(value) if set(value) & set(":,{}[]") else _text(value)
    return str(value).lower() if isinstance(value, bool) else f"{value:g}"


def _may_touch(pairs: Sequence[tuple[str, str]]) -> list[str]:
    if not pairs:
        return []
    rows = [f"      - [{_text(first)}, {_text(second)}]" for first, second in pairs]
    return ["    may_touch: # a guess", *rows]


def _row(values: Sequence[float]) -> str:
    return f"[{', '.join(f'{value:g}' for value in values)}]"


def _text(value: str) -> str:
    """A text as YAML, quoted where it must be."""
    return write_yaml([value]).removeprefix("- ").strip()
