"""Public arms of many makers: a profile of each by `profile new`, checked, and moved in simulation.

Their descriptions come from packages of others, in a folder of their own:

    python3 -m pip install --no-deps --target arms rtb-data==2.0.0 robosuite==1.5.2 \
        robosuite-models==1.0.0 mani-skill==3.0.1 airo-models==0.0.12 dm-control==1.0.50
    python -m benchmarks arms arms
"""

from __future__ import annotations

import json
import re
import tempfile
import time
from itertools import compress
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from typer.testing import CliRunner
from vla_zenoh_benchmarks.lockstep.loop import Lockstep

from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.errors import VlaZenohError
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec, Observation, ObservationSpec
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.policy.meaning import TURN_RAD, wrapped
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.program.main import app
from vla_zenoh.resources import ROBOT_DATA_PREFIX
from vla_zenoh.simulation.world import build_world

STEPS, STEP_M = 5, 0.01
SECONDS = 3.0
"""For the steps at 5 Hz, and to stand again."""
EXACT_M, EXACT_RAD = 5e-4, 5e-3
TURN_RAD_S = 0.4
TURNING = {"velocity_rad_s": 2.5}
ROBOT_DATA = f"{ROBOT_DATA_PREFIX}{{}}"
RTB = "rtbdata/xacro/{}"
ROBOSUITE = "robosuite/models/assets/robots/{}/robot.xml"
MODELS = "robosuite_models/assets/robots/{}/robot.xml"
MANISKILL = "mani_skill/assets/robots/{}"


class PublicArm(NamedTuple):
    """An arm and where its description is.

    Args:
        name: its maker and itself.
        package: which has its description, with the version.
        file: in the package.
    """

    name: str
    package: str
    file: str


DATA, RTB_DATA, SUITE = "example-robot-data 6.0.0", "rtb-data 2.0.0", "robosuite 1.5.2"
SUITE_MODELS, SKILL = "robosuite-models 1.0.0", "mani-skill 3.0.1"
ARMS = (
    PublicArm("Franka Panda", DATA, ROBOT_DATA.format("panda_description/urdf/panda.urdf")),
    PublicArm(
        "Universal Robots UR5", DATA, ROBOT_DATA.format("ur_description/urdf/ur5_robot.urdf")
    ),
    PublicArm("Kinova Jaco", DATA, ROBOT_DATA.format("kinova_description/robots/kinova.urdf")),
    PublicArm("UFACTORY xArm 7", DATA, ROBOT_DATA.format("xarm_description/urdf/xarm7.urdf")),
    PublicArm("Unitree Z1", DATA, ROBOT_DATA.format("z1_description/urdf/z1.urdf")),
    PublicArm(
        "The Robot Studio SO-101", DATA, ROBOT_DATA.format("so_arm_description/urdf/so101.urdf")
    ),
    PublicArm("PAL TIAGo", DATA, ROBOT_DATA.format("tiago_description/robots/tiago.urdf")),
    PublicArm("Willow Garage PR2", DATA, ROBOT_DATA.format("pr2_description/urdf/pr2.urdf")),
    PublicArm("Universal Robots UR3e", "airo-models 0.0.12", "airo_models/arms/ur3e/ur3e.urdf"),
    PublicArm("ABB IRB 140", RTB_DATA, RTB.format("abb_irb140_description/urdf/irb140.urdf")),
    PublicArm("KUKA KR 16", RTB_DATA, RTB.format("kuka_description/kuka_kr16/urdf/kr16_2.urdf")),
    PublicArm(
        "Trossen WidowX 250 S", RTB_DATA, RTB.format("trossen_descriptions/urdf/wx250s.urdf.xacro")
    ),
    PublicArm(
        "Lynxmotion AL5D", RTB_DATA, RTB.format("lynxmotion_al5d_description/urdf/al5d_robot.urdf")
    ),
    PublicArm(
        "Unimation Puma 560",
        RTB_DATA,
        RTB.format("unimation_puma560_description/urdf/puma560_robot.urdf"),
    ),
    PublicArm("Fetch Robotics Fetch", SKILL, MANISKILL.format("fetch/fetch.urdf")),
    PublicArm("Koch 1.1", SKILL, MANISKILL.format("koch/follower_arm_v1.1.urdf")),
    PublicArm("Rethink Sawyer", SUITE, ROBOSUITE.format("sawyer")),
    PublicArm("KUKA LBR iiwa", SUITE, ROBOSUITE.format("iiwa")),
    PublicArm("Kinova Gen3", SUITE, ROBOSUITE.format("kinova3")),
    PublicArm("Boston Dynamics Spot Arm", SUITE, ROBOSUITE.format("spot_arm")),
    PublicArm("ARX 5", SUITE_MODELS, MODELS.format("arx5")),
    PublicArm("ABB YuMi", SUITE_MODELS, MODELS.format("yumi")),
    PublicArm("Kinova Jaco 2", "dm-control 1.0.50", "dm_control/third_party/kinova/jaco_arm.xml"),
)


class Tried(NamedTuple):
    """What became of an arm.

    Args:
        joints: that are commanded; 0: no profile was made.
        guesses: in its profile.
        seconds: from the description to a motion that ended.
        fault: why there is none; empty: it went up exactly.
    """

    joints: int
    guesses: int
    seconds: float
    fault: str


