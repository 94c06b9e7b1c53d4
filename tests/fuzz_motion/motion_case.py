"""What a run of the motion fuzz is: a robot, a policy's actions, a network and people, by chance.

A run is named by its family and its seed, and the same two give the same run.
"""

from __future__ import annotations

import math
import random
import zlib
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from other_arms import so101, ur5

from vla_zenoh.kinematics.kinematics import Kinematics, make_kinematics
from vla_zenoh.kinematics.so3 import Pose, exp3, log3, quat_from_rotation
from vla_zenoh.policy import ActionSpec, CameraSpec, ModelSpec, ObservationSpec
from vla_zenoh.profile import Profile, load_profile, override

WORKER = "scripted"
START_M = np.array([0.45, 0.0, 0.35])
DOWN = np.diag([1.0, -1.0, -1.0])
"""Tool straight down."""
ANGLES_FAST = {"velocity_rad_s": 2.5, "acceleration_rad_s2": 25.0, "jerk_rad_s3": 12500.0}
EXTREMES: dict[str, dict[str, Any]] = {
    "50 Hz": {"timing": {"command_hz": 50.0}},
    "1000 Hz": {"timing": {"command_hz": 1000.0}},
    "slow": {"limits": {"translation": {"velocity_m_s": 0.005}}},
    "4 mm box": {},
    "home outside": {},
    "fast": {
        "limits": {
            "translation": {"velocity_m_s": 1.7, "acceleration_m_s2": 13.0, "jerk_m_s3": 6500.0},
            "rotation": ANGLES_FAST,
        }
    },
    "short leash": {
        "limits": {"step_m": 0.005, "lead_m": 0.005, "step_rad": 0.02, "lead_rad": 0.02}
    },
    "weak": {"limits": {"translation": {"acceleration_m_s2": 0.05}}},
    "tiny joints": {
        "robot": {"command": "joint"},
        "limits": {
            "joint": {"velocity_rad_s": 0.1, "acceleration_rad_s2": 0.3, "jerk_rad_s3": 10.0}
        },
    },
    "fast joints": {
        "robot": {"command": "joint"},
        "limits": {
            "translation": {"velocity_m_s": 1.7, "acceleration_m_s2": 13.0, "jerk_m_s3": 6500.0},
            "rotation": ANGLES_FAST,
        },
    },
}
"""Changes of the shipped profile; where there are none the box is made in `make_case`."""
OTHER_ARMS = {"five joints": so101, "six joints": ur5}
AS_POSES = "joints as poses"
IN_JOINTS = ("seven joints", AS_POSES, *OTHER_ARMS)
"""Policies that act in joints, by those of the arm; `AS_POSES` of a robot that takes poses."""
FAMILIES = (
    *("pose", "joint", "net", "pose", "extreme", "joint net", "pose", "reach"),
    *IN_JOINTS,
)
"""What seeds go through, one after the other. ``reach``: poses bounded by the arm's kinematics."""


@dataclass(frozen=True)
class Network:
    """What happens to a command on its way to the guard.

    Args:
        loss: share that never arrives.
        again: share that comes twice.
        delay_s: of each, by chance from zero to this.
        held_1_s: how often everything is held up, per second.
    """

    loss: float = 0.0
    again: float = 0.0
    delay_s: float = 0.0
    held_1_s: float = 0.0


@dataclass(frozen=True)
class Case:
    """A run.

    Args:
        family: of `FAMILIES`.
        seed: of everything random.
        label: for tables.
        profile: the robot's.
        spec: the worker's.
        start: where the arm stands, where it has no joints.
        reach: goals are bounded by the kinematics.
        guard_hz: rate of the robot's controller.
        noise_m: of measured poses.
        lag_s: time constant by which the arm follows its reference; 0: perfectly.
        network: between command node and guard.
    """

    family: str
    seed: int
    label: str
    profile: Profile
    spec: ModelSpec
    start: Pose
    reach: bool
    guard_hz: float
    noise_m: float
    lag_s: float
    network: Network
    random: random.Random = field(repr=False, default_factory=random.Random)

    @property
    def arm(self) -> Kinematics:
        """Of the arm."""
        return kinematics(self.family)

    @property
    def in_joints(self) -> bool:
        """The policy acts in joints."""
        return self.spec.action.space == "joint"

    @property
    def joint(self) -> bool:
        """Joints are commanded."""
        return self.profile.robot.command == "joint"


@cache
def base_profile(family: str = "") -> Profile:
    """Of the family's arm: the shipped simulated one unless the family names another."""
    return OTHER_ARMS[family]() if family in OTHER_ARMS else load_profile("panda_sim")


@cache
def kinematics(family: str = "") -> Kinematics:
    """Of that arm."""
    return make_kinematics(base_profile(family))


