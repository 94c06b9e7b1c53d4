"""A person's motion in the numbers of a model's spec.

A person's chunks have numbers of their own (deltas of a terminal, joints of a leader arm). What
they asked for is in the goals that the arm was commanded to reach: an action is the way from the
goal at the beginning of a frame to that at its end, or that pose or those joints themselves.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from vla_zenoh_policy_servers.state_vector import home_reference

from vla_zenoh.errors import RecordingError
from vla_zenoh.kinematics.so3 import Pose, pose_of, quat_from_rotation, rotation_from_quat
from vla_zenoh.lab.recording.run import Run, newest
from vla_zenoh.policy import ActionSpec
from vla_zenoh.policy.meaning import IDENTITY
from vla_zenoh.types import FloatArray


def commanded_motion(run: Run, spec: ActionSpec) -> Callable[[int, int], NDArray[np.float32]]:
    """`CommandedMotion.action` of a run, of all parts of its robot."""
    own = [CommandedMotion(run.of_part(each.part), each.action) for each in spec.parts]
    if not own:
        return CommandedMotion(run, spec).action
    return lambda since_ns, until_ns: np.concatenate(
        [motion.action(since_ns, until_ns) for motion in own]
    )


class CommandedMotion:
    """What the arm was commanded to do, as actions.

    Poses are the goals of the commands; where joints were commanded, the measured poses. Joints
    are those commanded; where poses were commanded, the measured ones.

    Args:
        spec: of the actions; deltas are added to the step before, velocities are those of a step.

    Raises:
        RecordingError: such actions cannot be made of a motion.
    """

    def __init__(self, run: Run, spec: ActionSpec) -> None:
        if spec.controller is not None:
            raise RecordingError(
                f"{run.path}: the model's spec says that a controller covers only a part of each "
                "step, so a person's motion cannot be told in its numbers; export what each of "
                "them led with --worker"
            )
        self._run, self._spec = run, spec
        self._max_width_m = run.profile.robot.max_width_m
        # Absolute poses lie around the home orientation, deltas around no motion.
        absolute = spec.space == "tcp" and spec.kind == "absolute"
        self._reference = home_reference(run.profile) if absolute else IDENTITY

    def action(self, since_ns: int, until_ns: int) -> NDArray[np.float32]:
        """(D,) the step from one time to another, wall ns.

        Raises:
            RecordingError: neither command nor state was recorded until then.
        """
        spec = self._spec
        if spec.space == "joint":
            arm = self._joints(until_ns)
            if spec.kind != "absolute":
                arm = arm - self._joints(since_ns)
        else:
            arm = self._way(self._pose(since_ns), self._pose(until_ns))
        if spec.kind == "velocity":
            arm = np.divide(arm, spec.dt_s)
        gripper = () if spec.gripper == "none" else (self._gripper(since_ns, until_ns),)
        return np.array([*arm, *gripper], np.float32)

    def _way(self, before: Pose, after: Pose) -> list[float]:
        spec = self._spec
        if spec.kind == "absolute":
            moved, turn = after.position_m, after.rotation
        elif spec.frame == "tcp":
            into = before.rotation.T
            moved, turn = into @ (after.position_m - before.position_m), into @ after.rotation
        else:
            moved = after.position_m - before.position_m
            turn = after.rotation @ before.rotation.T
        turned = spec.rotation_form.encode(quat_from_rotation(turn), self._reference)
        return [*(moved / spec.position_scale_m), *turned]

    def _gripper(self, since_ns: int, until_ns: int) -> float:
        spec, width_m = self._spec, self._width_m(until_ns)
        if spec.gripper == "delta_m":
            return width_m - self._width_m(since_ns)
        share = min(width_m / self._max_width_m, 1.0)
        if spec.gripper == "binary":
            share = float(share > 0.5)
        return spec.gripper_scale(self._max_width_m).encode(share)

    # -- what was recorded --------------------------------------------------------------------
    def _pose(self, at_ns: int) -> Pose:
        command = newest(self._run.commands, at_ns)
        if command is not None:
            goal = command.record
            return Pose(goal.goal_position_m, rotation_from_quat(goal.goal_quat_xyzw))
        state = newest(self._run.poses, at_ns)
        if state is None:
            raise self._missing("neither command/pose nor state/pose", at_ns)
        return pose_of(state.record)

    def _joints(self, at_ns: int) -> FloatArray:
        found = newest(self._run.joint_commands, at_ns) or newest(self._run.joints, at_ns)
        if found is None:
            raise self._missing("neither command/joint nor state/joint", at_ns)
        position = dict(zip(found.record.names, found.record.position_rad, strict=True))
        return np.array([position[name] for name in self._spec.joints])

    def _width_m(self, at_ns: int) -> float:
        found = newest(self._run.gripper_commands, at_ns) or newest(self._run.grippers, at_ns)
        if found is None:
            raise self._missing("neither command/gripper nor state/gripper", at_ns)
        if found.record.width_m is None:
            raise RecordingError(f"{self._run.path}: {self._run.profile.robot.no_gripper}")
        return max(float(found.record.width_m), 0.0)

    def _missing(self, what: str, at_ns: int) -> RecordingError:
        since_s = (at_ns - self._run.began_ns) / 1e9
        return RecordingError(
            f"{self._run.path}: a person led the arm, and {what} was recorded until {since_s:.1f} "
            "s, so what the person asked for is unknown; record all keys"
        )
