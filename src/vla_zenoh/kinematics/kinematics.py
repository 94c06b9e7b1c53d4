"""Kinematics of an arm, from its URDF: forward, Jacobian, joints for a pose; and of its gripper.

A joint that slides has metres where one that turns has radians; names say ``rad``.

Joint vectors are in the order of `Kinematics.arm_joints`, which is the order along the chain,
whatever order a profile or a `JointState` lists them in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vla_zenoh import resources
from vla_zenoh.errors import ProfileError, RecordError, nearest
from vla_zenoh.kinematics.description import MOVING, DescribedJoint, Description, Mimic
from vla_zenoh.kinematics.so3 import Pose, log3, quat_from_rotation
from vla_zenoh.policy.meaning import nearest_turn, reference
from vla_zenoh.profile import JointEnds, Profile, RobotProfile
from vla_zenoh.types import FloatArray, JointState

BEYOND_LIMITS = 0.1
"""A declared end of a finger joint may be outside its range by this share of it: drivers and URDFs
of a gripper differ in the last digits."""

_IDENTITY_6 = np.eye(6)
HOLDING = 2
"""Iterations that a round costs in which joints are put on their bounds."""
TOLERANCE_M, TOLERANCE_RAD = 1e-6, 1e-6
"""A solution is at most this far off."""
POSTURE_GAIN = 0.1
"""Part of the way to the posture taken in a first iteration."""
MAX_POSTURE_STEP_RAD = 0.01
"""At most this far: the posture is approached slowly."""
DAMPING_BIAS = 1e-9
"""W of an error of zero."""
MAX_JOINT_STEP_RAD = 0.5
"""Of one iteration: a far pose is approached in several."""


class Kinematics:
    """The arm alone: every joint that is not one of its own is locked, fingers wide open.

    One object serves one thread: it keeps Pinocchio's work space.

    Args:
        urdf: robot description.
        tcp_frame: the link whose pose is meant.
        arm_joints: in any order.
        finger_joints: locked where the hand is widest.
        base_frame: poses are given in this link, which must not move; None: the URDF's root.
        joint_range_rad: narrows the range of each of `arm_joints`, None does not; empty: all are as
            the URDF has them.
        locked_rad: where joints between base and TCP stand that are not commanded.
        finger_ends: positions of the open and shut hand; None: open at their upper limit, which
            needs joints that slide.

    Raises:
        ProfileError: a joint or link is not in the URDF, cannot be used, or lacks its limits; or
            the ends of a finger joint are outside its range.
    """

    def __init__(
        self,
        urdf: Path,
        tcp_frame: str,
        arm_joints: Sequence[str],
        finger_joints: Sequence[str] = (),
        *,
        base_frame: str | None = None,
        finger_ends: JointEnds | None = None,
        joint_range_rad: Sequence[tuple[float, float] | None] = (),
        locked_rad: Mapping[str, float] | None = None,
    ) -> None:
        self.urdf = urdf
        self.described = described = Description(urdf)
        self.followers: Mapping[str, Mimic] = _followers(described, arm_joints)
        """Joints that move with one of the arm's."""
        followers = self.followers
        passive = _not_commanded(
            described, base_frame or described.root, tcp_frame, arm_joints, locked_rad or {}
        )
        self.locked_rad: Mapping[str, float] = passive
        """Joints between base and TCP that are not commanded, and where they are assumed to be."""
        ends = [_finger_ends(described, name, finger_joints, finger_ends) for name in finger_joints]
        self.finger_signs: FloatArray = np.array([end.sign for end in ends], np.float64)
        """(k,) 1 for a finger joint whose position grows as the hand opens, else -1; as the first
        where the profile says where they are open and shut."""
        self.fingers_m = sum(abs(end.open) for end in ends)
        """How far finger joints that slide open in all."""
        opened = {name: end.open for name, end in zip(finger_joints, ends, strict=True)}
        self.full_model: Any = pin.buildModelFromXML(described.text(followers), mimic=True)
        self.locked_joints: list[int] = [
            self.joint_id(name)
            for name, joint in described.joints.items()
            if joint.moves and name not in arm_joints and name not in followers
        ]
        self._stand = {**opened, **passive}
        self.locked_position = _locked(self.full_model, described, self._stand)
        self.model: Any = pin.buildReducedModel(
            self.full_model, self.locked_joints, self.locked_position
        )
        self.data: Any = self.model.createData()
        self.arm_joints: tuple[str, ...] = tuple(sorted(arm_joints, key=self.joint_id))
        joints = [described.joints[name] for name in self.arm_joints]
        self.slides = np.array([joint.kind == "prismatic" for joint in joints], bool)
        """(n,) joints that slide: their positions are m."""
        self.tcp = _frame(self.model, tcp_frame)
        self.base_placement = _base_placement(self.model, self.data, base_frame)
        self._base_turn: FloatArray | None = None
        if not np.allclose(self.base_placement.rotation, np.eye(3), atol=1e-12):
            self._base_turn = np.kron(np.eye(2), self.base_placement.rotation.T)
        limits = [_limits(described, joint, followers) for joint in joints]
        self.lower_rad, self.upper_rad, self.velocity_rad_s = np.array(limits).T
        if joint_range_rad:
            ranges = [each or (-math.inf, math.inf) for each in joint_range_rad]
            lower, upper = zip(*ranges, strict=True)
            self.lower_rad = np.maximum(self.lower_rad, self.ordered(arm_joints, lower))
            self.upper_rad = np.minimum(self.upper_rad, self.ordered(arm_joints, upper))
        self.endless = np.isinf(self.upper_rad)
        """(n,) joints that turn without an end, from -inf to inf; their positions are counted over
        turns."""
        moves = (self.lower_rad < self.upper_rad) & (self.velocity_rad_s > 0)
        moves &= np.isfinite(self.velocity_rad_s)
        for index, name in enumerate(self.arm_joints):
            if not moves[index]:
                unit = self.unit(index)
                raise ProfileError(
                    f"joint {name!r} of {urdf.name} has no room to move: its <limit> needs "
                    f"lower < upper ({unit}; not if it is continuous) and velocity > 0 ({unit}/s)"
                )

    @property
    def size(self) -> int:
        """Number of arm joints, n."""
        return len(self.arm_joints)

    def joint_id(self, name: str) -> int:
        """Index of a joint in `full_model`."""
        return self.full_model.getJointId(self.described.model_name(name))

    def stands_at(self, name: str) -> float:
        """Where a joint is assumed to stand that is not commanded, m or rad."""
        return _position(self.described, name, self._stand)

    def unit(self, index: int) -> str:
        """Of the positions of joint `index`: rad, or m where it slides."""
        return "m" if self.slides[index] else "rad"

    @property
    def tool_m(self) -> FloatArray:
        """(3,) from the last joint that moves the TCP to the TCP, in the TCP's frame."""
        placement = self.model.frames[self.tcp].placement
        return placement.rotation.T @ placement.translation

    @property
    def length_m(self) -> float:
        """Length of the chain from the first joint to the TCP, slides at zero."""
        ways_m = [placement.translation for placement in list(self.model.jointPlacements)[2:]]
        return sum(float(np.linalg.norm(way_m)) for way_m in [*ways_m, self.tool_m])

    # -- joints -------------------------------------------------------------------------------
    @property
    def sampled_rad(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper ends (n,) between which the arm is in every place: of endless joints
        within one turn."""
        lower_rad = np.where(self.endless, -math.pi, self.lower_rad)
        return lower_rad, np.where(self.endless, math.pi, self.upper_rad)

    def nearest(self, joints_rad: FloatArray, near_rad: FloatArray) -> FloatArray:
        """The same place of the arm, with endless joints on the shortest way from `near_rad`."""
        if not self.endless.any():
            return joints_rad
        return np.where(self.endless, nearest_turn(joints_rad, near_rad), joints_rad)

    def ordered(self, names: Sequence[str], values: ArrayLike) -> FloatArray:
        """`values` (n,) given for `names` in any order, in the order of `arm_joints`.

        Raises:
            RecordError: a joint is missing; joints of other parts are ignored.
        """
        given = np.asarray(values, dtype=np.float64)
        places = {name: index for index, name in enumerate(names)}
        missing = [name for name in self.arm_joints if name not in places]
        if missing or given.shape != (len(places),):
            raise RecordError(
                f"joints {', '.join(missing) or 'repeated'} of the arm; given: {', '.join(names)}; "
                "wanted once each: " + ", ".join(self.arm_joints)
            )
        return given[[places[name] for name in self.arm_joints]]

    def joints_of(self, state: JointState) -> FloatArray:
        """Measured joint positions (n,) rad.

        Raises:
            RecordError: the state lacks a joint of the arm.
        """
        if state.names == self.arm_joints:
            return state.position_rad
        return self.ordered(state.names, state.position_rad)

    # -- poses and velocities -----------------------------------------------------------------
    def forward(self, joints_rad: FloatArray) -> Pose:
        """Pose of the TCP in the base frame."""
        pin.forwardKinematics(self.model, self.data, joints_rad)
        return self._tcp_pose()

    def jacobian(self, joints_rad: FloatArray) -> FloatArray:
        """(6, n): twist of the TCP (linear first, base axes) per joint velocity."""
        jacobian = pin.computeFrameJacobian(
            self.model, self.data, joints_rad, self.tcp, pin.LOCAL_WORLD_ALIGNED
        )
        jacobian = jacobian.reshape(6, -1)  # Pinocchio gives that of one joint as (6,)
        return jacobian if self._base_turn is None else self._base_turn @ jacobian

    def pose_and_jacobian(self, joints_rad: FloatArray) -> tuple[Pose, FloatArray]:
        jacobian = self.jacobian(joints_rad)  # leaves the joints' placements behind
        return self._tcp_pose(), jacobian

    def _tcp_pose(self) -> Pose:
        placement = pin.updateFramePlacement(self.model, self.data, self.tcp)
        placement = self.base_placement.actInv(placement)
        # Copies: the placement is a view into the work space.
        return Pose(placement.translation.copy(), placement.rotation.copy())


def make_kinematics(profile: Profile) -> Kinematics:
    """Kinematics of the profile's robot; see `arm_kinematics`."""
    return arm_kinematics(profile.robot)


def arm_kinematics(robot: RobotProfile) -> Kinematics:
    """Kinematics of a section `robot`.

    Raises:
        ResourceError: its description is missing.
        ProfileError: frames or joints that the description does not have.
    """
    return Kinematics(
        resources.robot_urdf(robot.description),
        robot.tcp_frame,
        robot.arm_joints,
        robot.finger_joints,
        base_frame=robot.base_frame,
        finger_ends=None if robot.gripper is None else robot.gripper.joint_ends,
        joint_range_rad=robot.joint_range_rad,
        locked_rad=robot.locked_rad,
    )


def home_orientation(
    profile: Profile, kinematics: Kinematics | None = None
) -> tuple[float, float, float, float]:
    """Orientation of the TCP at `robot.home_rad`, x, y, z, w, with a sign free of rounding.

    It is the default reference of the numbers that a rotation has (`vla_zenoh.policy.meaning`).

    Raises:
        ResourceError, ProfileError: as `make_kinematics`.
    """
    arm, robot = kinematics or make_kinematics(profile), profile.robot
    home_rad = arm.ordered(robot.arm_joints, robot.home_rad)
    return reference(quat_from_rotation(arm.forward(home_rad).rotation))


def smallest_singular_value(jacobian: FloatArray) -> float:
    """How slow the TCP's slowest direction is (m and rad alike) per rad/s; 0 when singular."""
    wide = jacobian if jacobian.shape[0] <= jacobian.shape[1] else jacobian.T
    return math.sqrt(max(float(np.linalg.eigvalsh(wide @ wide.T)[0]), 0.0))


class Approach(NamedTuple):
    """How near the arm came to a pose: joints (n,), the distances left, and whether that solves it.

    Args:
        wanted_rad: (n,) the last iteration's joints before they were put on their bounds.
        jacobian: (6, n) at `joints_rad`.
        effort: what it took, in iterations: some 3, and many times that at the ends of ranges.
    """

    joints_rad: FloatArray
    error_m: float
    error_rad: float
    solved: bool
    wanted_rad: FloatArray
    jacobian: FloatArray
    effort: int


def pose_error(goal: Pose, here: Pose) -> FloatArray:
    """(6,) m and rad in the base frame, from `here` to `goal`."""
    error = np.empty(6)
    error[:3] = goal.position_m - here.position_m
    error[3:] = log3(goal.rotation @ here.rotation.T)
    return error


class InverseKinematics:
    """Joints for a pose: damped least squares that leaves a redundant arm in its posture.

    One iteration, with e the pose error, z a step towards the posture and W the damping::

        e  = [p_goal - p ; log3(R_goal R^T)]          base frame
        W  = (|e|^2 / 2 + bias) 1
        dq = z + J^T (J J^T + W)^-1 (e - J z)

    A damping that follows the error converges quadratically where there is a solution and stays
    calm where there is none. A joint that would pass its bound is put on it and the others carry on
    without it. Source: Sugihara, "Solvability-unconcerned inverse kinematics by the
    Levenberg-Marquardt method", IEEE Trans. Robotics 27(5), 2011; here a metre weighs as much as a
    radian.

    Args:
        kinematics: of the arm.
        posture_rad: (n,) where a redundant arm prefers to be.
        joint_margin_rad: kept from both ends of every joint's range, one number or (n,).
        max_iterations: after which there is no solution.

    Raises:
        RecordError: the margin leaves a joint no range.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        posture_rad: FloatArray,
        *,
        joint_margin_rad: float | FloatArray = 0.05,
        max_iterations: int = 40,
    ) -> None:
        self._kinematics, self._max_iterations = kinematics, max_iterations
        self.lower_rad = kinematics.lower_rad + joint_margin_rad
        self.upper_rad = kinematics.upper_rad - joint_margin_rad
        if np.any(self.lower_rad >= self.upper_rad):
            worst = int(np.argmin(self.upper_rad - self.lower_rad))
            name, unit = kinematics.arm_joints[worst], kinematics.unit(worst)
            margin = np.broadcast_to(joint_margin_rad, kinematics.size)[worst]
            raise RecordError(f"joint_margin_{unit} {margin:g} leaves {name!r} no range")
        self.posture_rad = posture_rad.copy()

    def approach(self, pose: Pose, start_rad: FloatArray, *, bounded: bool = True) -> Approach:
        """Joints (n,) that put the TCP there, near `start_rad`, or how near it comes.

        The search is local: a pose that needs several joints on the very ends of their ranges, or
        the arm in another branch than at the start, may be missed.

        `bounded` keeps every joint within its bounds, the other joints taking over; else pose and
        posture alone decide where the joints go.
        """
        lower, upper = self.bounds(start_rad)
        joints = wanted = start_rad
        last, stalls, iteration, effort = math.inf, 0, 0, 0
        while True:
            here, jacobian = self._kinematics.pose_and_jacobian(joints)
            error = pose_error(pose, here)
            x, y, z, rx, ry, rz = error.tolist()
            error_m, error_rad = math.hypot(x, y, z), math.hypot(rx, ry, rz)
            squared = error_m * error_m + error_rad * error_rad
            solved = error_m <= TOLERANCE_M and error_rad <= TOLERANCE_RAD
            # At a bound or out of reach the error shrinks by ever less: three rounds are proof.
            stalls = stalls + 1 if squared > 0.8 * last and iteration > 2 else 0
            if solved or stalls == 3 or iteration == self._max_iterations:
                effort += iteration
                return Approach(joints, error_m, error_rad, solved, wanted, jacobian, effort)
            last, damping, drift = squared, 0.5 * squared + DAMPING_BIAS, None
            if iteration == 0:  # afterwards the pose alone decides
                posture_rad = self._kinematics.nearest(self.posture_rad, joints)
                drift = _shortened(POSTURE_GAIN * (posture_rad - joints), MAX_POSTURE_STEP_RAD)
            step = _damped_step(error, jacobian, drift, damping)
            wanted = joints + _shortened(step, MAX_JOINT_STEP_RAD)
            if bounded:
                joints, rounds = _inside(
                    wanted, joints, error, jacobian, drift, damping, lower, upper
                )
                effort += HOLDING * rounds
            else:
                joints = wanted
            iteration += 1

    def bounds(self, start_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Least and greatest joints (n,): no joint goes further out than it was."""
        return np.minimum(self.lower_rad, start_rad), np.maximum(self.upper_rad, start_rad)


def _shortened(step: FloatArray, most: float) -> FloatArray:
    largest = max(map(abs, step.tolist()))
    return step if largest <= most else step * (most / largest)


def _damped_step(
    error: FloatArray, jacobian: FloatArray, drift: FloatArray | None, damping: float
) -> FloatArray:
    left = jacobian @ jacobian.T + damping * _IDENTITY_6
    if drift is None:
        return jacobian.T @ np.linalg.solve(left, error)
    return drift + jacobian.T @ np.linalg.solve(left, error - jacobian @ drift)


def _inside(
    wanted: FloatArray,
    joints: FloatArray,
    error: FloatArray,
    jacobian: FloatArray,
    drift: FloatArray | None,
    damping: float,
    lower: FloatArray,
    upper: FloatArray,
) -> tuple[FloatArray, int]:
    """`wanted`, or the best step of the other joints once those past a bound stand on it.

    And in how many rounds.
    """
    if ((wanted >= lower) & (wanted <= upper)).all():
        return wanted, 0
    held, step, rounds = np.zeros(len(joints), dtype=bool), wanted - joints, 0
    while True:
        rounds += 1
        wanted = joints + step
        past = ~held & ((wanted < lower) | (wanted > upper))
        held |= past
        if held.all() or not past.any():
            return np.clip(wanted, lower, upper), rounds
        onto = np.where(held, np.clip(wanted, lower, upper) - joints, 0.0)
        free = np.where(held, 0.0, jacobian)
        aside = None if drift is None else np.where(held, 0.0, drift)
        step = onto + _damped_step(error - jacobian @ onto, free, aside, damping + 1e-6)


class FingerEnds(NamedTuple):
    """Where a finger joint is with the hand open, m or rad, and the way it goes to open it."""

    open: float
    sign: float


def _joint(described: Description, name: str) -> DescribedJoint:
    if name not in described.joints:
        raise ProfileError(
            f"{described.name} has no joint {name!r}{nearest(name, described.joints, '')}; "
            f"it has: {', '.join(each.name for each in described.joints.values() if each.moves)}"
        )
    return described.joints[name]


def _followers(described: Description, arm_joints: Sequence[str]) -> dict[str, Mimic]:
    """Joints that move with one of the arm's."""
    for name in arm_joints:
        joint = _joint(described, name)
        if not joint.moves:
            raise ProfileError(f"joint {name!r} of {described.name} is fixed: it cannot be moved")
        if joint.mimic is not None:
            raise ProfileError(
                f"joint {name!r} of {described.name} follows joint {joint.mimic.joint!r} (mimic) "
                "and is not commanded: leave it out of arm_joints"
            )
        if joint.kind not in MOVING:
            raise ProfileError(
                f"joint {name!r} of {described.name} is {joint.kind}: an arm's joint turns about "
                f"one axis or slides along one ({', '.join(MOVING)})"
            )
    followers: dict[str, Mimic] = {}
    for name, joint in described.joints.items():
        if joint.mimic is not None and joint.mimic.joint in described.joints:
            follows = described.follows(name)
            if follows.joint in arm_joints:
                followers[name] = follows
    return followers


def _not_commanded(
    described: Description,
    base_frame: str,
    tcp_frame: str,
    arm_joints: Sequence[str],
    locked_rad: Mapping[str, float],
) -> dict[str, float]:
    """Joint between base and TCP -> where it stands, for those that no arm joint moves."""
    for link in (base_frame, tcp_frame):
        if link not in described.links:
            raise ProfileError(
                f"{described.name} has no link {link!r}{nearest(link, described.links, '')}; "
                f"it has: {', '.join(described.links)}"
            )
    below = [described.follows(joint.name) for joint in described.chain(described.root, base_frame)]
    if any(follows.joint in arm_joints for follows in below):
        raise ProfileError(
            f"base_frame {base_frame!r} of {described.name} moves with the arm's joints"
        )
    chain = [joint for joint in described.chain(base_frame, tcp_frame) if joint.moves]
    leaders = {joint.name: described.follows(joint.name).joint for joint in chain}
    for name in arm_joints:
        if name not in leaders.values():
            raise ProfileError(
                f"arm joint {name!r} of {described.name} does not move tcp_frame {tcp_frame!r} "
                f"against base_frame {base_frame!r}: leave it out of arm_joints, or give other "
                "frames"
            )
    passive = {name: leader for name, leader in leaders.items() if leader not in arm_joints}
    for name in locked_rad:
        _joint(described, name)
    missing = sorted(set(passive.values()) - locked_rad.keys())
    if missing:
        raise ProfileError(
            f"{described.name} has {_listed(missing)} between base_frame {base_frame!r} and "
            f"tcp_frame {tcp_frame!r}, which arm_joints does not name. Where does it stand? Add it "
            "to arm_joints, or write where it is fixed, as robot: {locked_rad: {"
            + ", ".join(f"{name}: 0.0" for name in missing)
            + "}}"
        )
    for name, value in locked_rad.items():
        joint = _joint(described, name)
        if name not in passive.values():
            raise ProfileError(
                f"locked_rad has joint {name!r}, which is not between base_frame {base_frame!r} "
                f"and tcp_frame {tcp_frame!r} of {described.name}, or is commanded: leave it out"
            )
        if not joint.lower <= value <= joint.upper:
            raise ProfileError(
                f"locked_rad puts joint {name!r} of {described.name} at {value:g} {joint.unit}: "
                f"it goes from {joint.lower:g} to {joint.upper:g}"
            )
    return dict(locked_rad)


def _listed(names: Sequence[str]) -> str:
    return f"joint{'s' if len(names) > 1 else ''} {', '.join(map(repr, names))}"


def _locked(model: Any, described: Description, known: Mapping[str, float]) -> FloatArray:
    """Configuration of the whole robot in which all but the arm is locked.

    Joints of which nothing is known stand at 0, or at the end of their range next to it.
    """
    position = pin.neutral(model)
    for name in (each.name for each in described.joints.values() if each.moves):
        joint = model.joints[model.getJointId(described.model_name(name))]
        if joint.nq == 1:
            position[joint.idx_q] = _position(described, name, known)
    return position


def _position(described: Description, name: str, known: Mapping[str, float]) -> float:
    if name in known:
        return known[name]
    joint = described.joints.get(name)
    if joint is None or joint.kind not in MOVING:
        return 0.0
    if joint.mimic is not None and joint.mimic.joint in described.joints:
        follows = described.follows(name)
        leader = _position(described, follows.joint, known)
        return follows.multiplier * leader + follows.offset
    return min(max(0.0, joint.lower), joint.upper)


def _limits(
    described: Description, joint: DescribedJoint, followers: Mapping[str, Mimic]
) -> tuple[float, float, float]:
    """Range and velocity of an arm joint, in which the joints that follow it keep theirs."""
    lower, upper, velocity = joint.lower, joint.upper, joint.velocity
    for name, follows in followers.items():
        if follows.joint == joint.name and follows.multiplier != 0:
            other = described.joints[name]
            ends = [
                (end - follows.offset) / follows.multiplier for end in (other.lower, other.upper)
            ]
            lower, upper = max(lower, min(ends)), min(upper, max(ends))
            velocity = min(velocity, other.velocity / abs(follows.multiplier))
    return lower, upper, velocity


def _finger_ends(
    described: Description, name: str, fingers: Sequence[str], ends: JointEnds | None
) -> FingerEnds:
    """Where a finger joint is at which the hand is widest, m or rad, and its direction.

    The ends in the profile are those of the first finger; another one may be its mirror image.
    """
    joint = _joint(described, name)
    called = f"{name!r} of {described.name}"
    if joint.kind not in ("revolute", "prismatic"):
        raise ProfileError(f"finger joint {called} has no limits to open and to shut at")
    lower, upper, unit = joint.lower, joint.upper, joint.unit
    margin = BEYOND_LIMITS * (upper - lower)
    way = f"it goes from {lower:g} to {upper:g} {unit}"
    wanted = f"gripper: {{joint_open_{unit}: ..., joint_shut_{unit}: ...}}"
    if ends is None and unit == "rad":
        raise ProfileError(
            f"finger joint {called} turns, and its angle is no width: say at which angle the "
            f"gripper is open by max_width_m and at which it is shut, as {wanted}; {way}"
        )
    if ends is None:
        for end, far, sign in ((lower, upper, 1.0), (upper, lower, -1.0)):
            if abs(end) <= margin < abs(far):
                return FingerEnds(far, sign)
        raise ProfileError(
            f"finger joint {called} is not shut at 0: {way}. Say where the gripper is open by "
            f"max_width_m and where it is shut, as {wanted}"
        )
    if ends.unit != unit:
        does = "slides" if unit == "m" else "turns"
        raise ProfileError(f"finger joint {called} {does}: write {wanted}; {way}")
    signs = [1.0] if name == fingers[0] else [1.0, -1.0]
    if (follows := described.follows(name)).joint == fingers[0]:
        signs = [math.copysign(1.0, follows.multiplier)]
    for sign in signs:
        if all(lower - margin <= sign * end <= upper + margin for end in (ends.open, ends.shut)):
            return FingerEnds(sign * ends.open, sign)
    for what, value in (("open", ends.open), ("shut", ends.shut)):
        if not lower - margin <= value <= upper + margin:
            raise ProfileError(
                f"finger joint {called} cannot be at gripper.joint_{what}_{unit} ({value:g}): {way}"
            )
    raise ProfileError(
        f"finger joint {called} goes the other way than {fingers[0]!r}, and cannot be at "
        f"{-ends.open:g} and {-ends.shut:g} {unit}: {way}"
    )


def _frame(model: Any, name: str) -> int:
    """Index of a link's frame: a joint may have the same name."""
    return model.getFrameId(name, pin.FrameType.BODY)


def _base_placement(model: Any, data: Any, name: str | None) -> Any:
    if name is None:
        return pin.SE3.Identity()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    return data.oMf[_frame(model, name)].copy()
