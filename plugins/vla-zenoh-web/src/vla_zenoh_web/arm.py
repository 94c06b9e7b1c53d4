"""The arm as lines in the base frame: its joints, chunk, workspace and keep-outs. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_zenoh.control.actions import chunk_poses, step_joints
from vla_zenoh.errors import RecordError
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.policy import ActionSpec
from vla_zenoh.profile import PartBase, Profile
from vla_zenoh.types import FloatArray, HeldBox, JointState

MAX_LINE = 60
"""Points of a chunk that are drawn."""
Line = list[list[float]]


def rounded(points: FloatArray | Sequence[FloatArray]) -> Line:
    """Points (n, 3) m as lists, to the tenth of a millimetre."""
    return np.round(np.asarray(points, float), 4).tolist()


def corners_of(box: HeldBox, tcp: Pose) -> Line:
    """The eight corners (8, 3) m of what a gripper holds at a TCP; x changes first, z last."""
    signs = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)])
    own = np.array(box.centre_m) + 0.5 * signs * np.array(box.size_m)
    return rounded(own @ tcp.rotation.T + tcp.position_m)


def surroundings(profile: Profile) -> dict[str, dict[str, Any]]:
    """What stays, by part: base (x, y, z m, yaw rad); workspace, table, keep-outs, m, in it."""
    return {name: _around(profile, name) for name in profile.part_names}


def _around(profile: Profile, name: str) -> dict[str, Any]:
    base = profile.parts[name].base if name else PartBase()
    limits = profile.of_part(name).limits
    space, reach = limits.tcp_box, limits.reach
    return {
        "base": [*base.position_m, base.yaw_rad],
        "workspace": [list(space.x_m), list(space.y_m), list(space.z_m)],
        "table_z_m": reach.table_z_m,
        "keep_out": {
            name: shape.model_dump(exclude_none=True) for name, shape in reach.keep_out.items()
        },
    }


class ArmLines:
    """Lines of the arm and of what it is about to do.

    Args:
        kinematics: of the arm; it is used by one thread.
    """

    def __init__(self, kinematics: Kinematics) -> None:
        self._kinematics = kinematics

    def links(self, joints_rad: FloatArray) -> Line:
        """Base, joints and TCP at joint positions (n,), along the arm."""
        kinematics = self._kinematics
        tcp = kinematics.forward(joints_rad)
        placements = list(kinematics.data.oMi)[1:]
        joints = [kinematics.base_placement.actInv(each).translation for each in placements]
        return rounded([np.zeros(3), *joints, tcp.position_m])

    def links_of(self, state: JointState) -> Line:
        """The same, measured. Raises RecordError: it is not of this arm."""
        return self.links(self._kinematics.joints_of(state))

    def tcp(self, names: Sequence[str], joints_rad: FloatArray) -> list[float]:
        """Position of the TCP, m. Raises RecordError: it is not of this arm."""
        pose = self._kinematics.forward(self._kinematics.ordered(names, joints_rad))
        return rounded([pose.position_m])[0]

    def chunk(
        self, steps: NDArray[Any], action: ActionSpec, start: Pose, state: JointState | None
    ) -> Line:
        """Path of the TCP that a chunk asks for.

        Args:
            steps: (H, D) of a chunk, those of this arm.
            start: where it begins, with poses.
            state: where it begins, with joints; None: unknown.

        Raises:
            RecordError: it does not fit the spec.
        """
        steps = steps[:MAX_LINE]
        if steps.shape[1] != action.dimension:
            raise RecordError(f"a step has {steps.shape[1]} numbers, not {action.dimension}")
        if action.space == "tcp":
            poses = chunk_poses(action, steps, start)
            return rounded([start.position_m, *(pose.position_m for pose in poses)])
        if state is None:
            return []
        first = self._kinematics.joints_of(state)
        if set(action.joints) != set(self._kinematics.arm_joints):
            raise RecordError("its joints are not those of the arm")
        order = [action.joints.index(name) for name in self._kinematics.arm_joints]
        there = np.argsort(order)
        before = anchor = first[there]
        endless = self._kinematics.endless[there]
        line = [self._kinematics.forward(first).position_m]
        for step in steps:
            before = step_joints(action, np.asarray(step, np.float64), before, anchor, endless)
            line.append(self._kinematics.forward(before[order]).position_m)
        return rounded(line)
