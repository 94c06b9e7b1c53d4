"""Forces of a blocked arm: the whole loop in lockstep with MuJoCo, pushing on obstacles.

The profile is `panda_sim`, with a table that its limits do not contain. A worker keeps pushing at a
given speed, in steps of 0.1 s, until the activation ends and the command has come to rest; then the
run continues for three seconds. Forces are MuJoCo's contact forces on the robot, summed, each

- peak: the greatest of all, and the greatest mean over 50 ms;
- lasting: the mean from 2 s to 3 s after the command came to rest.

A person is a pad on a spring with a fixed other end: a clamped hand, a person with the back against
a wall. Stiffness and mass are those of ISO/TS 15066:2016, table A.3: hand and
fingers 75 N/mm and 0.6 kg, abdomen 10 N/mm (of its 40 kg the pad has 1 kg: the rest does not move).
That standard's table A.2 allows 140 N of lasting and 280 N of short contact with the hand, 110 N
and 220 N with the abdomen.

    .venv/bin/python -m benchmarks.contact [--only TEXT] [--untold]
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Message

from vla_zenoh import resources
from vla_zenoh.codec import message
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.kinematics.so3 import norm3
from vla_zenoh.policy import (
    ActionSpec,
    ActionSteps,
    CameraSpec,
    ModelSpec,
    Observation,
    ObservationSpec,
)
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.simulation.world import build_world
from vla_zenoh.types import PoseState

SPEEDS_M_S = (0.02, 0.1, 0.4)
STEP_S = 0.1
AFTER_S, LASTING_S = 3.0, 1.0
MEAN_MS = 50
PATIENCE_S = 8.0
"""Time after the expected contact in which the arm has to end the motion."""
HAND_M = 0.102
"""From the TCP to the side of the hand, which touches first."""
HARD = 'solref="0.004 1" solimp="0.95 0.99 0.001"'
WALL = """
    <body name="obstacle" pos="0.45 {face} 0.25">{spring}
      <geom type="box" size="0.25 0.02 0.25" pos="0 0.02 0" mass="{mass}" {hard}/>
    </body>"""
SPRING = """
      <joint type="slide" axis="0 1 0" stiffness="{stiffness}" damping="{damping}"/>"""


class Obstacle(NamedTuple):
    """An obstacle.

    Args:
        name: in the table.
        stiffness_n_m: None: it does not give way.
        mass_kg: of the pad.
        table: the table itself, from above; else a wall beside the hand.
    """

    name: str
    stiffness_n_m: float | None = None
    mass_kg: float = 1.0
    table: bool = False


OBSTACLES = (
    Obstacle("fixed wall"),
    Obstacle("soft wall (abdomen, 10 N/mm)", 10_000.0),
    Obstacle("table", table=True),
    Obstacle("clamped hand (75 N/mm)", 75_000.0, 0.6),
)


class Pushed(NamedTuple):
    """Forces and the end of the motion; N."""

    peak_n: float
    mean_peak_n: float
    lasting_n: float
    event: str


class Push:
    """A model that keeps moving in one direction (3,) by `step_m` every 0.1 s."""

    def __init__(self, step_m: np.ndarray) -> None:
        self.spec = ModelSpec(
            name="scripted",
            observation=ObservationSpec(
                cameras=(CameraSpec(camera="front"),), state=("pose",), prompt=True
            ),
            action=ActionSpec(horizon=2, dt_s=STEP_S, gripper="delta_m"),
        )
        self._step_m = step_m

    def infer(self, observation: Observation) -> ActionSteps:
        """The same step twice."""
        steps = np.zeros((2, 7))
        if observation.task.active:
            steps[:, :3] = self._step_m
        return ActionSteps(steps)


def scene_with(obstacle: Obstacle, gap_m: float, folder: Path) -> Path:
    """The table's scene with an obstacle `gap_m` beside the hand, as a file in `folder`."""
    text = (resources.find("sim", "table") / "scene.xml").read_text(encoding="utf-8")
    if not obstacle.table:
        k, mass = obstacle.stiffness_n_m, obstacle.mass_kg
        spring = "" if k is None else SPRING.format(stiffness=k, damping=(k * mass) ** 0.5)
        face = HAND_M + gap_m
        wall = WALL.format(face=face, spring=spring, mass=mass, hard=HARD)
        text = text.replace("</worldbody>", wall + "\n  </worldbody>")
    path = folder / "scene.xml"
    path.write_text(text, encoding="utf-8")
    return path


