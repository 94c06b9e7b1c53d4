"""A robot without a simulator, only its traffic: it stands, or is always where it is commanded."""

from __future__ import annotations

import threading

import numpy as np

from vla_zenoh.bus.buffers import LatestSample
from vla_zenoh.bus.clock import FixedRate
from vla_zenoh.bus.metrics import RateMeter
from vla_zenoh.bus.node import Node, publish_together
from vla_zenoh.bus.session import open_session
from vla_zenoh.codec.records import SMALL_BYTES
from vla_zenoh.keys import Kind
from vla_zenoh.kinematics.kinematics import InverseKinematics, make_kinematics
from vla_zenoh.kinematics.so3 import pose_of, quat_from_rotation
from vla_zenoh.profile import load_profile
from vla_zenoh.runtime.process import ROUTER_PATIENCE_S
from vla_zenoh.types import GripperState, JointState, PoseCommand, PoseState


def play_robot(profile_file: str, stop: threading.Event, *, follows: bool) -> None:
    """Publish the state of an arm at the profile's rate.

    Args:
        profile_file: of the robot.
        stop: set to stop it.
        follows: the newest commanded pose is the measured one, with joints that reach it; otherwise
            the arm stands at home and receives nothing.
    """
    profile = load_profile(profile_file)
    robot = profile.robot
    kinematics = make_kinematics(profile)
    home = kinematics.forward(kinematics.ordered(robot.arm_joints, robot.home_rad))
    still = np.zeros(len(robot.arm_joints))
    joints = JointState(robot.arm_joints, np.array(robot.home_rad), still, still)
    inverse = InverseKinematics(kinematics, kinematics.ordered(joints.names, joints.position_rad))
    pose = PoseState(home.position_m, quat_from_rotation(home.rotation), np.zeros(6))
    gripper = GripperState(robot.gripper.max_width_m, moving=False, holding=False)
    with open_session(profile.session, wait_s=ROUTER_PATIENCE_S) as session:
        node = Node(robot.driver, profile, session)
        orders = LatestSample(SMALL_BYTES)
        if follows:
            node.subscribe(node.keys.command_pose, orders)
        poses = node.declare_publisher(node.keys.state_pose, Kind.STATE)
        arms = node.declare_publisher(node.keys.state_joint, Kind.STATE)
        grippers = node.declare_publisher(node.keys.state_gripper, Kind.STATE)
        pace, rate = FixedRate(profile.timing.state_hz), RateMeter()
        while not stop.is_set():
            pace.wait()
            arrival = orders.pop()
            order = node.decode(PoseCommand, arrival) if arrival is not None else None
            if order is not None:
                told = order.record
                pose = PoseState(told.position_m, told.quat_xyzw, told.twist)
                before_rad = kinematics.joints_of(joints)
                found = inverse.approach(pose_of(pose), before_rad).joints_rad
                moved = (found - before_rad) * profile.timing.state_hz
                joints = JointState(kinematics.arm_joints, found, moved, still)
            states = (poses, pose), (arms, joints), (grippers, gripper)
            publish_together(node.clock.wall_ns(), poses.seq, *states)
            rate.tick()
            node.publish_status(
                "following" if follows else "standing", rates_hz={"state": rate.rate_hz}
            )
        node.close()
