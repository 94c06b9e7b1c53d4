"""What the numbers of a rotation and of a gripper mean, in both directions.

Every place that turns a rotation or an opening into numbers, or numbers into one, uses these
classes: steps, states, committed steps, data sets and the fields of policy servers.

One rotation has many numbers in most forms: both signs of a quaternion, angles that differ by a
turn. `RotationForm.encode` picks those nearest to a fixed reference, so that they are continuous
wherever the rotation is less than half a turn away from it. They depend on nothing else: they are
the same in every episode, data set and server. With the identity as reference they are the usual
ones: w >= 0, angles within [-pi, pi].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import SpecError
from vla_zenoh.types import JointState

Numbers = Sequence[float] | NDArray[np.float64]
TURN_RAD = 2 * math.pi
IDENTITY = (0.0, 0.0, 0.0, 1.0)
"""The rotation that does not turn, as x, y, z, w."""
CLEAR = 0.01
"""A w, or an angle's distance from -pi, that is not rounding of a half turn."""
UPRIGHT = 1e-7
"""Cosine of a pitch so near to 90 degrees that roll and yaw turn about the same axis."""
QUATERNION_SLACK = 0.1
"""A quaternion this far from unit length is normalised; further off it is rejected."""
SHORTEST_COLUMN = 0.1
"""Columns of a 6D rotation may have any length from this up: they are made orthonormal."""


# -- rotations ------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class RotationForm:
    """One way to write a rotation as numbers.

    Args:
        names: of its numbers.
        encode: numbers of a unit quaternion x, y, z, w, those nearest to a reference quaternion.
        decode: the unit quaternion x, y, z, w of such numbers; raises a `SpecError` where they are
            no rotation.
        angles: each number is an angle that may be a turn more or less.
    """

    names: tuple[str, ...]
    encode: Callable[[Numbers, Numbers], list[float]]
    decode: Callable[[Numbers], list[float]]
    angles: bool = False

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return len(self.names)

    def follow(self, numbers: Numbers, quaternion: Numbers) -> list[float]:
        """The numbers of a quaternion that follow on others of this form, without a cut."""
        found = self.encode(quaternion, self.decode(numbers))
        if not self.angles:
            return found
        return [_nearest_angle(angle, float(b)) for angle, b in zip(found, numbers, strict=True)]


def reference(quaternion: Numbers) -> tuple[float, float, float, float]:
    """A quaternion x, y, z, w as reference: its sign does not depend on rounding.

    w is positive; of a half turn the largest of x, y and z is.
    """
    x, y, z, w = (float(value) for value in quaternion)
    leading = w if abs(w) > CLEAR else max((x, y, z), key=abs)
    sign = math.copysign(1.0, leading)
    return sign * x, sign * y, sign * z, sign * w


def toward(quaternion: Numbers, near: Numbers) -> list[float]:
    """The same rotation, with the sign that is nearer to the quaternion `near`."""
    given = [float(value) for value in quaternion]
    ahead = sum(a * float(b) for a, b in zip(given, near, strict=True))
    return [-value for value in given] if ahead < 0.0 else given


def _wxyz(quaternion: Numbers, near: Numbers) -> list[float]:
    *axis, w = toward(quaternion, near)
    return [w, *axis]


def _rotvec(quaternion: Numbers, near: Numbers) -> list[float]:
    x, y, z, w = toward(quaternion, near)
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 2 * math.atan2(sine, w) / sine if sine > 0 else 2.0
    return [factor * x, factor * y, factor * z]


def _rpy(quaternion: Numbers, near: Numbers) -> list[float]:
    near_roll, _, near_yaw = (
        angle + 2 * math.pi if angle < CLEAR - math.pi else angle
        for angle in _principal_rpy(near, upright=CLEAR)
    )
    roll, pitch, yaw = _principal_rpy(quaternion, near_roll)
    return [_nearest_angle(roll, near_roll), pitch, _nearest_angle(yaw, near_yaw)]


