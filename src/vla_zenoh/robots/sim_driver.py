"""Driver of the simulated robot: MuJoCo and its torque controllers.

The arm follows poses or joint positions. Real time by default, as far as the computer keeps up (see
`vla_zenoh.simulation.pace`). In lockstep simulated time stands still until a query on ``sim/step``
advances it, by 1 ms per tick.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from vla_zenoh.bus.buffers import CallbackRing, bytes_of
from vla_zenoh.bus.clock import Tick
from vla_zenoh.bus.node import Node
from vla_zenoh.codec import message, settings
from vla_zenoh.errors import CodecError, NodeError
from vla_zenoh.guard.arm_guard import Measured
from vla_zenoh.keys import Kind
from vla_zenoh.kinematics.so3 import Pose, exp3
from vla_zenoh.profile import Profile
from vla_zenoh.robots.arm import Arm
from vla_zenoh.robots.driver import DriverStatus, Measurement, RobotDriver
from vla_zenoh.simulation.pace import Pace, control_steps
from vla_zenoh.simulation.world import STEP_NS, STEP_S, build_world
from vla_zenoh.types import Event, FloatArray, GripperCommand, ObjectPoses, SceneState
from vla_zenoh.types.records import JointReference, JointState, PoseReference

if TYPE_CHECKING:
    from vla_zenoh.robots.node import RobotNode

SLOW, FAST_AGAIN = 0.9, 0.97
"""Simulated over real time below which an event reports it, and above which it is over."""


def _every(rate_hz: float) -> int:
    """Steps of the simulation between two events of this rate."""
    return max(1, round(1e9 / STEP_NS / rate_hz))


SCENE_EVERY, OBJECTS_EVERY, LOOK_EVERY = _every(60.0), _every(10.0), _every(4.0)
MAX_LOCKSTEP_NS = 60_000_000_000
MAX_STEP_BYTES = 1024
WATCH_S = 0.2
LEAST_FORCE_N = 0.1
"""A gripper that may press with no force would not move."""


def in_world_time(
    reference: PoseReference | JointReference, stretch: float, steps: int
) -> PoseReference | JointReference:
    """The reference for the end of a tick of some `steps`, in real time, as that of its first step.

    It is in the time of a world that goes slower than real time by the factor `stretch`.
    """
    back_s = (steps - 1) * STEP_S
    if isinstance(reference, JointReference):
        velocity_rad_s = reference.velocity_rad_s * stretch
        return JointReference(
            reference.position_rad - velocity_rad_s * back_s,
            velocity_rad_s,
            reference.acceleration_rad_s2 * stretch**2,
        )
    twist = reference.twist * stretch
    return PoseReference(
        reference.position_m - twist[:3] * back_s,
        exp3(-twist[3:] * back_s) @ reference.rotation,
        twist,
        reference.acceleration * stretch**2,
    )


class SimDriver(RobotDriver):
    """The simulated robot of a profile; in `lockstep` only queries on ``sim/step`` advance time.

    Raises:
        ResourceError: scene or robot description are missing.
    """

    name, loop = "sim", "control"
    simulated = True
    switch_interval_s = 1e-4  # nothing else of ours runs here; Zenoh's callbacks must not wait

    def __init__(self, profile: Profile, *, lockstep: bool = False) -> None:
        super().__init__(profile)
        self.world = build_world(profile)
        self.lockstep = lockstep
        self.modes = ("pose", "joint")
        self._on_time = control_steps(max(profile.timing.command_hz, profile.timing.state_hz))
        self.steps = 1 if lockstep else self._on_time
        self.period_s = self.steps * STEP_S
        self.ticks = self.stamp_ns = 0
        self._pace: Pace | None = None
        self._slow = ""
        self._was_reset = False
        self._step_lock = threading.Lock()
        self._node: Node | None = None
        self._parts = {name: SimPart(self, name) for name in profile.part_names}
        self._first = next(iter(self._parts.values()))

    @property
    def parts(self) -> Mapping[str, SimPart]:
        return self._parts

    def read(self, mono_ns: int) -> Measurement | None:
        return self._first.read(mono_ns)

    def move(self, reference: PoseReference | JointReference, now_ns: int) -> None:
        self._first.move(reference, now_ns)

    def attach(self, node: Node, arm: Arm) -> None:
        """Subscribe to resets, and publish the scene."""
        super().attach(node, arm)
        keys, limit = node.keys, settings.MAX_SETTING_BYTES
        self._node = node
        self._resets = node.subscribe(keys.sim_reset, CallbackRing(4, limit))
        self._scene = node.declare_publisher(keys.sim_scene, Kind.STATE)
        self._objects = node.declare_publisher(keys.sim_objects, Kind.TELEMETRY)
        self._scene_wanted = self._objects_wanted = False

    # -- one tick -----------------------------------------------------------------------------
    def poll(self, mono_ns: int) -> None:
        """Execute resets."""
        if self._node is None:
            return
        self._watch_pace()
        for arrival in self._resets.drain():
            # In a tuple: no seed is a valid one, no tuple a rejection.
            found = self._node.decode_text(lambda text: (settings.decode_seed(text),), arrival)
            if found is None:
                continue
            guards = [part.guard for part in self._parts.values()]
            if any(guard.following for guard in guards) and not self.fault:
                why = "sim/reset: the arm is being commanded; deactivate first"
                self.report.reject("reset_refused", why)
            else:
                self.reset(found[0])
                for guard in guards:
                    guard.reset()

    def step_world(self, mono_ns: int) -> None:
        """Step the world towards the references of all parts."""
        self.ticks += self.steps
        self.measured_ns = mono_ns
        if not self.fault:
            references = {name: part.reference for name, part in self._parts.items()}
            if not self.lockstep:
                references = {
                    name: in_world_time(reference, self.stretch, self.steps)
                    for name, reference in references.items()
                }
            try:
                self.world.tick(references, self.steps)
            except NodeError as error:
                self.fault = str(error)
                self.report.reject("simulation_fault", self.fault)
        if self._node is not None:
            self._publish_scene()

    def _publish_scene(self) -> None:
        """Publish what is due and has subscribers."""
        world = self.world
        if self.due(LOOK_EVERY):
            self._scene_wanted = self._scene.has_subscribers
            self._objects_wanted = self._objects.has_subscribers
        if self._scene_wanted and self.due(SCENE_EVERY):
            scene = SceneState(self.profile.sim.scene, world.qpos(), world.seed)
            self._scene.publish(scene, stamp_wall_ns=self.stamp_ns)
        if self._objects_wanted and self.due(OBJECTS_EVERY):
            objects = world.objects()
            poses = ObjectPoses(
                tuple(objects),
                np.array([position_m for position_m, _ in objects.values()]).reshape(-1, 3),
                np.array([quat_xyzw for _, quat_xyzw in objects.values()]).reshape(-1, 4),
            )
            self._objects.publish(poses, stamp_wall_ns=self.stamp_ns)

    def due(self, every: int) -> bool:
        """Whether the last tick reached or passed a multiple of `every` steps."""
        return self.ticks % every < self.steps

    @property
    def stretch(self) -> float:
        """Real time over simulated time."""
        return self.period_s / (self.steps * STEP_S)

    def reset(self, seed: int | None) -> None:
        """Reset arm and objects to their initial state; `seed` None: that of the profile."""
        self.world.reset(self.profile.sim.seed if seed is None else seed)
        self.fault = ""
        self.report.counters["sim.resets"] += 1
        self._was_reset = True

    def status_changed(self) -> bool:
        was_reset, self._was_reset = self._was_reset, False
        return was_reset

    # -- time ---------------------------------------------------------------------------------
    def pace(self) -> Callable[[], Tick]:
        """Ticks on the monotonic clock; late ones follow each other at once."""
        pace = self._pace = Pace(time.monotonic_ns(), self._on_time)
        report = self.report
        report.counters["sim.overruns"] = 0

        def wait() -> Tick:
            tick = pace.next(time.monotonic_ns())
            if tick.wait_ns > 0:
                time.sleep(tick.wait_ns / 1e9)
            if tick.steps > self._on_time:
                report.counters["sim.overruns"] += 1
            if tick.given_up_ns:
                report.counters["sim.time_given_up_ms"] += tick.given_up_ns // 1_000_000
            self.steps, self.period_s = tick.steps, tick.period_s
            for part in self._parts.values():
                part.period_s = tick.period_s
            return Tick(1, tick.time_ns, 0.0, 0.0)

        return wait

    def _watch_pace(self) -> None:
        """Report that the world is slower than real time, once until it is not."""
        factor = 1.0 if self._pace is None else self._pace.factor
        if factor < SLOW and not self._slow:
            why = (
                f"the simulator is slower than real time: x {factor:.2f}; this computer is too "
                "slow or busy. The arm stays on its commands, so it meets objects harder than it "
                "should; they move and fall slower"
            )
            self.report.emit(Event("warning", "notice", "slow", why, factor, SLOW))
            self._slow = f"slower than real time: x {factor:.2f}"
        elif factor > FAST_AGAIN:
            self._slow = ""

    def serve_lockstep(self, node: RobotNode, stop: threading.Event) -> None:
        """Publish the first state, and answer ``sim/step`` until `stop` is set."""
        self.measured_ns = 0
        for name, part in self._parts.items():
            part.measured_ns = 0
            node.arms[name].publish(part.measure(), 0)
        node.node.serve(node.node.keys.sim_step, lambda query: self._answer_step(node, query))
        while not stop.wait(WATCH_S):
            with self._step_lock:
                node.watch()

    def _answer_step(self, node: RobotNode, query: zenoh.Query) -> None:
        """Advance by a msgpack map ``{"ns": ..}``; the reply is the state after it."""
        payload = query.payload
        try:
            asked = message.unpack(bytes_of(payload, MAX_STEP_BYTES)) if payload is not None else {}
            if not isinstance(asked, dict) or type(asked.get("ns")) is not int:
                raise CodecError("malformed", 'wanted a map {"ns": nanoseconds to advance}')
            duration_ns = asked["ns"]
            if not 0 < duration_ns <= MAX_LOCKSTEP_NS or duration_ns % STEP_NS:
                raise CodecError("invalid", f"ns: wanted a multiple of {STEP_NS}, at most 60 s")
        except CodecError as error:
            self.report.reject(error.reason, f"sim/step: {error}")
            query.reply_err(str(error).encode())
            return
        with self._step_lock:
            for _ in range(duration_ns // STEP_NS):
                node.step(Tick(1, (self.ticks + 1) * STEP_NS, 0.0, 0.0))
            state: dict[str, Any] = {"time_ns": self.ticks * STEP_NS}
            for name, arm in self.world.parts.items():
                found = {
                    "joint": arm.joint_state(),
                    "pose": arm.pose_state(self._parts[name].reference),
                    "gripper": arm.gripper_state(),
                }
                state |= {name: found} if name else found
        query.reply(node.node.keys.sim_step, message.pack(state))

    # -- status -------------------------------------------------------------------------------
    def status(self) -> DriverStatus:
        """Scene, command mode and fault."""
        self.report.counters["sim.torque_saturated"] = self.world.saturated
        detail: dict[str, Any] = {
            "scene": self.profile.sim.scene,
            "command": self._first.guard.kind,
        }
        if self._pace is not None:
            detail["real_time_factor"] = round(self._pace.factor, 3)
            detail["slow"] = self._slow
        return DriverStatus({**detail, "lockstep": self.lockstep, "fault": self.fault})


class SimPart(RobotDriver):
    """One arm of the simulated robot; the first one steps the world of all.

    It has a `guard` of its command streams once the node is on the bus; the next step goes towards
    `reference`.
    """

    name, simulated = "sim", True

    def __init__(self, sim: SimDriver, part: str) -> None:
        super().__init__(sim.profile.of_part(part))
        self._sim, self._arm = sim, sim.world.parts[part]
        self._is_first = part == sim.profile.part_names[0]
        self._state_every = _every(sim.profile.timing.state_hz)
        self._newest: Measurement | None = None
        self.modes, self.period_s, self.lockstep = sim.modes, sim.period_s, sim.lockstep
        self.reference: PoseReference | JointReference = self._arm.hold_reference()

    def attach(self, node: Node, arm: Arm) -> None:
        """Begin where the arm stands."""
        super().attach(node, arm)
        self.guard, self.reference = arm.guard, arm.guard.reference

    def move(self, reference: PoseReference | JointReference, now_ns: int) -> None:
        """Set the reference and the stamp of the next step."""
        self.reference, self._sim.stamp_ns = reference, now_ns

    def grip(self, command: GripperCommand, now_ns: int) -> None:
        force_n = max(command.force_n, LEAST_FORCE_N)
        self._arm.set_gripper(command.width_m, command.speed_m_s, force_n)

    def read(self, mono_ns: int) -> Measurement | None:
        """State of the arm at multiples of the period of ``timing.state_hz``."""
        sim = self._sim
        if self._is_first:
            sim.step_world(mono_ns)
        self.fault, self.measured_ns = sim.fault, sim.measured_ns
        return self.measure() if sim.due(self._state_every) else None

    def measure(self) -> Measurement:
        """State of the arm after the last step."""
        arm, stamp_ns = self._arm, self._sim.stamp_ns
        if self.fault and self._newest is not None:  # a diverged state may not be finite
            return self._newest._replace(stamp_ns=stamp_ns)
        pose, joints = arm.pose_state(self.reference), self._joints()
        stretch = self._sim.stretch
        if stretch != 1.0:
            pose = replace(pose, twist=pose.twist / stretch)
        self._newest = Measurement(stamp_ns, joints, Pose(*arm.tcp()), pose, arm.gripper_state())
        return self._newest

    def _joints(self) -> JointState:
        """State of the joints; their velocity is in real time, as are the stamps."""
        state, stretch = self._arm.joint_state(), self._sim.stretch
        if stretch == 1.0:
            return state
        return replace(state, velocity_rad_s=state.velocity_rad_s / stretch)

    def state_now(self) -> Measured:
        state = self._joints()
        return Measured(Pose(*self._arm.tcp()), state.position_rad, state.velocity_rad_s)

    @property
    def joint_range_rad(self) -> tuple[FloatArray, FloatArray]:
        return self._arm.joint_range_rad

    @property
    def slides(self) -> NDArray[np.bool_]:
        return self._arm.slides

    @property
    def joint_velocity_rad_s(self) -> FloatArray:
        """Any: MuJoCo's model has none, and what commands the arm knows the description."""
        return np.full(len(self.profile.robot.arm_joints), np.inf)
