"""The kinematics by which tests judge an rclpy robot, against Pinocchio and the URDF."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from vla_zenoh.kinematics.kinematics import make_kinematics
from vla_zenoh.profile import load_profile

sys.path.append(str(Path(__file__).resolve().parents[2] / "ros2"))

import panda_dh

EXACT = 1e-9


def test_poses_and_jacobians_are_those_of_the_urdf() -> None:
    kinematics, rng = make_kinematics(load_profile("panda_sim")), np.random.default_rng(0)
    for _ in range(20):
        q_rad = np.array(panda_dh.HOME_RAD) + rng.uniform(-0.8, 0.8, 7)
        tcp, jacobian = panda_dh.pose_and_jacobian(q_rad)
        pose = kinematics.forward(q_rad)
        assert tcp[:3, 3] == pytest.approx(pose.position_m, abs=EXACT)
        assert tcp[:3, :3] == pytest.approx(pose.rotation, abs=EXACT)
        assert jacobian == pytest.approx(kinematics.jacobian(q_rad), abs=EXACT)


def test_the_joints_of_a_pose_nearby_lead_to_it() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        q_rad = np.array(panda_dh.HOME_RAD) + rng.uniform(-0.3, 0.3, 7)
        tcp = panda_dh.forward(q_rad)
        goal_m = tcp[:3, 3] + rng.uniform(-0.02, 0.02, 3)
        rotation = panda_dh.turned(tcp[:3, :3], rng.uniform(-0.1, 0.1, 3))
        found = panda_dh.forward(panda_dh.inverse(goal_m, rotation, q_rad))
        assert found[:3, 3] == pytest.approx(goal_m, abs=EXACT)
        assert found[:3, :3] == pytest.approx(rotation, abs=EXACT)
