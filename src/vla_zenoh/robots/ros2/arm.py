"""The arm of a ROS 2 robot: its joint states in, our commands out; how it is led is in `lead`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from vla_zenoh.bus.node import Node
from vla_zenoh.errors import ProfileError, RecordError
from vla_zenoh.guard.arm_guard import Measured
from vla_zenoh.interop.joint_reading import pose_state
from vla_zenoh.interop.ros2 import table
from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.interop.ros2.qos import COMMAND
from vla_zenoh.interop.ros2.samples import Stamp
from vla_zenoh.interop.ros2.topics import pose
from vla_zenoh.keys import Kind
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.profile.ros2 import Ros2Output, Ros2Profile
from vla_zenoh.robots.command_follower import UNHEEDED_WHY, CommandFollower
from vla_zenoh.robots.ros2.ros_graph import RosGraph
from vla_zenoh.robots.ros2.state_subscriber import StateSubscriber
from vla_zenoh.types import Event, JointCommand, PoseCommand

FINGER_PATIENCE_NS = 1_000_000_000
"""Gripper nodes publish more slowly than arms."""
LEAD_PERIODS = 2
"""A trajectory's point lies this many command periods ahead."""


class Arm:
    """See the module.

    Args:
        node: on whose behalf.
        link: to the ROS graph.
        messages: of the robot's distribution.
        ros2: the profile's section.
        gripper: (busy, width asked for last, holding) of the gripper.

    Attributes:
        heard: what the robot's topics say.
        lead: what the robot is told.
    """

    def __init__(
        self,
        node: Node,
        link: RosGraph,
        messages: Messages,
        ros2: Ros2Profile,
        gripper: Callable[[], tuple[bool, float | None, bool]],
    ) -> None:
        profile = self._profile = node.profile
        self._node, self._messages, self._ros2, self._ask_gripper = node, messages, ros2, gripper
        self._kinematics = make_kinematics(profile)
        self.heard = StateSubscriber(node, link, messages, ros2, self._kinematics)
        self._state, self._clock = self.heard.state, self.heard.clock
        self.lead = CommandFollower(node, self._kinematics, self._send)
        self._was = ""
        self._published_ns = 0
        self._clock_told = False
        self._fingers_lost = False
        keys = node.keys
        self._joint_out = node.declare_publisher(keys.state_joint, Kind.STATE)
        self._pose_out = node.declare_publisher(keys.state_pose, Kind.STATE)
        self._gripper_out = node.declare_publisher(keys.state_gripper, Kind.STATE)
        output = self._output()
        self._frame = output.frame or profile.robot.base_frame
        self._kind, self._write = output.type, self._writing(output)
        self._topic = output.topic
        self._writer = link.write(output.topic, output.type, COMMAND)

    # -- setting up ---------------------------------------------------------------------------
    def _output(self) -> Ros2Output:
        ros2 = self._ros2
        joints = self._profile.robot.command == "joint"
        output = ros2.joint_command if joints else ros2.pose_command
        if output is None:
            raise ProfileError(f"ros2 lacks {self._profile.robot.command}_command")
        return output

    def _writing(self, output: Ros2Output) -> table.Write:
        """How commands are written.

        Raises:
            ProfileError: what the type cannot carry.
        """
        posture_rad = np.array(self._profile.robot.home_rad)
        lead_ns = round(LEAD_PERIODS * 1e9 / self._profile.timing.command_hz)
        key = f"command_{self._profile.robot.command}"
        for row in table.writings(posture_rad, lead_ns):
            if (row.type, row.key) == (output.type, key):
                return row.write
        if key == "command_joint":
            raise ProfileError(f"joint positions cannot be sent as {output.type}")
        pose.check(self._messages, output.type)
        return pose.writer(posture_rad)

    # -- one turn -----------------------------------------------------------------------------
    def turn(self, now_ns: int, mono_ns: int, stall_s: float = 0.0) -> None:
        """Take what arrived, publish the state, and send what the arm has to follow.

        Args:
            now_ns: wall clock, for stamps.
            mono_ns: the same moment on the monotonic clock: wall clocks are set now and then.
            stall_s: how late this turn is.
        """
        self.lead.woken(mono_ns, stall_s)
        if self.heard.take() and self._due(mono_ns):
            self._publish()
        self._lead_on(now_ns, mono_ns)
        self._tell()

    def wind_down(self, now_ns: int, mono_ns: int, stall_s: float) -> None:
        """Nothing but braking: see `turn`, and `CommandFollower.deafen`."""
        self.lead.woken(mono_ns, stall_s)
        self._lead_on(now_ns, mono_ns)

    def _lead_on(self, now_ns: int, mono_ns: int) -> None:
        # What nobody heard nobody holds: a bridge that is gone drops what is sent.
        away = "" if self._writer.heard else "not_heard"
        self.lead.turn(now_ns, mono_ns, away=away, silent=self.state == "silent")

    # -- state out ----------------------------------------------------------------------------
    def _due(self, mono_ns: int) -> bool:
        if mono_ns - self._published_ns < 0.9e9 / self._profile.timing.state_hz:
            return False
        self._published_ns = mono_ns
        return True

    def _publish(self) -> None:
        joints, stamp_ns = self._state.joints, self._state.stamp_ns
        assert joints is not None
        held, held_rad = self.lead.held()
        try:
            tcp, twist = self.heard.tcp(stamp_ns)
            if tcp is None:
                return
            wrench = self.heard.wrench(stamp_ns)
            record = pose_state(tcp, twist, wrench, held)
            if held_rad is not None:
                joints = replace(joints, reference_rad=held_rad)
        except RecordError as error:  # finite, and no arm's: what comes of it is not
            topic = self._ros2.joint_states
            self._node.reject("invalid", f"{topic}: {error}", topic)
            return
        self.lead.measured(Measured(tcp, joints.position_rad, joints.velocity_rad_s))
        seq = self._joint_out.seq
        self._joint_out.publish(joints, stamp_wall_ns=stamp_ns, seq=seq)
        self._pose_out.publish(record, stamp_wall_ns=stamp_ns, seq=seq)
        self._publish_gripper(stamp_ns, seq)

    @property
    def width_m(self) -> float | None:
        """How far the fingers are open, None where nobody has said so lately."""
        return None if self._fingers_lost else self._state.width_m

    def _publish_gripper(self, stamp_ns: int, seq: int) -> None:
        busy, wanted_m, held = self._ask_gripper()
        record = self._state.gripper(busy=busy, wanted_m=wanted_m, held=held)
        if record is None:
            return
        silent_ns = stamp_ns - self._state.width_stamp_ns
        lost = bool(self._profile.robot.finger_joints) and silent_ns > FINGER_PATIENCE_NS
        if lost and not self._fingers_lost:
            why = f"no joint state of {', '.join(self._profile.robot.finger_joints)}"
            self._node.emit(Event("warning", "fault", "fingers_lost", why))
        self._fingers_lost = lost
        if lost:
            return
        if self.state in ("braking", "stalled", "unheeded"):
            record = replace(record, mode=self.state)
        elif not self._writer.heard:
            record = replace(record, mode=f"not listening at {self._topic[:100]}")
        self._gripper_out.publish(record, stamp_wall_ns=stamp_ns, seq=seq)

    def _send(self, command: PoseCommand | JointCommand, now_ns: int) -> None:
        message = self._write(self._messages, self._kind, command, Stamp(now_ns, self._frame))
        self._writer.put(self._messages.encode(message))
        self._node.counters["ros2.commands_sent"] += 1

    # -- telling ------------------------------------------------------------------------------
    @property
    def state(self) -> str:
        """One word."""
        age_s = self.heard.age_s
        if age_s is None:
            return "waiting"
        if age_s > self._profile.timing.state_timeout_s:
            return "silent"
        if self.lead.braking:
            return "braking"
        if self.lead.stalled:
            return "stalled"
        return "unheeded" if self.lead.unheeded else "running"

    def _tell(self) -> None:
        state = self.state
        if state != self._was:
            if self._was:
                bad = state in ("silent", "braking", "stalled", "unheeded")
                level = "warning" if bad else "info"
                change = f"{self._was}->{state}"
                self._node.emit(Event(level, "transition", change, self._why(state)))
            self._was = state
        if self._clock.differs != self._clock_told and self._clock.offset_s is not None:
            self._clock_told = self._clock.differs
            if self._clock_told:
                why = (
                    f"the robot's stamps are {self._clock.offset_s:+.3f} s behind this clock; "
                    "synchronise both (chrony or ptp)"
                )
                self._node.emit(Event("warning", "notice", "robot_clock", why))

    def _why(self, state: str) -> str:
        if state == "silent":
            return f"nothing on {self._ros2.joint_states}; is the robot or the bridge gone?"
        if state == "braking":
            return "the command stream fell silent in motion"
        if state == "stalled":
            return (
                f"this loop stood still for {self.lead.stall_s:.3f} s while it moved the arm, "
                "which stands where it was sent last"
            )
        return UNHEEDED_WHY if state == "unheeded" else ""

    def detail(self) -> dict[str, Any]:
        """For status."""
        self._node.counters["ros2.unstamped"] = self._clock.unstamped
        self._node.counters["ros2.efforts_missing"] = self._state.efforts_missing
        self._node.counters["ros2.stream_silences"] = self.lead.silences
        self._node.counters["ros2.stalls"] = self.lead.stalls
        return {
            "following": self.lead.following,
            "held": self.lead.holds,
            "robot_clock_behind_s": self._clock.offset_s,
            "width_m": self._state.width_m,
        }
