"""An arm of one's own on the bus: a class in a Python file reads and moves it.

See `vla_zenoh.robot`. The loop runs at the rate of the command stream; between the stream and the
arm stands the same guard as in the simulator and before a ROS 2 robot.
"""

from __future__ import annotations

import gc
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import zenoh

from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.control.arm import make_kinematics
from vla_zenoh.control.arm_guard import Measured
from vla_zenoh.control.gripper_guard import GripperGuard
from vla_zenoh.errors import CodecError, NodeError, ProfileError
from vla_zenoh.interop.arm_state import ArmState, pose_state
from vla_zenoh.interop.ros2.samples import Joints
from vla_zenoh.keys import Kind
from vla_zenoh.loader import make_robot
from vla_zenoh.nodes.clock import FixedRate
from vla_zenoh.nodes.lead import Lead
from vla_zenoh.nodes.meter import RateMeter
from vla_zenoh.nodes.node import Node
from vla_zenoh.nodes.priority import realtime_thread
from vla_zenoh.nodes.slots import Inbox
from vla_zenoh.profile import Profile
from vla_zenoh.robot import Command, Reading, Robot, numbers
from vla_zenoh.types import Event, FloatArray, GripperCommand, GripperState

NAME = "arm"
SWITCH_INTERVAL_S = 5e-4
BRAKE_BEFORE_EXIT_S = 1.0
CLOCK_PERIOD_S = 0.1
REPORT_S = 0.2
MAX_WORDS = 300
FUTURE_NS = 100_000_000


