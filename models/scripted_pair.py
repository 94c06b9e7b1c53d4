# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "opencv-python-headless", "pin>=4"]
# ///
"""Lifts a bar with both arms of ``two_pandas_sim``, in joints and without any learning.

It finds the bar by its colour in one image from above, taken while both arms are home and out of
view, plans one path for both, and follows it blindly. Prompts::

    lift the bar                             by both its ends, level
    hold                                     stands still, as with any other prompt

The camera is that of the scene ``pair``, whose pose is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import WorkerError
from vla_zenoh.kinematics.kinematics import Kinematics, make_kinematics, pose_error
from vla_zenoh.kinematics.so3 import Pose, rotation_from_rpy
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.profile import Profile, load_profile

Vector = NDArray[np.float64]

BLUE = (0.10, 0.28, 0.75)
CAMERA_M = np.array([0.6, 0.0, 1.7])
FOVY_RAD = math.radians(27.0)
TOP_M = 0.03
"""Height of the bar's upper face."""
GRIP_M = 0.15
"""From the middle of the bar to where either arm grips it."""
ABOVE_M, DOWN_M, LIFTED_M = 0.12, 0.018, 0.22
"""Heights of the TCP."""
OPEN_M, SHUT_M = 0.08, 0.0
HORIZON, DT_S = 8, 0.1
HUE_DISTANCE = 0.13
MIN_PIXELS = 200
AT_HOME_RAD = MAX_LAG_RAD = 0.1
SPEED_RAD_S = 0.6
LIFT_S = 4.0
"""Slow: a lead of one arm over the other presses on the bar."""
PIECES = 12
"""Number of points on a straight path of the TCPs."""
DOWN = rotation_from_rpy(np.array([math.pi, 0.0, 0.0]))


class Segment(NamedTuple):
    """A path of all joints, with the openings.

    Args:
        steps: (k, D) points on it, evenly spaced, as the columns of a step.
        duration_s: of a minimum-jerk motion along it.
    """

    steps: Vector
    duration_s: float


class PairArm:
    """One arm: its base, and the joints of its TCP's poses."""

    def __init__(self, profile: Profile, part: str) -> None:
        own, base = profile.of_part(part), profile.parts[part].base
        self.kinematics: Kinematics = make_kinematics(own)
        self.home_rad = self.kinematics.ordered(own.robot.arm_joints, own.robot.home_rad)
        self._base_m, self.yaw_rad = np.array(base.position_m), base.yaw_rad
        self._turn = rotation_from_rpy(np.array([0.0, 0.0, base.yaw_rad]))

    def solve(self, place_m: Vector, yaw_rad: float, start_rad: Vector) -> Vector:
        """Joints with the TCP at a point of the world, pointing down, turned like the bar."""
        turned = (yaw_rad - self.yaw_rad + math.pi / 2) % math.pi - math.pi / 2
        rotation = rotation_from_rpy(np.array([0.0, 0.0, turned])) @ DOWN
        goal = Pose(self._turn.T @ (place_m - self._base_m), rotation)
        joints = start_rad.copy()
        for _ in range(100):
            here, jacobian = self.kinematics.pose_and_jacobian(joints)
            step = np.linalg.lstsq(jacobian, pose_error(goal, here), rcond=1e-3)[0]
            joints = np.clip(
                joints + np.clip(step, -0.2, 0.2),
                self.kinematics.lower_rad + 0.06,
                self.kinematics.upper_rad - 0.06,
            )
            if np.abs(step).max() < 1e-7:
                break
        if np.abs(pose_error(goal, self.kinematics.forward(joints))).max() > 1e-3:
            raise WorkerError(f"the end of the bar at {np.round(place_m, 3)} m is out of reach")
        return joints


