# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "opencv-python-headless", "pin>=4"]
# ///
"""Puts a brick in the box with an SO-101, in joints and without any learning: for ``so101_sim``.

It finds a brick by its colour in one image, taken while the arm is home and out of view, plans a
path of joints, and follows it blindly. Prompts::

    put the red brick in the box             or blue, green, yellow
    hold                                     stands still, as with any other prompt

The camera is that of the scene ``desk``, whose pose is known.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.errors import WorkerError
from vla_zenoh.kinematics.kinematics import make_kinematics, pose_error
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.profile import load_profile

Vector = NDArray[np.float64]

COLOURS = {
    "red": (0.86, 0.07, 0.06),
    "blue": (0.08, 0.20, 0.82),
    "green": (0.08, 0.56, 0.16),
    "yellow": (0.95, 0.80, 0.06),
}
CAMERA_M = np.array([0.60, -0.33, 0.47])
CAMERA_X = np.array([0.6269, 0.7791, 0.0])
CAMERA_Y = np.array([-0.4754, 0.3825, 0.7923])
FOVY_RAD = math.radians(46.0)
HALF_HEIGHT_M = 0.0115
"""Of a brick with its studs."""
BOX_M = np.array([0.18, 0.20, 0.12])
"""Above the box, where the brick is released."""

LIFT = ((0.012, 0.0), (0.03, 0.0), (0.05, 0.2), (0.07, 0.4))
"""Heights of the TCP in m from the grasp upwards, and how far it is tilted outwards there, rad."""
JAW_M = 0.022
"""From the fixed jaw's tip, which is the TCP, to the middle of a brick between the jaws."""
OPEN_M, SHUT_M = 0.09, 0.0
HORIZON, DT_S = 8, 0.1
HUE_DISTANCE = 0.13
MIN_PIXELS = 60
AT_HOME_RAD = MAX_LAG_RAD = 0.1
SPEED_RAD_S = 0.8


class Waypoint(NamedTuple):
    """Joints and opening to be reached `duration_s` after the waypoint before."""

    joints_rad: Vector
    width_m: float
    duration_s: float


