"""The limits that we take for Franka's against those that the simulator enforces."""

from __future__ import annotations

import json
import os
import shlex
import subprocess

import numpy as np
from franka_rig import VARIABLE
from vla_zenoh_franka.check import FR3, PANDA

TABLES = """
import json
from franka_sim.limits import tables as t
print(json.dumps({
    "range": t.JOINT_POSITION_LIMITS,
    "near_end": t.POSITION_BASED_VELOCITY_LIMITS,
    "acceleration": t.MAX_JOINT_ACCELERATION,
    "jerk": t.MAX_JOINT_JERK,
    "torque": t.MAX_TORQUE,
    "translation": [t.MAX_TRANSLATIONAL_VELOCITY, t.MAX_TRANSLATIONAL_ACCELERATION,
                    t.MAX_TRANSLATIONAL_JERK],
    "rotation": [t.MAX_ROTATIONAL_VELOCITY, t.MAX_ROTATIONAL_ACCELERATION, t.MAX_ROTATIONAL_JERK],
    "panda_acceleration": t.LIBFRANKA_FER_JOINT_ACCELERATION_LIMITS,
    "panda_jerk": t.LIBFRANKA_FER_JOINT_JERK_LIMITS,
}))
"""


def test_the_published_limits_are_those_that_the_simulator_enforces() -> None:
    command = [*shlex.split(os.environ[VARIABLE]), "-c", TABLES]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    theirs = json.loads(said.splitlines()[-1])
    lower, upper = np.array(theirs["range"]).T
    assert np.all(np.array(FR3.lower_rad) >= lower)  # the published table rounds inwards
    assert np.all(np.array(FR3.upper_rad) <= upper)
    near_end = [
        [velocity, *end] for velocity, end in zip(FR3.velocity_rad_s, FR3.near_end, strict=True)
    ]
    np.testing.assert_allclose(near_end, theirs["near_end"])
    for ours, name in (
        (FR3.acceleration_rad_s2, "acceleration"),
        (FR3.jerk_rad_s3, "jerk"),
        (FR3.torque_nm, "torque"),
        (FR3.translation, "translation"),
        (FR3.rotation, "rotation"),
        (PANDA.acceleration_rad_s2, "panda_acceleration"),
        (PANDA.jerk_rad_s3, "panda_jerk"),
    ):
        np.testing.assert_allclose(ours, theirs[name], err_msg=name)
