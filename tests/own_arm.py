"""An arm as a lab would write it, for tests: MuJoCo in a thread plays the hardware.

Its controller keeps time by itself, and holds what it was told last, like the one in a real arm.
`trouble` names a file: what is written there happens to the arm.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path

from vla_zenoh.kinematics.so3 import rotation_from_quat
from vla_zenoh.profile import load_profile
from vla_zenoh.robot import Command, Reading
from vla_zenoh.simulation.world import STEP_NS, build_world
from vla_zenoh.types import GripperState, JointCommand, JointReference, JointState, PoseReference

CONNECT_S = 12.0
"""Longer than a node may say nothing."""


class OwnArm:
    """See the module.

    Args:
        profile: whose simulated twin it is, by name or path.
        trouble: path of the file; empty: it has none.
    """

    def __init__(self, profile: str, trouble: str = "") -> None:
        self._world = build_world(load_profile(profile))
        self._trouble = Path(trouble) if trouble else None
        self._lock, self._end = threading.Lock(), threading.Event()
        self._target: PoseReference | JointReference | None = None
        self._state: tuple[JointState, GripperState, int] | None = None
        self._reflex: tuple[JointState, GripperState, int] | None = None
        self._moves_to_fail = 1
        self._thread = threading.Thread(target=self._control, daemon=True)

    # -- what vla-zenoh calls -----------------------------------------------------------------
    def connect(self) -> None:
        if self._now() == "far away":
            time.sleep(CONNECT_S)
        self._thread.start()

    def read(self) -> Reading | None:
        with self._lock:
            state = self._state
        if state is None:
            return None
        trouble = self._now()
        if trouble == "raise":
            raise ConnectionError("the cable is out")
        if trouble == "frozen":
            return None
        # Its library goes on giving the state in which it was.
        self._reflex = (self._reflex or state) if trouble == "reflex" else None
        joints, gripper, measured_ns = self._reflex or state
        position_rad = joints.position_rad * (float("nan") if trouble == "nan" else 1.0)
        return Reading(
            position_rad,
            joints.velocity_rad_s,
            joints.effort_nm,
            width_m=gripper.width_m,
            moving=gripper.moving,
            holding=gripper.holding,
            fault="the user stop is pressed" if trouble in ("fault", "reflex") else "",
            measured_ns=measured_ns,
        )

    def move(self, command: Command) -> None:
        if self._now() == "slow":
            time.sleep(0.3)
        if self._now() == "raise once" and self._moves_to_fail:
            self._moves_to_fail -= 1
            raise ConnectionError("the cable is out")
        if isinstance(command, JointCommand):
            target = JointReference(
                command.position_rad, command.velocity_rad_s, command.acceleration_rad_s2
            )
        else:
            rotation = rotation_from_quat(command.quat_xyzw)
            target = PoseReference(
                command.position_m, rotation, command.twist, command.acceleration
            )
        with self._lock:
            self._target = target

    def grip(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        with self._lock:
            self._world.set_gripper(width_m, speed_m_s, force_n)

    def close(self) -> None:
        self._end.set()
        self._thread.join(1.0)

    # -- the hardware -------------------------------------------------------------------------
    def _now(self) -> str:
        if self._trouble is None or not self._trouble.exists():
            return ""
        return self._trouble.read_text().strip()

    def _control(self) -> None:
        world = self._world
        target: PoseReference | JointReference = JointReference.at_rest(
            world.joint_state().position_rad
        )
        next_ns = time.monotonic_ns()
        while not self._end.is_set():
            next_ns = max(next_ns + STEP_NS, time.monotonic_ns() - 20 * STEP_NS)
            time.sleep(max(0, next_ns - time.monotonic_ns()) / 1e9)
            with self._lock:
                target = self._target or target
                world.tick(target)
                self._state = (world.joint_state(), world.gripper_state(), time.monotonic_ns())