def arms(
    packages: Annotated[Path, typer.Argument(help="Folder that the packages are installed in.")],
    match: Annotated[str, typer.Option("--match", help="Only arms whose name this matches.")] = "",
    turns: Annotated[
        int, typer.Option(help="Also turn the last joint without an end, by so many turns.")
    ] = 0,
) -> None:
    """Make a profile of each of 23 public arms, and move it up by 5 cm in simulation."""
    typer.echo("| arm | description | joints | guesses | s | simulated motion |")
    typer.echo("|---|---|---|---|---|---|")
    for arm in ARMS:
        if not re.search(match, arm.name):
            continue
        tried = _try(arm, packages, turns)
        file = arm.file.removeprefix(ROBOT_DATA_PREFIX)
        row = (
            f"{arm.name} | {arm.package}, `{Path(file).parts[-1]}` | {tried.joints or ''} | "
            f"{tried.guesses} | {tried.seconds:.0f} | {tried.fault or 'exact'}"
        )
        typer.echo(f"| {row} |")


def _try(arm: PublicArm, packages: Path, turns: int) -> Tried:
    began = time.monotonic()
    is_here = not arm.file.startswith(ROBOT_DATA_PREFIX)
    source = str(packages / arm.file) if is_here else arm.file
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "arm.yaml"
        words = ["profile", "new", source, "--output", str(file), "--yes", "--json"]
        done = CliRunner().invoke(app, words)
        guesses = 0
        if done.exit_code == 0:
            guesses = len(json.loads(done.stdout)["guesses"])
            done = CliRunner().invoke(app, ["profile", "check", str(file), "--sim"])
        if done.exit_code != 0:
            fault = " ".join(f"{done.output} {done.exception}".split())
            return Tried(0, guesses, time.monotonic() - began, fault)
        joints, fault = len(load_profile(str(file)).robot.arm_joints), _moved(file)
        if turns and not fault:
            fault = _turned(file, turns)
    return Tried(joints, guesses, time.monotonic() - began, fault)


class Turner:
    """A model that turns one joint steadily from home, by positions within (-pi, pi]."""

    def __init__(self, profile: Profile, joint: str, way_rad: float) -> None:
        names = profile.robot.arm_joints
        self.spec = ModelSpec(
            name="turner",
            observation=ObservationSpec(state=("joint",), prompt=False),
            action=ActionSpec(
                horizon=8, dt_s=0.1, kind="absolute", space="joint", joints=names, gripper="none"
            ),
        )
        self._home_rad, self._way_rad = np.array(profile.robot.home_rad), way_rad
        self._turns = np.array([name == joint for name in names])
        self._since_s: float | None = None

    def infer(self, observation: Observation) -> ActionSteps:
        now_s = observation.stamp_wall_ns / 1e9
        if self._since_s is None and observation.task.active:
            self._since_s = now_s
        passed_s = 0.0 if self._since_s is None else now_s - self._since_s
        at_s = passed_s + 0.1 * np.arange(1, 9)[:, None]
        rows = self._home_rad + np.minimum(TURN_RAD_S * at_s, self._way_rad) * self._turns
        return ActionSteps(np.where(self._turns, wrapped(rows), rows))


def _turned(file: Path, turns: int) -> str:
    """Why its last joint without an end is not turned so often; empty: it is, or has an end."""
    quick = {"timing": {"command_hz": 50, "state_hz": 50}, "limits": {"rotation": TURNING}}
    profile = override(load_profile(str(file)), quick)
    reach = ReachabilityFilter(profile)
    endless = [*compress(reach.kinematics.arm_joints, reach.kinematics.endless)]
    if not endless:
        return ""
    way_rad = turns * TURN_RAD
    world = build_world(profile)
    loop = Lockstep(profile, world, Turner(profile, endless[-1], way_rad), reach=reach)
    if why := loop.activate(1.0, 0.2):
        return why
    start_rad = world.joint_state().position_rad
    loop.run(way_rad / TURN_RAD_S + SECONDS)
    ways_rad = world.joint_state().position_rad - start_rad
    off_rad = np.abs(ways_rad - way_rad * (np.array(profile.robot.arm_joints) == endless[-1]))
    return "" if off_rad.max() < EXACT_RAD else f"{endless[-1]} off by {off_rad.max():.3f} rad"


def _moved(file: Path) -> str:
    """Why the simulated arm does not go up exactly; empty: it does."""
    # Slow nodes: only where the arm ends up matters.
    slow = {"timing": {"command_hz": 50, "state_hz": 50}}
    try:
        profile = override(load_profile(str(file)), slow)
        world = build_world(profile)
    except VlaZenohError as error:
        return str(error)
    reach = ReachabilityFilter(profile)
    loop = Lockstep(
        profile, world, make_policy(find_model("scripted"), profile=str(file)), reach=reach
    )
    start_m = world.tcp()[0]
    loop.put("prompt", f"HARD: go up x{STEPS}")
    loop.run(0.2)
    if why := loop.activate(1.0, 0.2):
        return why
    loop.run(SECONDS)
    off_m = world.tcp()[0] - start_m - [0.0, 0.0, STEPS * STEP_M]
    if np.abs(off_m).max() < EXACT_M:
        return ""
    limits = [event for event in loop.events if event.kind == "limit"]
    why = f": {limits[-1].what} {limits[-1].why}" if limits else ""
    return f"off by {', '.join(f'{1000 * each:.1f}' for each in off_m)} mm{why}"