class ScriptedPick:
    """Puts a brick in the box; see the module.

    Args:
        camera: the one that sees the desk.
        profile: of the arm.
    """

    example_prompts = ("put the red brick in the box", "put the green brick in the box", "hold")

    def __init__(self, camera: str = "front", profile: str = "so101_sim") -> None:
        loaded = load_profile(profile)
        self._kinematics = make_kinematics(loaded)
        joints = self._kinematics.arm_joints
        self._home_rad = self._kinematics.ordered(loaded.robot.arm_joints, loaded.robot.home_rad)
        self._camera = camera
        self.spec = ModelSpec(
            name="scripted_pick",
            observation=ObservationSpec(
                cameras=(CameraSpec(camera=camera),), state=("joint", "gripper"), prompt=True
            ),
            action=ActionSpec(
                space="joint",
                joints=joints,
                kind="absolute",
                horizon=HORIZON,
                dt_s=DT_S,
                gripper="absolute_m",
            ),
        )
        self.reset()

    def reset(self) -> None:
        """Forget the path, as at the start of an episode."""
        self._path: list[Waypoint] = []
        self._time_s = 0.0

    def infer(self, observation: Observation) -> ActionSteps:
        """The next steps of the path."""
        assert observation.joint is not None
        assert observation.gripper is not None
        here_rad = self._kinematics.joints_of(observation.joint)
        active = observation.task.active
        if active and self._path:
            # The arm is ahead by as much as chunks are late; if it lags, the path waits.
            ahead = np.array([_at(self._path, time_s)[:-1] for time_s in self._times_s(0)])
            if np.abs(ahead - here_rad).max(axis=1).min() < MAX_LAG_RAD:
                self._time_s += (observation.executed_steps or 0.0) * DT_S
        if not self._path or not active:
            self._time_s = 0.0
            here = Waypoint(here_rad, observation.gripper.width_m, 0.0)
            self._path = [here, *self._begin(observation, here)]
        total_s = sum(point.duration_s for point in self._path)
        if self._time_s >= total_s and self._goes_home(observation):
            self._path = [self._path[-1], *self._pick(observation)]
            self._time_s = 0.0
        done = self._time_s >= total_s
        return ActionSteps([_at(self._path, time_s) for time_s in self._times_s(1)], done)

    def _times_s(self, first: int) -> Vector:
        return self._time_s + DT_S * np.arange(first, HORIZON + 1)

    def _begin(self, observation: Observation, here: Waypoint) -> Iterator[Waypoint]:
        if colour_of(observation.prompt) is None:
            return
        yield self._to(here.joints_rad, self._home_rad, OPEN_M)

    def _goes_home(self, observation: Observation) -> bool:
        """Whether the arm has left the camera's view, and no brick was seen yet."""
        if colour_of(observation.prompt) is None or len(self._path) > 2:
            return False
        here_rad = self._kinematics.joints_of(observation.joint)
        return bool(np.abs(here_rad - self._home_rad).max() < AT_HOME_RAD)

    def _to(self, start_rad: Vector, end_rad: Vector, width_m: float) -> Waypoint:
        """As a minimum-jerk motion whose fastest joint has `SPEED_RAD_S` at its peak."""
        far_rad = float(np.abs(end_rad - start_rad).max())
        return Waypoint(end_rad, width_m, max(1.875 * far_rad / SPEED_RAD_S, DT_S))

    # -- the pick -----------------------------------------------------------------------------
    def _pick(self, observation: Observation) -> list[Waypoint]:
        """From home over the brick and the box back home; empty while no brick can be reached."""
        colour = colour_of(observation.prompt)
        found = see_brick(observation.images[self._camera], colour) if colour else None
        if found is None:
            return []
        grasp = self._grasp(*found)
        over_rad = self._over_box()
        down_rad, *lifts_rad = grasp
        raised_rad = self._home_rad.copy()
        raised_rad[[0, -1]] = lifts_rad[-1][[0, -1]]
        aside_rad = raised_rad.copy()
        aside_rad[0] = over_rad[0]
        way = [raised_rad, *lifts_rad[::-1], down_rad]
        path = self._follow([self._home_rad, *way], OPEN_M)
        path.append(Waypoint(down_rad, SHUT_M, 1.0))
        path += self._follow([down_rad, *lifts_rad, raised_rad, aside_rad, over_rad], SHUT_M)
        path.append(Waypoint(over_rad, OPEN_M, 0.8))
        return path + self._follow([over_rad, aside_rad, self._home_rad], OPEN_M)

    def _follow(self, way_rad: list[Vector], width_m: float) -> list[Waypoint]:
        return [self._to(start, end, width_m) for start, end in pairwise(way_rad)]

    def _grasp(self, place_m: Vector, yaw_rad: float) -> list[Vector]:
        """Joints at the brick, then above it; of its four sides the one that turns least."""
        pan_rad = self._pan(place_m)
        found: list[list[Vector]] = []
        for quarter in range(4):
            yaw = yaw_rad + quarter * math.pi / 2
            jaw = JAW_M * np.array([math.cos(yaw), math.sin(yaw), 0.0])
            start_rad = self._home_rad.copy()
            start_rad[0] = pan_rad
            joints: list[Vector] = []
            for height_m, tilt_rad in LIFT:
                place = np.array([*place_m, height_m]) + jaw
                solved = self._solve(place, yaw, tilt_rad, joints[-1] if joints else start_rad)
                if solved is None:
                    break
                joints.append(solved)
            if len(joints) > 1:
                found.append(joints)
        if not found:
            raise WorkerError(f"the brick at {np.round(place_m, 3)} m is out of reach")
        return min(found, key=lambda joints: abs(joints[0][-1]))

    def _over_box(self) -> Vector:
        start_rad = self._home_rad.copy()
        start_rad[0] = self._pan(BOX_M)
        yaw = math.pi / 2 - start_rad[0]
        solved = self._solve(BOX_M, yaw, 0.4, start_rad)
        if solved is None:
            raise WorkerError("the box is out of reach")
        return solved

    def _pan(self, place_m: Vector) -> float:
        base = self._kinematics.forward(self._home_rad).position_m
        return -math.atan2(place_m[1] - base[1], place_m[0])

    def _solve(self, place_m: Vector, yaw: float, tilt: float, start_rad: Vector) -> Vector | None:
        """Joints with the TCP there, pointing down and outwards by `tilt` or a little more."""
        azimuth = math.atan2(place_m[1], place_m[0])
        weight = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
        for tilted in tilt + 0.2 * np.arange(4):
            z = np.array([math.cos(azimuth), math.sin(azimuth), 0.0]) * math.sin(tilted)
            z[2] = -math.cos(tilted)
            x = np.array([math.cos(yaw), math.sin(yaw), 0.0])
            x -= z * (x @ z)
            x /= np.linalg.norm(x)
            goal = Pose(place_m, np.column_stack([x, np.cross(z, x), z]))
            joints = start_rad.copy()
            for _ in range(100):
                here, jacobian = self._kinematics.pose_and_jacobian(joints)
                error = weight * pose_error(goal, here)
                step = np.linalg.lstsq(weight[:, None] * jacobian, error, rcond=1e-3)[0]
                joints = np.clip(
                    joints + np.clip(step, -0.2, 0.2),
                    self._kinematics.lower_rad + 0.02,
                    self._kinematics.upper_rad - 0.02,
                )
            off = pose_error(goal, self._kinematics.forward(joints))
            if np.linalg.norm(off[:3]) < 2e-3 and np.linalg.norm(off[3:]) < 0.05:
                return joints
        return None


