"""Converts a robot's joint states to our joint, pose and gripper states.

Positions have to be finite, new, and possible for this arm. Missing velocities are differentiated,
missing efforts are None. Joints that turn without an end are counted over turns, however the robot
reports them: each reading is by whole turns as near as it gets to the one before.
"""

from __future__ import annotations

import bisect
import itertools
import threading
from collections import deque

import numpy as np

from vla_zenoh.errors import CodecError, RecordError
from vla_zenoh.kinematics.fingers import Fingers
from vla_zenoh.kinematics.kinematics import Kinematics, home_orientation
from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.policy.meaning import TURN_RAD, nearest_turn, toward, wrapped
from vla_zenoh.profile import Profile
from vla_zenoh.robots.driver import Measurement
from vla_zenoh.types import FloatArray, GripperState, JointState, PoseState
from vla_zenoh.types.records import Joints

MOVING_M_S = 0.002
"""Fingers faster than this move."""
WIDTH_ROOM, WIDTH_ROOM_M = 0.2, 0.005
"""A gripper may measure beyond its ends by this part of its width, and this much."""
BEYOND = 10.0
"""A joint may report this multiple of the range and speed of its description: zero points are set
in many ways, garbage is further off."""
MOST_TURNED_RAD = 1e5
"""No joint has turned further: some 16 000 turns."""
FURTHEST = 10.0
"""Larger positions (m or rad) and speeds of finger joints are garbage."""
RESTARTED_NS = 1_000_000_000
"""A stamp this much older than the last one means a restarted robot or a clock that was set; a
smaller step back is a message that was overtaken."""
CLOCK_WINDOW = 1000
"""Number of messages by which clocks are compared."""
RATE_WINDOW_NS = 1_000_000_000
"""Span by which the rate of simulated time is measured."""
SLOWEST = 0.01
"""Simulated time that runs more slowly counts as standing."""
OLDEST_NS = 2_000_000_000
"""Simulated stamps older than this are not translated."""
TOLERATED_NS = 20_000_000
"""Clocks that differ by less count as equal, as in the command node's preflight."""


class StampFilter:
    """Rejects stamps that do not advance: the robot or camera is frozen."""

    def __init__(self) -> None:
        self._stamp_ns = -1

    def check(self, stamp_ns: int) -> None:
        """Raise a `CodecError` if it is ``frozen`` (the same again) or ``out_of_order``."""
        if stamp_ns == self._stamp_ns:
            raise CodecError("frozen", f"the stamp {stamp_ns} came again")
        if self._stamp_ns - RESTARTED_NS < stamp_ns < self._stamp_ns:
            late_ms = (self._stamp_ns - stamp_ns) / 1e6
            raise CodecError("out_of_order", f"{late_ms:.1f} ms older than the one before")
        self._stamp_ns = stamp_ns


class RobotClock:
    """Offset of the robot's clock from ours, by stamps and arrivals, both in ns since the epoch.

    It is the minimum of (arrival - stamp) over the last messages, less the shortest delay.
    """

    def __init__(self) -> None:
        self._delays_ns: deque[int] = deque(maxlen=CLOCK_WINDOW)
        self.unstamped = 0

    def take(self, stamp_ns: int, arrived_ns: int) -> None:
        """Note the arrival of a message; a stamp of 0 is none."""
        if stamp_ns == 0:
            self.unstamped += 1
            return
        self._delays_ns.append(arrived_ns - stamp_ns)

    @property
    def offset_s(self) -> float | None:
        """Upper bound of how far the robot's clock is behind ours; negative: it is ahead."""
        return min(self._delays_ns) / 1e9 if self._delays_ns else None

    @property
    def differs(self) -> bool:
        """Whether the clocks differ by more than `TOLERATED_NS`."""
        offset_s = self.offset_s
        return offset_s is not None and abs(offset_s) * 1e9 > TOLERATED_NS


LOCKED_TOLERANCE = 0.01
"""A joint that is not commanded may be off by this, rad or m: 1 cm at the TCP, 1 m away."""


