"""A Franka arm: follows set-points like a spring, with franky's 1 kHz torque loop on libfranka.

The 1 kHz loop is C++ and reads the newest set-point, with velocity and acceleration, in each
cycle; Python is never in it. When Python falls silent in motion the velocity is dropped, so the arm
comes to rest at the last set-point. The loop runs while set-points arrive; at rest the robot's own
controller holds the arm where it stands.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from vla_zenoh.errors import MissingExtraError, NodeError, in_words
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import exp3, log3, quat_from_rotation, rotation_from_quat
from vla_zenoh.profile import Profile
from vla_zenoh.robot import Command, Reading
from vla_zenoh.runtime.process import INNER_PRIORITY, realtime_links
from vla_zenoh.types import FloatArray, JointCommand
from vla_zenoh_franka.hand import Hand
from vla_zenoh_franka.plugin import FrankaOptions

REST_S = 1.0
"""The loop ends after this long without a set-point."""
CLOSE_S = 1.0
CONNECT_S = 10.0
MOST_TCP_NM, MOST_POSTURE_NM = 6.0, 2.0
"""Torque limits of the springs at the TCP and of the elbow: the wrist's joints have 12 Nm."""
MOST_JOINT_NM = np.array([40.0, 40.0, 40.0, 40.0, 9.0, 9.0, 9.0])
"""Torque limits of the joints' springs."""
LONGEST_S = 0.02
"""Longest time between two set-points that the trim integrates over."""
_TURN = math.pi / 2
CRAIG = (
    # a (m), d (m), alpha (rad)
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -_TURN),
    (0.0, 0.316, _TURN),
    (0.0825, 0.0, _TURN),
    (-0.0825, 0.384, -_TURN),
    (0.0, 0.0, _TURN),
    (0.088, 0.0, _TURN),
)
"""Denavit-Hartenberg parameters of joint 1 to 7, in Craig's convention."""
FLANGE_M = 0.107
"""From the frame of joint 7 to the flange, along z."""
INTEGRAL_S, PROPORTION = 0.2, 1.5
MOST_M, MOST_RAD, MOST_JOINT_RAD = 0.008, 0.03, 0.008
"""Limits. Friction of an FR3 takes half of them at the stiffness of its profile."""
READY = frozenset({"Idle", "Move"})
STOPPED = frozenset({"Reflex", "UserStopped"})
"""Robot modes that are a fault. In the others the robot is healthy but follows no commands."""


TASKS = Path("/proc/self/task")
"""Threads of this process."""


@contextmanager
def realtime_children() -> Iterator[None]:
    """SCHED_FIFO for the threads that a library starts in this context.

    They inherit nothing from a `realtime_thread`.
    """
    before = set(TASKS.glob("*"))
    yield
    for task in set(TASKS.glob("*")) - before:
        try:
            os.sched_setscheduler(int(task.name), os.SCHED_FIFO, os.sched_param(INNER_PRIORITY))
        except OSError:  # not permitted, or already over
            return


