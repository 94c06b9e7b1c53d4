"""The simulated robot on the bus: takes poses, joints and widths, gives state, at 1 kHz inside.

Poses and joint positions are both accepted; the stream that is followed owns the arm, the other may
begin when it has ended and the arm stands.

Real time by default: the world is stepped against the wall clock, and time lost to a busy computer
is caught up (at most `CATCH_UP_NS`), then given up and counted. In lockstep mode time stands still
until somebody queries ``sim/step``.
"""

from __future__ import annotations

import gc
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import zenoh

from vla_zenoh.bus.buffers import bytes_of
from vla_zenoh.bus.metrics import RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.codec import message, records
from vla_zenoh.errors import CodecError, NodeError
from vla_zenoh.guard.arm_guard import ArmGuard, Measured, make_arm_guard
from vla_zenoh.keys import Kind
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.profile import Profile
from vla_zenoh.robots.sim.inputs import SimInputs
from vla_zenoh.runtime.scheduling import realtime_thread
from vla_zenoh.simulation.world import STEP_NS, World, build_world
from vla_zenoh.types import Event, ObjectPoses, SceneState
from vla_zenoh.types.commands import JointReference

CATCH_UP_NS = 50_000_000
SCENE_HZ, OBJECTS_HZ, WATCH_HZ = 60.0, 10.0, 4.0
MAX_LOCKSTEP_NS = 60_000_000_000
MAX_STEP_BYTES = 1024
SWITCH_INTERVAL_S = 1e-4


def build_guard(profile: Profile, world: World) -> ArmGuard:
    """The robot side's guard of both command streams, standing where the arm stands."""

    def measure() -> Measured:
        state = world.joint_state()
        return Measured(Pose(*world.tcp()), state.position_rad, state.velocity_rad_s)

    return make_arm_guard(profile, measure, world.joint_range_rad, STEP_NS / 1e9)