def make_case(family: str, seed: int) -> Case:
    """The run of this family and seed."""
    rng = random.Random(zlib.crc32(f"{family} {seed}".encode()))
    extreme = rng.choice(sorted(EXTREMES)) if family == "extreme" else ""
    changes: dict[str, Any] = dict(EXTREMES.get(extreme, {}))
    if family != AS_POSES and (family.startswith("joint") or family in IN_JOINTS):
        changes["robot"] = {"command": "joint"}
    joint = changes.get("robot") is not None
    mode = rng.choice(["replace", "replace", "blend", "ensemble"])
    changes["composition"] = {"mode": mode}
    start = Pose(
        START_M + np.array([rng.uniform(-0.1, 0.1) for _ in range(3)]),
        exp3(np.array([rng.uniform(-0.5, 0.5) for _ in range(3)])) @ DOWN,
    )
    if extreme == "4 mm box":
        changes["limits"] = {"workspace": _box(start.position_m, 0.002)}
    elif extreme == "home outside":
        changes["limits"] = {"workspace": _box(start.position_m - [0.13, 0, 0], 0.1)}
    elif not joint and family not in ("reach", AS_POSES) and rng.random() < 0.5:
        changes["limits"] = {
            **changes.get("limits", {}),
            "workspace": _box(start.position_m, rng.choice([0.01, 0.03, 0.1])),
        }
    profile = override(base_profile(family), changes)
    kind, frame = rng.choice([("delta", "base"), ("delta", "tcp"), ("absolute", "base")])
    rotation = rng.choice(["rpy", "rotvec", "quaternion"])
    spec = ModelSpec(
        name=WORKER,
        observation=ObservationSpec(cameras=(CameraSpec(camera="front"),)),
        action=ActionSpec(
            horizon=64,
            dt_s=rng.choice([0.01, 0.02, 0.05, 0.1, 0.2]),
            kind=kind,
            frame=frame,
            rotation=rotation,
            gripper="none",
        )
        if family not in IN_JOINTS
        else _joint_action(rng, kinematics(family).arm_joints),
    )
    hz = profile.timing.command_hz
    return Case(
        family,
        seed,
        f"{'joint' if joint else 'pose'}/{mode}" + (f" ({extreme})" if extreme else ""),
        profile,
        spec,
        start,
        reach=joint or family in ("reach", AS_POSES),
        guard_hz=1000.0 if hz > 250 or rng.random() < 0.25 else 250.0,
        noise_m=rng.choice([0.0, 1e-16, 1e-15, 1e-14, 1e-12]),
        lag_s=rng.choice([0.0, 0.0, 0.0, 0.02, 0.05]),
        network=_network(rng) if family.endswith("net") else Network(),
        random=rng,
    )


def _joint_action(rng: random.Random, joints: tuple[str, ...]) -> ActionSpec:
    return ActionSpec(
        horizon=64,
        dt_s=rng.choice([0.02, 0.05, 0.1, 0.2]),
        space="joint",
        joints=joints,
        kind=rng.choice(["absolute", "delta", "velocity"]),
        anchor="goal",
        gripper="none",
    )


def _box(around_m: np.ndarray, half_m: float) -> dict[str, list[float]]:
    return {
        name: [float(at) - half_m, float(at) + half_m]
        for name, at in zip(("x_m", "y_m", "z_m"), around_m, strict=True)
    }


def _network(rng: random.Random) -> Network:
    return Network(
        loss=rng.choice([0.0, 0.02, 0.1, 0.3]),
        again=rng.choice([0.0, 0.1]),
        delay_s=rng.choice([0.0, 0.002, 0.02, 0.09]),
        held_1_s=rng.choice([0.0, 0.3, 2.0]),
    )


