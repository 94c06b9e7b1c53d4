"""What a tick of the commander costs, with a chunk and without, and planning the chunk before it.

The commander alone, with the kinematics of the shipped arm and an arm that stands where it is
commanded: no session, no codec. Every scenario is played several times, tick for tick the same, and
of everything the least time counts, so that what else the computer does is left out as far as that
can be.

A chunk has 16 steps at 30 Hz and comes 10 times a second, 80 ms after its observation. `heap`: 64
of them arrive before one tick, once a second.
"""

from __future__ import annotations

import argparse
import gc
import platform
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vla_zenoh.control.commander import Commander, Inputs, Setting
from vla_zenoh.control.preflight import PeerSnapshot
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.policy import ActionSpec, CameraSpec, ModelSpec, ObservationSpec
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.types import ActionChunk, GripperState, Header, JointState, PoseState, Stamped

WORKER, SOURCE, ARM = "scripted", "worker-scripted-1", "sim-1"
START_NS = 1_700_000_000_000_000_000
HORIZON, DT_S = 16, 1 / 30
PERIOD_S, LATENCY_S = 0.1, 0.08
HEAP, HEAP_S = 64, 1.0


class Scenario(NamedTuple):
    """A policy: the step that it asks for at a time (s); the table's height (m).

    A step is (6,) m and rad of the TCP, or with `of_joints` (7,) rad.
    """

    name: str
    step: Callable[[float], tuple[float, ...]]
    heap: bool = False
    table_z_m: float = 0.0
    of_joints: bool = False


def _peers(t_s: float) -> tuple[float, ...]:
    return (0.004 * np.cos(t_s), 0.004 * np.sin(t_s), 0.002 * np.cos(t_s), 0.0, 0.0, 0.0)


def _down(t_s: float) -> tuple[float, ...]:
    return (0.002 * np.cos(t_s), 0.0, -0.006, 0.0, 0.0, 0.0)


def _swing(t_s: float) -> tuple[float, ...]:
    return tuple(0.008 * np.cos(t_s + joint) for joint in range(7))


def _lower(t_s: float) -> tuple[float, ...]:
    return (0.004 * np.cos(t_s), 0.01, 0.0, 0.0, 0.0, 0.0, 0.0)


SCENARIOS = (
    Scenario("free space", _peers),
    Scenario("at the table", _down, table_z_m=0.1),
    Scenario("at a joint's end", lambda _: (0.0, 0.0, 0.0, 0.0, 0.0, -0.05)),
    Scenario("stretched (singularity)", lambda _: (0.002, 0.01, 0.01, 0.0, 0.0, 0.0)),
    Scenario("a heap, free space", _peers, heap=True),
    Scenario("a heap, at the table", _down, heap=True, table_z_m=0.1),
    Scenario("joints, free space", _swing, of_joints=True),
    Scenario("joints, at the workspace box", _lower, of_joints=True),
    Scenario("joints, at the table", _lower, table_z_m=0.1, of_joints=True),
)