class SimNode:
    """See the module."""

    def __init__(self, profile: Profile, session: zenoh.Session, *, lockstep: bool = False) -> None:
        self.world = build_world(profile)
        self.guard = build_guard(profile, self.world)
        node = self.node = Node("sim", profile, session)
        self.lockstep = lockstep
        keys = node.keys
        self._inputs = SimInputs(node, self.world, self.guard, self._reset, lockstep=lockstep)
        self._braking = False
        self._joint = node.declare_publisher(keys.state_joint, Kind.STATE)
        self._pose = node.declare_publisher(keys.state_pose, Kind.STATE)
        self._gripper = node.declare_publisher(keys.state_gripper, Kind.STATE)
        self._scene = node.declare_publisher(keys.sim_scene, Kind.STATE)
        self._objects = node.declare_publisher(keys.sim_objects, Kind.TELEMETRY)
        self._reference = self.guard.reference
        self._base_ns = 0
        self._ticks = 0
        self._rate = RateMeter()
        self._overruns = 0
        self._realtime = False
        self._blown_up = ""
        self._scene_wanted = self._objects_wanted = False
        self._step_lock = threading.Lock()
        self._every = {
            name: max(1, round(1e9 / STEP_NS / rate_hz))
            for name, rate_hz in (
                ("state", profile.timing.state_hz),
                ("scene", SCENE_HZ),
                ("objects", OBJECTS_HZ),
                ("watch", WATCH_HZ),
            )
        }

    # -- running ------------------------------------------------------------------------------
    def run(self, stop: threading.Event) -> None:
        """Simulate until `stop` is set."""
        if self.lockstep:
            self._run_lockstep(stop)
        else:
            # Nothing else of ours runs in this process; what Zenoh calls back must not wait long.
            sys.setswitchinterval(SWITCH_INTERVAL_S)
            gc.collect()
            gc.freeze()
            with realtime_thread() as self._realtime:
                self._run_in_real_time(stop)
        self.node.publish_status("stopped", now=True)
        self.node.close()

    def _run_in_real_time(self, stop: threading.Event) -> None:
        next_ns = time.monotonic_ns()
        while not stop.is_set():
            next_ns += STEP_NS
            late_ns = time.monotonic_ns() - next_ns
            if late_ns < 0:
                time.sleep(-late_ns / 1e9)
            elif late_ns > CATCH_UP_NS:
                self.node.counters["sim.time_given_up_ms"] += late_ns // 1_000_000
                next_ns += late_ns
            elif late_ns > STEP_NS:
                self._overruns += 1
            wall_ns = self.node.clock.wall_ns()
            self._tick(wall_ns - (time.monotonic_ns() - next_ns))

    def _run_lockstep(self, stop: threading.Event) -> None:
        self._base_ns = 0
        self._publish_state(0)
        self.node.serve(self.node.keys.sim_step, self._answer_step)
        while not stop.wait(0.2):
            with self._step_lock:
                self._watch()

    def _answer_step(self, query: zenoh.Query) -> None:
        """Advance as asked by a msgpack map ``{"ns": ..}``, reply with the state then."""
        payload = query.payload
        try:
            asked = message.unpack(bytes_of(payload, MAX_STEP_BYTES)) if payload is not None else {}
            if not isinstance(asked, dict) or type(asked.get("ns")) is not int:
                raise CodecError("malformed", 'wanted a map {"ns": nanoseconds to advance}')
            duration_ns = asked["ns"]
            if not 0 < duration_ns <= MAX_LOCKSTEP_NS or duration_ns % STEP_NS:
                raise CodecError("invalid", f"ns: wanted a multiple of {STEP_NS}, at most 60 s")
        except CodecError as error:
            self.node.reject(error.reason, f"sim/step: {error}")
            query.reply_err(str(error).encode())
            return
        with self._step_lock:
            for _ in range(duration_ns // STEP_NS):
                self._tick((self._ticks + 1) * STEP_NS)
            state = {
                "time_ns": self._ticks * STEP_NS,
                "joint": records.encode(self.world.joint_state()),
                "pose": records.encode(self.world.pose_state(self._reference)),
                "gripper": records.encode(self.world.gripper_state()),
            }
        query.reply(self.node.keys.sim_step, message.pack(state))

    # -- one millisecond ----------------------------------------------------------------------
    def _tick(self, now_ns: int) -> None:
        self._inputs.take(now_ns)
        self._ticks += 1
        if not self._blown_up:
            self._reference = self.guard.tick(now_ns)
            if self.guard.braking != self._braking:
                self._tell_braking()
            try:
                if isinstance(self._reference, JointReference):
                    self.world.tick_joint(self._reference)
                else:
                    self.world.tick(self._reference)
            except NodeError as error:
                self._blown_up = str(error)
                self.node.reject("simulation_fault", str(error))
        self._rate.tick()
        if self._ticks % self._every["state"] == 0:
            self._publish_state(now_ns)
        if self._ticks % self._every["scene"] == 0 and self._scene_wanted:
            self._scene.publish(
                SceneState(self.node.profile.sim.scene, self.world.qpos(), self.world.seed),
                stamp_wall_ns=now_ns,
            )
        if self._ticks % self._every["objects"] == 0 and self._objects_wanted:
            self._publish_objects(now_ns)
        if self._ticks % self._every["watch"] == 0:
            self._watch()

    def _tell_braking(self) -> None:
        self._braking = self.guard.braking
        silent = f"command/{self.guard.mode} for {self.node.profile.timing.command_timeout_s:g} s"
        event = (
            Event(
                "warning",
                "transition",
                "following->braking",
                f"no {silent} while the arm moved: it brakes by itself",
            )
            if self._braking
            else Event("info", "transition", "braking->standing", "nobody is followed")
        )
        self.node.emit(event)
        self.node.publish_status(
            "braking" if self._braking else "running", detail=self._detail(), now=True
        )

    def _reset(self, seed: int | None) -> None:
        if self.guard.following and not self._blown_up:
            why = "sim/reset: the arm is being commanded; deactivate first"
            self.node.reject("reset_refused", why)
            return
        self.world.reset(self.node.profile.sim.seed if seed is None else seed)
        self.guard.reset()
        self._blown_up = ""
        self.node.counters["sim.resets"] += 1
        self.node.publish_status("running", detail=self._detail(), now=True)

    # -- what is published --------------------------------------------------------------------
    def _publish_state(self, now_ns: int) -> None:
        seq = self._joint.seq
        gripper = self.world.gripper_state()
        state = self._state
        if state != "running":
            gripper = replace(
                gripper,
                mode=state if state in ("braking", "unheeded") else gripper.mode,
                faults=(self._blown_up,) if self._blown_up else (),
            )
        self._joint.publish(self.world.joint_state(), stamp_wall_ns=now_ns, seq=seq)
        self._pose.publish(self.world.pose_state(self._reference), stamp_wall_ns=now_ns, seq=seq)
        self._gripper.publish(gripper, stamp_wall_ns=now_ns, seq=seq)

    def _publish_objects(self, now_ns: int) -> None:
        objects = self.world.objects()
        self._objects.publish(
            ObjectPoses(
                tuple(objects),
                np.array([place[0] for place in objects.values()]).reshape(-1, 3),
                np.array([place[1] for place in objects.values()]).reshape(-1, 4),
            ),
            stamp_wall_ns=now_ns,
        )

    def _watch(self) -> None:
        self._scene_wanted, self._objects_wanted = (
            self._scene.has_subscribers,
            self._objects.has_subscribers,
        )
        self.node.adopt_system_time()
        self.node.publish_status(
            self._state,
            detail=self._detail(),
            rates_hz={"control": self._rate.rate_hz},
        )

    @property
    def _state(self) -> str:
        if self._blown_up:
            return "fault"
        if self.guard.braking:
            return "braking"
        return "unheeded" if self.guard.unheeded else "running"

    def _detail(self) -> dict[str, object]:
        self.node.counters["sim.overruns"] = self._overruns
        self.node.counters["sim.stream_silences"] = self.guard.silences
        self.node.counters["sim.torque_saturated"] = self.world.saturated
        return {
            "scene": self.node.profile.sim.scene,
            "following": self.guard.following,
            "command": self.guard.mode,
            "realtime": self._realtime,
            "lockstep": self.lockstep,
            "fault": self._blown_up,
        }