class Actions:
    """Chunks of a policy that changes its mind: walks, headings, edges, nonsense.

    Args:
        case: whose.
    """

    STYLES = (
        *("walk", "heading", "axis", "jitter", "push", "push", "push", "line", "line", "turn"),
        *("tiny", "zero", "over", "absurd"),
    )

    def __init__(self, case: Case) -> None:
        self._case, self._rng = case, case.random
        self.style = "zero"
        self._way, self._turn = np.zeros(3), np.zeros(3)
        self._joint_way: np.ndarray | None = None

    def change(self) -> None:
        """Take another style, or another heading."""
        rng, limits = self._rng, self._case.profile.limits
        self.style = rng.choice(self.STYLES)
        # Mostly what the arm can follow, now and then more.
        dt_s = self._case.spec.action.dt_s
        pace = rng.choice([0.02, 0.2, 0.5, 1.0, 2.0])
        way_m = min(pace * limits.translation.velocity_m_s * dt_s, limits.step_m)
        turn_rad = min(pace * limits.rotation.velocity_rad_s * dt_s * 0.5, limits.step_rad)
        way, turn = self._direction(), self._direction()
        if self.style == "axis":
            way = self._one_axis()
            turn = np.zeros(3) if rng.random() < 0.5 else self._one_axis()
        elif self.style == "push":
            # Against a face, an edge or a corner; along it with what is left.
            order = rng.sample(range(3), 3)
            way = np.zeros(3)
            for axis in order[: rng.choice([1, 2, 2, 3])]:
                way[axis] = rng.choice([-1.0, 1.0])
            way[order[-1]] += rng.uniform(-1.0, 1.0)
            turn = rng.choice([0.0, 0.0, 1.0]) * turn
        elif self.style == "line":
            turn = np.zeros(3)
        elif self.style == "turn":
            way = np.zeros(3)
        self._way, self._turn = way_m * way, turn_rad * turn

    def steps(self, here: Pose) -> np.ndarray:
        """One chunk, (H, D); `here` is the goal it begins at."""
        rng = self._rng
        count = rng.choice([1, 1, 2, 4, 8, 16, 64])
        if self.style == "absurd":
            return np.full((count, self._case.spec.action.dimension), rng.choice([1e30, -3e38, 50]))
        ways = np.array([self._step() for _ in range(count)])
        if self.style in ("jitter", "line", "turn") and rng.random() < 0.3:
            self._way, self._turn = -self._way, -self._turn
        return np.array(self._coded(ways, here))

    def standing(self, here: Pose) -> np.ndarray:
        """A chunk of one step that asks for nothing."""
        return np.array(self._coded(np.zeros((1, 6)), here))

    def _step(self) -> np.ndarray:
        rng, style = self._rng, self.style
        if style == "zero":
            return np.zeros(6)
        if style == "tiny":
            return np.array([rng.choice([0.0, 1e-16, -1e-12, 1e-9, 1e-7]) for _ in range(6)])
        way = np.concatenate([self._way, self._turn])
        if style == "walk":
            return way * [rng.gauss(0.0, 1.0) for _ in range(6)]
        if style == "over":
            return way * rng.choice([1.0, 2.0, 6.0])
        return way

    def _coded(self, ways: np.ndarray, here: Pose) -> list[list[float]]:
        """In the form that the spec declares."""
        action, rows = self._case.spec.action, []
        place_m, rotation = np.array(here.position_m), here.rotation
        for way in ways:
            turned = exp3(way[3:])
            if action.kind == "absolute":
                place_m, rotation = place_m + way[:3], turned @ rotation
                rows.append([*place_m, *_numbers(action.rotation, rotation)])
            elif action.frame == "tcp":
                rows.append(
                    [
                        *(here.rotation.T @ way[:3]),
                        *_numbers(action.rotation, exp3(here.rotation.T @ way[3:])),
                    ]
                )
            else:
                rows.append([*way[:3], *_numbers(action.rotation, turned)])
        return rows

    def joint_steps(self, here_rad: np.ndarray) -> np.ndarray:
        """One chunk of joints, (H, n); `here_rad` are those of the goal it begins at."""
        rng, action, size = self._rng, self._case.spec.action, len(here_rad)
        count = rng.choice([1, 1, 2, 4, 8, 16, 64])
        if self.style == "absurd":
            return np.full((count, size), rng.choice([1e30, -3e38, 50]))
        most_rad = min(rng.choice([0.02, 0.2, 0.5, 1.0, 2.0]) * action.dt_s, 0.3)
        if self.style in ("zero", "tiny"):
            most_rad = 0.0 if self.style == "zero" else 1e-9
        if rng.random() < 0.3 or self._joint_way is None:
            way = np.array([rng.gauss(0.0, 1.0) for _ in range(size)])
            if self.style in ("axis", "push", "turn"):
                way *= np.arange(size) == rng.randrange(size)
            self._joint_way = way / np.abs(way).max()
        ways = np.tile(most_rad * self._joint_way, (count, 1))
        if self.style in ("walk", "jitter"):
            ways *= np.array([[rng.gauss(0.0, 1.0) for _ in range(size)] for _ in range(count)])
        if action.kind == "absolute":
            return here_rad + np.cumsum(ways, axis=0)
        return ways / (action.dt_s if action.kind == "velocity" else 1.0)

    def _direction(self) -> np.ndarray:
        way = np.array([self._rng.gauss(0.0, 1.0) for _ in range(3)])
        return way / np.linalg.norm(way)

    def _one_axis(self) -> np.ndarray:
        way = np.zeros(3)
        way[self._rng.randrange(3)] = self._rng.choice([-1.0, 1.0])
        return way


def _numbers(form: str, rotation: np.ndarray) -> list[float]:
    if form == "quaternion":
        return quat_from_rotation(rotation).tolist()
    if form == "rotvec":
        return log3(rotation).tolist()
    return [
        math.atan2(rotation[2, 1], rotation[2, 2]),
        math.asin(min(max(-rotation[2, 0], -1.0), 1.0)),
        math.atan2(rotation[1, 0], rotation[0, 0]),
    ]
