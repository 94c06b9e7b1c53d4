# /// script
# requires-python = ">=3.11"
# dependencies = ["vla-zenoh[sim]"]
# ///
"""Generates data: random situations, images of the two cameras, and the teacher's waypoints.

    python generate.py OUT --samples 60000 --seed 0 [--part 0 --parts 2]

Writes ``OUT/<seed>-<number>.npz`` with 500 samples each; existing files are left alone.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import cv2
import mujoco
import numpy as np
import pinocchio as pin
from expert import OPEN_M, Hand
from geometry import numbers
from rich.progress import track
from states import Situation, draw
from worker import FRONT, WRIST

from vla_zenoh.lab.tasks.order import brick
from vla_zenoh.profile import load_profile
from vla_zenoh.simulation.render import Renderer
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.scene import (
    DISTRACTOR_PREFIX,
    PREFIX,
    TCP_SITE,
    VARIATIONS,
    build_model,
    regions_of,
)

SCENE = "bricks"
SHARD = 500
PROFILE = "panda_bricks"
IK_STEPS, IK_TOLERANCE = 12, 2e-4


class Studio:
    """The scene with poses that are set, not simulated."""

    def __init__(self) -> None:
        robot = RobotModel()
        self.model = build_model(SCENE, [robot])
        self.data = mujoco.MjData(self.model)
        self.renderer = Renderer(SCENE, [robot])
        self._arm = [int(self.model.joint(PREFIX + n).qposadr[0]) for n in robot.arm_joints]
        self._dofs = [int(self.model.joint(PREFIX + n).dofadr[0]) for n in robot.arm_joints]
        self._fingers = [int(self.model.joint(PREFIX + n).qposadr[0]) for n in robot.finger_joints]
        self._lower, self._upper = np.array(
            [self.model.joint(PREFIX + n).range for n in robot.arm_joints]
        ).T
        self._site = self.model.site(PREFIX + TCP_SITE).id
        self._home = np.array(load_profile(PROFILE).robot.home_rad)
        self._distract = regions_of(self.model, DISTRACTOR_PREFIX)
        self._linear = np.zeros((3, self.model.nv))
        self._angular = np.zeros((3, self.model.nv))

    def show(self, situation: Situation, random: np.random.Generator, varied: bool) -> bool:
        """Set all poses of a situation; False if the arm cannot get there."""
        model, data = self.model, self.data
        for colour, place in situation.bricks.items():
            address = int(model.joint(brick(colour)).qposadr[0])
            half = place.yaw_rad / 2
            data.qpos[address : address + 7] = [*place[:3], math.cos(half), 0, 0, math.sin(half)]
        box = model.body_mocapid[model.body("box").id]
        data.mocap_pos[box] = [situation.box.x_m, situation.box.y_m, 0.0]
        for name, region in self._distract.items():
            index = model.body_mocapid[model.body(name).id]
            data.mocap_pos[index] = model.body_pos[model.body(name).id]
            if varied:
                self._distract_with(situation, index, region, random)
        hand = situation.hand
        data.qpos[self._fingers] = min(hand.width_m, OPEN_M) / 2
        return self._reach(hand, situation.tilt_rad)

    def _distract_with(self, situation: Situation, index: int, region, random) -> None:
        for _ in range(20):
            place = random.uniform(region.low, region.high)
            near = min(
                math.hypot(place[0] - b.x_m, place[1] - b.y_m) for b in situation.bricks.values()
            )
            to_box = math.hypot(place[0] - situation.box.x_m, place[1] - situation.box.y_m)
            if near > 0.07 and to_box > 0.13:
                self.data.mocap_pos[index, :2] = place[:2]
                half = place[2] / 2
                self.data.mocap_quat[index] = [math.cos(half), 0, 0, math.sin(half)]
                return

    def _reach(self, hand: Hand, tilt: tuple[float, float]) -> bool:
        model, data = self.model, self.data
        turn = pin.exp3(np.array([0.0, 0.0, hand.yaw_rad])) @ np.diag([1.0, -1.0, -1.0])
        turn = turn @ pin.exp3(np.array([*tilt, 0.0]))
        goal = np.array([hand.x_m, hand.y_m, hand.z_m])
        data.qpos[self._arm] = self._home
        for _ in range(IK_STEPS):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            rotation = data.site_xmat[self._site].reshape(3, 3)
            error = np.concatenate([goal - data.site_xpos[self._site], pin.log3(turn @ rotation.T)])
            if np.abs(error).max() < IK_TOLERANCE:
                return True
            mujoco.mj_jacSite(model, data, self._linear, self._angular, self._site)
            jacobian = np.concatenate([self._linear[:, self._dofs], self._angular[:, self._dofs]])
            pseudo = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + 1e-5 * np.eye(6))
            q = data.qpos[self._arm]
            step = pseudo @ error
            drift = 0.3 * (self._home - q)
            step += drift - pseudo @ (jacobian @ drift)
            data.qpos[self._arm] = np.clip(q + np.clip(step, -0.4, 0.4), self._lower, self._upper)
        return False

    def pictures(self, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Images of the front and the wrist camera, in the size of the model."""
        self.renderer.set_qpos(
            np.concatenate(
                [self.data.qpos, self.data.mocap_pos.ravel(), self.data.mocap_quat.ravel()]
            )
        )
        # Now and then in the size of the real chain; it costs twice as much.
        large = random.uniform() < 0.08
        out = []
        for camera, (width, height) in (("front", FRONT), ("wrist", WRIST)):
            size = (640, 480) if large else (2 * width, 2 * height)
            rgb = self.renderer.render(camera, *size)
            out.append(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA))
        return out[0], out[1]