class FrankaArm:
    """The arm of a profile with a section franka; see `vla_zenoh.robot.Robot`.

    Attributes:
        robot: franky's, once connected.
    """

    def __init__(self, profile: Profile, options: FrankaOptions) -> None:
        self._profile, self._settings = profile, options
        try:
            self._franky: Any = import_module("franky")
        except ImportError as error:
            raise MissingExtraError("franky", "franky", "vla-zenoh-franka") from error
        self._kinematics = make_kinematics(profile)
        self.robot: Any = None
        self._hand: Hand | None = None
        self._motion: Any = None
        self._command: Any = None
        self._state: Any = None
        self._time: Any = None
        self._trim, self._ended = Trim(6), ""
        self._led = self._configured = self._was_in_control = False
        self._measured_ns = self._moved_ns = 0
        self._recovery: threading.Thread | None = None
        self._timeout_s = profile.timing.command_timeout_s
        self._referring, self._closed = threading.Lock(), threading.Event()

    # -- connection ---------------------------------------------------------------------------
    def connect(self) -> None:
        """Connect to the control box, and to the hand.

        Raises:
            NodeError: it does not answer, or has another version of the interface.
        """
        franky, address = self._franky, self._settings.address
        enforce = self._settings.realtime == "enforce"
        realtime = franky.RealtimeConfig.Enforce if enforce else franky.RealtimeConfig.Ignore
        try:
            self.robot = _in_time(
                lambda: franky.Robot(address, realtime_config=realtime), f"{address}: connecting"
            )
            if self._settings.hand:
                gripper = _in_time(lambda: franky.Gripper(address), f"{address}: the hand")
                self._hand = Hand(gripper)
        except franky.IncompatibleVersionException as error:
            raise NodeError(
                f"{address}: {in_words(error)}. The profile has franka.fci: {self._settings.fci}; "
                "a Panda needs a franky built with libfranka 0.9"
            ) from error
        except franky.Exception as error:
            raise NodeError(
                f"{address}: {in_words(error)}. Are the joints unlocked, and is FCI activated in "
                "Desk? Is no other program connected?"
            ) from error
        self._update(self.robot.state)
        with realtime_links():  # it shares a lock and the GIL with the loop
            threading.Thread(target=self._hold, name="hold", daemon=True).start()

    def close(self) -> None:
        """End the loop and disconnect."""
        self._closed.set()
        if self._hand is not None:
            self._hand.close()
        if self.robot is not None and self.robot.is_in_control:
            self.robot.move(self._franky.TorqueStopMotion(), asynchronous=True)
            self.robot.join_motion(CLOSE_S)
        self.robot = self._hand = None

    def _configure(self) -> None:
        """Apply load, tool and collision settings; only an arm at rest accepts them."""
        settings, robot = self._settings, self.robot
        torque = list(settings.collision_joint_nm)
        force = [settings.collision_force_n] * 3 + [settings.collision_torque_nm] * 3
        robot.set_collision_behavior(torque, torque, force, force)
        load = settings.load
        xx, yy, zz, xy, xz, yz = load.inertia_kg_m2
        inertia = [xx, xy, xz, xy, yy, yz, xz, yz, zz]  # (3, 3), row by row
        robot.set_load(load.mass_kg, list(load.centre_m), inertia)
        hand = np.linalg.inv(self._state.F_T_NE.matrix) @ self.flange_to_tcp()
        robot.set_ee(list(hand.T.ravel()))
        robot.set_k(list(np.eye(4).ravel()))
        self._configured = True

    def flange_to_tcp(self) -> FloatArray:
        """(4, 4) pose of the profile's TCP in the flange frame, by the robot description."""
        names, home_rad = self._profile.robot.arm_joints, np.array(self._profile.robot.home_rad)
        pose = self._kinematics.forward(self._kinematics.ordered(names, home_rad))
        tcp = np.eye(4)
        tcp[:3, :3], tcp[:3, 3] = pose.rotation, pose.position_m
        return np.linalg.inv(flange_pose(home_rad)) @ tcp

    # -- state --------------------------------------------------------------------------------
    def read(self) -> Reading:
        """The newest state; an arm that stands is also sent its settings, or released."""
        robot = self.robot
        try:
            with self._referring:
                in_control, state = robot.is_in_control, robot.state
        except RuntimeError as error:  # of libfranka's network, too
            raise NodeError(
                f"the robot fell silent ({in_words(error)}). Is its cable plugged in, and FCI "
                "active? The node restarts and reconnects; then activate the arm again"
            ) from error
        if self._was_in_control and not in_control:
            self._motion, self._ended = None, ""  # it was released, or ended by itself
            try:
                robot.poll_motion()
            except self._franky.Exception as error:
                self._ended = in_words(error)
        self._was_in_control = in_control
        still_ns = time.monotonic_ns() - self._moved_ns
        if in_control and still_ns > REST_S * 1e9 and self._motion is not None:
            self._motion = None  # the robot's own controller holds the arm from here
            robot.move(self._franky.TorqueStopMotion(), asynchronous=True)
        self._update(state)
        mode = state.robot_mode.name
        if mode == "Idle" and not self._configured:
            self._configure()
        return Reading(
            state.q,
            state.dq,
            state.tau_ext_hat_filtered,
            **({} if self._hand is None else self._hand.state()._asdict()),
            wrench=external_wrench(state.O_F_ext_hat_K),
            fault=self._fault(mode),
            mode="" if mode in READY | STOPPED else mode,
            measured_ns=self._measured_ns,
            idle=self._motion is None,
        )

    def _update(self, state: Any) -> None:
        if state.time != self._time:  # unchanged: the robot is silent
            self._time, self._measured_ns = state.time, time.monotonic_ns()
        self._state = state

    def _fault(self, mode: str) -> str:
        state = self._state
        names = error_names(state.current_errors) or error_names(state.last_motion_errors)
        if mode == "Reflex":
            return f"Reflex: {', '.join(names) or self._ended or 'no error named'}"
        if mode == "UserStopped":
            return "UserStopped: the user stop or the enabling device stopped the arm"
        if self._hand is not None and self._hand.fault:
            return f"hand: {self._hand.fault}"
        return self._ended

    def status(self) -> Mapping[str, Any]:
        """Robot mode, errors and quality of the connection."""
        state = self._state
        return {
            "robot_mode": state.robot_mode.name,
            "errors": error_names(state.current_errors),
            "last_motion_errors": error_names(state.last_motion_errors),
            "control_command_success_rate": float(state.control_command_success_rate),
            "tau_j_nm": [round(float(torque), 2) for torque in state.tau_J],
            "in_control": self._was_in_control,
            "configured": self._configured,
            "hand_failed": "" if self._hand is None else self._hand.failed,
        }

    # -- motion -------------------------------------------------------------------------------
    def move(self, command: Command) -> None:
        """Give the loop its set-point, and start the loop if it does not run."""
        if self._ended or not self._configured:
            return  # reported as a fault; only `recover` ends it
        now_ns = time.monotonic_ns()
        elapsed_s = min((now_ns - self._moved_ns) / 1e9, LONGEST_S)
        self._moved_ns = now_ns
        starts = self._motion is None
        if starts:
            self._motion, elapsed_s = self._new_motion(), 0.0
            self._trim = Trim(7 if isinstance(command, JointCommand) else 6)
        with self._referring:
            self._motion.set_reference(self._reference(command, self._state, elapsed_s))
            self._command, self._led = command, True
        if starts:
            with realtime_children():
                self.robot.move(self._motion, asynchronous=True)
            self._was_in_control = True

    def _hold(self) -> None:
        """Thread that brings the arm to rest at its last set-point while the next one is overdue.

        The loop keeps a set-point with its velocity, and the spring would pull the arm beyond it.
        """
        period_s = self._timeout_s / 4
        while not self._closed.wait(period_s):
            if self._motion is None or not self._overdue:
                continue
            with self._referring, suppress(RuntimeError):  # `read` reports the failure
                motion, robot = self._motion, self.robot
                if motion is None or robot is None or not self._overdue or not robot.is_in_control:
                    continue
                if self._led:  # the trim for friction in motion would now push beyond it
                    self._led, self._trim = False, Trim(self._trim.columns)
                still = at_rest(self._command)
                motion.set_reference(self._reference(still, robot.state, period_s))

    @property
    def _overdue(self) -> bool:
        return time.monotonic_ns() - self._moved_ns > self._timeout_s * 1e9

    def _new_motion(self) -> Any:
        franky, settings = self._franky, self._settings
        if self._profile.robot.command == "joint":
            return franky.JointImpedanceTrackingMotion(
                stiffness=list(settings.joint_stiffness_nm_rad)
            )
        posture = franky.PostureTask(
            self._state.q, settings.posture_stiffness_nm_rad, max_torque=MOST_POSTURE_NM
        )
        return franky.CartesianImpedanceTrackingMotion(
            translational_stiffness=settings.stiffness_n_m,
            rotational_stiffness=settings.stiffness_nm_rad,
            translational_error_clip=[settings.collision_force_n / settings.stiffness_n_m] * 3,
            rotational_error_clip=[MOST_TCP_NM / settings.stiffness_nm_rad] * 3,
            posture_task=posture,
        )

    def _reference(self, command: Command, state: Any, elapsed_s: float) -> Any:
        """The set-point for the loop, trimmed."""
        franky = self._franky
        if isinstance(command, JointCommand):
            left = command.position_rad - state.q
            most = MOST_JOINT_NM / self._settings.joint_stiffness_nm_rad
            ahead = np.clip(left + self._trim.update(left, elapsed_s), -most, most)
            return franky.JointReference(state.q + ahead, command.velocity_rad_s)
        rotation = rotation_from_quat(command.quat_xyzw)
        measured = state.O_T_EE.matrix
        left = np.concatenate(
            (command.position_m - measured[:3, 3], log3(rotation @ measured[:3, :3].T))
        )
        trim = self._trim.update(left, elapsed_s)
        twist, acceleration = command.twist, command.acceleration
        quat_xyzw = quat_from_rotation(exp3(trim[3:]) @ rotation)
        return franky.CartesianReference(
            franky.Affine(command.position_m + trim[:3], quat_xyzw),
            franky.Twist(twist[:3], twist[3:]),
            franky.TwistAcceleration(acceleration[:3], acceleration[3:]),
        )

    def recover(self) -> None:
        """Clear the robot's errors, in a thread: it may take seconds."""
        if self._recovery is None or not self._recovery.is_alive():
            self._recovery = threading.Thread(target=self._recover, name="recovery", daemon=True)
            self._recovery.start()

    def _recover(self) -> None:
        mode = self._state.robot_mode.name
        if mode != "Reflex" and not self._ended:
            return
        try:
            if mode == "Reflex":
                self.robot.recover_from_errors()
        except self._franky.Exception as error:
            self._ended = f"recovery: {in_words(error)}"
        else:
            self._ended = ""

    def grip(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Move the fingers: closing grasps with `force_n`."""
        if self._hand is not None:
            self._hand.ask(width_m, speed_m_s, force_n)


def at_rest(command: Command) -> Command:
    """The same set-point, without velocity and acceleration."""
    if isinstance(command, JointCommand):
        still = np.zeros_like(command.velocity_rad_s)
        return replace(command, velocity_rad_s=still, acceleration_rad_s2=still)
    return replace(command, twist=np.zeros(6), acceleration=np.zeros(6))


def external_wrench(reported: Any) -> FloatArray | None:
    """(6,) N and Nm that the surroundings exert on the arm; None: the robot does not know them.

    It reports what the robot exerts on the surroundings, and zeros near a singularity (`RobotState`
    in the documentation of libfranka): a force limit that took these for no force would be none.
    """
    wrench = -np.array(reported, dtype=np.float64)
    return wrench if wrench.any() else None


def _in_time(make: Callable[[], Any], what: str) -> Any:
    """Result of `make`, or a `NodeError` after `CONNECT_S`: the library itself waits for ever."""
    made: Future[Any] = Future()

    def run() -> None:
        try:
            made.set_result(make())
        except BaseException as error:
            made.set_exception(error)

    threading.Thread(target=run, name="connection", daemon=True).start()
    try:
        return made.result(CONNECT_S)
    except TimeoutError as error:
        if made.done():
            raise  # its own
        why = f"{what}: no answer within {CONNECT_S:g} s; restart its control box?"
        raise NodeError(why) from error


def error_names(errors: Any) -> list[str]:
    """Franka's names of the errors that are set."""
    return [name for name in dir(errors) if not name.startswith("_") and getattr(errors, name)]


def flange_pose(position_rad: FloatArray) -> FloatArray:
    """(4, 4): the flange in the base frame, with the joints at `position_rad` (7,).

    Source: "Robot and interface specifications" of the Franka Control Interface documentation; the
    same for Panda and FR3.
    """
    pose = np.eye(4)
    for (a, d, alpha), theta in zip(CRAIG, position_rad, strict=True):
        ct, st, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        pose = pose @ np.array(
            [
                [ct, -st, 0.0, a],
                [st * ca, ct * ca, -sa, -d * sa],
                [st * sa, ct * sa, ca, d * ca],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    pose[:3, 3] += FLANGE_M * pose[:3, 2]
    return pose


class Trim:
    """Compensates joint friction: a bounded correction that is added to a motion's set-points.

    A spring stops short of its goal by the friction divided by its stiffness. The integral part
    removes that over time; alone it overshoots and creeps from side to side, which the proportional
    part prevents. `columns` are 6 for a pose (m, rad), 7 for joints (rad).
    """

    def __init__(self, columns: int) -> None:
        self.columns = columns
        self._integral: FloatArray = np.zeros(columns)

    def update(self, left: FloatArray, elapsed_s: float) -> FloatArray:
        """The correction for `left`, set-point minus measured value, `elapsed_s` after the last."""
        self._integral = self._bounded(self._integral + elapsed_s / INTEGRAL_S * left)
        return self._bounded(self._integral + PROPORTION * left)

    def _bounded(self, trim: FloatArray) -> FloatArray:
        if self.columns != 6:
            return np.clip(trim, -MOST_JOINT_RAD, MOST_JOINT_RAD)
        return np.concatenate((_shortened(trim[:3], MOST_M), _shortened(trim[3:], MOST_RAD)))


def _shortened(vector: FloatArray, most: float) -> FloatArray:
    """`vector` (3,), shortened to a length of `most`."""
    return vector * min(1.0, most / max(float(np.linalg.norm(vector)), 1e-12))