class Player:
    """A commander with all its inputs; see the module."""

    def __init__(self, profile: Profile, scenario: Scenario) -> None:
        self.profile, self.scenario = profile, scenario
        self.kinematics = make_kinematics(profile)
        self.commander = Commander(profile, reach=ReachabilityFilter(profile, self.kinematics))
        self.spec = ModelSpec(
            name=WORKER,
            observation=ObservationSpec(cameras=(CameraSpec(camera="front"),)),
            action=ActionSpec(
                horizon=HORIZON,
                dt_s=DT_S,
                rotation="rotvec",
                gripper="none",
                space="joint" if scenario.of_joints else "tcp",
                joints=self.kinematics.arm_joints if scenario.of_joints else (),
            ),
        )
        nodes = frozenset({"sim", "camera", f"worker-{WORKER}"})
        self.peers = PeerSnapshot(
            alive=nodes,
            robot_node="sim",
            specs={WORKER: self.spec},
            spec_sources={WORKER: SOURCE},
            camera_ages_s={"front": 0.0},
            camera_nodes={"front": "camera"},
            same_host=nodes,
        )
        robot = profile.robot
        self.joints_rad = self.kinematics.ordered(robot.arm_joints, robot.home_rad)
        pose = self.kinematics.forward(self.joints_rad)
        self.position_m, self.quat_xyzw = pose.position_m, quat_from_rotation(pose.rotation)
        self.now_ns, self.seq = START_NS, 0
        self.period_ns = round(1e9 / profile.timing.command_hz)
        self.tick([])
        self.tick([self.chunk(0.0)])
        self.tick([], Setting("active", True))
        if self.commander.state.value != "active":
            raise SystemExit(f"not activated: {self.commander.why}")

    def chunk(self, t_s: float, ago_s: float = 0.0) -> Stamped[ActionChunk]:
        self.seq += 1
        now_ns = self.now_ns + self.period_ns
        observed_ns = now_ns - round((LATENCY_S + ago_s) * 1e9) if t_s else now_ns
        steps = [self.scenario.step(t_s + k * DT_S) for k in range(HORIZON)]
        record = ActionChunk(
            worker=WORKER,
            spec_hash=self.spec.hash,
            episode=self.commander.task.episode,
            observation_stamp_ns=observed_ns,
            observation_seq=0,
            valid_until_ns=now_ns + 10**9,
            steps=np.asarray(steps, np.float32),
            observed_ns=observed_ns,
            inference_start_ns=observed_ns,
            inference_end_ns=now_ns,
        )
        header = Header(now_ns - round(ago_s * 1e9), self.seq, SOURCE)
        return Stamped(header, record, now_ns)

    def tick(self, chunks: list[Stamped[ActionChunk]], *settings: Setting) -> tuple[int, int]:
        """One tick; nanoseconds of planning before it, and of itself."""
        self.now_ns += self.period_ns
        header = Header(self.now_ns, self.now_ns // self.period_ns, ARM)
        held = (self.position_m, self.quat_xyzw)
        pose = PoseState(*held, np.zeros(6), None, *held)
        gripper = GripperState(0.08, moving=False, holding=False)
        still = np.zeros(len(self.joints_rad))
        joint = JointState(self.kinematics.arm_joints, self.joints_rad, still, still)
        inputs = Inputs(
            settings,
            (),
            Stamped(header, pose, self.now_ns),
            Stamped(header, gripper, self.now_ns),
            self.peers,
            Stamped(header, joint, self.now_ns),
        )
        began_ns = time.perf_counter_ns()
        if chunks:
            self.commander.prepare(Inputs(chunks=chunks), self.now_ns)
        planned_ns = time.perf_counter_ns()
        out = self.commander.step(inputs, self.now_ns)
        stepped_ns = time.perf_counter_ns()
        if out.pose is not None:
            self.position_m, self.quat_xyzw = out.pose.position_m, out.pose.quat_xyzw
        if out.joint is not None:
            self.joints_rad = out.joint.position_rad
            at = self.kinematics.forward(self.joints_rad)
            self.position_m, self.quat_xyzw = at.position_m, quat_from_rotation(at.rotation)
        return planned_ns - began_ns, stepped_ns - planned_ns

    def play(self, duration_s: float) -> tuple[list[tuple[int, int]], list[bool]]:
        """The times of every tick, and whether a chunk came before it."""
        spent_ns: list[tuple[int, int]] = []
        with_chunk: list[bool] = []
        period_s = HEAP_S if self.scenario.heap else PERIOD_S
        every = round(period_s * 1e9 / self.period_ns)
        for count in range(round(duration_s * 1e9 / self.period_ns)):
            t_s = 0.5 + count * self.period_ns / 1e9
            chunks: list[Stamped[ActionChunk]] = []
            if count % every == every // 2:
                many = HEAP if self.scenario.heap else 1
                chunks = [self.chunk(t_s, ago_s=0.002 * k) for k in reversed(range(many))]
            spent_ns.append(self.tick(chunks))
            with_chunk.append(bool(chunks))
        return spent_ns, with_chunk


def _row(name: str, spent_us: np.ndarray) -> str:
    p50, p95 = np.percentile(spent_us, [50, 95])
    return f"  {name:<18} {p50:9.0f} {p95:9.0f} {spent_us.max():9.0f}   {len(spent_us):6d}"


def main() -> None:
    arguments = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    arguments.add_argument("--duration-s", type=float, default=5.0, help="of every scenario")
    arguments.add_argument("--runs", type=int, default=5, help="of which the least counts")
    arguments.add_argument("--command", choices=("pose", "joint", "both"), default="both")
    arguments.add_argument("--only", default="", help="scenarios whose name has this")
    given = arguments.parse_args()
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}")
    base = load_profile("panda_sim")
    for command in ("pose", "joint") if given.command == "both" else (given.command,):
        robot = base.robot.model_copy(update={"command": command})
        for scenario in SCENARIOS:
            if given.only not in scenario.name:
                continue
            reach = base.limits.reach.model_copy(update={"table_z_m": scenario.table_z_m})
            limits = base.limits.model_copy(update={"reach": reach})
            profile = base.model_copy(update={"robot": robot, "limits": limits})
            runs: list[list[tuple[int, int]]] = []
            with_chunk: list[bool] = []
            for _ in range(given.runs):
                player = Player(profile, scenario)
                gc.collect()
                gc.disable()
                spent_ns, with_chunk = player.play(given.duration_s)
                gc.enable()
                runs.append(spent_ns)
            least_us = np.min(runs, axis=0) / 1e3
            chunky = np.array(with_chunk)
            print(f"{command}, {scenario.name}:  p50, p95, max us; ticks")
            planned_us, tick_us = least_us.T
            print(_row("chunk planned", planned_us[chunky]))
            print(_row("tick after it", tick_us[chunky]))
            print(_row("any other tick", tick_us[~chunky]))


if __name__ == "__main__":
    main()
