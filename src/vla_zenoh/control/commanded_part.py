"""One arm and gripper of a robot under a `Commander`: its states, plans, motion and monitors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from vla_zenoh.control.chunk_planner import ChunkPlanner
from vla_zenoh.control.commander_io import MotionCommands, NewStates, make_event
from vla_zenoh.control.contact import LOAD_SETTLES_NS
from vla_zenoh.control.limits import slowest
from vla_zenoh.control.monitor import Brake, Monitor, PartSnapshot
from vla_zenoh.control.motion_pipeline import MotionPipeline
from vla_zenoh.control.policy_check import Lease
from vla_zenoh.control.preflight import (
    PeerSnapshot,
    reasons_by_joints,
    why_not_ready,
)
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.control.state_monitor import StateMonitor
from vla_zenoh.control.states import State
from vla_zenoh.control.tracking import FollowMonitor, TrackingMonitor
from vla_zenoh.control.watchdog import JointMonitor, NodeMonitor
from vla_zenoh.errors import RecordError, SpecError
from vla_zenoh.kinematics.so3 import held_pose, pose_of
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

LET_GO_M = 0.01
"""A gripper that opens by more than this lets go of what it holds."""
SAME_WIDTH_M = 0.005
"""A gripper this near to the width sent last has reached it."""
GRIPPER_STARTS_NS = 60_000_000
"""Time until a command of the gripper shows as movement in its state."""


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
        self.planner = ChunkPlanner(profile, reach)
        self.motion = MotionPipeline(profile, reach, self.planner)
        gripper = profile.robot.gripper
        self.gripper = None if gripper is None else GripperArbiter(gripper)
        self.contact, self.retreat = self.motion.contact, self.motion.retreat
        self.states = StateMonitor(
            profile,
            None if reach is None else reach.kinematics,
            self.planner.poses,
            wants_joints=reach is not None or self.contact.wants_effort,
        )
        self.tracking = TrackingMonitor(profile.limits, self.contact, self.states)
        self.monitors: list[Monitor] = [
            self.states,
            NodeMonitor(profile.camera_servers()),
            self.contact,
            self.tracking,
            FollowMonitor(),
        ]
        """In the order in which they are asked."""
        self._joint_monitor: JointMonitor | None = None
        if reach is not None:
            self._joint_monitor = JointMonitor(profile, reach)
            self.monitors.append(self._joint_monitor)
        self.held = None if reach is None else reach.barriers.collisions.held
        """What the gripper holds."""
        self._grasp_m = np.inf
        """Least width of the gripper since it holds something."""
        self.brakes = False
        """It brakes, and what presses on it then is not known yet."""
        self._relieves = False
        self._rests_ns: int | None = None
        """Since when it stands after the brake."""

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
            self.pose = states.pose
            self.planner.poses.add(states.pose)
            self.contact.update_pose(states.pose)
        if states.joint is not None:
            self.joint = states.joint
            self.planner.joints.add(states.joint)
            self.contact.update_joints(states.joint)
        self.states.update(states)
        if states.pose is not None and self.states.actual is not None:
            self.retreat.measure(self.states.actual)
        if states.gripper is not None:
            self.gripper_state = states.gripper
            width_m = states.gripper.record.width_m
            if self.held is not None and width_m is not None:
                self._grasp_m = min(self._grasp_m, width_m)

    def forget_states(self) -> None:
        """Forget the states of a robot that is gone: the next may be another one, elsewhere."""
        self.pose = self.joint = self.gripper_state = None
        self.states.forget()

    # -- what it holds ------------------------------------------------------------------------
    @property
    def let_go(self) -> bool:
        """The gripper has opened since it holds something."""
        return self._width_m is not None and self._width_m > self._grasp_m + LET_GO_M

    @property
    def _width_m(self) -> float | None:
        return None if self.gripper_state is None else self.gripper_state.record.width_m

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
        if box is not None and self.gripper is None:
            raise RecordError(f"it holds nothing: {self.profile.robot.no_gripper}")
        self.reach.hold(box)
        self.held = box
        self._grasp_m = np.inf if self._width_m is None else self._width_m
        if self._joint_monitor is not None:
            self._joint_monitor.reset()  # what is too near now may only move apart

    def measure(self) -> str:
        """Track whether the arm follows, or stands; why its joints are another arm's, or empty."""
        actual = self.states.actual
        if self.pose is None or actual is None:
            return ""
        self.tracking.measure(self.motion.commanded, actual)
        joint = self.joint.record if self.joint else None
        try:
            self.motion.measure(self.pose.record, joint, self.pose.received_ns)
        except RecordError as error:
            return str(error)
        return ""

    # -- activation ---------------------------------------------------------------------------
    def snapshot(
        self, peers: PeerSnapshot, worker: str, lease: Lease | None, now_ns: int, *, published: bool
    ) -> PartSnapshot:
        """What the monitors look at in this tick; `published`: the commands reach the robot."""
        motion = self.motion
        return PartSnapshot(
            now_ns=now_ns,
            peers=peers,
            worker=worker,
            lease=lease,
            pose=self.pose,
            gripper=self.gripper_state,
            joint=self.joint,
            measured_rad=self.measured_rad,
            commanded=motion.commanded,
            commanded_rad=motion.joints_rad,
            joints_asked=motion.joints_asked,
            published=published,
            stuck=motion.stuck,
        )

    def reasons(self, part: PartSnapshot) -> list[str]:
        """Reasons of all monitors against an activation, with the part that they are about."""
        found = [why for monitor in self.monitors for why in monitor.reasons(part)]
        return [self.says(why) for why in found]

    def reasons_by_worker(
        self, worker: str, spec: ModelSpec | None, chunk: Stamped[ActionChunk] | None
    ) -> list[str]:
        """Reasons from what a worker asks of this arm's joints."""
        bounds, reasons = self.planner.joint_bounds, list[str]()
        if spec is None:
            return reasons
        if bounds is not None and chunk is not None and self.joint is not None:
            reasons += reasons_by_joints(
                self.profile, worker, spec, chunk.record, bounds, self.joint
            )
        if self.reach is None and self._asks_joints(spec):
            reasons.append(
                f"worker {worker!r} acts in joints, which needs the robot's kinematics: set "
                "robot.description, robot.tcp_frame and robot.arm_joints in the profile"
            )
        return [self.says(why) for why in reasons]

    def _asks_joints(self, spec: ModelSpec) -> bool:
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
        for monitor in self.monitors:
            monitor.begin()
        self.planner.restart(self.pose, self.joint)
        measured, joint = self.pose.record, self.joint.record if self.joint else None
        blocked = self.tracking.excuse(held_pose(measured), pose_of(measured))
        events = self.motion.anchor(
            measured,
            np.nan if self.gripper is None else self.gripper.keep(self.gripper_state.record),
            joint,
            now_ns,
            blocked=blocked,
            joints_asked=self._asks_joints(lease.spec),
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
        obeys = arm is not None and state is State.ACTIVE and motion.scaling.override > 0.0
        if obeys and self.gripper is not None:
            if motion.goal is not None:
                self.gripper.request(motion.goal.width_m)
            width = self.gripper.step(now_ns, self.gripper_state)
        pose = arm if isinstance(arm, PoseCommand) else None
        return MotionCommands(pose, arm if isinstance(arm, JointCommand) else None, width)

    # -- supervision --------------------------------------------------------------------------
    def check(self, part: PartSnapshot) -> tuple[Brake | None, list[Event]]:
        """Why the arm cannot continue, None if it can; and events.

        All monitors are asked until one finds a reason; an arm that retreats begins to.
        """
        news = self.contact.news()
        events = [] if news is None else [news]
        found = (monitor.check(part) for monitor in self.monitors)
        brake = next((brake for brake in found if brake is not None), None)
        self.motion.scaling.monitored = slowest(*(monitor.slowdown for monitor in self.monitors))
        if brake is None:
            return None, events
        if brake.event is not None:
            events.append(brake.event)
        if brake.retreats and part.commanded is not None:
            self.retreat.begin(part.commanded)
        return brake, events

    def brake(self, *, relieves: bool) -> None:
        """The arm stops obeying: look at what presses on it once it stands, see `relief`.

        `relieves`: it may retreat from that.
        """
        self.brakes, self._relieves, self._rests_ns = True, relieves, None

    def stay(self) -> None:
        """Stand where the brake ends, whatever presses."""
        self.retreat.end()
        self._relieves = False

    def relief(self, part: PartSnapshot, *, stays: bool) -> Event | None:
        """Begin to retreat from what presses where a brake ended, unless it `stays`; or say so.

        Once for each brake; None: nothing presses, or the load has not settled yet.
        """
        if self.retreat.busy:
            self._relieves = False
        if self.retreat.busy or self._rests_ns is None or not self.motion.at_rest:
            self._rests_ns = part.now_ns
        if part.now_ns - self._rests_ns < LOAD_SETTLES_NS:
            return None
        self.brakes, load = False, self.contact.touching()
        if load is None:
            return None
        retreats = self._relieves and not stays and not self.keeps_from_retreat(part)
        if retreats and part.commanded is not None:
            self.retreat.begin(part.commanded)
        why = f"{load} presses on the arm where it came to rest; " + (
            "it retreats" if self.retreat.busy else "it stays there"
        )
        return make_event("warning", "notice", "pressed", why, load.most, load.slow)

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

    def keeps_from_retreat(self, part: PartSnapshot) -> str:
        """Why the arm must not retreat, empty: the robot is ready, and its state can be trusted."""
        if part.peers.robot_node not in part.peers.alive:
            return f"node {part.peers.robot_node!r} is gone"
        if part.pose is None or part.gripper is None:
            return "its state is not known"
        why = self.states.lost(part) or self.states.doubt
        return why or why_not_ready(part.gripper.record)


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
        measured_m = gripper.width_m
        if measured_m is None:
            raise RecordError("state/gripper has no width_m, and the profile declares a gripper")
        width_m = min(max(measured_m, 0.0), self._profile.max_width_m)
        sent_m = self.sent_m
        if sent_m is not None:
            grasps = gripper.holding and sent_m < measured_m
            if grasps or abs(sent_m - measured_m) < SAME_WIDTH_M:
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
                and state.received_ns > self._sent_ns + GRIPPER_STARTS_NS
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
