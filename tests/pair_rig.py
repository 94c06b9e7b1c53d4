"""Two simulated Pandas under one policy, in lockstep: what each is asked, and how it moved."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np
from vla_zenoh_benchmarks.lockstep.loop import Lockstep

from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.kinematics.collision import PlacedArm
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.simulation.world import World, build_world
from vla_zenoh.types import FloatArray

PARTS = ("left", "right")
HORIZON, DT_S = 8, 0.1
TICK_S = 0.004
FAR_M = 0.4
"""Arms further apart count as this far."""
STILL_M_S = 2e-3
Motion = Callable[[int], Mapping[str, FloatArray]]
"""Number of the inference -> step of each part, (D,)."""


@cache
def shipped() -> Profile:
    return load_profile("two_pandas_sim")


@cache
def world() -> World:
    return build_world(shipped())


@cache
def reach() -> Mapping[str, ReachabilityFilter]:
    return {part: ReachabilityFilter(shipped().of_part(part)) for part in PARTS}


@cache
def placed(part: str) -> PlacedArm:
    own = reach()[part]
    base = shipped().parts[part].base
    return PlacedArm(own.kinematics, own.barriers.collisions, base)


def apart_m(left_rad: FloatArray, right_rad: FloatArray, within_m: float = FAR_M) -> float:
    """Distance of the arms at these joints (n,), if it is less than `within_m`."""
    left, right = map(placed, PARTS)
    return left.nearest([left_rad], right, [right_rad], within_m).distance_m


def joint_steps(kind: str = "delta") -> ActionSpec:
    """One part's actions in joints."""
    joints = shipped().robot.arm_joints
    return ActionSpec(
        space="joint", joints=joints, kind=kind, horizon=HORIZON, dt_s=DT_S, gripper="absolute_m"
    )


def tcp_steps() -> ActionSpec:
    """One part's actions as deltas of its TCP."""
    return ActionSpec(rotation="rotvec", horizon=HORIZON, dt_s=DT_S, gripper="absolute_m")


class Asked:
    """A policy that asks for the same step eight times, of each part its own."""

    def __init__(self, motion: Motion, action: ActionSpec) -> None:
        self.spec = ModelSpec(
            name="asked",
            observation=ObservationSpec(state=("joint", "pose", "gripper"), prompt=False),
            action=ActionSpec.of_parts(dict.fromkeys(PARTS, action)),
        )
        self._motion, self.asked = motion, 0
        self.seen: Observation | None = None

    def infer(self, observation: Observation) -> ActionSteps:
        self.seen = observation
        self.asked += 1
        step = np.concatenate([self._motion(self.asked)[part] for part in PARTS])
        return ActionSteps(np.tile(step, (HORIZON, 1)))


class Pair:
    """An active loop, and the track of both TCPs since it began, in the frame of each base."""

    def __init__(self, motion: Motion, action: ActionSpec | None = None, seed: int = 0) -> None:
        world().reset()
        self.policy = Asked(motion, action or joint_steps())
        self.loop = Lockstep(shipped(), world(), self.policy, reach=reach(), seed=seed, steps=2)
        self.commander = self.loop.commander
        self.path_m: dict[str, list[FloatArray]] = {part: [] for part in PARTS}
        self.least_m = self.least_measured_m = np.inf
        self.loop.run(0.5)
        self.activate()

    def activate(self) -> None:
        self.loop.put("active", True)
        self.loop.run(TICK_S * 2)
        assert self.state == "active", self.commander.why

    @property
    def state(self) -> str:
        return self.commander.state.value

    def run(self, seconds: float, *, distances: bool = False) -> None:
        for _ in range(round(seconds / TICK_S)):
            self.loop.run(TICK_S)
            for part in PARTS:
                self.path_m[part].append(world().parts[part].tcp()[0])
            if distances:
                self.least_m = min(self.least_m, self.distance_m())
                self.least_measured_m = min(self.least_measured_m, self.measured_m())

    def distance_m(self) -> float:
        """Between the arms where they are commanded."""
        left_rad, right_rad = (part.motion.joints_rad for part in self.commander.parts)
        assert left_rad is not None
        assert right_rad is not None
        return apart_m(left_rad, right_rad)

    def measured_m(self) -> float:
        """Between the arms in the world."""
        return apart_m(*(self.joints_rad(part) for part in PARTS))

    def joints_rad(self, part: str) -> FloatArray:
        return world().parts[part].joint_state().position_rad

    def speed_m_s(self, part: str) -> FloatArray:
        return np.linalg.norm(np.diff(np.array(self.path_m[part]), axis=0), axis=1) / TICK_S

    def mark(self) -> int:
        return len(self.path_m["left"])

    def stop_time_s(self, part: str, since: int) -> float:
        """When the measured TCP moved for the last time, after `since`."""
        fast = np.flatnonzero(self.speed_m_s(part)[since:] > STILL_M_S)
        return 0.0 if not len(fast) else float((fast[-1] + 1) * TICK_S)


def steady(**joints: Any) -> Motion:
    """The same step at every inference; parts that are not named stand."""
    stand = np.array([*np.zeros(7), 0.04])
    return lambda _: {part: np.array(joints.get(part, stand)) for part in PARTS}


def random_motion(seed: int, action: str) -> Motion:
    """Steps that change every second or so, mostly into the space between the arms."""
    random = np.random.default_rng(seed)
    held: dict[str, FloatArray] = {}
    home = np.array(shipped().robot.home_rad)

    def motion(number: int) -> dict[str, FloatArray]:
        for part in PARTS if number % 6 == 1 else ():
            drawn = random.normal(size=8)
            if action == "tcp":
                into = abs(drawn[0]) if drawn[7] > -0.6 else drawn[0]
                way = [0.05 * into, 0.02 * drawn[1], 0.03 * drawn[2], *0.03 * drawn[3:6], 0.04]
            else:
                lean = [0.4 * drawn[0], 0.9 + 0.5 * drawn[1], 0.5 * drawn[2], 0.6 + 0.5 * drawn[3]]
                way = [*home + np.array([*lean, *0.5 * drawn[4:6], drawn[6]]), 0.04]
            held[part] = np.array(way)
        return dict(held)

    return motion
