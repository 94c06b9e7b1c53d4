"""Our driver of an arm, in a process that can be killed.

    python driver_process.py PROFILE

It moves the arm up by `WAY_M`, or its first joint by `TURN_RAD`, and tells, one line each: ready,
moving, there, and fault or lost.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from driver_report import Report

from vla_zenoh.errors import NodeError
from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.kinematics.so3 import pose_distance
from vla_zenoh.profile import load_profile
from vla_zenoh.robots.python_driver import PythonDriver
from vla_zenoh.types.records import JointReference, PoseReference

WAY_M, TURN_RAD, TIME_S, SETTLE_S = 0.06, 0.2, 3.0, 3.0


def tell(event: str, **more: Any) -> None:
    print(json.dumps({"event": event, "at_s": time.monotonic(), **more}), flush=True)


class Mover:
    """Ticks the driver as its node does."""

    def __init__(self, driver: PythonDriver) -> None:
        self.driver, self.newest = driver, None
        self._next_s, self._fault = time.monotonic(), ""

    def tick(self, reference: Any = None) -> Any:
        """One period; the newest measurement."""
        measured = self.driver.read(time.monotonic_ns())
        self.newest = self.newest if measured is None else measured
        if reference is not None and not self.driver.away:
            self.driver.move(reference, 0)
        if self.driver.fault != self._fault:
            self._fault = self.driver.fault
            tell("fault", why=self._fault)
        self._next_s = max(self._next_s + self.driver.period_s, time.monotonic() - 0.02)
        time.sleep(max(0.0, self._next_s - time.monotonic()))
        return self.newest


def run(mover: Mover) -> None:
    driver = mover.driver
    while mover.tick() is None or driver.away:
        pass
    tell("ready")
    begin = mover.tick()
    count = len(driver.profile.robot.arm_joints)
    zero, still = np.zeros(6), np.zeros(count)
    began_s = time.monotonic()
    tell("moving")
    while True:
        elapsed_s = time.monotonic() - began_s
        share = 0.5 - 0.5 * np.cos(np.pi * min(1.0, elapsed_s / TIME_S))
        if driver.profile.robot.command == "joint":
            goal_rad = begin.joints.position_rad + share * TURN_RAD * np.eye(count)[0]
            tcp = driver.forward(goal_rad)
            reference: Any = JointReference(goal_rad, still, still)
        else:
            tcp = begin.tcp._replace(position_m=begin.tcp.position_m + [0, 0, share * WAY_M])
            reference = PoseReference(tcp.position_m, tcp.rotation, zero, zero)
        measured = mover.tick(reference)
        if driver.fault:
            break
        if elapsed_s > TIME_S + SETTLE_S:
            apart_m, apart_rad = pose_distance(measured.tcp, tcp)
            tell("there", apart_m=apart_m, apart_rad=apart_rad, detail=driver.status().detail)
            break
    while True:
        mover.tick()


def main(profile: str) -> None:
    """Run until killed, or the node is lost."""
    driver = PythonDriver(load_profile(profile))
    Report(driver)
    make_kinematics(driver.profile)
    try:
        driver.connect()
        run(Mover(driver))
    except NodeError as error:
        tell("lost", why=str(error))


if __name__ == "__main__":
    main(sys.argv[1])