def pushing(mode: str, scene: Path) -> Profile:
    """`panda_sim` in that scene, commanded by `mode`, without knowledge of the table."""
    profile = load_profile("panda_sim")
    limits = profile.limits
    return profile.model_copy(
        update={
            "robot": profile.robot.model_copy(update={"command": mode}),
            "sim": profile.sim.model_copy(update={"scene": str(scene)}),
            "limits": limits.model_copy(
                update={
                    "workspace": limits.workspace.model_copy(update={"z_m": (-0.2, 0.9)}),
                    "reach": limits.reach.model_copy(update={"table_z_m": None}),
                }
            ),
        }
    )


def untold(sent: Message) -> list[Message]:
    """Messages of a robot that reports no wrench."""
    if sent.kind is not PoseState:
        return [sent]
    fields = message.unpack(sent.payload)
    return [replace(sent, payload=message.pack({**fields, "wrench": None}))]


def push(obstacle: Obstacle, mode: str, speed_m_s: float, *, told: bool = True) -> Pushed:
    """Push on an obstacle until the activation ends, and measure what remains.

    Args:
        obstacle: see `OBSTACLES`.
        mode: ``pose`` or ``joint``.
        speed_m_s: of the approach.
        told: the robot reports its external wrench.
    """
    gap_m = 0.12 if speed_m_s > 0.2 else 0.03
    way_m = 0.16 if obstacle.table else gap_m
    step_m = np.array([0.0, 0.0, -1.0] if obstacle.table else [0.0, 1.0, 0.0]) * speed_m_s * STEP_S
    with tempfile.TemporaryDirectory() as folder:
        profile = pushing(mode, scene_with(obstacle, gap_m, Path(folder)))
        world = build_world(profile)
    loop = Lockstep(profile, world, Push(step_m), reach=ReachabilityFilter(profile))
    loop.tamper = None if told else untold
    loop.put("rate", 10.0)
    loop.run(1.1)
    loop.put("active", True)
    loop.run(0.01)
    if loop.commander.state.value != "active":
        raise RuntimeError(loop.commander.why)
    forces_n: list[float] = []

    def force_n() -> float:
        forces_n.append(norm3(world.wrench()[:3]))
        return forces_n[-1]

    ended = loop.run_until(
        lambda: force_n() < 0 or loop.commander.state.value != "active",
        way_m / speed_m_s + PATIENCE_S,
    )
    loop.run_until(lambda: force_n() < 0 or loop.commander.at_rest, AFTER_S)
    loop.run_until(lambda: force_n() < 0, AFTER_S)
    means = np.convolve(forces_n, np.full(MEAN_MS, 1.0 / MEAN_MS), "valid")
    return Pushed(
        max(forces_n),
        float(means.max()),
        float(np.mean(forces_n[-round(LASTING_S * 1e3) :])),
        _what_ended_it(loop) if ended else "none: it pushes on",
    )


def _what_ended_it(loop: Lockstep) -> str:
    stops = [event for event in loop.events if event.what.startswith("contact_")]
    if stops and stops[-1].kind == "limit" and stops[-1].value is not None:
        return f"{stops[-1].what} {stops[-1].value:.1f} (limit {stops[-1].limit:g})"
    return "tracking" if "does not follow" in loop.commander.why else loop.commander.why[:60]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--only", default="", help="rows of obstacles with this text in their name")
    parser.add_argument("--untold", action="store_true", help="the robot reports no wrench")
    asked = parser.parse_args()
    print("| obstacle | by | m/s | peak N (1 ms / 50 ms) | lasting N | ended by |")
    print("|---|---|---|---|---|---|")
    for obstacle, mode, speed in itertools.product(OBSTACLES, ("pose", "joint"), SPEEDS_M_S):
        if asked.only in obstacle.name:
            row = push(obstacle, mode, speed, told=not asked.untold)
            print(
                f"| {obstacle.name} | {mode} | {speed:g} "
                f"| {row.peak_n:.0f} / {row.mean_peak_n:.0f} "
                f"| {row.lasting_n:.1f} | {row.event} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