def pixels(renderer: Renderer, camera: str, points: np.ndarray) -> np.ndarray:
    """(n, 3) column, row in [0, 1] over the image and depth of points (n, 3), as now rendered."""
    position, axes, fovy = renderer.view(camera)
    local = (points - position) @ axes
    scale = 0.5 / math.tan(fovy / 2)
    depth = np.maximum(-local[:, 2], 1e-3)
    column = 0.5 + local[:, 0] / depth * scale * 3 / 4
    row = 0.5 - local[:, 1] / depth * scale
    return np.stack([column, row, -local[:, 2]], 1)


def sample(studio: Studio, random: np.random.Generator) -> dict[str, np.ndarray]:
    """One sample, see the keys."""
    while True:
        situation = draw(random)
        varied = random.uniform() < 0.7
        vary = [v for v in VARIATIONS if varied and random.uniform() < 0.8]
        if studio.show(situation, random, "distractors" in vary):
            break
    studio.renderer.vary(int(random.integers(1 << 40)), vary)
    front, wrist = studio.pictures(random)
    return labelled(situation, (front, wrist), studio.renderer, random)


def labelled(
    situation: Situation,
    pictures: tuple[np.ndarray, np.ndarray],
    renderer: Renderer,
    random: np.random.Generator,
) -> dict[str, np.ndarray]:
    """A situation, the images of the two cameras, and all labels.

    Args:
        situation: the true one.
        pictures: images of the front and of the wrist camera, in the size of the model.
        renderer: shows the situation.
        random: draws other orders, for which the teacher is asked too.
    """
    known = numbers(situation, random)
    points, hand = known["objects"], known["pose"][None, :3]
    return known | {
        "front": pictures[0],
        "wrist": pictures[1],
        "front_px": pixels(renderer, "front", np.concatenate([points, hand])).astype(np.float32),
        "wrist_px": pixels(renderer, "wrist", points).astype(np.float32),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--samples", type=int, default=60_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--part", type=int, default=0, help="number of this part, from 0")
    parser.add_argument("--parts", type=int, default=1, help="number of parts")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    studio = Studio()
    shards = range(args.part, -(-args.samples // SHARD), args.parts)
    for number in track(shards, description="shards"):
        path = args.out / f"{args.seed}-{number:04d}.npz"
        if path.exists():
            continue
        random = np.random.default_rng((args.seed, number))
        samples = [sample(studio, random) for _ in range(SHARD)]
        stacked = {key: np.stack([s[key] for s in samples]) for key in samples[0]}
        part = path.with_suffix(".part")
        with part.open("wb") as file:
            np.savez(file, **stacked)
        part.rename(path)


if __name__ == "__main__":
    main()
