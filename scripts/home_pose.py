"""Solves for the arm joints of a TCP position, to choose a home pose for a profile.

    python scripts/home_pose.py table 0.43 0.0 0.16

Prints the joint positions in rad of a Franka Panda whose tool points straight down.
"""

from __future__ import annotations

import argparse
import math

import mujoco
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vla_zenoh.errors import ResourceError
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.scene import PREFIX, TCP_SITE, build_model
from vla_zenoh.types import FloatArray

MAX_STEPS = 2000
DAMPING = 1e-6
POSTURE_PULL = 0.1
TOLERANCE = 1e-10  # m and rad
TOOL_DOWN = np.diag([1.0, -1.0, -1.0])
PANDA_START_RAD = (0.0, -0.2, 0.0, -2.4, 0.0, 2.2, math.pi / 4)


def solve_home(
    scene: str,
    robot: RobotModel,
    position_m: ArrayLike,
    rotation: FloatArray = TOOL_DOWN,
    start_rad: ArrayLike = PANDA_START_RAD,
) -> FloatArray:
    """Joints (n,) with the TCP at `position_m` and `rotation`, as near to `start_rad` as possible.

    Damped least squares with the posture in the nullspace::

        dq = J^T (J J^T + d 1)^-1 e + (1 - J^+ J) k (q_start - q)

    Raises:
        ResourceError: the pose is out of reach within the joint limits.
    """
    model = build_model(scene, [robot])
    data = mujoco.MjData(model)
    joints = [model.joint(PREFIX + name) for name in robot.arm_joints]
    addresses = [int(joint.qposadr[0]) for joint in joints]
    dofs = [int(joint.dofadr[0]) for joint in joints]
    lower, upper = np.array([joint.range for joint in joints]).T
    site = model.site(PREFIX + TCP_SITE).id
    goal, start = np.asarray(position_m, float), np.asarray(start_rad, float)
    linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))

    data.qpos[addresses] = start
    for _ in range(MAX_STEPS):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, linear, angular, site)
        jacobian = np.concatenate([linear[:, dofs], angular[:, dofs]])
        turn = pin.log3(rotation @ data.site_xmat[site].reshape(3, 3).T)
        error = np.concatenate([goal - data.site_xpos[site], turn])
        q = data.qpos[addresses]
        step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + DAMPING * np.eye(6), error)
        null = np.eye(len(q)) - np.linalg.pinv(jacobian) @ jacobian
        drift = null @ (start - q)
        if np.abs(error).max() < TOLERANCE and np.abs(drift).max() < 1e-9:
            return q
        data.qpos[addresses] = np.clip(q + step + POSTURE_PULL * drift, lower, upper)
    raise ResourceError(f"no joints put the TCP of {robot.description} at {goal.tolist()}")


def main() -> None:
    """Print the joints of one position."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("scene", help="name of a folder in sim/, or a path")
    parser.add_argument("position_m", type=float, nargs=3, metavar="M", help="x, y and z")
    given = parser.parse_args()
    print(*(f"{q:.10f}" for q in solve_home(given.scene, RobotModel(), given.position_m)), sep=", ")


if __name__ == "__main__":
    main()
