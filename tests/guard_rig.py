"""Command streams over an ill link to a guard, and its references as finite differences."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from ruckig import (
    ControlInterface,
    InputParameter,
    OutputParameter,
    Ruckig,
    RuckigError,
    Synchronization,
    Trajectory,
)

from vla_zenoh.control.limits import JointMotionLimits, joint_motion_limits, motion_limits
from vla_zenoh.control.smoothing import Motion, Smoother
from vla_zenoh.guard.reference_governor import BRAKE_MARGIN
from vla_zenoh.guard.stream_guard import (
    JointGuard,
    PoseGuard,
    pose_brake_limits,
)
from vla_zenoh.kinematics.so3 import Pose, exp3, log3, quat_from_rotation
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.types import FloatArray, Header, JointCommand, JointReference, PoseCommand, Stamped

PROFILE = load_profile("panda_sim")
NAMES = PROFILE.robot.arm_joints
HOME_RAD = np.array(PROFILE.robot.home_rad)
HOME = Pose(np.array([0.43, 0.0, 0.3]), exp3(np.array([3.0, 0.1, 0.0])))
STREAM_NS = 4_000_000
STREAM_S = STREAM_NS / 1e9
START_NS = 1_700_000_000_000_000_000
WRITER_AHEAD_NS = 5_000_000_000
LINGER = 60
"""Commands at rest after a stop."""

Mode = Literal["pose", "joint"]


@dataclass
class Link:
    """What happens to what is sent.

    Args:
        loss: share that is lost.
        delay_s: most of what a command is on its way, evenly drawn: they overtake each other.
        holdup_s: most of what the link is held up for; then all that waited arrives in a heap.
        holdups: how often, of every command.
        twice: share that arrives twice.
        late: how often a second the guard is late, by up to `late_s`.
        late_s: see there.
        dies: how often, of every command, the writer is gone without a stop.
    """

    loss: float = 0.0
    delay_s: float = 0.0
    holdup_s: float = 0.0
    holdups: float = 0.0
    twice: float = 0.0
    late: float = 0.0
    late_s: float = 0.0
    dies: float = 0.0


CLEAN = Link()


def ill(rng: random.Random) -> Link:
    """A link of which anything may be wrong."""
    return Link(
        loss=rng.choice([0.0, 0.02, 0.1, 0.4]),
        delay_s=rng.choice([0.0, 0.003, 0.02, 0.09]),
        holdup_s=rng.choice([0.0, 0.05, 0.25]),
        holdups=rng.choice([0.002, 0.01]),
        twice=rng.choice([0.0, 0.1]),
        late=rng.choice([0.0, 1.0]),
        late_s=rng.choice([0.01, 0.09]),
        dies=rng.choice([0.0, 0.002]),
    )


class PoseWriter:
    """The pose stream of a command node: jerk-limited, to poses that change in motion."""

    def __init__(self, profile: Profile, here: Pose, rng: random.Random) -> None:
        self._smoother = Smoother(here, STREAM_S, motion_limits(profile.limits))
        self._rng = rng

    def aim(self) -> None:
        around = [self._rng.uniform(-1, 1) for _ in range(6)]
        turn = exp3(0.5 * np.array(around[3:]))
        here = Pose(HOME.position_m + 0.12 * np.array(around[:3]), turn @ HOME.rotation)
        self._smoother.target(here)

    def brake(self) -> None:
        self._smoother.brake()

    def aside(self, share: float) -> None:
        """Begin again a little aside, as an activation at rest does."""
        pose = self._smoother.motion.pose
        turn = exp3(share * np.array([0.004, -0.003, 0.002]))
        offset_m = share * np.array([0.0009, -0.0005, 0.0005])
        self._smoother.reset(Pose(pose.position_m + offset_m, turn @ pose.rotation))

    @property
    def at_rest(self) -> bool:
        return self._smoother.at_rest

    def tick(self) -> PoseCommand:
        motion = self._smoother.tick()
        at_m, quat = motion.pose.position_m, quat_from_rotation(motion.pose.rotation)
        return PoseCommand(at_m, quat, motion.twist, motion.acceleration, at_m, quat, "active")


class JointWriter:
    """The same of joint positions, each joint within its own limits."""

    def __init__(self, profile: Profile, here_rad: FloatArray, rng: random.Random) -> None:
        limits = joint_motion_limits(profile)
        self._otg, self._out = Ruckig(len(here_rad), STREAM_S), OutputParameter(len(here_rad))
        self._in = InputParameter(len(here_rad))
        self._in.synchronization = Synchronization.No
        self._in.max_velocity = limits.velocity_rad_s.tolist()
        self._in.max_acceleration = limits.acceleration_rad_s2.tolist()
        self._in.max_jerk = limits.jerk_rad_s3.tolist()
        self._in.current_position = self._in.target_position = here_rad.tolist()
        self._rng = rng

    def aim(self) -> None:
        self._in.target_position = [q + self._rng.uniform(-0.8, 0.8) for q in HOME_RAD]

    def brake(self) -> None:
        """Turn round to where it is."""
        self._in.target_position = self._in.current_position

    def aside(self, share: float) -> None:
        here = [q + share * 0.0018 for q in self._in.current_position]
        self._in.current_position = self._in.target_position = here
        self._in.current_velocity = self._in.current_acceleration = [0.0] * len(here)
        self._otg.reset()

    @property
    def at_rest(self) -> bool:
        return max(abs(v) for v in self._in.current_velocity) < 1e-6

    def tick(self) -> JointCommand:
        self._otg.update(self._in, self._out)
        self._out.pass_to_input(self._in)
        out = self._out
        return JointCommand(
            NAMES, out.new_position, out.new_velocity, out.new_acceleration, "active"
        )


class Trace(NamedTuple):
    """References of consecutive ticks, (k, n) each: what is told of them, and the moves between.

    Args:
        moves: (k, n) from the reference before: m, or rad; of a rotation its vector, base axes.
        rate: as told.
        change: as told.
        tick_s: between two.
        silences: how often the guard braked.
        refused: how many commands.
    """

    moves: FloatArray
    rate: FloatArray
    change: FloatArray
    tick_s: float
    silences: int
    refused: int

    def differences(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Velocity, acceleration and jerk as one computes them who sees positions alone."""
        velocity = self.moves / self.tick_s
        acceleration = np.diff(velocity, axis=0) / self.tick_s
        return velocity, acceleration, np.diff(acceleration, axis=0) / self.tick_s


