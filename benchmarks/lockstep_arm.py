"""Shared by the benchmarks in lockstep: a perfect arm, and one activated loop."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Delays

from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import log3, quat_from_rotation
from vla_zenoh.policy import Policy
from vla_zenoh.profile import Profile
from vla_zenoh.simulation.world import build_world
from vla_zenoh.types import FloatArray, GripperState, JointState, PoseState
from vla_zenoh.types.records import JointReference, PoseReference

WARM_UP_S, LOOK_S = 1.2, 0.25
DAMPING = 1e-6


class PerfectArm:
    """Replaces the simulated world by an arm that is where its reference is, without physics.

    Args:
        profile: of the robot.
    """

    def __init__(self, profile: Profile) -> None:
        self._kinematics = make_kinematics(profile)
        names = profile.robot.arm_joints
        self._joints = self._kinematics.ordered(names, profile.robot.home_rad)
        self._rates = np.zeros(len(names))
        self._pose = self._kinematics.forward(self._joints)
        self._width_m = profile.robot.gripper.max_width_m

    @property
    def joint_range_rad(self) -> tuple[FloatArray, FloatArray]:
        """Least and greatest position of every arm joint, (n,) each."""
        return self._kinematics.lower_rad, self._kinematics.upper_rad

    @property
    def slides(self) -> NDArray[np.bool_]:
        """Which arm joints slide, (n,)."""
        return self._kinematics.slides

    def tick(self, reference: PoseReference | JointReference) -> None:
        """A millisecond: TCP or joints are there; the TCP's joints follow without their elbow."""
        if isinstance(reference, JointReference):
            self._joints, self._rates = reference.position_rad, reference.velocity_rad_s
            self._pose = self._kinematics.forward(self._joints)
            return
        pose, jacobian = self._kinematics.pose_and_jacobian(self._joints)
        turn = log3(reference.rotation @ pose.rotation.T)
        apart = np.concatenate([reference.position_m - pose.position_m, turn])
        square = jacobian @ jacobian.T + DAMPING * np.eye(6)
        step = jacobian.T @ np.linalg.solve(square, apart)
        self._joints, self._rates = self._joints + step, step * 1e3
        self._pose = self._pose._replace(
            position_m=reference.position_m, rotation=reference.rotation
        )

    def joint_state(self) -> JointState:
        """Measured."""
        still = np.zeros(len(self._joints))
        return JointState(
            self._kinematics.arm_joints, self._joints, self._rates, still, self._joints
        )

    def tcp(self) -> tuple[FloatArray, FloatArray]:
        """Measured position (3,) in m, and rotation (3, 3)."""
        return self._pose.position_m, self._pose.rotation

    def pose_state(self, _: PoseReference | JointReference) -> PoseState:
        """The measured pose, equal to the held one."""
        quat, place = quat_from_rotation(self._pose.rotation), self._pose.position_m
        return PoseState(place, quat, np.zeros(6), np.zeros(6), place, quat)

    def gripper_state(self) -> GripperState:
        """As commanded."""
        return GripperState(self._width_m, moving=False, holding=False)

    def set_gripper(self, width_m: float, _speed_m_s: float, _force_n: float) -> None:
        """Takes no time."""
        self._width_m = width_m


def activated(
    profile: Profile, policy: Policy, delays: Delays, rate_hz: float, seed: int, *, perfect: bool
) -> Lockstep:
    """A loop whose arm follows the policy, ready to be measured.

    Raises:
        RuntimeError: it could not be activated; says why.
    """
    world = PerfectArm(profile) if perfect else build_world(profile)
    loop = Lockstep(
        profile, world, policy, delays=delays, reach=ReachabilityFilter(profile), seed=seed
    )
    loop.put("rate", rate_hz)
    loop.run(WARM_UP_S)
    loop.put("active", True)
    loop.run(0.01)
    if loop.commander.state.value != "active":
        raise RuntimeError(f"the arm was not activated: {loop.commander.why}")
    return loop


def in_processes(
    work: Callable[..., Any], jobs: Iterable[tuple[Any, ...]], many: int | None
) -> Iterator[Any]:
    """``work(*job)`` of every job, as they end, in this many processes (None: one per core)."""
    waiting = list(jobs)
    count = min(many or os.cpu_count() or 1, len(waiting) or 1)
    if count == 1:
        yield from (work(*job) for job in waiting)
        return
    with multiprocessing.get_context("spawn").Pool(count, initializer=_begin) as pool:
        yield from pool.imap_unordered(_Call(work), waiting)


class _Call:
    """`work` for a pool, which gives one argument."""

    def __init__(self, work: Callable[..., Any]) -> None:
        self._work = work

    def __call__(self, job: tuple[Any, ...]) -> Any:
        return self._work(*job)


def _begin() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends us
