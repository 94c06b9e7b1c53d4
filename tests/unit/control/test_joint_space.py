"""The workspace box of an arm that moves in joints: goals and commands stay inside it."""

from __future__ import annotations

import numpy as np
from joint_rig import panda
from panda_arm import HOME_RAD

from vla_zenoh.control.joint_space import JointBounds, JointPath
from vla_zenoh.control.limits import workspace_corners
from vla_zenoh.control.plan_timeline import joint_goal
from vla_zenoh.control.reachability import make_reachability_filter
from vla_zenoh.types import FloatArray

OUTSIDE_M = 1e-4
LEAD_RAD = 0.6


def made_path() -> JointPath:
    profile = panda()
    reach = make_reachability_filter(profile)
    path = JointPath(profile, JointBounds(profile, reach.kinematics, reach.barriers))
    path.stand(HOME_RAD)
    return path


def outside_m(position_m: FloatArray) -> float:
    low, high = workspace_corners(panda().limits)
    return float(np.linalg.norm(position_m - np.clip(position_m, low, high)))


def test_a_goal_that_the_leash_cuts_stays_inside_the_box_and_on_the_leash() -> None:
    rng, path = np.random.default_rng(0), made_path()
    cuts = 0
    for _ in range(400):
        path.stand(HOME_RAD + rng.uniform(-0.5, 0.5, 7))
        if outside_m(path.motion.pose.position_m) > 0.0:
            continue
        asked = joint_goal(path.kinematics, path.state.position + rng.uniform(-1.5, 1.5, 7), 0.0)
        goal, hits = path.leash(asked, LEAD_RAD, 0.004)
        assert goal.joints_rad is not None
        assert outside_m(goal.pose.position_m) < OUTSIDE_M
        assert np.abs(goal.joints_rad - path.state.position).max() < LEAD_RAD + 1e-5
        cuts += any(hit.name == "workspace" for hit in hits)
    assert cuts > 50


def test_commands_stay_inside_the_box_whenever_the_goal_changes() -> None:
    """The goals are inside; it is the way to them, and the stop, that could leave the box."""
    rng, path = np.random.default_rng(1), made_path()
    worst_m = 0.0
    for _ in range(400):
        asked = joint_goal(path.kinematics, HOME_RAD + rng.uniform(-1.0, 1.0, 7), 0.0)
        path.target(path.leash(asked, LEAD_RAD, 0.0)[0])
        if rng.random() < 0.2:
            path.brake()
        for _ in range(int(rng.integers(1, 60))):
            worst_m = max(worst_m, outside_m(path.tick().pose.position_m))
    assert worst_m < OUTSIDE_M