def drive(
    mode: Mode,
    seed: int,
    link: Link,
    *,
    tick_s: float,
    duration_s: float,
    profile: Profile = PROFILE,
    each: Callable[[Any, Any], None] = lambda *_: None,
    aside: bool = True,
) -> Trace:
    """Lead a guard over a link for so long, begin, stop, begin again and fall silent.

    Args:
        mode: of the stream.
        seed: of all that is drawn.
        link: between writer and guard.
        tick_s: of the guard.
        duration_s: in all.
        profile: whose limits count.
        each: is given the guard after each tick, and the command that was written last.
        aside: a stream may begin a little aside of the reference.
    """
    rng = random.Random(seed)
    guard: Any
    timeout_s = profile.timing.command_timeout_s
    if mode == "pose":
        guard = PoseGuard(HOME, tick_s, timeout_s, pose_brake_limits(profile))
    else:
        ends = HOME_RAD - 3, HOME_RAD + 3
        brake = joint_motion_limits(profile, BRAKE_MARGIN)
        guard = JointGuard(
            NAMES, HOME_RAD, tick_s, timeout_s, brake, ends, np.zeros(len(NAMES), bool)
        )
    motions = [guard.motion]
    arrivals: list[tuple[int, Stamped[Any]]] = []
    writer: Any = None
    record: Any = None
    seq = refused = linger = held_until_ns = late_until_ns = silent_until_ns = 0
    source = ""
    tick_ns = round(tick_s * 1e9)
    for now_ns in range(START_NS, START_NS + round(duration_s * 1e9), tick_ns):
        if (now_ns - START_NS) % STREAM_NS == 0:
            if writer is not None and (guard.braking or rng.random() < link.dies):
                writer = None
                silent_until_ns = now_ns + 400_000_000
            if writer is None and now_ns >= silent_until_ns and not guard.braking:
                here = guard.motion
                if mode == "pose":
                    writer = PoseWriter(profile, here.pose, rng)
                else:
                    writer = JointWriter(profile, here.position_rad, rng)
                writer.aside(aside * rng.choice([0.0, rng.uniform(-1, 1)]))
                source = source if rng.random() < 0.5 else f"command#{now_ns}"
                linger = 0
            if writer is not None:
                if linger and writer.at_rest:
                    linger += 1
                    if linger > LINGER:
                        writer.aside(aside * rng.choice([0.0, rng.uniform(-0.4, 0.4)]))
                        linger = 0
                elif not linger and rng.random() < 0.008:
                    writer.brake()
                    linger = 1
                elif not linger and rng.random() < 0.02:
                    writer.aim()
                record = writer.tick()
                seq += 1
                if link.holdup_s and rng.random() < link.holdups:
                    held_until_ns = now_ns + round(rng.uniform(0, link.holdup_s) * 1e9)
                header = Header(now_ns + WRITER_AHEAD_NS, seq, source)
                for _ in range(1 + (rng.random() < link.twice)):
                    if rng.random() >= link.loss:
                        arrives = now_ns + round(rng.uniform(0, link.delay_s) * 1e9)
                        arrives = max(arrives, held_until_ns)
                        arrivals.append((arrives, Stamped(header, record, arrives)))
        if link.late and rng.random() < link.late * tick_s:
            late_until_ns = now_ns + round(rng.uniform(0, link.late_s) * 1e9)
        if now_ns < late_until_ns:
            continue
        arrivals.sort(key=lambda arrival: arrival[0])
        while arrivals and arrivals[0][0] <= now_ns:
            refused += guard.offer(arrivals.pop(0)[1], now_ns) is not None
        motions.append(guard.tick(now_ns))
        each(guard, record if writer is not None else None)
    return _trace(motions, tick_s, guard.silences, refused)