def _principal_rpy(
    quaternion: Numbers, free_roll_rad: float = 0.0, upright: float = UPRIGHT
) -> tuple[float, float, float]:
    """Angles within [-pi, pi]; with a pitch of 90 degrees the roll is `free_roll_rad`."""
    x, y, z, w = quaternion
    ahead, aside = 1 - 2 * (y * y + z * z), 2 * (w * z + x * y)
    sine, cosine = 2 * (w * y - z * x), math.hypot(ahead, aside)
    pitch = math.atan2(sine, cosine)
    if cosine < upright:  # only the sum, or difference, of the other two is known
        side = math.copysign(1.0, sine)
        return free_roll_rad, pitch, side * (free_roll_rad - 2 * math.atan2(x, w))
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return roll, pitch, math.atan2(aside, ahead)


def _nearest_angle(angle_rad: float, near_rad: float) -> float:
    return angle_rad + TURN_RAD * round((near_rad - angle_rad) / TURN_RAD)


def _columns(quaternion: Numbers, near: Numbers) -> list[float]:
    """First two columns of the rotation matrix, one after the other; no two are of one rotation."""
    x, y, z, w = quaternion
    return [
        1 - 2 * (y * y + z * z),
        2 * (x * y + z * w),
        2 * (x * z - y * w),
        2 * (x * y - z * w),
        1 - 2 * (x * x + z * z),
        2 * (y * z + x * w),
    ]


def _rows(quaternion: Numbers, near: Numbers) -> list[float]:
    x, y, z, w = quaternion
    return _columns((-x, -y, -z, w), near)  # the rows are the columns of the inverse


def _of_quat(numbers: Numbers) -> list[float]:
    length = math.hypot(*numbers)
    if not abs(length - 1.0) <= QUATERNION_SLACK:
        raise SpecError(f"a quaternion of norm {length:.3g}; wanted 1", "quaternion")
    return [float(value) / length for value in numbers]


def _of_wxyz(numbers: Numbers) -> list[float]:
    w, *axis = _of_quat(numbers)
    return [*axis, w]


def _of_rotvec(turn_rad: Numbers) -> list[float]:
    angle_rad = math.hypot(*turn_rad)
    factor = math.sin(angle_rad / 2) / angle_rad if angle_rad > 0 else 0.5
    return [*(factor * float(value) for value in turn_rad), math.cos(angle_rad / 2)]


def _of_rpy(turns_rad: Numbers) -> list[float]:
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a / 2), math.cos(a / 2)) for a in turns_rad)
    return [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]


def _of_columns(numbers: Numbers) -> list[float]:
    """Gram and Schmidt: the first column keeps its direction.

    Source: Zhou, Barnes, Lu, Yang, Li, "On the continuity of rotation representations in neural
    networks", CVPR 2019, equation 15.
    """
    given = np.asarray(numbers, np.float64)
    first, second = given[:3], given[3:]
    second = second / max(1.0, float(np.linalg.norm(second)))  # what is parallel leaves no noise
    long = float(np.linalg.norm(first))
    if long >= SHORTEST_COLUMN:
        first = first / long
        second = second - (first @ second) * first
    aside = float(np.linalg.norm(second))
    if not (long >= SHORTEST_COLUMN and aside >= SHORTEST_COLUMN):
        raise SpecError(
            f"a 6D rotation whose columns have the lengths {long:.3g} and {aside:.3g} across each "
            "other; wanted 1 and 1",
            "rotation_6d",
        )
    second = second / aside
    return quat_of_matrix(np.stack([first, second, np.cross(first, second)], axis=1).tolist())


def _of_rows(numbers: Numbers) -> list[float]:
    x, y, z, w = _of_columns(numbers)
    return [-x, -y, -z, w]


