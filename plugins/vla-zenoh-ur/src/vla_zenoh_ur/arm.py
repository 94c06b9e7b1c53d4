"""A UR arm over RTDE, with the library ur_rtde: set-points by ``servoj``, without ROS.

The library uploads a control program; it runs on the robot and follows the newest set-point, which
it holds when none comes. The robot's own watchdog stops that program when this computer falls
silent. Only `connect` and an operator's ``reset`` start the program again: the library reconnects
on its own, and is configured not to upload the program then.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np

from vla_zenoh.errors import MissingExtraError, NodeError, in_words
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.profile import Profile
from vla_zenoh.robot import Command, Reading
from vla_zenoh.types import FloatArray, JointCommand
from vla_zenoh_ur.plugin import UrOptions

PORTS = (29999, 30004)
"""Dashboard server and RTDE."""
CONNECT_S, START_S, RELEASE_S = 2.0, 5.0, 2.0
LOST_S, DOUBTFUL_S = 1.0, 0.3
"""A robot that was silent for this long counts as lost."""
KICK_S = 0.02
FULL_SPEED = 0.995
RUNNING = "RUNNING"
ROBOT_MODES = {
    -1: "NO_CONTROLLER",
    0: "DISCONNECTED",
    1: "CONFIRM_SAFETY",
    2: "BOOTING",
    3: "POWER_OFF",
    4: "POWER_ON",
    5: "IDLE",
    6: "BACKDRIVE",
    7: RUNNING,
    8: "UPDATING_FIRMWARE",
}
SAFETY_MODES = {
    1: "NORMAL",
    2: "REDUCED",
    3: "PROTECTIVE_STOP",
    4: "RECOVERY",
    5: "SAFEGUARD_STOP",
    6: "SYSTEM_EMERGENCY_STOP",
    7: "ROBOT_EMERGENCY_STOP",
    8: "VIOLATION",
    9: "FAULT",
    10: "VALIDATE_JOINT_ID",
    11: "UNDEFINED_SAFETY_MODE",
    12: "AUTOMATIC_MODE_SAFEGUARD_STOP",
    13: "SYSTEM_THREE_POSITION_ENABLING_STOP",
    14: "TP_THREE_POSITION_ENABLING_STOP",
}
WELL = ("NORMAL", "REDUCED")
VARIABLES = [
    "timestamp",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "actual_TCP_force",
    "robot_mode",
    "safety_mode",
    "robot_status_bits",
    "speed_scaling",
    "target_speed_fraction",
]
PROGRAM_RUNS = 1 << 1
"""Of the robot status bits."""
_ABANDONED: list[Any] = []


class UrArm:
    """The arm of a profile with a section ur; see `vla_zenoh.robot.Robot`."""

    def __init__(self, profile: Profile, options: UrOptions) -> None:
        self._settings, self.address = options, options.address
        modules = "rtde_control", "rtde_receive", "dashboard_client"
        try:
            self._library: dict[str, Any] = {name: import_module(name) for name in modules}
        except ImportError as error:
            raise MissingExtraError("ur_rtde", "rtde", "vla-zenoh-ur") from error
        self._rate_hz = min(profile.timing.command_hz, 500.0)
        self._period_s = 1.0 / profile.timing.command_hz
        kinematics = make_kinematics(profile)
        reached = kinematics.forward(np.zeros(len(profile.robot.arm_joints))).position_m
        # With all joints at 0 a UR reaches along -x of its own base; ROS turns that base by pi.
        self._turn = np.diag([-1.0, -1.0, 1.0] if reached[0] > 0 else [1.0, 1.0, 1.0])
        self._control: Any = None
        self._receive: Any = None
        self._starting: threading.Thread | None = None
        self._started = self._watched = False
        self._stopped = "the control program has not been started"
        self._robot_s: float | None = None
        self._measured_ns = self._sent_ns = 0

    # -- connection ---------------------------------------------------------------------------
    def connect(self) -> None:
        """Connect, and start the control program if the robot is ready for it.

        Raises:
            NodeError: the robot does not answer, or accepts no programs from this computer.
        """
        self.open()
        control, address = self._library["rtde_control"].RTDEControlInterface, self.address
        try:
            # No upload: after a lost connection the library would start the program again.
            self._control = control(address, self._rate_hz, control.FLAG_NO_WAIT)
        except RuntimeError as error:
            raise NodeError(f"{address}: {in_words(error)}") from error
        if self.safety_mode in WELL and self._mode() == RUNNING:
            self._start()

    def open(self) -> None:
        """Connect for reading only; a `NodeError` if the robot does not answer."""
        address = self.address
        for port in PORTS:  # the library holds the GIL while it waits for an answer
            try:
                socket.create_connection((address, port), CONNECT_S).close()
            except OSError as error:
                raise NodeError(
                    f"{address}: no answer on port {port}: {in_words(error)}. Is the robot on, is "
                    "this its address, and are RTDE and dashboard server enabled in its security "
                    "settings?"
                ) from error
        try:
            self._receive = self._library["rtde_receive"].RTDEReceiveInterface(
                address, self._rate_hz, VARIABLES
            )
        except RuntimeError as error:
            raise NodeError(f"{address}: {in_words(error)}") from error
        self._update()

    def close(self) -> None:
        """Stop the control program and disconnect."""
        control, receive = self._control, self._receive
        if receive is not None:
            self._update()
        self._control = self._receive = None
        links = [link for link in (control, receive) if link is not None]
        if not all(link.isConnected() for link in links) or self._silent_s > DOUBTFUL_S:
            # The library crashes if it disconnects while it reconnects; so does its destructor.
            _ABANDONED.append((control, receive))
            return
        if control is not None:
            control.stopScript()
            control.disconnect()
        if receive is not None:
            receive.disconnect()

    def _start(self) -> None:
        """Start the control program, and apply the profile's tool and payload."""
        settings, control = self._settings, self._control
        try:
            control.reuploadScript()
            if not _wait(control.isProgramRunning, START_S):
                raise RuntimeError("the control program did not start")
            tool = [*settings.tcp_m, *settings.tcp_rotvec]
            payload = settings.payload_kg, list(settings.payload_centre_m)
            if not (control.setTcp(tool) and control.setPayload(*payload)):
                raise RuntimeError("the robot did not take tool and payload")
        except RuntimeError as error:
            self._stopped = in_words(error)
        else:
            self._started, self._watched, self._stopped = True, False, ""

    # -- state --------------------------------------------------------------------------------
    def read(self) -> Reading:
        """The newest state; a `NodeError`, and so a restart, after too long a silence."""
        self._update()
        if self._silent_s > LOST_S:
            raise NodeError(
                f"{self.address}: connection lost; the robot's watchdog stops its program, and "
                "holds the arm"
            )
        if self._started and not self._program_runs:
            self._started = False
            self._stopped = "the control program was stopped (at the pendant, or by the watchdog)"
        if self._started and not self._watched:
            # Not in `connect`: a node does more between that and its first tick than the watchdog
            # allows.
            self._watched = self._control.setWatchdog(self._settings.watchdog_hz)
        receive, now_ns = self._receive, time.monotonic_ns()
        if self._started and now_ns - self._sent_ns > KICK_S * 1e9:
            self._sent_ns = now_ns
            self._send(self._control.kickWatchdog)
        return Reading(
            receive.getActualQ(),
            receive.getActualQd(),
            wrench=(np.reshape(receive.getActualTCPForce(), (2, 3)) @ self._turn).ravel(),
            fault=self._fault(),
            mode=self._not_ready(),
            measured_ns=self._measured_ns,
            idle=not self._started,
        )

    def _update(self) -> None:
        robot_s = self._receive.getTimestamp()
        if robot_s != self._robot_s:  # unchanged: the robot is silent
            self._robot_s, self._measured_ns = robot_s, time.monotonic_ns()

    @property
    def _silent_s(self) -> float:
        """Silence: the library's own connection flag means nothing for the first seconds."""
        return (time.monotonic_ns() - self._measured_ns) / 1e9

    def _fault(self) -> str:
        if (safety := self.safety_mode) not in WELL:
            return f"safety mode {safety}" + (f": {self._stopped}" if self._stopped else "")
        if self._started or self._busy or self._mode() != RUNNING:
            return ""
        return f"{self._stopped}; `vla-zenoh reset` starts it"

    @property
    def _busy(self) -> bool:
        return self._starting is not None and self._starting.is_alive()

    def _not_ready(self) -> str:
        if self._mode() != RUNNING:
            return f"robot mode {self._mode()}"
        slider = self._receive.getTargetSpeedFraction()
        if slider < FULL_SPEED:  # the robot would fall behind its set-points
            return f"speed slider at {100 * slider:.0f} %"
        return "" if self._started and self._watched else "starting"

    def _mode(self) -> str:
        mode = self._receive.getRobotMode()
        return ROBOT_MODES.get(mode, f"UNKNOWN_{mode}")

    @property
    def _program_runs(self) -> bool:
        return bool(self._receive.getRobotStatus() & PROGRAM_RUNS)

    def status(self) -> Mapping[str, Any]:
        """Modes by UR's names, program, speed slider and scaling."""
        receive = self._receive
        return {
            "robot_mode": self._mode(),
            "safety_mode": self.safety_mode,
            "program_runs": self._program_runs,
            "speed_slider": round(receive.getTargetSpeedFraction(), 3),
            "speed_scaling": round(receive.getSpeedScaling(), 3),
            "tool_set": self._started,
        }

    # -- motion -------------------------------------------------------------------------------
    def move(self, command: Command) -> None:
        """Send the set-point; a `NodeError` if the connection is lost."""
        assert isinstance(command, JointCommand)
        if not (self._started and self._watched):
            return  # reported as a fault; only `recover` ends it
        self._update()
        if self._silent_s > LOST_S:
            raise NodeError(f"{self.address}: connection lost")
        settings, self._sent_ns = self._settings, time.monotonic_ns()
        # Speed and acceleration are not used by servoj.
        more = 0.0, 0.0, self._period_s, settings.lookahead_s, settings.gain
        self._send(self._control.servoJ, list(command.position_rad), *more)

    def _send(self, call: Any, *given: Any) -> None:
        try:
            call(*given)
        except RuntimeError as error:
            raise NodeError(f"{self.address}: connection lost: {in_words(error)}") from error

    def recover(self) -> None:
        """Release a protective stop and start the control program, in a thread."""
        works = self._started and self._program_runs and self.safety_mode in WELL
        if not self._busy and not works:
            self._started = False  # `read` may not have noticed yet that the program has ended
            self._starting = threading.Thread(target=self._recover, name="recovery", daemon=True)
            self._starting.start()

    def _recover(self) -> None:
        if self.safety_mode == "PROTECTIVE_STOP":
            dashboard = self._library["dashboard_client"].DashboardClient(self.address)
            try:
                dashboard.connect()
                dashboard.unlockProtectiveStop()
                dashboard.closeSafetyPopup()
            except RuntimeError as error:
                self._stopped = in_words(error)
                return
            finally:
                dashboard.disconnect()
            _wait(lambda: self.safety_mode in WELL, RELEASE_S)
        if self.safety_mode in WELL and self._mode() == RUNNING:
            self._start()

    # -- for `robot check` --------------------------------------------------------------------
    @property
    def safety_mode(self) -> str:
        """UR's name of the safety mode."""
        mode = self._receive.getSafetyMode()
        return SAFETY_MODES.get(mode, f"UNKNOWN_{mode}")

    def measured(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Joints (6,), and position (3,) and rotation vector (3,) of its own TCP, in our base."""
        pose = np.array(self._receive.getActualTCPPose())
        return np.array(self._receive.getActualQ()), self._turn @ pose[:3], self._turn @ pose[3:]


def _wait(for_it: Any, timeout_s: float) -> bool:
    end_s = time.monotonic() + timeout_s
    while not for_it():
        if time.monotonic() > end_s:
            return False
        time.sleep(0.01)
    return True