class SimulatedClock:
    """Translates a robot's simulated time to ours, by stamps and arrivals of its joint states.

    Simulated time runs at any rate, stands still and is set back. Safe to use from any thread.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pairs: deque[tuple[int, int]] = deque()  # (stamp, arrival)

    def take(self, stamp_ns: int, arrived_ns: int) -> None:
        """Note the arrival of a joint state; a stamp of 0 is none."""
        if stamp_ns == 0:
            return
        with self._lock:
            pairs = self._pairs
            if pairs and stamp_ns < pairs[-1][0]:
                pairs.clear()
            pairs.append((stamp_ns, arrived_ns))
            while arrived_ns - pairs[0][1] > RATE_WINDOW_NS:
                pairs.popleft()

    @property
    def newest_ns(self) -> int:
        """The newest stamp, 0 before the first."""
        with self._lock:
            return self._pairs[-1][0] if self._pairs else 0

    @property
    def rate(self) -> float:
        """Simulated seconds in a second of ours; 1 while unknown."""
        with self._lock:
            return self._rate()

    def _rate(self) -> float:
        if not self._pairs:
            return 1.0
        (first_ns, since_ns), (last_ns, until_ns) = self._pairs[0], self._pairs[-1]
        known = until_ns - since_ns > RATE_WINDOW_NS / 10
        return (last_ns - first_ns) / (until_ns - since_ns) if known else 1.0

    def wall_ns(self, stamp_ns: int, arrived_ns: int) -> int:
        """When a message of this stamp was made, in our time; its arrival where that is unknown."""
        with self._lock:
            pairs, rate = list(self._pairs), self._rate()
        if stamp_ns == 0 or not pairs:
            return arrived_ns
        at = bisect.bisect_right(pairs, (stamp_ns, arrived_ns))
        near_ns, then_ns = pairs[max(at - 1, 0)]
        made_ns = then_ns + round((stamp_ns - near_ns) / max(rate, SLOWEST))
        # Of another clock, or from before the simulation was set back.
        return arrived_ns if arrived_ns - made_ns > OLDEST_NS else min(made_ns, arrived_ns)


def wall_stamp_ns(stamp_ns: int, arrived_ns: int, simulated: SimulatedClock | None) -> int:
    """When a message was made, in our time; a stamp of 0 is none."""
    if simulated is not None:
        return simulated.wall_ns(stamp_ns, arrived_ns)
    return stamp_ns or arrived_ns


class JointReading:
    """Newest state of one arm and its gripper, from its joint states; None before the first."""

    def __init__(self, profile: Profile, kinematics: Kinematics) -> None:
        robot = profile.robot
        self.arm_joints, self._finger_names = robot.arm_joints, robot.finger_joints
        self.has_gripper = robot.gripper is not None
        if robot.gripper is not None:
            self._fingers = Fingers(robot.gripper, len(robot.finger_joints))
        self._finger_signs = dict(zip(robot.finger_joints, kinematics.finger_signs, strict=True))
        self._max_width_m = robot.max_width_m
        self._kinematics = kinematics
        self._home_quat = home_orientation(profile, kinematics)
        at = [kinematics.arm_joints.index(name) for name in robot.arm_joints]
        lower_rad, upper_rad = (ends_rad[at] for ends_rad in kinematics.sampled_rad)
        self._units = [kinematics.unit(index) for index in at]
        self._endless = tuple(itertools.compress(robot.arm_joints, kinematics.endless[at]))
        self._sliding = tuple(itertools.compress(robot.arm_joints, kinematics.slides[at]))
        kinds = [kinematics.described.joints[name].kind for name in robot.arm_joints]
        within_turn = upper_rad - lower_rad <= TURN_RAD
        self._turns = (np.array(kinds) == "continuous") & within_turn
        self._middle_rad = (lower_rad + upper_rad) / 2
        furthest_rad = BEYOND * (upper_rad - lower_rad) / 2
        self._furthest_rad = np.where(self._turns, MOST_TURNED_RAD, furthest_rad)
        self._fastest_rad_s = BEYOND * kinematics.velocity_rad_s[at]
        self._arm_newness, self._finger_newness = StampFilter(), StampFilter()
        self.joints: JointState | None = None
        self.turned_rad: FloatArray = np.zeros(len(at))
        """(n,) whole turns by which our positions are more than the robot's."""
        self.stamp_ns = 0
        self.width_m: float | None = None
        self.width_stamp_ns = 0
        self._finger_speed_m_s = 0.0
        self.efforts_missing = 0

    def take(self, joints: Joints, stamp_ns: int, made_ns: int | None = None) -> JointState | None:
        """Process a message of `stamp_ns`; the arm's joints in it, None if it has none of them.

        `made_ns` is the robot's own stamp, by which messages are told to be new, if `stamp_ns` is
        not that one.

        Raises:
            CodecError: ``frozen``, ``out_of_order``, ``partial`` (some of the arm's joints), or
                ``invalid`` (not finite, or nothing that this arm can do).
        """
        places = {name: index for index, name in enumerate(joints.names)}
        made_ns = stamp_ns if made_ns is None else made_ns
        self._take_fingers(joints, places, stamp_ns, made_ns)
        missing = [name for name in self.arm_joints if name not in places]
        if len(missing) == len(self.arm_joints):
            return None
        if missing:
            raise CodecError("partial", f"joint states of this arm without {', '.join(missing)}")
        self._check_locked(joints, places)
        at = [places[name] for name in self.arm_joints]
        reported_rad = _finite("position", joints.position[at])
        self._check(reported_rad - self._middle_rad, self._furthest_rad, reported_rad)
        position = self._counted(reported_rad)
        if joints.velocity is None:
            velocity = self._velocity(position, stamp_ns)
        else:
            velocity = _finite("velocity", joints.velocity[at])
            self._check(velocity, self._fastest_rad_s, velocity, "/s")
        self._arm_newness.check(made_ns)
        try:
            state = JointState(
                self.arm_joints,
                position,
                velocity,
                self._effort(joints, at),
                endless=self._endless,
                sliding=self._sliding,
            )
        except RecordError as error:
            raise CodecError("invalid", str(error)) from error
        self.joints, self.stamp_ns = state, stamp_ns
        self.turned_rad = position - reported_rad
        return state

    def _counted(self, reported_rad: FloatArray) -> FloatArray:
        """The positions (n,) with joints that turn counted, from within half a turn of the middle.

        They have no end, or a range within one turn that the profile gives them.
        """
        if self.joints is None:
            here_rad = self._middle_rad + wrapped(reported_rad - self._middle_rad)
        else:
            here_rad = nearest_turn(reported_rad, self.joints.position_rad)
        return np.where(self._turns, here_rad, reported_rad)

    def _check_locked(self, joints: Joints, places: dict[str, int]) -> None:
        """Reject states in which a joint that is not commanded is not where poses assume it."""
        for name, assumed in self._kinematics.locked_rad.items():
            if name not in places:
                continue
            value = float(joints.position[places[name]])
            if not abs(value - assumed) <= LOCKED_TOLERANCE:
                raise CodecError(
                    "invalid",
                    f"{name} is at {value:.4g}, and robot.locked_rad has it at {assumed:g}: every "
                    "pose would be wrong. Put it there, or change the profile",
                )

    def _check(self, off: FloatArray, most: FloatArray, values: FloatArray, per: str = "") -> None:
        """Reject `values` whose `off` exceeds `most`, all (n,)."""
        wrong = np.flatnonzero(np.abs(off) > most)
        if wrong.size:
            joint = int(wrong[0])
            unit = self._units[joint] + per
            raise CodecError(
                "invalid",
                f"{self.arm_joints[joint]} at {values[joint]:.4g} {unit}: nothing that an arm of "
                f"its description can have; it is {most[joint]:.4g} off at most",
            )

    def _velocity(self, position: FloatArray, stamp_ns: int) -> FloatArray:
        """Difference to the previous message, bounded: two close stamps make it noisy."""
        elapsed_s = (stamp_ns - self.stamp_ns) / 1e9
        if self.joints is None or not 0 < elapsed_s < 1:
            return np.zeros(len(position))
        velocity = (position - self.joints.position_rad) / elapsed_s
        return np.clip(velocity, -self._fastest_rad_s, self._fastest_rad_s)

    def _effort(self, joints: Joints, at: list[int]) -> FloatArray | None:
        """Efforts of the arm; ros2_control publishes NaN if it has none."""
        if joints.effort is not None and np.isfinite(joints.effort[at]).all():
            return joints.effort[at]
        self.efforts_missing += 1
        return None

    def _take_fingers(
        self, joints: Joints, places: dict[str, int], stamp_ns: int, made_ns: int
    ) -> None:
        fingers = [name for name in self._finger_names if name in places]
        if not fingers:
            return
        at = [places[name] for name in fingers]
        signs = np.array([self._finger_signs[name] for name in fingers])
        positions = signs * _finite("position", joints.position[at])
        if float(np.abs(positions).max()) > FURTHEST:
            raise CodecError("invalid", f"a finger joint beyond {FURTHEST:g} m or rad")
        self._finger_newness.check(made_ns)
        width_m = self._fingers.width_m(positions)
        self.check_width(width_m)
        elapsed_s = (stamp_ns - self.width_stamp_ns) / 1e9
        velocity = None if joints.velocity is None else joints.velocity[at]
        if velocity is not None and bool((np.abs(velocity) <= FURTHEST).all()):
            self._finger_speed_m_s = self._fingers.speed_m_s(signs * velocity)
        elif self.width_m is not None and 0 < elapsed_s < 1:
            self._finger_speed_m_s = abs(width_m - self.width_m) / elapsed_s
        self.width_m, self.width_stamp_ns = width_m, stamp_ns

    def check_width(self, width_m: float) -> None:
        """Raise a `CodecError` for a width that the gripper cannot have."""
        most_m, room_m = self._max_width_m, WIDTH_ROOM * self._max_width_m + WIDTH_ROOM_M
        if not -room_m <= width_m <= most_m + room_m:
            raise CodecError(
                "invalid",
                f"width_m is {width_m:.4g}, and the gripper opens from 0 to {most_m:g} m "
                "(robot.gripper.max_width_m): is this a share, percent or millimetres?",
            )

    # -- state --------------------------------------------------------------------------------
    def measurement(self, wrench: FloatArray | None, gripper: GripperState | None) -> Measurement:
        """The newest `joints` as records, or a `RecordError`: finite, but too large for one."""
        joints, kinematics = self.joints, self._kinematics
        assert joints is not None
        tcp, jacobian = kinematics.pose_and_jacobian(kinematics.joints_of(joints))
        twist = jacobian @ kinematics.ordered(joints.names, joints.velocity_rad_s)
        quat_xyzw = np.array(toward(quat_from_rotation(tcp.rotation), self._home_quat))
        pose = PoseState(tcp.position_m, quat_xyzw, twist, wrench, None, None)
        return Measurement(self.stamp_ns, joints, tcp, pose, gripper)

    def gripper(self, *, busy: bool, wanted_m: float | None, held: bool) -> GripperState | None:
        """State of the gripper, None where it is not known.

        While `busy` a goal is in flight. `wanted_m` is the last commanded width, used if no finger
        joints are described; `held`: the gripper reports that it holds an object.
        """
        if not self.has_gripper:
            return GripperState(None, moving=False, holding=False)
        if not self._finger_names:
            width_m = self._max_width_m if wanted_m is None else wanted_m
            return GripperState(width_m, busy, held)
        if self.width_m is None:
            return None
        moving = busy or self._finger_speed_m_s > MOVING_M_S
        return GripperState(min(max(self.width_m, 0.0), 1.0), moving, held and not moving)


def _finite(what: str, values: FloatArray) -> FloatArray:
    if not np.isfinite(values).all():
        raise CodecError("invalid", f"a joint {what} that is NaN or infinite")
    return values