class ScriptedPair:
    """Lifts a bar with two arms; see the module.

    Args:
        camera: the one above the table.
        profile: of the robot.
    """

    example_prompts = ("lift the bar", "hold")

    def __init__(self, camera: str = "top", profile: str = "two_pandas_sim") -> None:
        loaded = load_profile(profile)
        self._arms = {part: PairArm(loaded, part) for part in loaded.parts}
        self._camera = camera
        self.spec = ModelSpec(
            name="scripted_pair",
            observation=ObservationSpec(
                cameras=(CameraSpec(camera=camera),), state=("joint", "gripper"), prompt=True
            ),
            action=ActionSpec.of_parts(
                {
                    part: ActionSpec(
                        space="joint",
                        joints=arm.kinematics.arm_joints,
                        kind="absolute",
                        horizon=HORIZON,
                        dt_s=DT_S,
                        gripper="absolute_m",
                    )
                    for part, arm in self._arms.items()
                }
            ),
        )
        self.reset()

    def reset(self) -> None:
        """Forget the path, as at the start of an episode."""
        self._path: list[Segment] = []
        self._seen = False
        self._time_s = 0.0

    def infer(self, observation: Observation) -> ActionSteps:
        """The next steps of the path."""
        here = self._here(observation)
        active = observation.task.active
        wanted = observation.prompt.lower().strip(" .") == "lift the bar"
        if active and self._path:
            # The arms are ahead by as much as chunks are late; if one lags, the path waits.
            ahead = np.array([_at(self._path, time_s) for time_s in self._times_s(0)])
            if np.abs(self._joints(ahead) - self._joints(here)).max(axis=1).min() < MAX_LAG_RAD:
                self._time_s += (observation.executed_steps or 0.0) * DT_S
        if not self._path or not active:
            self._time_s, self._seen = 0.0, False
            home = self._step([arm.home_rad for arm in self._arms.values()], OPEN_M)
            self._path = [_way(here, home if wanted else here)]
        total_s = sum(segment.duration_s for segment in self._path)
        if active and wanted and not self._seen and self._time_s >= total_s:
            home = self._path[-1].steps[-1]
            if np.abs(self._joints(here) - self._joints(home)).max() < AT_HOME_RAD:
                self._lift(observation, home)
                total_s = sum(segment.duration_s for segment in self._path)
        done = self._seen and self._time_s >= total_s
        times_s = self._times_s(1)[: 1 if done else HORIZON]  # `done` refers to the last step
        return ActionSteps([_at(self._path, time_s) for time_s in times_s], done)

    def _times_s(self, first: int) -> Vector:
        return self._time_s + DT_S * np.arange(first, HORIZON + 1)

    def _here(self, observation: Observation) -> Vector:
        """The columns of a step that keeps the present position."""
        columns: list[float] = []
        for part, arm in self._arms.items():
            own = observation.parts[part]
            assert own.joint is not None
            assert own.gripper is not None
            columns += [*arm.kinematics.joints_of(own.joint), max(own.gripper.width_m, 0.0)]
        return np.array(columns)

    def _step(self, joints_rad: Sequence[Vector], width_m: float) -> Vector:
        return np.concatenate([[*joints, width_m] for joints in joints_rad])

    def _joints(self, steps: Vector) -> Vector:
        """Steps (..., D) without the openings."""
        ends = np.cumsum([arm.kinematics.size + 1 for arm in self._arms.values()]) - 1
        return np.delete(steps, ends, axis=-1)

    def _lift(self, observation: Observation, home: Vector) -> None:
        """Plan the path from home over both ends of the bar, down, and up with it."""
        found = see_bar(observation.images[self._camera])
        if found is None:
            return
        middle_m, yaw_rad = found
        along = GRIP_M * np.array([math.cos(yaw_rad), math.sin(yaw_rad)])
        ends_m = {
            part: middle_m + (along if np.cos(arm.yaw_rad) < 0 else -along)
            for part, arm in self._arms.items()
        }

        def places(heights_m: Vector, begin_rad: Sequence[Vector], width_m: float) -> Vector:
            joints, steps = list(begin_rad), list[Vector]()
            for height_m in heights_m:
                joints = [
                    arm.solve(np.array([*ends_m[part], height_m]), yaw_rad, start)
                    for (part, arm), start in zip(self._arms.items(), joints, strict=True)
                ]
                steps.append(self._step(joints, width_m))
            return np.array(steps)

        homes = [arm.home_rad for arm in self._arms.values()]
        down = places(np.linspace(ABOVE_M, DOWN_M, PIECES), homes, OPEN_M)
        begin = np.split(self._joints(down[-1]), len(homes))
        up = places(np.linspace(DOWN_M, LIFTED_M, PIECES), begin, SHUT_M)
        self._path = [
            _way(home, down[0]),
            _along(down),
            Segment(np.array([up[0], up[0]]), 1.0),
            _along(up)._replace(duration_s=LIFT_S),
        ]
        self._time_s, self._seen = 0.0, True


def _way(start: Vector, end: Vector) -> Segment:
    return _along(np.array([start, end]))


def _along(steps: Vector) -> Segment:
    """A minimum-jerk motion whose fastest joint has `SPEED_RAD_S` at its peak."""
    far_rad = float(np.abs(np.diff(steps, axis=0)).max()) * (len(steps) - 1)
    return Segment(steps, max(1.875 * far_rad / SPEED_RAD_S, DT_S))


def _at(path: list[Segment], time_s: float) -> Vector:
    """The step of a path at a time."""
    for steps, duration_s in path:
        if time_s < duration_s:
            s = max(time_s, 0.0) / duration_s
            place = s**3 * (10 - 15 * s + 6 * s * s) * (len(steps) - 1)
            below = min(int(place), len(steps) - 2)
            return steps[below] + (place - below) * (steps[below + 1] - steps[below])
        time_s -= duration_s
    return path[-1].steps[-1]


def see_bar(image: NDArray[np.uint8]) -> tuple[Vector, float] | None:
    """Middle (2,) m of the bar and its turn in rad, within a quarter; None: it is not in sight.

    Args:
        image: (H, W, 3) RGB of the camera above the table, whose x is to the right.
    """
    rgb = image.astype(np.float64)
    brightness = rgb.sum(axis=2) + 1e-9
    wanted = np.array(BLUE) / sum(BLUE)
    mask = np.linalg.norm(rgb / brightness[..., None] - wanted, axis=2) < HUE_DISTANCE
    mask &= brightness > 60
    if mask.sum() < MIN_PIXELS:
        return None
    rows, columns = np.nonzero(mask)
    height, width = mask.shape
    scale_m = (CAMERA_M[2] - TOP_M) / (height / 2 / math.tan(FOVY_RAD / 2))
    places_m = np.column_stack([columns + 0.5 - width / 2, height / 2 - rows - 0.5]) * scale_m
    (x_m, y_m), (a_m, b_m), degrees = cv2.minAreaRect((places_m + CAMERA_M[:2]).astype(np.float32))
    yaw_rad = math.radians(degrees if a_m > b_m else degrees + 90.0)
    return np.array([x_m, y_m]), (yaw_rad + math.pi / 2) % math.pi - math.pi / 2