class ArmNode:
    """See the module.

    Args:
        profile: the effective profile, with its section arm.
        session: open session, closed by whoever opened it.

    Raises:
        ProfileError: the section arm is missing.
        WorkerError: its file is not there, or has no arm in it.
        NodeError: a node of this name is alive already.
    """

    def __init__(self, profile: Profile, session: zenoh.Session) -> None:
        if profile.arm is None:
            raise ProfileError(
                f"profile {profile.name!r} has no section arm, which names a Python file: "
                "arm: {file: my_arm.py}, with robot.driver: arm"
            )
        path = Path(profile.arm.file).expanduser()
        self._file = path.name
        self._robot: Robot = make_robot(path, profile.arm.options)
        robot = profile.robot
        node = self.node = Node(NAME, profile, session)
        kinematics = make_kinematics(profile)
        self._state = ArmState(profile, kinematics)
        self._lead = Lead(node, kinematics, self._move)
        self._joint_out = node.stream(node.keys.state_joint, Kind.STATE)
        self._pose_out = node.stream(node.keys.state_pose, Kind.STATE)
        self._gripper_out = node.stream(node.keys.state_gripper, Kind.STATE)
        self._orders = node.listen(node.keys.command_gripper, Inbox(16, SMALL_BYTES))
        self._grip, self._gripper_guard = self._method("grip"), GripperGuard(robot.gripper)
        self._width_m = robot.gripper.max_width_m
        self._reading: Reading | None = None
        self._measured_ns = self._published_ns = 0
        self._was = self._fault = ""
        self._rate, self._readings = RateMeter(), RateMeter()
        self._realtime = False
        self._clock_s = 0.0

    def _method(self, name: str) -> Callable[..., Any] | None:
        method = getattr(self._robot, name, None)
        return method if callable(method) else None

    # -- running ------------------------------------------------------------------------------
    def run(self, stop: threading.Event) -> None:
        """Drive until `stop` is set; a motion is braked first.

        Raises:
            NodeError: the robot's file raised something.
        """
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        try:
            self._connect()
            gc.collect()
            gc.freeze()
            with realtime_thread() as self._realtime:
                self._loop(stop)
        finally:
            self._close()

    def _connect(self) -> None:
        connect = self._method("connect")
        if connect is None:
            return
        done = threading.Event()

        def tell() -> None:  # a node that says nothing for long is taken for one that hangs
            while not done.wait(REPORT_S):
                self.node.report("connecting")

        self.node.report("connecting", now=True)
        teller = threading.Thread(target=tell, name="connecting", daemon=True)
        teller.start()
        try:
            self._called("connect", connect)
        finally:
            done.set()
            teller.join()

    def _close(self) -> None:
        close = self._method("close")
        try:
            if close is not None:
                self._called("close", close)
        except NodeError as error:  # what went wrong before it is what matters
            self.node.refuse("robot_failed", str(error))
        finally:
            self.node.report("stopped", now=True)
            self.node.close()

    def _called(self, name: str, method: Callable[..., Any], *given: Any) -> Any:
        try:
            return method(*given)
        except Exception as error:
            words = f"{type(error).__name__}: {error}"[:MAX_WORDS]
            raise NodeError(f"{self._file}: {name}: {words}") from error

    def _loop(self, stop: threading.Event) -> None:
        loop = FixedRate(self.node.profile.timing.command_hz)
        give_up_s, failure = 0.0, None
        while True:
            tick = loop.wait()
            if tick.periods > 1:
                self.node.counters["arm.missed_ticks"] += tick.periods - 1
            self._lead.woken(tick.nominal_ns, tick.stall_s)
            if stop.is_set() or failure is not None:
                give_up_s = give_up_s or time.monotonic() + BRAKE_BEFORE_EXIT_S
                self._lead.deafen()
                if not self._lead.sending or time.monotonic() > give_up_s:
                    break
            now_ns = self.node.clock.wall_at(tick.nominal_ns)
            if failure is None:
                try:
                    self._read(tick.nominal_ns)
                    self._take_widths()
                except NodeError as error:  # what moves can be braked all the same
                    failure = error
                    self.node.refuse("robot_failed", str(error))
            away, silent = "fault" if self._fault else "", self.state == "silent"
            self._lead.turn(now_ns, tick.nominal_ns, away=away, silent=silent)
            self._rate.tick()
            self._watch()
        if failure is not None:
            raise failure

    # -- state in, state out ------------------------------------------------------------------
    def _read(self, mono_ns: int) -> None:
        reading = self._called("read", self._robot.read)
        if reading is None:
            return
        if not isinstance(reading, Reading):
            raise NodeError(f"{self._file}: read gave {type(reading).__name__}, wanted a Reading")
        measured_ns = reading.measured_ns or time.monotonic_ns()
        if measured_ns == self._measured_ns:
            return  # the same again: the robot is slower than this loop
        try:
            self._take(reading, measured_ns)
            self._tell_fault(str(reading.fault)[:MAX_WORDS])
            if mono_ns - self._published_ns >= 0.9e9 / self.node.profile.timing.state_hz:
                self._publish(reading)
                self._published_ns = mono_ns
        except ValueError as error:
            self.node.refuse(getattr(error, "reason", "invalid"), f"{self._file}: read: {error}")
            return
        self._measured_ns = measured_ns
        self._readings.tick()

    def _take(self, reading: Reading, measured_ns: int) -> None:
        if measured_ns > time.monotonic_ns() + FUTURE_NS:
            raise ValueError("measured_ns is yet to come; it is of time.monotonic_ns()")
        names = self.node.profile.robot.arm_joints
        count = len(names)

        def maybe(name: str, given: Any) -> FloatArray | None:
            return None if given is None else numbers(name, given, count)

        joints = Joints(
            self.node.clock.wall_at(measured_ns),
            names,
            numbers("position_rad", reading.position_rad, count),
            maybe("velocity_rad_s", reading.velocity_rad_s),
            maybe("effort_nm", reading.effort_nm),
        )
        if reading.wrench is not None:
            numbers("wrench", reading.wrench, 6)
        taken = self._state.take(joints, joints.stamp_ns)
        assert taken is not None
        tcp, self._twist = self._state.tcp()
        self._lead.measured(Measured(tcp, taken.position_rad, taken.velocity_rad_s))
        self._tcp, self._reading = tcp, reading

    def _tell_fault(self, fault: str) -> None:
        if fault and fault != self._fault:
            self.node.tell(Event("error", "fault", "robot_fault", fault))
        self._fault = fault

    def _publish(self, reading: Reading) -> None:
        joints, stamp_ns, seq = self._state.joints, self._state.stamp_ns, self._joint_out.seq
        assert joints is not None
        pose, angles_rad = self._lead.held()
        joints = joints if angles_rad is None else replace(joints, reference_rad=angles_rad)
        self._joint_out.put(joints, stamp_wall_ns=stamp_ns, seq=seq)
        wrench = None if reading.wrench is None else numbers("wrench", reading.wrench, 6)
        record = pose_state(self._tcp, self._twist, wrench, pose)
        self._pose_out.put(record, stamp_wall_ns=stamp_ns, seq=seq)
        gripper = GripperState(
            self._width_m if reading.width_m is None else reading.width_m,
            reading.moving,
            reading.holding,
            self.state if self.state in ("braking", "stalled") else "ready",
            (self._fault,) if self._fault else (),
        )
        self._gripper_out.put(gripper, stamp_wall_ns=stamp_ns, seq=seq)

    # -- commands -----------------------------------------------------------------------------
    def _move(self, command: Command, now_ns: int) -> None:
        self._called("move", self._robot.move, command)
        self.node.counters["arm.commands_given"] += 1

    def _take_widths(self) -> None:
        for arrival in self._orders.take_all():
            order = self.node.read(GripperCommand, arrival)
            if order is None:
                continue
            if self._grip is None:
                self.node.refuse("no_gripper", f"command/gripper: {self._file} has no method grip")
                continue
            try:
                command = self._gripper_guard.take(order, self._lead.writer)
            except CodecError as error:
                self.node.refuse(error.reason, f"command/gripper {error}")
                continue
            self.node.counters["gripper_bounded"] = self._gripper_guard.bounded
            self._width_m = command.width_m
            self._called("grip", self._grip, command.width_m, command.speed_m_s, command.force_n)

    # -- status -------------------------------------------------------------------------------
    @property
    def state(self) -> str:
        """One word."""
        if self._reading is None:
            return "waiting"
        age_s = (time.monotonic_ns() - self._measured_ns) / 1e9
        if age_s > self.node.profile.timing.state_timeout_s:
            return "silent"
        if self._fault:
            return "fault"
        if self._lead.braking:
            return "braking"
        return "stalled" if self._lead.stalled else "running"

    def _why(self, state: str) -> str:
        if state == "silent":
            return f"{self._file}: read gives nothing new"
        if state == "stalled":
            return (
                f"the loop stood still for {self._lead.stall_s:.3f} s; does {self._file} wait for "
                "something?"
            )
        return "the command stream fell silent in motion" if state == "braking" else self._fault

    def _watch(self) -> None:
        if time.monotonic() - self._clock_s >= CLOCK_PERIOD_S:
            self._clock_s = time.monotonic()
            self.node.follow_clock()
        state = self.state
        if state != self._was:
            level = "info" if state == "running" else "warning"
            if self._was:
                change = f"{self._was}->{state}"
                self.node.tell(Event(level, "transition", change, self._why(state)))
            self._was = state
        if not self.node.report_due(state):
            return
        reading = self._reading
        self.node.counters["arm.stream_silences"] = self._lead.silences
        self.node.counters["arm.stalls"] = self._lead.stalls
        self.node.report(
            state,
            detail={
                "file": self._file,
                "following": self._lead.following,
                "fault": self._fault,
                "width_m": self._width_m if reading is None else reading.width_m,
                "realtime": self._realtime,
            },
            rates_hz={"loop": self._rate.rate_hz, "readings": self._readings.rate_hz},
        )
