"""How far an arm leaves its workspace box while it slides along faces and edges of it.

    python -m benchmarks.box_edges [-n 100] [--perfect]

Random policies push against each of the six faces and twelve edges and wander along it, in
lockstep. The lower face is the shipped profile's, over the table. The shipped box's other faces are
partly out of the arm's reach, where its joints bend the goals and not the box: instead a box is
used whose pushed faces are `NEAR_M` from home and whose others are out of reach. Reported are the
largest excursions outside the box, of the command and of the measured TCP, and how far the command
moves inwards from a face once it was there, which no policy asks for.
"""

from __future__ import annotations

import argparse
import itertools
import json
import random
import sys
from pathlib import Path
from typing import Any

import numpy as np
from vla_zenoh_benchmarks.lockstep.worker import Delays

from benchmarks.lockstep_arm import activated, in_processes
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.profile import load_profile, override

AXES = "xyz"
HOME_M = np.array([0.43, 0.0, 0.16])
NEAR_M, ROOM_M, FAR_M = 0.04, 0.08, 0.2
"""Of a pushed face, of where a policy turns round, of the other faces; from home."""
ARRIVED_M, APPROACH_M_S, MOST_STEP_M = 0.01, 0.25, 0.028
THERE_M = 1e-6
SHAPES = ((0.02, 16), (0.05, 8), (0.1, 8), (0.1, 1), (0.2, 4), (0.2, 1))
LASTS_S = 4.0
INFERENCE_S, JITTER, CAMERA_S, WIRE_S = 0.05, 0.5, 0.015, 0.0005


def places() -> list[tuple[int, int, int]]:
    """Faces and edges: -1, 0 or 1 of every axis, one or two of them not 0."""
    signs = itertools.product((-1, 0, 1), repeat=3)
    return [sides for sides in signs if 1 <= np.count_nonzero(sides) <= 2]


def name_of(sides: tuple[int, int, int]) -> str:
    """As ``x high, z low``."""
    return ", ".join(
        f"{axis} {'high' if side > 0 else 'low'}"
        for axis, side in zip(AXES, sides, strict=True)
        if side
    )


def box_at(sides: tuple[int, int, int], shipped: Any) -> dict[str, list[float]]:
    """The workspace of a face or edge."""
    box = {}
    for axis, side, home_m in zip(AXES, sides, HOME_M.tolist(), strict=True):
        low, high = home_m - FAR_M, home_m + FAR_M
        if side < 0:
            low = home_m - NEAR_M
        elif side > 0:
            high = home_m + NEAR_M
        box[f"{axis}_m"] = [low, high]
    if sides[2] <= 0:
        box["z_m"][0] = shipped.z_m[0]
    return box


class Pusher:
    """Pushes outwards, and wanders along the free directions.

    Args:
        sides: which faces it pushes against.
        face_m: (3,) positions of these faces.
        seed: of all random numbers.
    """

    def __init__(self, sides: tuple[int, int, int], face_m: Any, seed: int) -> None:
        self._face_m = face_m
        self._random = rng = random.Random(seed)
        self._sides = np.array(sides, dtype=np.float64)
        self._dt_s, horizon = rng.choice(SHAPES)
        self._speed_m_s = rng.choice([0.1, 0.2, 0.4])
        self._turns = rng.random() < 0.3
        self._along = np.zeros(3)
        self._left = 0
        self.rate_hz = rng.choice([3.0, 5.0, 10.0, 20.0])
        self._longest = rng.choice([1, 1, 4])
        self.spec = ModelSpec(
            name="pusher",
            observation=ObservationSpec(state=("pose", "gripper")),
            action=ActionSpec(
                horizon=horizon,
                dt_s=self._dt_s,
                rotation="rotvec",
                gripper="none",
            ),
        )
        self._turn = np.array([rng.gauss(0.0, 1.0) for _ in range(3)])
        self._turn /= np.linalg.norm(self._turn)

    def infer(self, observation: Observation) -> ActionSteps:
        """The next chunk; no steps before the arm follows."""
        rng, pose = self._random, observation.pose
        assert pose is not None
        count = self.spec.action.horizon
        steps = np.zeros((count, 6), np.float32)
        if not observation.task.active:
            return ActionSteps(steps)
        if self._left <= 0:
            self._left = rng.randint(1, self._longest)
            self._along = np.array([rng.choice([-1.0, 1.0, rng.uniform(-1, 1)]) for _ in range(3)])
        self._left -= 1
        away_m = pose.position_m - HOME_M
        apart_m = np.where(self._sides != 0, np.abs(self._face_m - pose.position_m), 0.0)
        for axis in range(3):
            if abs(away_m[axis]) > ROOM_M and self._along[axis] * away_m[axis] > 0:
                self._along[axis] *= -1.0
        out = rng.uniform(0.1, 1.5)
        speed_m_s = np.full(3, self._speed_m_s)
        if apart_m.max() > ARRIVED_M:
            out, speed_m_s = 1.0, np.where(self._sides != 0, APPROACH_M_S, speed_m_s)
        way = np.where(self._sides != 0, self._sides * out, self._along)
        steps[:, :3] = np.clip(way * speed_m_s * self._dt_s, -MOST_STEP_M, MOST_STEP_M)
        if self._turns:
            if rng.random() < 0.3:
                self._turn = -self._turn
            steps[:, 3:] = 0.2 * self._dt_s * self._turn
        return ActionSteps(steps)


