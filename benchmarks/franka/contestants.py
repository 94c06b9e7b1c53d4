"""One library alone: ``python contestants.py NAME``; prints its times and what ended it as JSON."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from target_stream import play

ADDRESS = "127.0.0.1"
SPEED_M_S, ACCELERATION_M_S2, JERK_M_S3 = 0.3, 1.0, 10.0
"""The limits of the profile fr3, for libraries that take limits."""
SLOWER = 0.1
SETTLE_S = 1.0

Ended = tuple[tuple[float, float], str]


def _franky() -> tuple[Any, Any, Any]:
    franky = import_module("franky")
    robot = franky.Robot(ADDRESS, realtime_config=franky.RealtimeConfig.Ignore)
    robot.set_collision_behavior([40.0] * 7, [40.0] * 7, [60.0] * 6, [60.0] * 6)
    return franky, robot, robot.state.O_T_EE


def _poll(robot: Any) -> str:
    try:
        robot.poll_motion()
    except Exception as error:
        return str(error)
    return ""


def franky_motion(share: float) -> Ended:
    """A new CartesianMotion for each target, which replaces the one before."""
    franky, robot, start = _franky()
    robot.relative_dynamics_factor = share
    why: list[str] = []

    def give(offset: np.ndarray) -> None:
        target = franky.Affine(start.translation + offset, start.quaternion)
        try:
            robot.move(franky.CartesianMotion(target), asynchronous=True)
        except Exception as error:
            why.append(str(error))

    times = play(give, lambda: bool(why))
    return times, "".join(why[:1]) or _poll(robot)


def franky_impedance() -> Ended:
    """The tracking motion that our driver uses, given each target as it comes."""
    franky, robot, start = _franky()
    motion = franky.CartesianImpedanceTrackingMotion(
        translational_stiffness=2000.0, rotational_stiffness=150.0
    )
    motion.set_reference(franky.CartesianReference(start))
    robot.move(motion, asynchronous=True)

    def give(offset: np.ndarray) -> None:
        target = franky.Affine(start.translation + offset, start.quaternion)
        motion.set_reference(franky.CartesianReference(target))

    times = play(give, lambda: not robot.is_in_control)
    return times, _poll(robot)


def franka_rs(backend: str) -> Ended:
    """Its target loop, with the profile's limits."""
    os.environ["FRANKA_REALTIME"] = "ignore"
    franka = import_module("franka")
    robot = franka.Robot(ADDRESS)
    times, why = (0.0, 0.0), ""
    try:
        with robot.cartesian_targets(
            max_velocity=SPEED_M_S,
            max_acceleration=ACCELERATION_M_S2,
            max_jerk=JERK_M_S3,
            backend=backend,
        ) as arm:
            start = np.array(arm.target())[:3]
            times = play(lambda offset: arm.move_to(list(start + offset)), lambda: not arm.running)
    except franka.FrankaError as error:
        why = str(error)
    return times, why


def aiofranka() -> Ended:
    """Its operational space controller, whose 1 kHz loop is Python."""
    asyncio, library = import_module("asyncio"), import_module("aiofranka")

    async def run() -> Ended:
        robot = library.RobotInterface(ADDRESS)
        controller = library.FrankaController(robot)
        await controller.start()
        controller.switch("osc")
        start = np.array(robot.state["ee"])
        loop, ended = asyncio.get_running_loop(), []

        def give(offset: np.ndarray) -> None:
            target = start.copy()
            target[:3, 3] += offset
            asyncio.run_coroutine_threadsafe(controller.set("ee_desired", target), loop)

        try:
            times = await loop.run_in_executor(None, play, give, lambda: not controller.running)
        except Exception as error:
            ended.append(str(error))
            times = (0.0, 0.0)
        return times, "".join(ended)

    return asyncio.run(run())


CONTESTANTS: dict[str, Callable[[], Ended]] = {
    "franky_motion": lambda: franky_motion(1.0),
    "franky_motion_slower": lambda: franky_motion(SLOWER),
    "franky_impedance": franky_impedance,
    "franka_rs": lambda: franka_rs("impedance"),
    "franka_rs_robot": lambda: franka_rs("robot"),
    "aiofranka": aiofranka,
}

if __name__ == "__main__":
    cpu_s = -time.process_time()
    (began_s, ended_s), why = CONTESTANTS[sys.argv[1]]()
    cpu_s += time.process_time()
    time.sleep(SETTLE_S)
    print(json.dumps({"began_s": began_s, "ended_s": ended_s, "why": why, "cpu_s": cpu_s}))
    sys.stdout.flush()
    os._exit(0)  # some libraries wait for their loop at the end
