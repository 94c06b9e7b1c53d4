"""A commander with everything around it made up: clock, arm, gripper, worker, nodes.

The arm is perfect: it stands where it was last commanded to, unless it is `blocked`.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from vla_zenoh.control.commander import Commander, Inputs, Outputs, Setting
from vla_zenoh.control.preflight import PeerSnapshot
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.states import MODES
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import Pose, exp3, log3, quat_from_rotation, rotation_from_quat
from vla_zenoh.policy import ActionSpec, CameraSpec, ModelSpec, ObservationSpec
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.types import (
    ActionChunk,
    Event,
    FloatArray,
    GripperState,
    Header,
    JointState,
    PoseCommand,
    PoseState,
    Stamped,
)

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000
WORKER, OTHER = "scripted", "other"
SOURCE = "worker-scripted-1"
LIMIT_RTOL = 1e-6
STANDING = 0.01  # m/s and rad/s, in the first tick of a move at most
START_M = np.array([0.43, 0.0, 0.3])
_REACHES: dict[str, ReachabilityFilter] = {}
DOWN = np.array([1.0, 0.0, 0.0, 0.0])  # tool straight down


@cache
def shipped() -> Profile:
    """The shipped profile, but for the rate of its commands.

    Hardly anything that is shown depends on it, and every command takes a third of a millisecond.
    """
    return override(load_profile("panda_sim"), {"timing": {"command_hz": 100.0}})


OFTEN = {"command_hz": 250.0}
"""The rate that is shipped, as `timing` of a profile."""


def profile(**parts: dict[str, Any]) -> Profile:
    """`shipped` with other numbers: ``profile(timing={"watchdog_s": 1.0})``."""
    base = shipped()
    changes = {name: getattr(base, name).model_copy(update=part) for name, part in parts.items()}
    return base.model_copy(update=changes)


def reach_of(of: Profile) -> ReachabilityFilter:
    """The filter of this profile, at home: one for all tests, for its collisions take long."""
    key = repr(of)
    if key not in _REACHES:
        _REACHES[key] = ReachabilityFilter(of)
    reach = _REACHES[key]
    reach.hold(None)
    reach.reset(reach.kinematics.ordered(of.robot.arm_joints, of.robot.home_rad))
    return reach


def model_spec(name: str = WORKER, **action: Any) -> ModelSpec:
    fields = {"horizon": 16, "dt_s": 0.1, "rotation": "rotvec", "gripper": "delta_m", **action}
    return ModelSpec(
        name=name,
        observation=ObservationSpec(cameras=(CameraSpec(camera="front"),)),
        action=ActionSpec(**fields),
    )


class Rig:
    """See the module."""

    def __init__(
        self,
        of: Profile | None = None,
        *,
        dry_run: bool = False,
        reach: ReachabilityFilter | None = None,
        **action: Any,
    ) -> None:
        self.profile = of or profile()
        self.commander = Commander(self.profile, reach=reach, dry_run=dry_run)
        self.joints_rad: FloatArray | None = None
        self.joints_of_tcp = True
        self._solved_rad: FloatArray | None = None
        self.spec = model_spec(**action)
        self.now_ns = START_NS
        self.period_ns = round(1e9 / self.profile.timing.command_hz)
        self.peers = PeerSnapshot(
            alive=frozenset({"sim", "camera", f"worker-{WORKER}", f"worker-{OTHER}"}),
            robot_node="sim",
            specs={WORKER: self.spec, OTHER: self.spec},
            spec_sources={WORKER: SOURCE, OTHER: "worker-other-1"},
            camera_ages_s={"front": 0.0},
            camera_nodes={"front": "camera"},
            same_host=frozenset({"sim", "camera", f"worker-{WORKER}", f"worker-{OTHER}"}),
        )
        self.position_m, self.quat_xyzw = START_M.copy(), DOWN.copy()
        self.reference: PoseCommand | None = None
        self.blocked = self.silent = False
        self.gripper = GripperState(0.08, moving=False, holding=False)
        self.seq: Counter[str] = Counter()
        self.commands: list[PoseCommand] = []
        self.times_ns: list[int] = []
        self.widths_m: list[float] = []
        self.events: list[Event] = []
        self.refused: Counter[str] = Counter()

    # -- time ---------------------------------------------------------------------------------
    def tick(
        self,
        *settings: Setting | str,
        chunks: Sequence[Stamped[ActionChunk]] = (),
        ticks: int = 1,
    ) -> Outputs:
        """One call of the commander, `ticks` periods after the last one."""
        self.now_ns += ticks * self.period_ns
        put = [Setting(s) if isinstance(s, str) else s for s in settings]
        inputs = Inputs(put, list(chunks), peers=self.peers)
        if not self.silent:
            inputs.pose, inputs.gripper = self.pose_state(), self.gripper_state()
            inputs.joint = self.joint_state()
        out = self.commander.step(inputs, self.now_ns, ticks)
        if self.state != "fault":  # one found in this tick ends what was done in it
            modes = [part.motion.mode for part in self.commander.parts]
            assert MODES[self.commander.state].issuperset(modes)
        self.events += out.events
        self.refused.update(refusal.reason for refusal in out.rejections)
        if out.pose is not None:
            self.reference = out.pose
            self.commands.append(out.pose)
            self.times_ns.append(self.now_ns)
            if not self.blocked:
                self.position_m, self.quat_xyzw = out.pose.position_m, out.pose.quat_xyzw
        if out.gripper is not None:
            self.widths_m.append(out.gripper.width_m)
            self.gripper = replace(self.gripper, width_m=out.gripper.width_m)
        return out

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s * 1e9 / self.period_ns)):
            self.tick()

    def put(self, name: str, value: str | bool | float | None = None) -> Outputs:
        return self.tick(Setting(name, value))

    def activate(self) -> None:
        """Publish a chunk in the shadow, activate, and see that it worked."""
        self.tick(chunks=[self.chunk([[0.0] * 7])])
        self.put("active", True)
        assert self.state == "active", self.commander.why

    def settle(self, most_s: float = 1.5) -> None:
        """Let the arm come to where it is to go, and stand there for 0.1 s."""
        for _ in range(round(most_s / 0.1)):
            before_m = self.position_m
            self.run(0.1)
            if self.commander.at_rest and np.array_equal(before_m, self.position_m):
                return
        assert self.commander.at_rest

    def stand_at(self, kinematics: Kinematics, joints_rad: FloatArray) -> None:
        """The measured joints, and their TCP."""
        pose, self.joints_rad = kinematics.forward(joints_rad), joints_rad
        self.position_m, self.quat_xyzw = pose.position_m, quat_from_rotation(pose.rotation)

    # -- what the others say ------------------------------------------------------------------
    def pose_state(self) -> Stamped[PoseState]:
        held = self.reference
        record = PoseState(
            self.position_m,
            self.quat_xyzw,
            np.zeros(6),
            None,
            held.position_m if held else self.position_m,
            held.quat_xyzw if held else self.quat_xyzw,
        )
        return Stamped(self.header("sim", "sim-1"), record, self.now_ns)

    def joint_state(self) -> Stamped[JointState] | None:
        """Those of the test, wherever its TCP is said to be, else those of its TCP."""
        reach, joints_rad = self.commander.parts[0].reach, self.joints_rad
        names = self.profile.robot.arm_joints
        if joints_rad is None and reach is not None and self.joints_of_tcp:
            pose = Pose(self.position_m, rotation_from_quat(self.quat_xyzw))
            start_rad = reach.joints_rad if self._solved_rad is None else self._solved_rad
            solved_rad = reach.solve(pose, start_rad)
            joints_rad = self._solved_rad = start_rad if solved_rad is None else solved_rad
            names = reach.kinematics.arm_joints
        if joints_rad is None:
            return None
        zero = np.zeros(len(joints_rad))
        record = JointState(names, joints_rad, zero, zero, joints_rad)
        return Stamped(self.header("joint", "sim-1"), record, self.now_ns)

    def gripper_state(self) -> Stamped[GripperState]:
        return Stamped(self.header("sim", "sim-1"), self.gripper, self.now_ns)

    def header(self, stream: str, source: str) -> Header:
        self.seq[stream] += 1
        return Header(self.now_ns, self.seq[stream], source)

    def chunk(
        self,
        steps: Any,
        *,
        observed_ago_s: float = 0.0,
        published_ago_s: float = 0.0,
        seq: int | None = None,
        source: str | None = None,
        **fields: Any,
    ) -> Stamped[ActionChunk]:
        """A chunk that arrives with the next tick; times are as seen from then."""
        now_ns = self.now_ns + self.period_ns
        observed_ns = now_ns - round(observed_ago_s * 1e9)
        worker = fields.get("worker", WORKER)
        self.seq[worker] += 1
        made = {
            "worker": worker,
            "spec_hash": self.spec.hash,
            "episode": self.commander.task.episode,
            "observation_stamp_ns": observed_ns,
            "observation_seq": 0,
            "valid_until_ns": now_ns + 10**9,
            "steps": np.asarray(steps, np.float32),
            "observed_ns": observed_ns,
            "inference_start_ns": observed_ns,
            "inference_end_ns": now_ns,
            **fields,
        }
        header = Header(
            now_ns - round(published_ago_s * 1e9),
            self.seq[worker] if seq is None else seq,
            self.peers.spec_sources.get(worker, SOURCE) if source is None else source,
        )
        return Stamped(header, ActionChunk(**made), now_ns)

    def send(self, steps: Any, **how: Any) -> Outputs:
        return self.tick(chunks=[self.chunk(steps, **how)])

    # -- what came of it ----------------------------------------------------------------------
    @property
    def state(self) -> str:
        return self.commander.state.value

    @property
    def transitions(self) -> list[str]:
        return [event.what for event in self.events if event.kind == "transition"]

    def moved_m(self) -> np.ndarray:
        return self.position_m - START_M

    def turned_rad(self) -> np.ndarray:
        return log3(rotation_from_quat(self.quat_xyzw) @ rotation_from_quat(DOWN).T)

    def assert_smooth(self) -> None:
        """Limits hold in every command and between any two, and no pose is out of the blue."""
        limits = self.profile.limits
        translation, rotation = (
            list(part.model_dump().values()) for part in (limits.translation, limits.rotation)
        )
        twist = np.array([command.twist for command in self.commands])
        acceleration = np.array([command.acceleration for command in self.commands])
        dt_s = self.period_ns / 1e9
        # The stream may pause, but only while the arm stands.
        pauses = np.round(np.diff(self.times_ns) / self.period_ns) != 1
        for standing in (twist[:-1][pauses], twist[1:][pauses]):
            assert np.abs(standing).max(initial=0.0) < STANDING
        jerk = np.diff(acceleration, axis=0)[~pauses] / dt_s
        for order, values in enumerate((twist, acceleration, jerk)):
            assert np.abs(values[:, :3]).max() <= translation[order] * (1 + LIMIT_RTOL)
            assert np.linalg.norm(values[:, 3:], axis=1).max() <= rotation[order] * (1 + LIMIT_RTOL)
        position_m = np.array([command.position_m for command in self.commands])
        turns = [rotation_from_quat(command.quat_xyzw) for command in self.commands]
        turned = [log3(b @ a.T) for a, b in itertools.pairwise(turns)]
        moved = np.hstack([np.diff(position_m, axis=0), np.array(turned)])
        error = np.abs(moved - (twist[:-1] + twist[1:]) * (dt_s / 2))[~pauses]
        assert error[:, :3].max() <= translation[2] * dt_s**3 / 4
        assert error[:, 3:].max() <= rotation[2] * dt_s**3


def quat_of(rotvec: Sequence[float]) -> np.ndarray:
    """Tool down, then turned by `rotvec` in the base frame."""
    return quat_from_rotation(exp3(np.array(rotvec)) @ rotation_from_quat(DOWN))


def lone_chunk(steps: Any, observed_ns: int = START_NS) -> Stamped[ActionChunk]:
    """A chunk for a planner alone, received when its observation was taken."""
    record = ActionChunk(
        worker=WORKER,
        spec_hash="",
        episode=1,
        observation_stamp_ns=observed_ns,
        observation_seq=0,
        valid_until_ns=observed_ns + 10**9,
        steps=np.asarray(steps, np.float32),
        observed_ns=observed_ns,
        inference_start_ns=observed_ns,
        inference_end_ns=observed_ns,
    )
    return Stamped(Header(observed_ns, 1, SOURCE), record, observed_ns)
