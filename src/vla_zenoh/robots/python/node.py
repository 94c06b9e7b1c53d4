"""An arm of one's own on the bus: a class in a Python file reads and moves it.

See `vla_zenoh.robot`. The loop runs at the rate of the command stream; between the stream and the
arm stands the same guard as in the simulator and before a ROS 2 robot.
"""

from __future__ import annotations

import gc
import sys
import threading
import time

import zenoh

from vla_zenoh.bus.buffers import CallbackRing
from vla_zenoh.bus.clock import FixedRate, Tick
from vla_zenoh.bus.metrics import RateMeter
from vla_zenoh.bus.node import Node
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.errors import CodecError, NodeError, ProfileError
from vla_zenoh.guard.arm_guard import Measured
from vla_zenoh.guard.gripper_guard import GripperGuard
from vla_zenoh.interop.python_reading import MAX_WORDS
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.profile import Profile
from vla_zenoh.robot import Command
from vla_zenoh.robots.command_follower import UNHEEDED_WHY, CommandFollower
from vla_zenoh.robots.python.driver_file import ArmFile
from vla_zenoh.robots.python.state_publisher import ArmStates
from vla_zenoh.robots.python.state_reader import ArmHearing
from vla_zenoh.robots.shutdown_brake import ShutdownBrake
from vla_zenoh.runtime.scheduling import realtime_thread
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import Event, GripperCommand, GripperState