def _at(path: list[Waypoint], time_s: float) -> list[float]:
    """Joints and opening of a path at a time: minimum-jerk motions between its waypoints."""
    for start, end in pairwise(path):
        if time_s < end.duration_s:
            s = max(time_s, 0.0) / end.duration_s
            share = s**3 * (10 - 15 * s + 6 * s * s)
            joints = start.joints_rad + share * (end.joints_rad - start.joints_rad)
            return [*joints, end.width_m]
        time_s -= end.duration_s
    return [*path[-1].joints_rad, path[-1].width_m]


def colour_of(prompt: str) -> str | None:
    """The colour of the brick that a prompt wants in the box; None: it wants something else."""
    pattern = rf"put the ({'|'.join(COLOURS)}) brick (?:in|into) the box"
    found = re.fullmatch(pattern, " ".join(prompt.lower().split()).rstrip("."))
    return found[1] if found else None


def see_brick(image: NDArray[np.uint8], colour: str) -> tuple[Vector, float] | None:
    """Centre (2,) m and turn in rad of the brick of this colour, None: it is not in sight.

    Args:
        image: (H, W, 3) RGB of the camera.
        colour: one of `COLOURS`.
    """
    rgb = image.astype(np.float64)
    brightness = rgb.sum(axis=2) + 1e-9
    wanted = np.array(COLOURS[colour]) / sum(COLOURS[colour])
    mask = np.linalg.norm(rgb / brightness[..., None] - wanted, axis=2) < HUE_DISTANCE
    mask &= brightness > 60
    if mask.sum() < MIN_PIXELS:
        return None
    # The outline is that of the top and of the sides in view: at half the height its middle is the
    # brick's. The top alone is the brighter part, and gives the rotation.
    (x_m, y_m), _, _ = cv2.minAreaRect(_ground(mask, HALF_HEIGHT_M))
    top = mask & (brightness > 0.85 * np.percentile(brightness[mask], 80))
    _, _, degrees = cv2.minAreaRect(_ground(top, 2 * HALF_HEIGHT_M))
    return np.array([x_m, y_m]), math.radians(degrees)


def _ground(mask: NDArray[np.bool_], height_m: float) -> NDArray[np.float32]:
    """(n, 2) m of the pixels of a mask, as if they were at this height."""
    rows, columns = np.nonzero(mask)
    height, width = mask.shape
    focal = height / 2 / math.tan(FOVY_RAD / 2)
    right, up = (columns + 0.5 - width / 2) / focal, (height / 2 - rows - 0.5) / focal
    rays = right[:, None] * CAMERA_X + up[:, None] * CAMERA_Y - np.cross(CAMERA_X, CAMERA_Y)
    distance = (height_m - CAMERA_M[2]) / rays[:, 2]
    return (CAMERA_M + distance[:, None] * rays)[:, :2].astype(np.float32)
