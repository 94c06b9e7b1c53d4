"""A robot that speaks R2C, declared once in a file: what its numbers and pictures mean.

No message of R2C says it, so a policy and a robot that were made apart cannot know. Both
directions read this file: `vla-zenoh serve r2c` (its robot, our model) and the model
``r2c_policy`` (our robot, its policy).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, ValidationError

from vla_zenoh import resources
from vla_zenoh.errors import CodecError, ProfileError
from vla_zenoh.kinematics.description import Description
from vla_zenoh.profile import Profile
from vla_zenoh.profile.load import read_yaml
from vla_zenoh.profile.section import Fault, Name, Section, Word, Words, explain, unlisted
from vla_zenoh.types import FloatArray


class Gripper(Section):
    """The gripper among the numbers.

    Args:
        name: of its number.
        shut: the number where it is shut.
        open: the number where it is open.
    """

    name: Word
    shut: float
    open: float

    def contradictions(self) -> Iterator[Fault]:
        """Numbers that say nothing."""
        if self.shut == self.open:
            yield ("open",), "is the same as shut"


class Camera(Section):
    """A camera.

    Args:
        name: theirs.
        colours: of its JPEG files: ``rgb``: as JPEG has them; ``bgr``: red and blue exchanged, as
            files are that were encoded from RGB arrays by OpenCV.
    """

    name: Word
    colours: Literal["rgb", "bgr"]


class DeclaredRobot(Section):
    """A robot that speaks R2C.

    Args:
        project: first part of its keys.
        device: second part of its keys.
        order: its names of the numbers in ``joint_states``, in their order.
        joints: its name -> joint of the profile.
        unit: of the joints: radians or degrees.
        reversed: its names of the joints that turn against the profile's.
        zero: its name -> its number where the profile's joint is 0; others: 0.
        gripper: the gripper among the numbers; left out: there is none.
        cameras: camera of ours -> camera of the robot.
        step_hz: steps that it executes in a second (``runtime.publish_hz`` of its file).
        horizon: longest chunk that its policy answers with.
        max_age_s: older observations are not answered.
    """

    project: Name
    device: Name
    order: Words = Field(min_length=1)
    joints: dict[Word, Word] = Field(min_length=1)
    unit: Literal["radians", "degrees"]
    reversed: Words = ()
    zero: dict[Word, float] = Field(default_factory=dict)
    gripper: Gripper | None = None
    cameras: dict[Name, Camera] = Field(default_factory=dict)
    step_hz: float = Field(gt=0, le=1000)
    horizon: int = Field(default=100, ge=1, le=1000)
    max_age_s: float = Field(default=1.0, gt=0, le=60)

    def contradictions(self) -> Iterator[Fault]:
        """Names that are missing, or that nothing knows."""
        meant = (*self.joints, *((self.gripper.name,) if self.gripper else ()))
        yield from unlisted(("order",), self.order, "joints and gripper", meant)
        yield from unlisted(("joints",), meant, "order", self.order)
        yield from unlisted(("reversed",), self.reversed, "joints", tuple(self.joints))
        yield from unlisted(("zero",), self.zero, "joints", tuple(self.joints))
        if len(set(meant)) != len(meant):
            yield ("gripper", "name"), "is a joint, too"
        if len(set(self.joints.values())) != len(self.joints):
            yield ("joints",), "names a joint of the profile twice"


def read_robot(path: str | Path) -> DeclaredRobot:
    """A robot from its file.

    Raises:
        ProfileError: the file cannot be read, or a field is missing or wrong, by name.
    """
    file = Path(path).expanduser()
    try:
        raw = file.read_bytes()
    except OSError as error:
        raise ProfileError(f"the robot's file {file} cannot be read: {error.strerror}") from error
    content, lines = read_yaml(raw, str(file))
    try:
        return DeclaredRobot.model_validate(content)
    except ValidationError as error:
        raise ProfileError("; ".join(explain(error, lines, DeclaredRobot))) from error


class Numbers:
    """A robot's numbers, and ours: joints in rad in the order of the profile, and a width in m.

    Args:
        robot: as declared.
        profile: of the same arm.

    Raises:
        ProfileError: the two do not fit, by name.
    """

    def __init__(self, robot: DeclaredRobot, profile: Profile) -> None:
        ours = profile.robot.arm_joints
        for name in robot.joints.values():
            if name not in ours:
                raise ProfileError(
                    f"joints: {name!r} is no arm_joint of profile {profile.name}; it has "
                    f"{', '.join(ours)}"
                )
        lacking = [name for name in ours if name not in robot.joints.values()]
        if lacking:
            raise ProfileError(f"joints: no number is joint {', '.join(lacking)} of the profile")
        described = Description(resources.robot_urdf(profile.robot.description)).joints
        for joint in ours:
            if described[joint].kind == "prismatic":
                raise ProfileError(f"joints: {joint!r} slides; only joints that turn are declared")
        theirs = {joint: name for name, joint in robot.joints.items()}
        self.order = robot.order
        self._columns = [robot.order.index(theirs[joint]) for joint in ours]
        per_rad = 180 / np.pi if robot.unit == "degrees" else 1.0
        self._per_rad = np.array(
            [-per_rad if theirs[joint] in robot.reversed else per_rad for joint in ours]
        )
        self._zero = np.array([robot.zero.get(theirs[joint], 0.0) for joint in ours])
        self._gripper = robot.gripper
        if robot.gripper is not None:
            profile.robot.require_gripper("gripper of the declaration")
        self._max_width_m = profile.robot.max_width_m

    @property
    def grips(self) -> bool:
        """Whether the gripper is among the numbers."""
        return self._gripper is not None

    def ordered(self, names: tuple[str, ...], values: FloatArray) -> FloatArray:
        """Columns (..., n) of a message in the declared order.

        Raises:
            CodecError: other names than declared, or another count.
        """
        if not names:
            if values.shape[-1] != len(self.order):
                raise CodecError(
                    "shape",
                    f"joint_states has {values.shape[-1]} numbers, declared are {len(self.order)}: "
                    f"{', '.join(self.order)}",
                )
            return values
        if set(names) != set(self.order):
            raise CodecError(
                "joints",
                f"joint_states.names are {', '.join(names)}; declared are {', '.join(self.order)}",
            )
        return values[..., [names.index(name) for name in self.order]]

    def ours(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Joints (..., k) in rad and the width (...) in m of numbers (..., n) in order.

        The width is 0 where there is no gripper, and not bounded where there is one.
        """
        joints_rad = (values[..., self._columns] - self._zero) / self._per_rad
        if self._gripper is None:
            return joints_rad, np.zeros(values.shape[:-1])
        number = values[..., self.order.index(self._gripper.name)]
        share = (number - self._gripper.shut) / (self._gripper.open - self._gripper.shut)
        return joints_rad, share * self._max_width_m

    def theirs(self, joints_rad: FloatArray, width_m: FloatArray) -> FloatArray:
        """Numbers (..., n) in order of joints (..., k) in rad and widths (...) in m."""
        values = np.empty((*joints_rad.shape[:-1], len(self.order)))
        values[..., self._columns] = self._zero + joints_rad * self._per_rad
        if self._gripper is not None:
            share = np.clip(width_m / self._max_width_m, 0.0, 1.0)
            way = self._gripper.open - self._gripper.shut
            values[..., self.order.index(self._gripper.name)] = self._gripper.shut + share * way
        return values
