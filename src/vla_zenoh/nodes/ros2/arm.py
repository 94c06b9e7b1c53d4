"""The arm of a ROS 2 robot: its joint states in, our commands out.

Between the command stream and the robot stands the same guard as in the simulator. When the stream
falls silent in motion it brakes here; then nothing more is sent, and the robot's own controller
holds what it was sent last.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.control.arm import make_kinematics
from vla_zenoh.control.arm_guard import ArmGuard, Measured, make_arm_guard
from vla_zenoh.control.impedance import Reference
from vla_zenoh.control.joint_impedance import JointReference
from vla_zenoh.control.so3 import Pose, quat_from_rotation
from vla_zenoh.errors import ProfileError, RecordError
from vla_zenoh.interop.ros2 import table
from vla_zenoh.interop.ros2.arm_state import pose_state
from vla_zenoh.interop.ros2.hold import SETTLE_NS, Hold
from vla_zenoh.interop.ros2.messages import Messages
from vla_zenoh.interop.ros2.qos import COMMAND
from vla_zenoh.interop.ros2.samples import Stamp
from vla_zenoh.interop.ros2.topics import pose
from vla_zenoh.keys import Kind
from vla_zenoh.nodes.node import Node
from vla_zenoh.nodes.ros2.hearing import INBOX, Hearing
from vla_zenoh.nodes.ros2.link import Link
from vla_zenoh.nodes.slots import Arrival, Inbox
from vla_zenoh.profile.ros2 import Ros2Output, Ros2Profile
from vla_zenoh.types import Event, JointCommand, PoseCommand

FINGER_PATIENCE_NS = 1_000_000_000
"""Gripper nodes publish more slowly than arms."""
LEAD_PERIODS = 2
"""A trajectory's point lies this many command periods ahead."""
STREAMING = "streaming"
STALLED_NS = 500_000_000
"""After a stall nobody is obeyed for so long, and the robot is not ready: what was sent meanwhile
is still arriving, and who sent it has to hear of it and brake."""


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
    """

    def __init__(
        self,
        node: Node,
        link: Link,
        messages: Messages,
        ros2: Ros2Profile,
        gripper: Callable[[], tuple[bool, float | None, bool]],
    ) -> None:
        profile = self._profile = node.profile
        self._node, self._messages, self._ros2, self._ask_gripper = node, messages, ros2, gripper
        self._kinematics = make_kinematics(profile)
        self.heard = Hearing(node, link, messages, ros2, self._kinematics)
        self._state, self._clock = self.heard.state, self.heard.clock
        self._guard: ArmGuard | None = None
        self._hold = Hold()
        self._deaf = False
        self._was = ""
        self._measured: Measured | None = None
        self._published_ns = 0
        self._stalled_ns, self._stall_s = 0, 0.0
        self._clock_told = False
        self._fingers_lost = False
        keys = node.keys
        self._joint_out = node.stream(keys.state_joint, Kind.STATE)
        self._pose_out = node.stream(keys.state_pose, Kind.STATE)
        self._gripper_out = node.stream(keys.state_gripper, Kind.STATE)
        output = self._output()
        self._frame = output.frame or profile.robot.base_frame
        self._kind, self._write = output.type, self._writing(output)
        self._orders = node.listen(
            keys.command_joint if profile.robot.command == "joint" else keys.command_pose,
            Inbox(INBOX, SMALL_BYTES),
        )
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
        if stall_s > self._profile.timing.command_timeout_s:
            self._stand_after_a_stall(mono_ns, stall_s)
        elif mono_ns >= self._stalled_ns:
            self._stalled_ns = 0
        if self.heard.take() and self._due(mono_ns):
            self._publish()
        self._take_orders(mono_ns)
        self._follow(now_ns, mono_ns)
        self._tell()

    def wind_down(self, now_ns: int, mono_ns: int) -> None:
        """Nothing but braking: see `turn`, and `deafen`."""
        self._follow(now_ns, mono_ns)

    def _stand_after_a_stall(self, mono_ns: int, stall_s: float) -> None:
        """The robot stopped at what it was sent last: stand there, whatever moved before."""
        if stall_s * 1e9 > SETTLE_NS:
            self._hold.lose()  # somebody else may have moved the arm meanwhile
        if self._guard is not None and self.sending:
            self._guard.stand()
            self._stalled_ns, self._stall_s = mono_ns + STALLED_NS, stall_s
            self._node.counters["ros2.stalls"] += 1
        for _ in self._orders.take_all():
            self._refuse_order("stalled")

    # -- state out ----------------------------------------------------------------------------
    def _due(self, mono_ns: int) -> bool:
        if mono_ns - self._published_ns < 0.9e9 / self._profile.timing.state_hz:
            return False
        self._published_ns = mono_ns
        return True

    def _publish(self) -> None:
        joints, stamp_ns = self._state.joints, self._state.stamp_ns
        assert joints is not None
        reference = self._guard.reference if self._guard is not None and self._hold.held else None
        try:
            tcp, twist = self.heard.tcp(stamp_ns)
            if tcp is None:
                return
            wrench = self.heard.wrench(stamp_ns)
            record = pose_state(tcp, twist, wrench, self._pose_of(reference))
            if isinstance(reference, JointReference):
                joints = replace(joints, reference_rad=reference.position_rad)
        except RecordError as error:  # finite, and no arm's: what comes of it is not
            topic = self._ros2.joint_states
            self._node.refuse("invalid", f"{topic}: {error}", topic)
            return
        self._measured = Measured(tcp, joints.position_rad, joints.velocity_rad_s)
        if self._guard is None:
            self._guard = self._make_guard()
        seq = self._joint_out.seq
        self._joint_out.put(joints, stamp_wall_ns=stamp_ns, seq=seq)
        self._pose_out.put(record, stamp_wall_ns=stamp_ns, seq=seq)
        self._publish_gripper(stamp_ns, seq)

    def _pose_of(self, reference: Reference | JointReference | None) -> Pose | None:
        """Where the TCP is held."""
        if isinstance(reference, JointReference):
            kinematics, names = self._kinematics, self._profile.robot.arm_joints
            return kinematics.forward(kinematics.ordered(names, reference.position_rad))
        return None if reference is None else Pose(reference.position_m, reference.rotation)

    def _publish_gripper(self, stamp_ns: int, seq: int) -> None:
        busy, wanted_m, held = self._ask_gripper()
        record = self._state.gripper(busy=busy, wanted_m=wanted_m, held=held)
        if record is None:
            return
        silent_ns = stamp_ns - self._state.width_stamp_ns
        lost = bool(self._profile.robot.finger_joints) and silent_ns > FINGER_PATIENCE_NS
        if lost and not self._fingers_lost:
            why = f"no joint state of {', '.join(self._profile.robot.finger_joints)}"
            self._node.tell(Event("warning", "fault", "fingers_lost", why))
        self._fingers_lost = lost
        if lost:
            return
        if self._guard is not None and self._guard.braking:
            record = replace(record, mode="braking")
        elif self._stalled_ns:
            record = replace(record, mode="stalled")
        elif not self._writer.heard:
            record = replace(record, mode=f"not listening at {self._topic[:100]}")
        self._gripper_out.put(record, stamp_wall_ns=stamp_ns, seq=seq)

    # -- commands -----------------------------------------------------------------------------
    def _measure(self) -> Measured:
        assert self._measured is not None
        return self._measured

    def _make_guard(self) -> ArmGuard:
        kinematics, names = self._kinematics, self._profile.robot.arm_joints
        order = [kinematics.arm_joints.index(name) for name in names]
        ends = (kinematics.lower_rad[order], kinematics.upper_rad[order])
        return make_arm_guard(
            self._profile, self._measure, ends, 1.0 / self._profile.timing.command_hz
        )

    def _take_orders(self, mono_ns: int) -> None:
        guard = self._guard
        for arrival in self._orders.take_all():
            if guard is None or self._deaf:
                continue
            if self._stalled_ns:
                self._refuse_order("stalled")
                continue
            if not (guard.following or guard.braking or self._hold.held):
                guard.anchor()  # nobody holds the arm at what was sent last: it is where it is
            reason = self._offer(guard, arrival, mono_ns)
            if reason is not None:
                self._refuse_order(reason)

    def _offer(self, guard: ArmGuard, arrival: Arrival, mono_ns: int) -> str | None:
        # Silence is counted by a clock that nobody sets.
        if self._profile.robot.command == "joint":
            joints = self._node.read(JointCommand, arrival)
            if joints is None:
                return None
            return guard.offer_joint(replace(joints, received_ns=arrival.mono_ns), mono_ns)
        order = self._node.read(PoseCommand, arrival)
        if order is None:
            return None
        return guard.offer_pose(replace(order, received_ns=arrival.mono_ns), mono_ns)

    def _refuse_order(self, reason: str) -> None:
        mode = self._profile.robot.command
        self._node.refuse(f"{mode}_{reason}", f"command/{mode}: {reason}")

    def _follow(self, now_ns: int, mono_ns: int) -> None:
        guard = self._guard
        if guard is None:
            return
        heard = self._writer.heard
        if not heard and self.sending:
            guard.anchor()  # who listens later must not be led on from where nobody went
        was_braking = guard.braking
        reference = guard.tick(mono_ns)
        if guard.following or guard.braking or was_braking:
            self._hold.sent(mono_ns)
            self._send(reference, now_ns)
        elif self._measured is not None:
            self._hold.look(self._measured.pose, mono_ns)
        # What nobody heard nobody holds: a bridge that is gone drops what is sent.
        if self.state == "silent" or not heard:
            self._hold.lose()

    def _send(self, reference: Reference | JointReference, now_ns: int) -> None:
        command: Any
        if isinstance(reference, JointReference):
            command = JointCommand(self._profile.robot.arm_joints, *reference, STREAMING)
        else:
            quat_xyzw = quat_from_rotation(reference.rotation)
            command = PoseCommand(
                reference.position_m,
                quat_xyzw,
                reference.twist,
                reference.acceleration,
                reference.position_m,
                quat_xyzw,
                STREAMING,
            )
        message = self._write(self._messages, self._kind, command, Stamp(now_ns, self._frame))
        self._writer.put(self._messages.encode(message))
        self._node.counters["ros2.commands_sent"] += 1

    # -- ending and telling -------------------------------------------------------------------
    def deafen(self) -> None:
        """Take no more commands: what moves is braked."""
        self._deaf = True

    @property
    def sending(self) -> bool:
        """The robot is being sent commands."""
        return self._guard is not None and (self._guard.following or self._guard.braking)

    @property
    def writer(self) -> str:
        """Source of the command stream that is followed, empty where none is."""
        return "" if self._guard is None else self._guard.writer

    @property
    def state(self) -> str:
        """One word."""
        age_s = self.heard.age_s
        if age_s is None:
            return "waiting"
        if age_s > self._profile.timing.state_timeout_s:
            return "silent"
        if self._guard is not None and self._guard.braking:
            return "braking"
        return "stalled" if self._stalled_ns else "running"

    def _tell(self) -> None:
        state = self.state
        if state != self._was:
            if self._was:
                bad = state in ("silent", "braking", "stalled")
                level = "warning" if bad else "info"
                change = f"{self._was}->{state}"
                self._node.tell(Event(level, "transition", change, self._why(state)))
            self._was = state
        if self._clock.differs != self._clock_told and self._clock.offset_s is not None:
            self._clock_told = self._clock.differs
            if self._clock_told:
                why = (
                    f"the robot's stamps are {self._clock.offset_s:+.3f} s behind this clock; "
                    "synchronise both (chrony or ptp)"
                )
                self._node.tell(Event("warning", "notice", "robot_clock", why))

    def _why(self, state: str) -> str:
        if state == "silent":
            return f"nothing on {self._ros2.joint_states}; is the robot or the bridge gone?"
        if state == "braking":
            return "the command stream fell silent in motion"
        if state == "stalled":
            return (
                f"this loop stood still for {self._stall_s:.3f} s while it moved the arm, "
                "which stands where it was sent last"
            )
        return ""

    def detail(self) -> dict[str, Any]:
        """For status."""
        guard = self._guard
        self._node.counters["ros2.unstamped"] = self._clock.unstamped
        self._node.counters["ros2.efforts_missing"] = self._state.efforts_missing
        if guard is not None:
            self._node.counters["ros2.stream_silences"] = guard.silences
        return {
            "following": guard is not None and guard.following,
            "held": self._hold.held,
            "robot_clock_behind_s": self._clock.offset_s,
            "width_m": self._state.width_m,
        }