def slide(
    sides: tuple[int, int, int], seed: int, profile_name: str, command: str, perfect: bool
) -> dict[str, Any]:
    """One policy at one face or edge."""
    shipped = load_profile(profile_name)
    box = box_at(sides, shipped.limits.workspace)
    changes: dict[str, Any] = {"limits": {"workspace": box}, "robot": {"command": command}}
    low, high = np.array([box[f"{axis}_m"] for axis in AXES]).T
    edge = np.where(np.array(sides) < 0, low, high)
    policy = Pusher(sides, edge, seed)
    loop = activated(
        override(shipped, changes),
        policy,
        Delays(INFERENCE_S, JITTER, CAMERA_S, wire_s=WIRE_S),
        policy.rate_hz,
        seed,
        perfect=perfect,
    )
    since = len(loop.trace.time_ns)
    loop.run(LASTS_S)
    trace = loop.trace
    told = [command.position_m for command in trace.commands[since:] if command is not None]
    if command == "joint" and loop.commander.parts[0].reach is not None:
        kinematics = loop.commander.parts[0].reach.kinematics
        told = [
            kinematics.forward(joint.position_rad).position_m
            for joint in trace.joints[since:]
            if joint is not None
        ]
    measured = np.array(trace.position_m[since:])
    pushed = np.array(sides) != 0
    near = np.abs(measured - edge)[:, pushed].max(axis=1).min()
    off = np.abs(np.array(told) - edge)[:, pushed].max(axis=1)
    there = np.flatnonzero(off < THERE_M)
    left = off[there[0] :].max() if len(there) else 0.0
    return {
        "place": name_of(sides),
        "seed": seed,
        "command_mm": 1e3 * _outside(np.array(told), low, high),
        "measured_mm": 1e3 * _outside(measured, low, high),
        "left_mm": 1e3 * float(left),
        "nearest_mm": 1e3 * float(near),
        "fault": loop.commander.state.value == "fault"
        or any(event.what.endswith("->fault") for event in loop.events),
        "state": loop.commander.state.value,
        "why": loop.commander.why,
    }


def _outside(place_m: Any, low: Any, high: Any) -> float:
    if not len(place_m):
        return 0.0
    return float(np.linalg.norm(place_m - np.clip(place_m, low, high), axis=1).max())


def main() -> int:
    """Command line of the benchmark."""
    parser = argparse.ArgumentParser(description="How far an arm leaves its workspace box.")
    parser.add_argument("-n", type=int, default=100, help="policies at each face and edge")
    parser.add_argument("--seed", type=int, default=1, help="of the first one")
    parser.add_argument("--profile", default="panda_sim", help="name or path")
    parser.add_argument("--command", choices=["pose", "joint"], default="pose")
    parser.add_argument("--perfect", action="store_true", help="without physics, much faster")
    parser.add_argument("--jobs", type=int, help="parallel processes; default: one per core")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="every policy")
    options = parser.parse_args()
    how = (options.profile, options.command, options.perfect)
    jobs = [(p, options.seed + n, *how) for p in places() for n in range(options.n)]
    found = sorted(
        in_processes(slide, jobs, options.jobs), key=lambda row: (row["place"], row["seed"])
    )
    print(
        f"{'place':16} {'policies':>8} {'command out mm':>15} {'over 0.1 mm':>12} "
        f"{'measured out mm':>16} {'off face mm':>12} {'over 0.1 mm':>12} {'faults':>7} "
        f"{'ended early':>12} {'not reached':>12}"
    )
    for place in [*map(name_of, places()), "all"]:
        rows = [row for row in found if place in ("all", row["place"])]
        worst = max(rows, key=lambda row: row["command_mm"])
        print(
            f"{place:16} {len(rows):8d} {worst['command_mm']:15.3f} "
            f"{sum(row['command_mm'] > 0.1 for row in rows):12d} "
            f"{max(row['measured_mm'] for row in rows):16.3f} "
            f"{max(row['left_mm'] for row in rows):12.3f} "
            f"{sum(row['left_mm'] > 0.1 for row in rows):12d} "
            f"{sum(row['fault'] for row in rows):7d} "
            f"{sum(row['state'] not in ('active', 'holding') for row in rows):12d} "
            f"{sum(row['nearest_mm'] > 5.0 for row in rows):12d}"
        )
    for row in found:
        if row["state"] not in ("active", "holding"):
            print(f"{row['place']} seed {row['seed']}: {row['state']}, {row['why'][:100]}")
    if options.output:
        options.output.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