def _trace(motions: list[Any], tick_s: float, silences: int, refused: int) -> Trace:
    if isinstance(motions[0], JointReference):
        position, rate, change = map(np.array, zip(*motions, strict=True))
        return Trace(np.diff(position, axis=0), rate[1:], change[1:], tick_s, silences, refused)
    moves = [_move(*pair) for pair in itertools.pairwise(motions)]
    rate = np.array([motion.twist for motion in motions[1:]])
    change = np.array([motion.acceleration for motion in motions[1:]])
    return Trace(np.array(moves), rate, change, tick_s, silences, refused)


def _move(before: Motion, after: Motion) -> FloatArray:
    turn = log3(after.pose.rotation @ before.pose.rotation.T)
    return np.concatenate([after.pose.position_m - before.pose.position_m, turn])


def magnitudes(mode: Mode, values: FloatArray) -> FloatArray:
    """What limits count: (k, n) joints, or (k, 4): three axes and the norm of a rotation."""
    if mode == "joint":
        return np.abs(values)
    turned = np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
    return np.hstack([np.abs(values[:, :3]), turned])


def limits_of(mode: Mode, profile: Profile = PROFILE) -> FloatArray:
    """(3, m) the stream's own limits of velocity, acceleration and jerk, as `magnitudes`."""
    if mode == "joint":
        return np.array(joint_motion_limits(profile))
    translation, rotation = motion_limits(profile.limits)
    return np.array([[a, a, a, b] for a, b in zip(translation, rotation, strict=True)])


def ratios(mode: Mode, trace: Trace, profile: Profile = PROFILE) -> FloatArray:
    """(3,) the greatest velocity, acceleration and jerk in times of the stream's own limits."""
    limits = limits_of(mode, profile)
    return np.array(
        [
            (magnitudes(mode, values) / limit).max()
            for values, limit in zip(trace.differences(), limits, strict=True)
        ]
    )


def stop_from(motion: JointReference, limits: JointMotionLimits) -> Trajectory | None:
    """The shortest jerk-limited stop from `motion`, each joint by itself.

    None if none can be planned; every finite motion has one.
    """
    joints = len(motion.position_rad)
    ask, path = InputParameter(joints), Trajectory(joints)
    ask.control_interface = ControlInterface.Velocity
    ask.synchronization = Synchronization.No
    ask.current_position = motion.position_rad.tolist()
    ask.current_velocity = motion.velocity_rad_s.tolist()
    ask.current_acceleration = motion.acceleration_rad_s2.tolist()
    ask.target_velocity = ask.target_acceleration = [0.0] * joints
    ask.max_acceleration = limits.acceleration_rad_s2.tolist()
    ask.max_jerk = limits.jerk_rad_s3.tolist()
    try:
        Ruckig(joints).calculate(ask, path)
    except (RuckigError, ValueError):
        return None
    return path
