"""A WidowX AI by the maker's library ``trossen_arm``, driven by targets of its joints.

A thread of that library speaks to the controller, about a thousand times a second, with the newest
target that it was given. It does not tell when the controller falls silent, and the controller's
UDP port takes targets from anyone: what these lead to is found here.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import numpy as np

from vla_zenoh.errors import MissingExtraError, NodeError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.profile import Profile
from vla_zenoh.robot import Command, Reading
from vla_zenoh.types import FloatArray, JointCommand
from vla_zenoh_trossen.bounds import Bounds, JointBound
from vla_zenoh_trossen.hand import Hand
from vla_zenoh_trossen.plugin import ARM_JOINTS, TrossenOptions

CONNECT_S, LOST_S = 3.0, 0.5
"""A controller that starts answers within the first; without an answer it is lost after the
second."""
APART_S = 0.2
"""So long further than `follow_rad` from its target is a fault."""
AT_ONCE_S = 0.0
"""The library interpolates to targets that have more time."""
LIBRARY_ERRORS = (RuntimeError, AssertionError)
"""Its own derive from these."""
OF_CONTROLLER = "Error occurred"
"""How the library begins to tell an error of the controller; any other one ends the node."""


class TrossenArm:
    """The arm of a profile with a section trossen; see `vla_zenoh.robot.Robot`."""

    def __init__(self, profile: Profile, options: TrossenOptions) -> None:
        self._profile, self._options = profile, options
        try:
            self._library: Any = import_module("trossen_arm")
        except ImportError as error:
            raise MissingExtraError("trossen_arm", "arm", "vla-zenoh-trossen") from error
        kinematics = make_kinematics(profile)
        order = [kinematics.arm_joints.index(name) for name in profile.robot.arm_joints]
        self._range_rad = kinematics.lower_rad[order], kinematics.upper_rad[order]
        self._period_s = 1.0 / profile.timing.command_hz
        if options.end_effector == "no_gripper":
            vars(self)["grip"] = None  # commands of the gripper are rejected then
        self._driver: Any = None
        self._bounds: Bounds | None = None
        self._hand: Hand | None = None
        self._firmware = self._fault = ""
        """Why nothing is sent; only `recover` ends that."""
        self._number: int | None = None
        self._measured_ns = 0
        self._position_rad: FloatArray = np.zeros(ARM_JOINTS)
        self._velocity_rad_s: FloatArray = np.zeros(ARM_JOINTS)
        self._external_nm: FloatArray = np.zeros(ARM_JOINTS)
        self._hottest_c = 0.0
        self._target_rad: FloatArray = np.zeros(ARM_JOINTS)
        self._sent_s = 0.0
        self._moved = False
        self._apart_s: float | None = None
        """Since when the arm is not where it was sent."""
        self._not_sent = 0
        self._starting: threading.Thread | None = None

    # -- connection ---------------------------------------------------------------------------
    def connect(self) -> None:
        """Connect, open the brakes and hold the arm where it is, or raise a `NodeError`."""
        self._open(clear=self._options.clear_error)

    def _open(self, *, clear: bool) -> None:
        library, options = self._library, self._options
        self._driver = driver = library.TrossenArmDriver()
        end_effector = getattr(library.StandardEndEffector, options.end_effector)
        try:
            driver.configure(library.Model.wxai_v0, end_effector, options.address, clear, CONNECT_S)
        except LIBRARY_ERRORS as error:
            raise NodeError(
                f"{options.address}: {_words(error)}. Is the controller on, is this its address, "
                "and is no other program connected to it? An error of it is cleared with "
                "trossen.clear_error: true"
            ) from error
        try:
            self._firmware = driver.get_controller_version()
            self._take_limits(driver.get_joint_limits())
            driver.set_all_modes(library.Mode.position)
            self._take(driver.get_robot_output())
            self._hold()
        except LIBRARY_ERRORS as error:
            raise NodeError(f"{options.address}: {_words(error)}") from error
        self._measured_ns = time.monotonic_ns()

    def _take_limits(self, limits: Any) -> None:
        found = [JointBound(one.position_min, one.position_max, one.velocity_max) for one in limits]
        names = self._profile.robot.arm_joints
        self._bounds = bounds = Bounds(names, found[:ARM_JOINTS])
        lower_rad, upper_rad = self._range_rad
        fastest_rad_s = np.full(ARM_JOINTS, self._profile.limits.joint.velocity_rad_s)
        if wider := "; ".join(bounds.narrower_than(lower_rad, upper_rad, fastest_rad_s)):
            raise NodeError(f"{self._options.address}: {wider}")
        if self._options.end_effector != "no_gripper":
            self._hand = Hand(found[-1].upper, found[-1].velocity)

    def close(self) -> None:
        """Close the brakes and disconnect."""
        driver, self._driver = self._driver, None
        if self._starting is not None:
            self._starting.join()
        if driver is not None:
            driver.cleanup()

    # -- state --------------------------------------------------------------------------------
    def read(self) -> Reading | None:
        """The newest state; a `NodeError`, and so a restart, after too long a silence."""
        now_s = time.monotonic()
        new = False
        if not (self._fault or self._busy):
            new = bool(self._ask(self._newest))
            age_s = now_s - self._measured_ns / 1e9
            if not self._fault and age_s > LOST_S:
                raise NodeError(
                    f"{self._options.address}: no answer for {age_s:.1f} s: is the controller on, "
                    "and is its cable in?"
                )
            if not self._fault:
                self._check_apart(now_s)
        if not (new or self._fault):
            return None
        hand = self._hand
        return Reading(
            self._position_rad,
            self._velocity_rad_s,
            self._external_nm,
            width_m=None if hand is None else hand.width_m,
            moving=hand is not None and hand.moving(now_s),
            holding=hand is not None and hand.holding(now_s),
            fault=self._fault,
            measured_ns=self._measured_ns,
            idle=not self._moved,
        )

    def _newest(self) -> bool:
        return self._take(self._driver.get_robot_output())

    def _take(self, output: Any) -> bool:
        """Whether this is another answer than the last one."""
        if output.header.id == self._number:
            return False
        self._number, self._measured_ns = output.header.id, time.monotonic_ns()
        joints = output.joint.all
        self._position_rad = np.array(joints.positions)[:ARM_JOINTS]
        self._velocity_rad_s = np.array(joints.velocities)[:ARM_JOINTS]
        self._external_nm = np.array(joints.external_efforts)[:ARM_JOINTS]
        self._hottest_c = float(np.max(joints.rotor_temperatures))
        if self._hand is not None:
            self._hand.take(joints.positions[ARM_JOINTS], joints.velocities[ARM_JOINTS])
        return True

    def _check_apart(self, now_s: float) -> None:
        apart_rad = np.abs(self._position_rad - self._target_rad)
        index = int(np.argmax(apart_rad))
        if apart_rad[index] <= self._options.follow_rad:
            self._apart_s = None
            return
        self._apart_s = now_s if self._apart_s is None else self._apart_s
        if now_s - self._apart_s < APART_S:
            return
        name = self._profile.robot.arm_joints[index]
        self._ask(self._hold)  # where it is: it shall not push on
        self._fault = self._fault or (
            f"{name} is {apart_rad[index]:.2f} rad from its target: something blocks it, or "
            "another program commands the arm"
        )

    def _ask(self, call: Callable[..., Any], *given: Any) -> Any:
        """The answer of the library; an error of the controller is the arm's fault."""
        try:
            return call(*given)
        except LIBRARY_ERRORS as error:
            words = _words(error)
            if not words.startswith(OF_CONTROLLER):
                raise NodeError(f"{self._options.address}: {words}") from error
            self._fault = words
            return None

    @property
    def _busy(self) -> bool:
        return self._starting is not None and self._starting.is_alive()

    def status(self) -> Mapping[str, Any]:
        """Address, firmware, the hottest motor, and how many targets were not sent."""
        return {
            "address": self._options.address,
            "firmware": self._firmware,
            "hottest_rotor_c": round(self._hottest_c, 1),
            "not_sent": self._not_sent,
        }

    # -- motion -------------------------------------------------------------------------------
    def move(self, command: Command) -> None:
        """Give the set-point to the library; one that the controller does not allow is a fault."""
        assert isinstance(command, JointCommand)
        if self._fault or self._busy:
            return  # only `recover` ends that
        now_s = time.monotonic()
        elapsed_s = min(max(now_s - self._sent_s, self._period_s), APART_S)
        assert self._bounds is not None
        target_rad = np.array(command.position_rad)
        if why := self._bounds.why_not(target_rad, self._target_rad, elapsed_s):
            self._not_sent += 1
            self._fault = f"{why}: not sent"
            return
        self._ask(self._send, target_rad)
        self._moved = True

    def _send(self, target_rad: FloatArray) -> None:
        assert self._bounds is not None
        self._target_rad, self._sent_s = target_rad, time.monotonic()
        inside_rad = self._bounds.inside(target_rad).tolist()
        self._driver.set_arm_positions(inside_rad, AT_ONCE_S, False)

    def _hold(self) -> None:
        """Make the arm's target where it is."""
        self._send(self._position_rad)
        self._moved, self._apart_s = False, None

    def grip(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Start a motion of the fingers; the force is the controller's."""
        if self._fault or self._busy or self._hand is None:
            return
        travel_m, time_s = self._hand.ask(width_m, speed_m_s, time.monotonic())
        self._ask(self._driver.set_gripper_position, travel_m, time_s, False)

    def recover(self) -> None:
        """Connect anew, clear the controller's error and hold the arm, in a thread."""
        if self._fault and not self._busy:
            self._starting = threading.Thread(target=self._recover, name="recovery", daemon=True)
            self._starting.start()

    def _recover(self) -> None:
        self._driver.cleanup()  # closes the brakes
        try:
            self._open(clear=True)
        except NodeError as error:
            self._fault = str(error)
        else:
            self._fault = ""


def _words(error: BaseException) -> str:
    """What the library says: not where its guide is, nor what the controller's log begins with."""
    printable = "".join(sign for sign in str(error) if sign == "\n" or sign.isprintable())
    lines = printable.splitlines()
    return "; ".join(line for line in lines if line and "troubleshooting" not in line)
