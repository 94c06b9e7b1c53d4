"""A model of ours, asked by a robot that speaks R2C: an observation in, joint positions out.

The model may act in joints or on the pose of the TCP: poses become joints by the kinematics of the
profile. What it answers is brought to the robot's own step duration, and is refused as a whole
where a step leaves the range of a joint, or is faster than ``limits.joint`` allows.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np

from vla_zenoh.control.actions import chunk_poses, step_joints, step_width
from vla_zenoh.errors import CodecError, PeerError, SpecError
from vla_zenoh.kinematics.kinematics import InverseKinematics, make_kinematics
from vla_zenoh.kinematics.plausibility import state_fault
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.policy import ActionSteps, Observation, Policy, check_steps, reset_of
from vla_zenoh.policy.inference import ChunkPrefix
from vla_zenoh.policy.meaning import joints_as, nearest_turn
from vla_zenoh.policy.observation import prepare_image
from vla_zenoh.profile import Profile
from vla_zenoh.types import FloatArray, GripperState, JointState, PoseState, Task
from vla_zenoh_r2c.declared import DeclaredRobot, Numbers
from vla_zenoh_r2c.pictures import read_image
from vla_zenoh_r2c.wire import MAX_STEPS, Seen, Steps

ARRIVED_RAD = 0.05
"""A robot that is this near to the end of its last chunk goes on from that end, not from where it
sags to: deltas would lose the rest each time."""
SLACK = 1.01
"""A step may be this much faster than its limit: rounding, and the robot's own clock."""
SLACK_RAD = 1e-6


