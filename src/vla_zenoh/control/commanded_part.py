"""One arm and gripper of a robot under a `Commander`: its states, plans, motion and monitors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from vla_zenoh.control.chunk_planner import ChunkPlanner
from vla_zenoh.control.commander_io import MotionCommands, NewStates, State, make_event
from vla_zenoh.control.limits import LimitHit
from vla_zenoh.control.motion_pipeline import MotionPipeline
from vla_zenoh.control.policy_check import Lease
from vla_zenoh.control.preflight import (
    CLOCK_TOLERANCE_S,
    JOINT_PATIENCE_S,
    PeerSnapshot,
    joint_state_faults,
    reasons_by_joints,
    state_lost,
    why_not_ready,
)
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.watchdog import JointMonitor, Watchdog
from vla_zenoh.errors import RecordError, SpecError
from vla_zenoh.kinematics.so3 import Pose, held_pose, interpolate, pose_distance, pose_of
from vla_zenoh.policy import ModelSpec
from vla_zenoh.profile import GripperProfile, Profile
from vla_zenoh.types import (
    ActionChunk,
    Event,
    FloatArray,
    GripperCommand,
    GripperState,
    HeldBox,
    JointCommand,
    JointState,
    PoseCommand,
    PoseState,
    Stamped,
)

FUTURE_NS = round(CLOCK_TOLERANCE_S * 1e9)
"""A pose that is stamped later than it arrived by more than this says nothing about the past."""
FALSE_M, FALSE_RAD = 0.01, 0.05
"""Distance of two measurements of one TCP beyond which one of them is false, while it moves."""
FASTER = 4.0
"""A measured TCP may be this many times as fast as an axis of a command: people push arms."""
COMPARED_NS = 50_000_000
"""A pose is compared with joints that were measured this long after it, at most."""
LET_GO_M = 0.01
"""A gripper that opens by more than this lets go of what it holds."""
SAME_WIDTH_M = 0.005
"""A gripper this near to the width sent last has reached it."""
SETTLE_NS = 60_000_000
"""Time until a command shows as movement in the state."""


class CommandedPart:
    """States, plans, motion and monitors of one part.

    Args:
        profile: of the part.
        reach: bounds goals by its kinematics; None: only the workspace box does.

    Attributes:
        name: of the part; empty: the robot has one.
    """

    def __init__(self, profile: Profile, reach: ReachabilityFilter | None) -> None:
        self.profile, self.reach, self.name = profile, reach, profile.part
        self.pose: Stamped[PoseState] | None = None
        self.joint: Stamped[JointState] | None = None
        self.gripper_state: Stamped[GripperState] | None = None
        self._measured: Pose | None = None  # of the pose
        self._jumped = ""
        """Why the measured pose may be false, until joints confirm it."""
        self._contradiction = ""
        """Why the measured pose or the joints are false."""
        self._contradicts_ns = 0
        """Since when, on the clock of their arrival."""
        self.planner = ChunkPlanner(profile, reach)
        self.motion = MotionPipeline(profile, reach, self.planner)
        self.gripper = GripperArbiter(profile.robot.gripper)
        self.contact, self.retreat = self.motion.contact, self.motion.retreat
        self.watchdog = Watchdog(profile)
        self.too_near: LimitHit | None = None
        """The bound that the measured joints are too near to: the arm has to brake."""
        self._joint_monitor = None if reach is None else JointMonitor(profile, reach)
        self.held = None if reach is None else reach.barriers.collisions.held
        """What the gripper holds."""
        self._load_known = True
        self._grasp_m = np.inf
        """Least width of the gripper since it holds something."""

    # -- its name in messages -----------------------------------------------------------------
    def says(self, why: str) -> str:
        """`why`, with the part that it is about."""
        return type(why)(f"{self.name}: {why}") if self.name and why else why

    def tagged(self, events: Iterable[Event]) -> list[Event]:
        """Events with the part that they are about."""
        if not self.name:
            return list(events)
        return [replace(event, why=self.says(event.why) or self.name) for event in events]

    @property
    def elbow_rad(self) -> float:
        """Greatest distance of a measured joint from where it is expected, see `JointMonitor`."""
        return 0.0 if self._joint_monitor is None else self._joint_monitor.elbow_rad

    @property
    def measured_rad(self) -> FloatArray | None:
        """(n,) newest measured joints of the arm, None without kinematics or joints of it."""
        if self.reach is None or self.joint is None:
            return None
        try:
            return self.reach.kinematics.joints_of(self.joint.record)
        except RecordError:
            return None  # reported by the monitor of its joints

    # -- states -------------------------------------------------------------------------------
    def update(self, states: NewStates) -> None:
        """Take the newest states."""
        if states.pose is not None:
            before, self.pose = self.pose, states.pose
            measured = pose_of(states.pose.record)
            if before is not None and self._measured is not None:
                elapsed_ns = states.pose.header.stamp_wall_ns - before.header.stamp_wall_ns
                self._jumped = self._jump(measured, self._measured, elapsed_ns) or self._jumped
            self._measured = measured
            self.planner.poses.add(states.pose, FUTURE_NS)
            self.contact.update_pose(states.pose)
            self.retreat.measure(measured)
        if states.joint is not None:
            self.joint = states.joint
            self.planner.joints.add(states.joint, FUTURE_NS)
            self.contact.update_joints(states.joint)
            self._compare(states.joint)
        if states.gripper is not None:
            self.gripper_state = states.gripper
            if self.held is not None:
                self._grasp_m = min(self._grasp_m, states.gripper.record.width_m)

    def _jump(self, measured: Pose, before: Pose, elapsed_ns: int) -> str:
        """Why a reported pose cannot follow the one `before`, empty if an arm can move so."""
        elapsed_s = abs(elapsed_ns) / 1e9
        apart = self._too_far(measured, before, elapsed_s)
        if not apart:
            return ""
        return (
            f"the reported TCP pose jumped by {apart} in {elapsed_s:.3f} s, faster than the arm "
            "can move: was its tool frame set?"
        )

    def _too_far(self, pose: Pose, other: Pose, elapsed_s: float) -> str:
        """The distance of two measured poses if no arm moves so far in `elapsed_s`, else empty."""
        apart_m, apart_rad = pose_distance(pose, other)
        limits = self.profile.limits
        most_m = FALSE_M + FASTER * elapsed_s * limits.translation.velocity_m_s
        most_rad = FALSE_RAD + FASTER * elapsed_s * limits.rotation.velocity_rad_s
        if apart_m <= most_m and apart_rad <= most_rad:
            return ""
        return f"{apart_m * 1e3:.1f} mm and {apart_rad:.3f} rad"

    @property
    def doubt(self) -> str:
        """Why the measured pose must not be moved to, empty if it is trusted."""
        return self._contradiction or self._jumped

    def _compare(self, joint: Stamped[JointState]) -> None:
        """Compare the joints with the TCP pose that the robot reported for their time."""
        why = self._contradicted_by(joint)
        if why is None:
            return
        if not why:
            self._jumped = ""
        elif not self._contradiction:
            self._contradicts_ns = joint.received_ns
        self._contradiction = why

    def _contradicted_by(self, joint: Stamped[JointState]) -> str | None:
        """Why joints and reported TCP pose of one time cannot both be right, empty if they can.

        None: there is nothing to compare.
        """
        stamp_ns = joint.header.stamp_wall_ns
        around = self.planner.poses.around(stamp_ns, COMPARED_NS)
        if self.reach is None or self.pose is None or around is None:
            return None
        try:
            joints_rad = self.reach.kinematics.joints_of(joint.record)
        except RecordError:
            return None  # reported by the monitor of its joints
        before, after, share = around
        reported = interpolate(pose_of(before), pose_of(after), share)
        unknown_s = max(stamp_ns - self.pose.header.stamp_wall_ns, 0) / 1e9
        apart = self._too_far(self.reach.kinematics.forward(joints_rad), reported, unknown_s)
        if not apart:
            return ""
        return (
            f"the measured joints put the TCP {apart} from where the robot reports it: one of the "
            "two is frozen or false, or the tool frame was changed"
        )

    # -- what it holds ------------------------------------------------------------------------
    @property
    def let_go(self) -> bool:
        """The gripper has opened since it holds something."""
        gripper = self.gripper_state
        return gripper is not None and gripper.record.width_m > self._grasp_m + LET_GO_M

    def hold(self, box: HeldBox | None) -> None:
        """Count `box` among the arm's links from now on; None: the gripper holds nothing.

        Raises:
            RecordError: the profile does not describe the robot's kinematics.
        """
        if self.reach is None:
            raise RecordError(
                "what the gripper holds needs the robot's kinematics: set robot.description, "
                "robot.tcp_frame and robot.arm_joints in the profile"
            )
        self.reach.hold(box)
        self.held = box
        gripper = self.gripper_state
        self._grasp_m = np.inf if gripper is None else gripper.record.width_m
        if self._joint_monitor is not None:
            self._joint_monitor.reset()  # what is too near now may only move apart

    def measure(self) -> str:
        """Track whether the arm follows, or stands; why its joints are another arm's, or empty."""
        if self.pose is None or self._measured is None:
            return ""
        self.watchdog.measure(self.motion.commanded, self._measured)
        joint = self.joint.record if self.joint else None
        try:
            self.motion.measure(self.pose.record, joint, self.pose.received_ns)
        except RecordError as error:
            return str(error)
        return ""

    # -- activation ---------------------------------------------------------------------------
    def reasons_against(
        self, worker: str, spec: ModelSpec | None, chunk: Stamped[ActionChunk] | None, now_ns: int
    ) -> list[str]:
        """Reasons from the joints of the arm, and from what the worker asks of them."""
        bounds, reasons = self.planner.joint_bounds, list[str]()
        if bounds is not None and self.pose is not None:
            reasons += joint_state_faults(
                self.profile, bounds.kinematics, self.joint, self.pose, now_ns
            )
            if spec is not None and chunk is not None and self.joint is not None:
                reasons += reasons_by_joints(
                    self.profile, worker, spec, chunk.record, bounds, self.joint
                )
        if self.reach is None and spec is not None and self._in_joints(spec):
            reasons.append(
                f"worker {worker!r} acts in joints, which needs the robot's kinematics: set "
                "robot.description, robot.tcp_frame and robot.arm_joints in the profile"
            )
        if self.joint is not None and self.pose is not None:
            writers = {self.joint.header.source, self.pose.header.source}
            if len(writers) > 1:
                reasons.append(f"joints and pose have different writers: {', '.join(writers)}")
        return reasons

    def _in_joints(self, spec: ModelSpec) -> bool:
        try:
            return spec.action.of(self.name).space == "joint"
        except SpecError:
            return False  # reported with the spec

    def activate(self, lease: Lease, now_ns: int) -> list[Event]:
        """Start the motion where the arm stands; its states are known.

        Returns events: what is dropped of the goals before, and each distance that is too small
        where it stands: the arm may only move away.
        """
        assert self.pose is not None and self.gripper_state is not None
        self.too_near = None
        self._jumped = ""
        if self._joint_monitor is not None:
            self._joint_monitor.reset()
        self.contact.begin()
        self.planner.restart(self.pose, self.joint)
        measured, joint = self.pose.record, self.joint.record if self.joint else None
        blocked = self.watchdog.begin(held_pose(measured), pose_of(measured))
        events = self.motion.anchor(
            measured,
            self.gripper.keep(self.gripper_state.record),
            joint,
            now_ns,
            blocked=blocked,
            in_joints=self._in_joints(lease.spec),
        )
        if self.reach is None or self.measured_rad is None:
            return events
        why = "begins too near, and may only move away"
        return events + [
            make_event("warning", "limit", hit.name, why + hit.at, hit.value, hit.limit)
            for hit in self.reach.barriers.inside(self.measured_rad)
        ]

    def commands(self, state: State, now_ns: int) -> MotionCommands:
        """The set-points of robot and gripper, while streaming."""
        arm, motion, width = self.motion.command(state), self.motion, None
        if arm is not None and state is State.ACTIVE and motion.pace.override > 0.0:
            if motion.goal is not None:
                self.gripper.request(motion.goal.width_m)
            width = self.gripper.step(now_ns, self.gripper_state)
        pose = arm if isinstance(arm, PoseCommand) else None
        return MotionCommands(pose, arm if isinstance(arm, JointCommand) else None, width)

    # -- supervision --------------------------------------------------------------------------
    def lost(
        self, peers: PeerSnapshot, worker: str, lease: Lease, now_ns: int, *, moves: bool
    ) -> tuple[str, list[Event]]:
        """Why the arm cannot continue, empty if it can; and events.

        `moves`: commands are published, so the arm may be blocked.
        """
        assert self.pose is not None and self.gripper_state is not None
        contact, motion = self.contact, self.motion
        motion.pace.contact_slowdown = contact.slowdown()
        events = [] if contact.known is self._load_known else [self._load_sensing()]
        why = self._state_lost(now_ns)
        if not why and now_ns - self._contradicts_ns > self.profile.timing.state_timeout_s * 1e9:
            why = self._contradiction
        why = why or self.watchdog.lost(peers, worker, lease)
        if not why and motion.streaming and moves:
            why = self._obstructed(events)
        return why or contact.lost or motion.stuck, events

    def _state_lost(self, now_ns: int) -> str:
        """Which measured state is missing, late, or stamped in the future; empty if none is.

        Each has its own age: that one arrives says nothing about the others.
        """
        joints = self._joint_monitor is not None or self.contact.wants_effort
        patience_s = self.profile.timing.state_timeout_s
        streams: list[tuple[str, Stamped[Any] | None, float]] = [
            ("pose", self.pose, patience_s),
            ("gripper", self.gripper_state, patience_s),
            ("joints", self.joint if joints else None, patience_s + JOINT_PATIENCE_S),
        ]
        for name, state, most_s in streams:
            why = "" if state is None else state_lost(name, state, most_s, now_ns)
            if why:
                return why
        return ""

    def follow_elbow(self, *, obeying: bool) -> None:
        """Begin to bound the next step with the elbow of the commanded or measured joints.

        Raises:
            RecordError: joints of another arm.
        """
        monitor, reach, motion = self._joint_monitor, self.reach, self.motion
        if monitor is None or reach is None or self.joint is None:
            return
        if not obeying or not motion.streaming:
            monitor.reset()
            return
        measured_rad = reach.kinematics.joints_of(self.joint.record)
        commanded_rad = motion.joints_rad
        reach.set_elbow(measured_rad if commanded_rad is None else commanded_rad)

    def monitor_joints(self, now_ns: int) -> None:
        """Slow a moving arm down if its measured joints come near a bound, see `too_near`."""
        monitor, motion = self._joint_monitor, self.motion
        if monitor is None or not monitor.due(now_ns):
            return
        measured_rad = self.measured_rad
        if measured_rad is None or not motion.streaming:
            return
        commanded_rad, in_joints = motion.joints_rad, motion.joints_asked
        found = monitor.update(measured_rad, commanded_rad, now_ns, in_joints=in_joints)
        self.too_near = found or self.too_near  # until the arm brakes for it
        motion.pace.joint_slowdown = monitor.slowdown

    def _obstructed(self, events: list[Event]) -> str:
        """Why the arm is blocked or in contact, empty otherwise; it then brakes and retreats."""
        overload = self.contact.overload()
        if overload is None:
            why = self.watchdog.blocked()
            if not why:
                return ""
            # An arm without contact is not blocked: its state is stuck, or it was slowed down.
            retreats = not (self.contact.known and self.contact.quiet)
            if self.doubt:
                retreats, why = False, f"{self.doubt}; {why}"
        else:
            name, value, limit, unit = overload.name, overload.most, overload.stop, overload.unit
            events.append(make_event("warning", "limit", name, "stopped", value, limit))
            why = (
                f"something presses against the arm: {name} {value:.1f} {unit}, "
                f"at most {limit:g} {unit}; it retreats"
            )
            retreats = True
        commanded = self.motion.commanded
        if retreats and commanded is not None:
            self.retreat.begin(commanded)
        return why

    def keeps_from_retreat(self, peers: PeerSnapshot, now_ns: int) -> str:
        """Why the arm must not retreat, empty: the robot is ready, and its state can be trusted."""
        if self.pose is None or self.gripper_state is None:
            return "its state is not known"
        if peers.robot_node not in peers.alive:
            return f"node {peers.robot_node!r} is gone"
        why = self._state_lost(now_ns) or self.doubt
        return why or why_not_ready(self.gripper_state.record)

    def _load_sensing(self) -> Event:
        """Event when the robot begins or ceases to measure external loads."""
        self._load_known = self.contact.known
        if self._load_known:
            why = "the robot measures external loads"
            return make_event("info", "notice", "contact_told", why)
        why = (
            "the robot measures no external wrench: limits.contact has no effect, and a "
            "blocked arm is detected by limits.tracking_m alone"
        )
        return make_event("warning", "notice", "contact_not_told", why)


