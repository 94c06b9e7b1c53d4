"""A brick between the fingers of a simulated arm, and whether it stays there."""

from __future__ import annotations

import numpy as np

from vla_zenoh.kinematics.so3 import quat_from_rotation
from vla_zenoh.profile import Profile
from vla_zenoh.simulation.world import World
from vla_zenoh.types import JointReference

IN_JAW_M = np.array([-0.0146, 0.0, -0.022])
"""From the fixed jaw's tip of the SO-101, which is its TCP, to the middle of a brick beside it."""
SLIPPED_M = 0.003
CLOSE_TICKS = 2400
TOUCHED_M = 5e-5
"""Ten times what it falls in a tick."""


def hold(world: World, by_m: np.ndarray, profile: Profile) -> np.ndarray:
    """Shut the fingers on the brick; where it is then, (3,) m in the axes of the TCP."""
    home = JointReference.at_rest(np.array(profile.robot.home_rad))
    still = home if profile.robot.command == "joint" else world.hold_reference()
    world.set_gripper(0.0, 0.1, 25.0)
    touched = False
    for _ in range(CLOSE_TICKS):
        if not touched:  # it would be pushed through the fingers
            position_m, rotation = world.tcp()
            world.place(name_of(world), position_m + rotation @ by_m, quat_from_rotation(rotation))
        world.tick(still)
        touched = touched or np.linalg.norm(brick_m(world) - by_m) > TOUCHED_M
    assert world.gripper_state().holding
    return brick_m(world)


def name_of(world: World) -> str:
    return next(name for name in world.objects() if name in ("brick", "red_brick"))


def brick_m(world: World) -> np.ndarray:
    """Where the brick is, in the axes of the TCP."""
    position_m, rotation = world.tcp()
    return rotation.T @ (world.objects()[name_of(world)][0] - position_m)


def held(world: World, was_m: np.ndarray) -> None:
    assert world.gripper_state().holding
    assert np.linalg.norm(brick_m(world) - was_m) < SLIPPED_M