class Answers:
    """A model's answers to one robot.

    Args:
        policy: the model.
        robot: as declared.
        profile: of the same arm: its kinematics and limits.

    Raises:
        SpecError: the model needs what no observation of this robot has; names it.
        ProfileError: robot and profile do not fit.
    """

    def __init__(self, policy: Policy, robot: DeclaredRobot, profile: Profile) -> None:
        profile.require_one_arm("serve r2c")
        self._policy, self._robot, self._profile = policy, robot, profile
        self._numbers = Numbers(robot, profile)
        spec = policy.spec
        lacking = [f"camera {name}" for name in _cameras(policy) if name not in robot.cameras]
        lacking += [part for part in spec.observation.state if part not in _MEASURED]
        if "gripper" in spec.observation.state and not self._numbers.grips:
            lacking.append("gripper")
        lacking += ["depth"] if spec.observation.depth else []
        lacking += ["a history of observations"] if spec.observation.history > 1 else []
        if lacking:
            raise SpecError(f"the model needs {', '.join(lacking)}; the robot's file has none")
        if spec.action.parts:
            raise SpecError("the model moves a robot of several parts; one arm is served")
        self._joints = profile.robot.arm_joints
        if spec.action.space == "joint" and set(spec.action.joints) != set(self._joints):
            raise SpecError(
                f"the model moves {', '.join(spec.action.joints)}; the profile has "
                f"{', '.join(self._joints)}"
            )
        self._kinematics = make_kinematics(profile)
        self._in_chain = [self._joints.index(name) for name in self._kinematics.arm_joints]
        self._in_profile = [self._kinematics.arm_joints.index(name) for name in self._joints]
        self._endless = self._kinematics.endless[self._in_profile]
        home_rad = np.array(profile.robot.home_rad)
        self._inverse = InverseKinematics(
            self._kinematics, home_rad[self._in_chain], joint_margin_rad=0.0
        )
        velocity = profile.limits.joint.velocity_rad_s
        own = self._kinematics.velocity_rad_s[self._in_profile]
        self._velocity_rad_s = np.minimum(np.broadcast_to(velocity, own.shape), own)
        self._target: tuple[FloatArray, float] | None = None
        self._episode = 0
        self._followed = ChunkPrefix(policy)

    def reset(self) -> None:
        """Begin an episode."""
        self._target, self._episode = None, self._episode + 1
        self._followed = ChunkPrefix(self._policy)
        (reset_of(self._policy) or (lambda: None))()

    def answer(self, seen: Seen, stamp_ms: int) -> Steps:
        """The answer to an observation, made at `stamp_ms`.

        Raises:
            CodecError: the observation is not what the file declares.
            PeerError, SpecError, RecordError: the model has no answer, or one that is refused.
        """
        joint, gripper = self._measured(seen)
        joints_rad, width_m = joint.position_rad, gripper.width_m or 0.0
        observation = self._observe(seen, joint, gripper)
        result: Any = self._policy.infer(self._followed.with_progress(observation))
        steps = check_steps(
            self._policy.spec.action, result.steps if isinstance(result, ActionSteps) else result
        )
        self._followed.published(observation, steps, observation.stamp_wall_ns, obeyed=True)
        start_rad, start_m = self._start(joints_rad, width_m)
        ends_rad, widths_m = self._ends(steps, start_rad, start_m)
        rows_rad, rows_m = self._resampled(start_rad, start_m, ends_rad, widths_m)
        self._refuse(joints_rad, rows_rad)
        self._target = rows_rad[-1], float(rows_m[-1])
        position = self._numbers.theirs(rows_rad, rows_m)
        return Steps(stamp_ms, seen.id, self._numbers.order, position)

    def _measured(self, seen: Seen) -> tuple[JointState, GripperState]:
        """Joints and gripper of an observation; a `CodecError` where they are not this arm's."""
        numbers = self._numbers.ordered(seen.names, seen.position)
        joints_rad, opening_m = self._numbers.ours(numbers)
        still, endless = np.zeros(len(joints_rad)), itertools.compress(self._joints, self._endless)
        joint = JointState(self._joints, joints_rad, still, still, endless=tuple(endless))
        width_m = float(opening_m) if self._numbers.grips else None
        gripper = GripperState(width_m, moving=False, holding=False)
        most_m = self._profile.robot.max_width_m
        if why := state_fault(self._kinematics, most_m, joint, gripper):
            raise CodecError("implausible_state", f"joint_states: {why}")
        if width_m is not None:
            gripper = replace(gripper, width_m=min(max(width_m, 0.0), most_m))
        return joint, gripper

    def _observe(self, seen: Seen, joint: JointState, gripper: GripperState) -> Observation:
        spec, images = self._policy.spec.observation, {}
        for wanted in spec.cameras:
            camera = self._robot.cameras[wanted.camera]
            if camera.name not in seen.images:
                raise CodecError(
                    "images",
                    f"raw_images.color has no {camera.name!r}; it has "
                    f"{', '.join(seen.images) or 'none'}",
                )
            image = read_image(camera, seen.images[camera.name])
            images[wanted.camera] = prepare_image(image, wanted)
        if spec.prompt and not seen.task:
            raise CodecError("task", "task is empty, and the model needs a prompt")
        state = dict[str, Any]()
        if "joint" in spec.state:
            state["joint"] = joints_as(joint, self._policy.spec.action.turns)
        if "gripper" in spec.state:
            state["gripper"] = gripper
        if "pose" in spec.state:
            pose = self._kinematics.forward(joint.position_rad[self._in_chain])
            quat = quat_from_rotation(pose.rotation)
            state["pose"] = PoseState(pose.position_m, quat, np.zeros(6))
        hz = 1.0 / self._policy.spec.action.dt_s
        task = Task(self._episode, True, seen.task, self._policy.spec.name, hz)
        return Observation(seen.stamp_ms * 1_000_000, seen.id, task, images, **state)

    def _start(self, joints_rad: FloatArray, width_m: float) -> tuple[FloatArray, float]:
        """Where a chunk of deltas begins."""
        goal = self._policy.spec.action.anchor == "goal"
        if not goal or self._target is None:
            return joints_rad, width_m
        target_rad, target_m = self._target
        near_rad = nearest_turn(target_rad, joints_rad)
        target_rad = np.where(self._endless, near_rad, target_rad)
        if np.abs(target_rad - joints_rad).max() > ARRIVED_RAD:
            return joints_rad, width_m
        return target_rad, target_m

    def _ends(
        self, steps: Any, start_rad: FloatArray, start_m: float
    ) -> tuple[FloatArray, FloatArray]:
        """Joints (H, n) and width (H,) at the end of each of the model's steps."""
        action, most_m = self._policy.spec.action, self._profile.robot.max_width_m
        widths_m, width_m = list[float](), start_m
        for step in steps:
            wanted_m = step_width(action, step, width_m, most_m)
            width_m = width_m if wanted_m is None else wanted_m
            widths_m.append(width_m)
        rows = list[FloatArray]()
        if action.space == "joint":
            order = [action.joints.index(name) for name in self._joints]
            first_rad = np.empty(len(order))
            first_rad[order] = start_rad
            endless = np.empty(len(order), bool)
            endless[order] = self._endless
            before_rad = first_rad
            for step in steps:
                before_rad = step_joints(action, step, before_rad, first_rad, endless)
                rows.append(before_rad[order])
            return np.array(rows), np.array(widths_m)
        here_rad = start_rad[self._in_chain]
        start = self._kinematics.forward(here_rad)
        for nth, pose in enumerate(chunk_poses(action, steps, start)):
            found = self._inverse.approach(pose, here_rad)
            if not found.solved:
                raise PeerError(
                    "unreachable",
                    f"step {nth} is out of reach by {1e3 * found.error_m:.1f} mm and "
                    f"{math.degrees(found.error_rad):.1f} degrees",
                )
            here_rad = found.joints_rad
            rows.append(here_rad[self._in_profile])
        return np.array(rows), np.array(widths_m)

    def _resampled(
        self, start_rad: FloatArray, start_m: float, ends_rad: FloatArray, widths_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The same motion in steps of the robot."""
        dt_s, step_s = self._policy.spec.action.dt_s, 1.0 / self._robot.step_hz
        count = max(1, round(len(ends_rad) * dt_s / step_s))
        if count > MAX_STEPS:
            raise PeerError(
                "horizon",
                f"{len(ends_rad)} steps of {dt_s:g} s are {count} of the robot's, at most "
                f"{MAX_STEPS}",
            )
        known_s = dt_s * np.arange(len(ends_rad) + 1)
        at_s = np.linspace(known_s[-1] / count, known_s[-1], count)
        path_rad = np.vstack([start_rad, ends_rad])
        rows = [np.interp(at_s, known_s, column) for column in path_rad.T]
        return np.stack(rows, axis=1), np.interp(at_s, known_s, [start_m, *widths_m])

    def _refuse(self, measured_rad: FloatArray, rows_rad: FloatArray) -> None:
        """Raise a `PeerError` where a row is out of range, or too fast after the one before."""
        lower_rad = self._kinematics.lower_rad[self._in_profile]
        upper_rad = self._kinematics.upper_rad[self._in_profile]
        beyond = (rows_rad < lower_rad - SLACK_RAD) | (rows_rad > upper_rad + SLACK_RAD)
        if beyond.any():
            nth, joint = map(int, np.argwhere(beyond)[0])
            raise PeerError(
                "joint_range",
                f"step {nth} has {self._joints[joint]} at {rows_rad[nth, joint]:.3f} rad, allowed: "
                f"{lower_rad[joint]:.3f} to {upper_rad[joint]:.3f}",
            )
        ways_rad = np.abs(np.diff(rows_rad, axis=0, prepend=measured_rad[None]))
        speeds_rad_s = ways_rad * self._robot.step_hz
        allowed = SLACK * self._velocity_rad_s
        # The first step makes up for what the robot sags: it is at its goal, not far from it.
        most_rad_s = np.broadcast_to(allowed, speeds_rad_s.shape).copy()
        most_rad_s[0] += ARRIVED_RAD * self._robot.step_hz
        if (speeds_rad_s > most_rad_s).any():
            nth, joint = map(int, np.argwhere(speeds_rad_s > most_rad_s)[0])
            raise PeerError(
                "joint_speed",
                f"step {nth} moves {self._joints[joint]} at {speeds_rad_s[nth, joint]:.2f} rad/s, "
                f"allowed: {self._velocity_rad_s[joint]:.2f} (limits.joint)",
            )


_MEASURED = ("joint", "gripper", "pose")
"""Parts of the state that an observation of R2C has, or that follow from it."""


def _cameras(policy: Policy) -> tuple[str, ...]:
    return tuple(camera.camera for camera in policy.spec.observation.cameras)
