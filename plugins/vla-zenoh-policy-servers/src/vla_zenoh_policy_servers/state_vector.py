"""A robot's state as the numbers a policy was trained on, and back.

For model environments: numpy alone. Parts are joined by ``+``, as in ``position+rotvec+gripper_m``:

    joint, joint_deg                positions of the arm's joints, rad or degrees: as many as it has
    position, x y z                 TCP in the base frame, m
    rpy, roll pitch yaw             its rotation: extrinsic x, y, z, rad
    rotvec, rx ry rz                its rotation: axis times angle, rad
    quat_xyzw, quat_wxyz            its rotation: unit quaternion
    rotation_6d, rotation_6d_rows   its rotation: first two columns, or rows, of the matrix
    wrench                          external, at the TCP: force N, torque Nm, base axes
    effort                          of the arm's joints, Nm
    gripper_m, fingers_m            opening, m; both fingers, +half and -half of it, m
    gripper_open, gripper_closed    0 shut to 1 open, and 0 open to 1 shut
    zero, zero*N                    N zeros, for what this robot does not have

`StateUnits` says in which units, where a policy has others.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import MissingExtraError, SpecError
from vla_zenoh.kinematics.description import sliding_joints
from vla_zenoh.policy import Observation, StatePart
from vla_zenoh.policy.meaning import (
    CLEAR,
    IDENTITY,
    QUATERNION_SLACK,
    ROTATION_FORMS,
    SHARE,
    TURN_RAD,
    GripperScale,
)
from vla_zenoh.policy.options import number
from vla_zenoh.policy.spec import FIELD_OF
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, JointState
from vla_zenoh_policy_servers.action_semantics import HOME, METRIC, SCALED, StateUnits

ROTATIONS = tuple(name for name in ROTATION_FORMS if name != "quaternion")
CUT = ("rpy", "rotvec", "quat_xyzw", "quat_wxyz")
"""Forms in which a rotation has several numbers, so that a reference chooses."""
COORDINATES: Mapping[str, tuple[str, ...]] = {
    "position": ("x", "y", "z"),
    **{name: ROTATION_FORMS[name].names for name in SCALED},
}
"""Parts whose numbers have names of their own."""
PARTS: Mapping[str, tuple[StatePart | None, int | None]] = {
    "joint": ("joint", None),
    "joint_deg": ("joint", None),
    **{whole: ("pose", 3) for whole in COORDINATES},
    **{name: ("pose", 1) for names in COORDINATES.values() for name in names},
    **{name: ("pose", ROTATION_FORMS[name].size) for name in ROTATIONS if name not in SCALED},
    "gripper_m": ("gripper", 1),
    "fingers_m": ("gripper", 2),
    "gripper_open": ("gripper", 1),
    "gripper_closed": ("gripper", 1),
    "wrench": ("wrench", 6),
    "effort": ("effort", None),
    "zero": (None, 1),
}
"""Name -> which part of the robot's state it is taken from, and how many numbers it has; None: as
many as the arm has joints."""

_ZEROS = re.compile(r"zero\*([1-9][0-9]{0,3})")
_WHOLE = {name: (whole, i) for whole, names in COORDINATES.items() for i, name in enumerate(names)}
MOST_TURNED_RAD = 1.1 * TURN_RAD
"""A rotation has no larger angles, whatever it is told nearest to."""
GRIPPERS = ("gripper_m", "fingers_m", "gripper_open", "gripper_closed")


# -- names ----------------------------------------------------------------------------------------
def read_parts(text: str) -> tuple[str, ...]:
    """Names of the parts in ``position+rotvec+zero*2``, zeros one by one; none of an empty text.

    Raises:
        SpecError: a name that is not known; says what there is.
    """
    names: list[str] = []
    for name in (part.strip() for part in text.split("+") if text.strip()):
        zeros = _ZEROS.fullmatch(name)
        if zeros is None and name not in PARTS:
            raise SpecError(f"no part of the state is called {name!r}; there are: {known_parts()}")
        names += ["zero"] * int(zeros[1]) if zeros is not None else [name]
    return tuple(names)


def read_state(text: str, size: int, joints: int, *more: int) -> tuple[str, ...]:
    """Names of the parts in `text`, whose numbers are `size` in all.

    Args:
        text: see `read_parts`; of a robot of several arms that of each, one after the other.
        size: how many numbers the model wants.
        more: how many each further arm has.

    Raises:
        SpecError: a name that is not known, or another count; says what there is.
    """
    names = read_parts(text)
    found = sum(size_of(name, count) for count in (joints, *more) for name in names)
    if found != size:
        each = f" of {1 + len(more)} arms" if more else ""
        raise SpecError(
            f"the model's state has {size} numbers, {text!r}{each} has {found}; "
            f"join its parts by +, in order: {known_parts(joints)}"
        )
    return names


def size_of(name: str, joints: int) -> int:
    """Size of a part, for an arm with `joints`."""
    count = PARTS[name][1]
    return joints if count is None else count


def known_parts(joints: int | None = None) -> str:
    """All names with their sizes, as text; `joints`: of the arm, if known."""
    counts = {name: count for name, (_, count) in PARTS.items()}
    of_arm = "one for each of the arm's" if joints is None else joints
    return ", ".join(
        f"{name} ({of_arm if count is None else count})" for name, count in counts.items()
    )


def parts_of(names: Sequence[str]) -> tuple[StatePart, ...]:
    """Parts of the state that a model must observe for them."""
    return tuple(dict.fromkeys(part for name in names if (part := PARTS[name][0]) is not None))


# -- a state as numbers ---------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class StateNumbers:
    """A state in the numbers of a policy, in both directions; made by `state_numbers`.

    Args:
        names: of `read_parts`.
        joints: names of the arm's, in the order in which they are told.
        max_width_m: of the open gripper.
        units: of the numbers.
        reference: quaternion x, y, z, w; of the numbers of a rotation those nearest to it are told.
    """

    names: tuple[str, ...]
    joints: tuple[str, ...]
    max_width_m: float
    units: StateUnits = METRIC
    reference: tuple[float, ...] = IDENTITY

    @property
    def size(self) -> int:
        """How many numbers there are."""
        return sum(size_of(name, len(self.joints)) for name in self.names)

    def encode(self, observation: Observation) -> NDArray[np.float32]:
        """(n,) the numbers of an observation that has the state of `parts_of`.

        Raises:
            SpecError: it lacks a part.
        """
        out: list[float] = []
        for name in self.names:
            whole, index = _WHOLE.get(name, (name, None))
            part = PARTS[name][0]
            measured = None if part is None else getattr(observation, FIELD_OF.get(part, part))
            if part is not None and measured is None:
                raise SpecError(f"the observation has no {part}, of which {name!r} is a part")
            if PARTS[name][1] is None:
                measured = self._ordered(observation, measured)
            values = self._encoded(whole, measured)
            out += values if index is None else [values[index]]
        return np.array(out, np.float32)

    def _encoded(self, name: str, measured: Any) -> list[float]:
        units = self.units
        if name == "joint_deg":
            return np.rad2deg(measured).tolist()
        if name == "joint":
            unit = np.array(units.joint_scales)
            return (measured / unit + units.joint_zeros).tolist()
        if name == "position":
            return (measured.position_m / units.position_scale_m).tolist()
        if name in ROTATIONS:
            values = ROTATION_FORMS[name].encode(measured.quat_xyzw, self.reference)
            return [value / self._unit_of(name) for value in values]
        if name in GRIPPERS:
            if measured.width_m is None:
                raise SpecError(f"the state has {name}, and this robot has no gripper")
            share = measured.width_m / self.max_width_m
            if name == "fingers_m":
                return [measured.width_m / 2, -measured.width_m / 2]
            if name != "gripper_m":
                share = min(max(share, 0.0), 1.0)
            return [self._scale_of(name).encode(share)]
        return [0.0] if name == "zero" else measured.tolist()

    def _ordered(self, observation: Observation, measured: Any) -> FloatArray:
        """What was measured of each joint, in the order of `joints`."""
        if isinstance(measured, JointState):
            names, measured = measured.names, measured.position_rad
        elif observation.joint is not None:
            names = observation.joint.names
        else:
            return measured
        if names == self.joints:
            return measured
        place = {name: index for index, name in enumerate(names)}
        missing = [name for name in self.joints if name not in place]
        if missing:
            raise SpecError(
                f"the state has no joint {', '.join(missing)}; it has {', '.join(names)}"
            )
        return measured[[place[name] for name in self.joints]]

    def decode(self, numbers: NDArray[np.float64]) -> dict[str, Any]:
        """The inverse of `encode`: what the numbers say of the robot.

        Single coordinates (``x``, ``roll``) are not read back.

        Returns:
            any of ``joint`` (n,) rad, ``position_m`` (3,), ``quat_xyzw`` (4,), ``width_m``.

        Raises:
            SpecError: another count of numbers, angles of more than a turn, or a part that cannot
                be read back.
        """
        if numbers.shape != (self.size,):
            raise SpecError(
                f"{'+'.join(self.names)} has shape {numbers.shape}, wanted ({self.size},)", "shape"
            )
        units, out = self.units, dict[str, Any]()
        at = 0
        for name in self.names:
            size = size_of(name, len(self.joints))
            values, at = numbers[at : at + size], at + size
            if name == "joint_deg":
                out["joint"] = np.deg2rad(values)
            elif name == "joint":
                out["joint"] = (values - units.joint_zeros) * np.array(units.joint_scales)
            elif name == "position":
                out["position_m"] = values * units.position_scale_m
            elif name in ROTATIONS:
                given = (values * self._unit_of(name)).tolist()
                if name in SCALED and max(map(abs, given)) > MOST_TURNED_RAD:
                    why = f"{name} has {max(given, key=abs):.4g} rad: is it in degrees?"
                    raise SpecError(why, "implausible_state")
                out["quat_xyzw"] = self._near(ROTATION_FORMS[name].decode(given))
            elif name == "fingers_m":
                out["width_m"] = float(values[0] - values[1])
            elif name in GRIPPERS:
                out["width_m"] = self.max_width_m * self._scale_of(name).decode(float(values[0]))
            elif name != "zero":
                raise SpecError(f"{name} alone says too little; give position and rpy or quat_xyzw")
        return out

    def _near(self, quat_xyzw: list[float]) -> FloatArray:
        return np.array(ROTATION_FORMS["quat_xyzw"].encode(quat_xyzw, self.reference))

    def _unit_of(self, rotation: str) -> float:
        return self.units.rotation_scale_rad if rotation in SCALED else 1.0

    def _scale_of(self, gripper: str) -> GripperScale:
        if gripper == "gripper_m":
            return GripperScale(0.0, self.max_width_m)
        return GripperScale(1.0, 0.0) if gripper == "gripper_closed" else self.units.gripper


def only_others_grip(part: str, arms: Mapping[str, Profile]) -> bool:
    """Whether this one of several arms has no gripper, and another has one."""
    without = [name for name, arm in arms.items() if arm.robot.no_gripper]
    return part in without and len(without) < len(arms)


def names_of_part(names: Sequence[str], part: str, arms: Mapping[str, Profile]) -> list[str]:
    """The names of the state of one of several arms: those of a gripper only where it has one."""
    bare = only_others_grip(part, arms)
    return [name for name in names if not (bare and name in GRIPPERS)]


def state_numbers(
    names: Sequence[str], profile: Profile, units: StateUnits = METRIC
) -> StateNumbers:
    """The numbers of a state of the profile's robot.

    Args:
        names: of `read_parts`.
        profile: of one arm, see `Profile.of_part`.
        units: of the numbers.

    Raises:
        SpecError: a part and a unit that contradict each other, or an invalid reference.
        ProfileError, ResourceError: rotations need the home orientation, and the robot's
            description does not give it.
    """
    if "gripper_closed" in names and units.gripper != SHARE:
        raise SpecError(
            "the state has gripper_closed, which is 0 open to 1 shut, and gripper_range says other "
            "numbers: name gripper_open, which has them"
        )
    turned = any(units.joint_zeros) or min(units.joint_scales) < 0
    if "joint_deg" in names and turned:
        raise SpecError(
            "the state has joint_deg, degrees from the profile's zero, and joint_zero or "
            "joint_scale_rad says another zero or direction: name joint, which has them"
        )
    if "joint_deg" in names and (sliding := sliding_joints(profile.robot)):
        raise SpecError(
            f"the state has joint_deg, and {', '.join(sorted(sliding))} slides: name joint, with "
            "joint_scale_rad where others are in degrees"
        )
    robot = profile.robot
    cut = any(_WHOLE.get(name, (name,))[0] in CUT for name in names)
    given = units.rotation_reference
    near = read_reference(given) if given != HOME else home_reference(profile) if cut else IDENTITY
    grips = [name for name in names if name in GRIPPERS]
    if grips and robot.no_gripper:
        raise SpecError(f"the state has {', '.join(grips)}, and {robot.no_gripper}: leave it out")
    return StateNumbers(tuple(names), robot.arm_joints, robot.max_width_m, units, near)


def home_reference(profile: Profile) -> tuple[float, ...]:
    """The TCP's orientation at `robot.home_rad` of one arm, as a reference.

    Raises:
        ProfileError, ResourceError, MissingExtraError: the robot's kinematics cannot be made.
    """
    try:
        from vla_zenoh.kinematics.kinematics import home_orientation
    except ImportError as error:
        raise MissingExtraError("pinocchio", "control") from error
    return home_orientation(profile)


def read_reference(text: str) -> tuple[float, ...]:
    """The quaternion of the option ``rotation_reference``.

    Raises:
        SpecError: neither home nor a unit quaternion x,y,z,w with w >= 0.
    """
    entries = text.split(",")
    found = tuple(number("rotation_reference", entry.strip(), least=-math.inf) for entry in entries)
    length = math.hypot(*found)
    if len(found) != 4 or abs(length - 1.0) > QUATERNION_SLACK or found[3] < -CLEAR:
        raise SpecError(
            f"rotation_reference is {text!r}; wanted home, or a unit quaternion x,y,z,w with w >= 0"
        )
    return tuple(value / length for value in found)
