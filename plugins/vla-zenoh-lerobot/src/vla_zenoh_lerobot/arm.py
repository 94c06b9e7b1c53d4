# /// script
# requires-python = ">=3.12,<3.14"
# dependencies = ["lerobot[dynamixel,feetech]==0.6.1"]
# ///
"""A robot class of LeRobot (SO-100, SO-101, Koch, ...), run in its own environment.

LeRobot drives the motors and keeps their calibration; its cameras are not used. Its joints are in
degrees, or -100 to 100 from one end to the other, and its gripper in 0 to 100. It reports neither
velocity nor torque.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from vla_zenoh.errors import NodeError, in_words
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.profile import Profile
from vla_zenoh.robot import Command, Reading
from vla_zenoh.types import JointCommand
from vla_zenoh_lerobot.plugin import LeRobotOptions

LOST_S = 1.0
"""Motors that did not answer for this long count as lost."""
OPEN = 100.0
STILL, HELD = 1.0, 4.0
"""The gripper stands if it moved by less, and holds an object if it is open wider than commanded by
this much; both of 100."""
STILL_S = 0.3


class LeRobotArm:
    """The arm of a profile with a section lerobot; see `vla_zenoh.robot.Robot`."""

    def __init__(self, profile: Profile, options: LeRobotOptions) -> None:
        settings = self._settings = options
        names = profile.robot.arm_joints
        self._keys = [f"{name}.pos" for name in settings.motors or names]
        self._gripper = f"{settings.gripper}.pos" if settings.gripper else ""
        if settings.gripper:
            profile.robot.require_gripper(f"lerobot.gripper {settings.gripper!r}")
        self._width_m = profile.robot.max_width_m
        sign = np.array([-1.0 if name in settings.reversed else 1.0 for name in names])
        kinematics = make_kinematics(profile)
        order = [kinematics.arm_joints.index(name) for name in names]
        if settings.units == "degrees":
            if slides := list(itertools.compress(names, kinematics.slides[order])):
                raise NodeError(
                    f"{', '.join(slides)} slides, and degrees are of joints that turn; set "
                    "lerobot.units: normalised"
                )
            self._zero = np.array(settings.zero_deg or (0.0,) * len(names))
            self._unit_rad = sign * np.pi / 180
        else:
            lower, upper = kinematics.lower_rad[order], kinematics.upper_rad[order]
            if endless := list(itertools.compress(names, kinematics.endless[order])):
                raise NodeError(
                    f"{', '.join(endless)} turns without an end: normalised units need two; set "
                    "lerobot.units: degrees"
                )
            self._unit_rad = sign * (upper - lower) / 200
            self._zero = -(upper + lower) / 2 / self._unit_rad
        self._robot: Any = None
        self._read_s = 0.0
        self._grip_was, self._grip_moved_s, self._gripping = OPEN, 0.0, False
        self._asked: float | None = None
        self._failed = 0
        if not self._gripper:
            vars(self)["grip"] = None  # commands of the gripper are rejected then

    # -- connection ---------------------------------------------------------------------------
    def connect(self) -> None:
        """Connect to the motors, or raise a `NodeError`; they go limp for a moment."""
        settings, lerobot = self._settings, import_module("lerobot.robots")
        folder = Path(settings.calibration_dir).expanduser() if settings.calibration_dir else None
        given = {
            "port": settings.port,
            "id": settings.id,
            "calibration_dir": folder,
            "use_degrees": settings.units == "degrees",
            "disable_torque_on_disconnect": settings.limp_at_end,
        }
        try:
            # Packages lerobot_robot_*, and lerobot_camera_* that they may use.
            import_module("lerobot.utils.import_utils").register_third_party_plugins()
            kind = lerobot.RobotConfig.get_choice_class(settings.robot)
            known = {field.name for field in fields(kind)}  # a plug-in's robot may have no port
            config = kind(**{name: value for name, value in given.items() if name in known})
            robot = self._robot = lerobot.make_robot_from_config(config)
        except Exception as error:
            raise NodeError(f"LeRobot's {settings.robot}: {in_words(error)}") from error
        missing = {*self._keys, *filter(None, [self._gripper])} - set(robot.action_features)
        if missing:
            raise NodeError(
                f"{settings.robot} has no {', '.join(sorted(missing))}; it has "
                f"{', '.join(robot.action_features)}. Set lerobot.motors and lerobot.gripper"
            )
        told = f"--robot.type={settings.robot} --robot.port={settings.port}"
        calibrate = f"run `lerobot-calibrate {told} --robot.id={settings.id}`"
        if not robot.calibration:
            raise NodeError(f"there is no calibration {robot.calibration_fpath}; {calibrate}")
        try:
            robot.connect(calibrate=False)
            calibrated = robot.is_calibrated
        except Exception as error:  # each bus raises its own
            raise NodeError(f"{settings.port}: {in_words(error)}") from error
        if not calibrated:
            raise NodeError(f"its motors have another calibration than {settings.id}; {calibrate}")
        self._read_s = time.monotonic()

    def close(self) -> None:
        """Disconnect; the motors hold the arm, unless the profile says otherwise."""
        if self._robot is not None and self._robot.is_connected:
            self._robot.disconnect()

    # -- state --------------------------------------------------------------------------------
    def read(self) -> Reading | None:
        """The newest state; None if the motors missed an answer, a `NodeError` if for too long."""
        now_s = time.monotonic()
        try:
            found = self._robot.get_observation()
        except (OSError, RuntimeError) as error:  # a corrupt packet, or an unplugged cable
            self._failed += 1
            if now_s - self._read_s > LOST_S:
                raise NodeError(f"{self._settings.port}: {in_words(error)}") from error
            return None
        self._read_s = now_s
        units = np.array([found[key] for key in self._keys])
        position_rad = (units - self._zero) * self._unit_rad
        if not self._gripper:
            return Reading(position_rad)
        opening = float(found[self._gripper])
        if abs(opening - self._grip_was) > STILL:
            self._grip_was, self._grip_moved_s = opening, now_s
        if now_s - self._grip_moved_s > STILL_S:
            self._gripping = False
        asked = opening if self._asked is None else self._asked
        return Reading(
            position_rad,
            width_m=min(max(opening / OPEN, 0.0), 1.0) * self._width_m,
            moving=self._gripping,
            holding=not self._gripping and opening > asked + HELD,
        )

    def status(self) -> Mapping[str, Any]:
        """Which robot it is, and how many answers of its motors were missed."""
        return {
            "lerobot": self._settings.robot,
            "calibration": str(self._robot.calibration_fpath),
            "failed_reads": self._failed,
        }

    # -- motion -------------------------------------------------------------------------------
    def move(self, command: Command) -> None:
        """Send the set-point."""
        assert isinstance(command, JointCommand)
        units = command.position_rad / self._unit_rad + self._zero
        self._robot.send_action(dict(zip(self._keys, units.tolist(), strict=True)))

    def grip(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        """Send the opening; the motor has its own speed and force."""
        self._asked = OPEN * min(max(width_m / self._width_m, 0.0), 1.0)
        self._grip_moved_s, self._gripping = time.monotonic(), True
        self._robot.send_action({self._gripper: self._asked})