def quat_of_matrix(rows: Sequence[Sequence[float]]) -> list[float]:
    """Unit quaternion x, y, z, w with w >= 0 of a rotation matrix.

    Its greatest component is computed first, of the diagonal, and divides the others.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rows
    if xx + yy + zz > 0.0:
        q = (zy - yz, xz - zx, yx - xy, 1.0 + xx + yy + zz)
    elif xx >= yy and xx >= zz:
        q = (1.0 + xx - yy - zz, xy + yx, xz + zx, zy - yz)
    elif yy >= zz:
        q = (xy + yx, 1.0 - xx + yy - zz, yz + zy, xz - zx)
    else:
        q = (xz + zx, yz + zy, 1.0 - xx - yy + zz, yx - xy)
    norm = math.copysign(math.hypot(*q), q[3])
    return [value / norm for value in q]


_QUAT = RotationForm(("qx", "qy", "qz", "qw"), toward, _of_quat)
ROTATION_FORMS: Mapping[str, RotationForm] = {
    "rpy": RotationForm(("roll", "pitch", "yaw"), _rpy, _of_rpy, angles=True),
    "rotvec": RotationForm(("rx", "ry", "rz"), _rotvec, _of_rotvec),
    "quaternion": _QUAT,
    "quat_xyzw": _QUAT,
    "quat_wxyz": RotationForm(("qw", "qx", "qy", "qz"), _wxyz, _of_wxyz),
    "rotation_6d": RotationForm(("r11", "r21", "r31", "r12", "r22", "r32"), _columns, _of_columns),
    "rotation_6d_rows": RotationForm(("r11", "r12", "r13", "r21", "r22", "r23"), _rows, _of_rows),
}
"""Every form by name. ``rpy``: extrinsic x, y, z, rad; ``rotvec``: axis times angle, rad;
``rotation_6d``: the first two columns of the matrix (Zhou et al.); ``rotation_6d_rows``: its first
two rows, as PyTorch3D, UMI and Diffusion Policy have it."""


def unturned(rotation: str) -> list[float]:
    """The numbers of a rotation that does not turn."""
    return ROTATION_FORMS[rotation].encode(IDENTITY, IDENTITY)


# -- joints that turn without an end --------------------------------------------------------------
def nearest_turn(angles_rad: NDArray[Any], near_rad: NDArray[Any]) -> NDArray[np.float64]:
    """Angles (n,) or (k, n), each by whole turns as near as it gets to that of `near_rad`."""
    return angles_rad + TURN_RAD * np.round((near_rad - angles_rad) / TURN_RAD)


def wrapped(angles_rad: NDArray[Any]) -> NDArray[np.float64]:
    """The same angles within (-pi, pi]."""
    return angles_rad - TURN_RAD * np.ceil((angles_rad - math.pi) / TURN_RAD)


def joints_as(state: JointState, turns: str) -> JointState:
    """A state with its endless joints as `ActionSpec.turns` says: ``wrapped`` or ``counted``."""
    if turns == "counted" or not state.endless:
        return state
    endless = np.isin(state.names, state.endless)
    both = (state.position_rad, state.reference_rad)
    position_rad, reference_rad = (
        None if each is None else np.where(endless, wrapped(each), each) for each in both
    )
    return replace(state, position_rad=position_rad, reference_rad=reference_rad)


# -- openings of a gripper ------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class GripperScale:
    """Numbers that say how far a gripper is open, linear in its width.

    Args:
        shut: the number where it is shut.
        opened: the number where it is open.
    """

    shut: float = 0.0
    opened: float = 1.0

    def encode(self, share: float) -> float:
        """The number of a share of the opening, 0 shut to 1 open."""
        return self.shut + share * (self.opened - self.shut)

    def decode(self, number: float) -> float:
        """The share of the opening that a number says, 0 shut to 1 open."""
        return (number - self.shut) / (self.opened - self.shut)


SHARE = GripperScale()
"""The share itself."""
