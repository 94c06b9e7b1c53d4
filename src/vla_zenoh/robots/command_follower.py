"""Leads an arm that holds by itself what it was told last: a command stream in, targets out.

Between the two stands the same guard as in the simulator. When the stream falls silent in motion it
brakes here; then nothing more is sent, and the robot's own controller holds what it was sent last.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from vla_zenoh.bus.buffers import CallbackRing, ReceivedSample
from vla_zenoh.bus.node import Node
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.guard.arm_guard import SETTLE_NS, ArmGuard, HeldReference, Measured, make_arm_guard
from vla_zenoh.kinematics.kinematics import Kinematics
from vla_zenoh.kinematics.so3 import Pose, quat_from_rotation
from vla_zenoh.types import FloatArray, JointCommand, PoseCommand
from vla_zenoh.types.commands import JointReference, PoseReference

INBOX = 64
STREAMING = "streaming"
STALLED_NS = 500_000_000
"""After a stall nobody is obeyed for so long, and the robot is not ready: what was sent meanwhile
is still arriving, and who sent it has to hear of it and brake."""

UNHEEDED_WHY = (
    "the command stream is refused and nobody is followed: it does not begin where the arm stands, "
    "or its beginning was lost"
)


class CommandFollower:
    """See the module.

    Args:
        node: on whose behalf; its profile says which stream leads the arm.
        kinematics: of the arm.
        send: takes each target, and the wall clock it is for.

    Attributes:
        stall_s: how long the last stall was.
        stalls: how often the arm was led when this side stood still.
    """

    def __init__(
        self,
        node: Node,
        kinematics: Kinematics,
        send: Callable[[PoseCommand | JointCommand, int], None],
    ) -> None:
        self._node, self._kinematics, self._send = node, kinematics, send
        self._mode = node.profile.robot.command
        keys = node.keys
        key = keys.command_joint if self._mode == "joint" else keys.command_pose
        self._orders = node.subscribe(key, CallbackRing(INBOX, SMALL_BYTES))
        self._guard: ArmGuard | None = None
        self._measured: Measured | None = None
        self._hold = HeldReference()
        self._deaf = False
        self._stalled_until_ns = 0
        self.stall_s, self.stalls = 0.0, 0

    # -- one turn -----------------------------------------------------------------------------
    def measured(self, measured: Measured) -> None:
        """Where the arm is; with the first of these it can be led."""
        self._measured = measured
        if self._guard is None:
            self._guard = self._make_guard()

    def woken(self, mono_ns: int, stall_s: float) -> None:
        """A turn begins.

        Args:
            mono_ns: on the monotonic clock: wall clocks are set now and then.
            stall_s: how late it is. The robot stopped at what it was sent last: after a long stall
                it is led on from there, and from rest, whatever moved before.
        """
        if stall_s <= self._node.profile.timing.command_timeout_s:
            if mono_ns >= self._stalled_until_ns:
                self._stalled_until_ns = 0
            return
        if stall_s * 1e9 > SETTLE_NS:
            self._hold.invalidate()  # somebody else may have moved the arm meanwhile
        if self._guard is not None and self.sending:
            self._guard.hold()
            self._stalled_until_ns, self.stall_s = mono_ns + STALLED_NS, stall_s
            self.stalls += 1
        for _ in self._orders.drain():
            self._refuse("stalled")

    def turn(self, now_ns: int, mono_ns: int, *, away: str = "", silent: bool = False) -> None:
        """Take what arrived, and send what the arm has to follow.

        Args:
            now_ns: wall clock.
            mono_ns: the same moment on the monotonic clock.
            away: why the robot follows nothing, in one word, where it does not.
            silent: it is not known where the arm is.
        """
        guard = self._guard
        for arrival in self._orders.drain():
            if guard is None or self._deaf:
                continue
            reason = away or ("stalled" if self.stalled else self._offer(guard, arrival, mono_ns))
            if reason:
                self._refuse(reason)
        if guard is not None and self._measured is not None:
            self._follow(guard, self._measured, now_ns, mono_ns, away)
        if silent or away:
            self._hold.invalidate()

    def _offer(self, guard: ArmGuard, arrival: ReceivedSample, mono_ns: int) -> str | None:
        if not (guard.following or guard.braking or self._hold.held):
            guard.anchor()  # nobody holds the arm at what was sent last: it is where it is
        # Silence is counted by a clock that nobody sets.
        if self._mode == "joint":
            joints = self._node.decode(JointCommand, arrival)
            if joints is None:
                return None
            return guard.offer_joint(replace(joints, received_ns=arrival.mono_ns), mono_ns)
        pose = self._node.decode(PoseCommand, arrival)
        if pose is None:
            return None
        return guard.offer_pose(replace(pose, received_ns=arrival.mono_ns), mono_ns)

    def _refuse(self, reason: str) -> None:
        self._node.reject(f"{self._mode}_{reason}", f"command/{self._mode}: {reason}")

    def _follow(
        self, guard: ArmGuard, measured: Measured, now_ns: int, mono_ns: int, away: str
    ) -> None:
        if away and self.sending:
            guard.anchor()  # who follows later must not be led on from where nobody went
        was_moving = guard.moving
        reference = guard.tick(mono_ns)
        if guard.moving or was_moving:
            self._hold.on_sent(mono_ns)
            self._send(self._target(reference), now_ns)
        else:
            self._hold.update(measured, mono_ns)

    def _target(self, reference: PoseReference | JointReference) -> PoseCommand | JointCommand:
        if isinstance(reference, JointReference):
            return JointCommand(self._node.profile.robot.arm_joints, *reference, STREAMING)
        position_m, rotation, twist, acceleration = reference
        quat_xyzw = quat_from_rotation(rotation)
        return PoseCommand(
            position_m, quat_xyzw, twist, acceleration, position_m, quat_xyzw, STREAMING
        )

    def _make_guard(self) -> ArmGuard:
        profile, kinematics = self._node.profile, self._kinematics
        order = [kinematics.arm_joints.index(name) for name in profile.robot.arm_joints]
        ends = (kinematics.lower_rad[order], kinematics.upper_rad[order])
        dt_s = 1.0 / profile.timing.command_hz
        return make_arm_guard(profile, self._measure, ends, dt_s)

    def _measure(self) -> Measured:
        assert self._measured is not None
        return self._measured

    # -- looking ------------------------------------------------------------------------------
    def deafen(self) -> None:
        """Take no more commands: what moves is braked."""
        self._deaf = True

    @property
    def deaf(self) -> bool:
        """It was deafened: what else belongs to the arm takes no more commands either."""
        return self._deaf

    @property
    def following(self) -> bool:
        """A command stream is being followed."""
        return self._guard is not None and self._guard.following

    @property
    def braking(self) -> bool:
        """The stream fell silent in motion."""
        return self._guard is not None and self._guard.braking

    @property
    def stalled(self) -> bool:
        """This side stood still a moment ago, while the arm was led."""
        return self._stalled_until_ns > 0

    @property
    def unheeded(self) -> bool:
        """Somebody commands the arm and is not obeyed; see `ArmGuard.unheeded`."""
        return self._guard is not None and self._guard.unheeded

    @property
    def sending(self) -> bool:
        """The robot is being sent targets."""
        return self._guard is not None and self._guard.moving

    @property
    def writer(self) -> str:
        """Source of the command stream that is followed, empty where none is."""
        return "" if self._guard is None else self._guard.writer

    @property
    def leads(self) -> bool:
        """See `ArmGuard.leads`."""
        return self._guard is not None and self._guard.writer_active

    @property
    def silences(self) -> int:
        """How often a stream fell silent in motion."""
        return 0 if self._guard is None else self._guard.silences

    @property
    def holds(self) -> bool:
        """What was sent last is what the robot's controller holds."""
        return self._hold.held

    def held(self) -> tuple[Pose | None, FloatArray | None]:
        """Where the robot's controller holds the TCP, and (n,) its joints where it is led by them.

        None: nobody knows, since nothing was sent, or somebody else moved the arm.
        """
        if self._guard is None or not self._hold.held:
            return None, None
        reference = self._guard.reference
        if isinstance(reference, JointReference):
            names = self._node.profile.robot.arm_joints
            joints_rad = self._kinematics.ordered(names, reference.position_rad)
            return self._kinematics.forward(joints_rad), reference.position_rad
        return Pose(reference.position_m, reference.rotation), None