NAME = "arm"
SWITCH_INTERVAL_S = 5e-4
CLOCK_PERIOD_S = 0.1
MODES = ("braking", "stalled", "unheeded")
"""States in which the robot is not ready, though it is heard and well."""


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
        self._file = ArmFile(profile.arm)
        robot = profile.robot
        node = self.node = Node(NAME, profile, session)
        kinematics = make_kinematics(profile)
        self._heard, self._states = ArmHearing(node, self._file, kinematics), ArmStates(node)
        self._lead = CommandFollower(node, kinematics, self._move)
        self._last_brake = ShutdownBrake(node, self._lead)
        self._orders = node.subscribe(node.keys.command_gripper, CallbackRing(16, SMALL_BYTES))
        self._gripper_guard = GripperGuard(robot.gripper)
        self._width_m = robot.gripper.max_width_m
        self._was = ""
        self._rate = RateMeter()
        self._realtime = False
        self._clock_s = 0.0

    # -- running ------------------------------------------------------------------------------
    def run(self, stop: threading.Event) -> None:
        """Drive until `stop` is set; a motion is braked first.

        Raises:
            NodeError: the robot's file raised something.
        """
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        try:
            # A node that says nothing for long is taken for one that hangs.
            self.node.publish_status("connecting", now=True)
            self._file.connect(lambda: self.node.publish_status("connecting"))
            gc.collect()
            gc.freeze()
            with realtime_thread() as self._realtime:
                self._loop(FixedRate(self.node.profile.timing.command_hz), stop)
        finally:
            self._close()

    def _close(self) -> None:
        try:
            self._file.close()
        except NodeError as error:  # what went wrong before it is what matters
            self.node.reject("robot_failed", str(error))
        finally:
            self.node.publish_status("stopped", now=True)
            self.node.close()

    def _loop(self, pace: FixedRate, stop: threading.Event) -> None:
        """Drive; whatever goes wrong in it, the arm is braked before this ends."""
        try:
            self._drive(pace, stop)
        except Exception as error:
            self._last_brake.wind_down(pace, self._brake_on)
            if isinstance(error, NodeError):
                self.node.reject("robot_failed", str(error))
            else:
                self.node.emit(Event("error", "fault", "broken", one_line(repr(error), MAX_WORDS)))
            raise

    def _drive(self, pace: FixedRate, stop: threading.Event) -> None:
        while True:
            tick = pace.wait()
            if tick.periods > 1:
                self.node.counters["arm.missed_ticks"] += tick.periods - 1
            self._lead.woken(tick.nominal_ns, tick.stall_s)
            if stop.is_set() and self._last_brake.over(tick.nominal_ns):
                return
            self._read(tick.nominal_ns)
            away = "fault" if self._heard.fault else ""
            now_ns = self.node.clock.wall_at(tick.nominal_ns)
            self._lead.turn(now_ns, tick.nominal_ns, away=away, silent=self._heard.silent)
            self._take_widths(now_ns)
            self._rate.tick()
            self._watch()

    def _brake_on(self, tick: Tick) -> None:
        """A turn of nothing but `move`."""
        self._lead.woken(tick.nominal_ns, tick.stall_s)
        self._lead.turn(self.node.clock.wall_at(tick.nominal_ns), tick.nominal_ns)

    # -- state in, state out ------------------------------------------------------------------
    def _read(self, mono_ns: int) -> None:
        taken = self._heard.read(mono_ns, self._width_m)
        if taken is not None:
            joints = taken.joints
            self._lead.measured(Measured(taken.tcp, joints.position_rad, joints.velocity_rad_s))
        fault = self._heard.fault
        mode = self.state if self.state in MODES else "ready"
        if taken is not None:
            self._states.tell(taken, self._lead.held(), mode, fault, mono_ns)
            return
        newest = self._heard.newest
        gripper = newest.gripper if newest else GripperState(self._width_m, False, False)
        self._states.tell_fault(gripper, mode, fault, mono_ns)

    # -- commands -----------------------------------------------------------------------------
    def _move(self, command: Command, now_ns: int) -> None:
        self._file.move(command)
        self.node.counters["arm.commands_given"] += 1

    def _take_widths(self, now_ns: int) -> None:
        if self._lead.deaf:
            return
        for arrival in self._orders.drain():
            order = self.node.decode(GripperCommand, arrival)
            if order is None:
                continue
            if not self._file.grips:
                why = f"command/gripper: {self._file.name} has no method grip"
                self.node.reject("no_gripper", why)
                continue
            try:
                command = self._gripper_guard.accept(
                    order, self._lead.writer, now_ns, writer_active=self._lead.leads
                )
            except CodecError as error:
                self.node.reject(error.reason, f"command/gripper {error}")
                continue
            self.node.counters["gripper_bounded"] = self._gripper_guard.bounded
            self._width_m = command.width_m
            self._file.grip(command.width_m, command.speed_m_s, command.force_n)

    # -- status -------------------------------------------------------------------------------
    @property
    def state(self) -> str:
        """One word."""
        if self._heard.fault:
            return "fault"
        if self._heard.newest is None:
            return "waiting"
        if self._heard.silent:
            return "silent"
        if self._lead.braking:
            return "braking"
        if self._lead.stalled:
            return "stalled"
        return "unheeded" if self._lead.unheeded else "running"

    def _why(self, state: str) -> str:
        if state == "fault":
            return self._heard.fault
        if state == "silent":
            return f"{self._file.name}: read gives nothing new"
        if state == "stalled":
            stood = f"the loop stood still for {self._lead.stall_s:.3f} s"
            return f"{stood}; does {self._file.name} wait for something?"
        if state == "unheeded":
            return UNHEEDED_WHY
        return "the command stream fell silent in motion" if state == "braking" else ""

    def _watch(self) -> None:
        if time.monotonic() - self._clock_s >= CLOCK_PERIOD_S:
            self._clock_s = time.monotonic()
            self.node.adopt_system_time()
        state = self.state
        if state != self._was:
            level = "info" if state == "running" else "warning"
            if self._was:
                change = f"{self._was}->{state}"
                self.node.emit(Event(level, "transition", change, self._why(state)))
            self._was = state
        if not self.node.status_due(state):
            return
        newest = self._heard.newest
        self.node.counters["arm.stream_silences"] = self._lead.silences
        self.node.counters["arm.stalls"] = self._lead.stalls
        self.node.publish_status(
            state,
            detail={
                "file": self._file.name,
                "following": self._lead.following,
                "fault": self._heard.fault,
                "width_m": self._width_m if newest is None else newest.gripper.width_m,
                "realtime": self._realtime,
            },
            rates_hz={"loop": self._rate.rate_hz, "readings": self._heard.rate.rate_hz},
        )