class GripperArbiter:
    """Decides when to send which width: absolute, the newest one wins, one command in flight.

    A request within the dead band of the width sent last is ignored. While a command is in flight,
    newer requests replace each other; the last one is sent when the gripper stands, or after
    `command_timeout_s`.
    """

    def __init__(self, profile: GripperProfile) -> None:
        self._profile = profile
        self._requested_m: float | None = None
        self.sent_m: float | None = None
        self._sent_ns = 0
        self.in_flight = False
        """A command was sent and the gripper has not come to rest since."""
        self.timeouts = 0

    def keep(self, gripper: GripperState) -> float:
        """Restart at the width sent last while the gripper follows it, else at its width.

        Another width would end a grasp. Nothing is to be sent then.
        """
        width_m = min(max(gripper.width_m, 0.0), self._profile.max_width_m)
        sent_m = self.sent_m
        if sent_m is not None:
            grasps = gripper.holding and sent_m < gripper.width_m
            if grasps or abs(sent_m - gripper.width_m) < SAME_WIDTH_M:
                width_m = sent_m
        self._requested_m = self.sent_m = width_m
        self.in_flight = False
        return width_m

    def request(self, width_m: float) -> None:
        """Request a width; replaces an earlier one that was not sent."""
        self._requested_m = min(max(width_m, 0.0), self._profile.max_width_m)

    def step(self, now_ns: int, state: Stamped[GripperState] | None) -> GripperCommand | None:
        """The command to send now, None without one."""
        profile, asked_m, sent_m = self._profile, self._requested_m, self.sent_m
        if self.in_flight:
            settled = (
                state is not None
                and state.received_ns > self._sent_ns + SETTLE_NS
                and not state.record.moving
            )
            late = now_ns - self._sent_ns > profile.command_timeout_s * 1e9
            if not (settled or late):
                return None
            self.in_flight = False
            self.timeouts += int(not settled)
        if asked_m is None or (sent_m is not None and abs(asked_m - sent_m) <= profile.dead_band_m):
            return None
        self.sent_m, self._sent_ns, self.in_flight = asked_m, now_ns, True
        return GripperCommand(asked_m, profile.speed_m_s, profile.force_n)
