"""A Franka Panda in MuJoCo that speaks ROS 2 over DDS and nothing else: a robot to try things on.

    python tests/ros2/panda_robot.py --domain 0

It is a stand-in for a lab's ROS 2 robot: the topics of the multipanda stack, no Zenoh and nothing
of ours but the simulated world.

    /joint_states                                              sensor_msgs/JointState       out
    /franka_robot_state_broadcaster/current_pose               geometry_msgs/PoseStamped    out
    /camera/realsense2_camera/color/image_raw                  sensor_msgs/Image            out
    /camera/wrist_camera/color/image_raw                       sensor_msgs/Image            out
    /panda/panda_cartesian_impedance_controller/desired_pose   CartesianImpedanceGoal       in
    /panda_gripper/move                                        franka_msgs/action/Move      served

The controller goes to the newest desired pose like a critically damped spring and knows nothing of
whoever sends it: where the stream ends it stays at the last pose, as such controllers do.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Sequence
from multiprocessing.sharedctypes import SynchronizedArray
from types import FrameType

import numpy as np
import pinocchio as pin
from cyclonedds.sub import DataReader
from move_server import MoveServer
from numpy.typing import NDArray
from ros_messages import (
    CartesianImpedanceGoal,
    Header,
    Image,
    JointState,
    Point,
    Pose,
    PoseStamped,
    Quaternion,
    Time,
)
from ros_node import RosNode

from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.simulation.render import Renderer
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.world import STEP_NS, World
from vla_zenoh.types import PoseReference

JOINT_STATES = "/joint_states"
CURRENT_POSE = "/franka_robot_state_broadcaster/current_pose"
DESIRED_POSE = "/panda/panda_cartesian_impedance_controller/desired_pose"
MOVE = "/panda_gripper/move"
CAMERAS = {
    "front": "/camera/realsense2_camera/color/image_raw",
    "wrist": "/camera/wrist_camera/color/image_raw",
}
BASE = "panda_link0"

FOLLOW_1_S = 30.0
"""How stiffly the desired pose is followed: in motion the arm is two time constants behind it."""
MAX_ACCELERATION = np.array([10.0, 10.0, 10.0, 30.0, 30.0, 30.0])
"""m/s^2 and rad/s^2: what the motors can do is not exceeded by a pose some way off."""
STEPS = 2
PERIOD_NS = STEPS * STEP_NS
"""Of the controller; the world is stepped by 1 ms."""
SHOW_EVERY = 5
CATCH_UP_NS = 50_000_000
PRIORITY = 40


class Follower:
    """The reference of a controller that is led by poses which come when they come."""

    def __init__(self, position_m: NDArray[np.float64], rotation: NDArray[np.float64]) -> None:
        self._position_m, self._rotation = position_m, rotation
        self._goal_m, self._goal_rotation = position_m, rotation
        self._twist = np.zeros(6)

    def lead(self, goal: CartesianImpedanceGoal) -> None:
        """Go there from now on."""
        p, q = goal.pose.position, goal.pose.orientation
        self._goal_m = np.array([p.x, p.y, p.z])
        quat = np.array([q.x, q.y, q.z, q.w])
        self._goal_rotation = pin.Quaternion(quat / np.linalg.norm(quat)).toRotationMatrix()

    def tick(self, dt_s: float) -> PoseReference:
        """One step on."""
        w = FOLLOW_1_S
        away = np.concatenate(
            (self._goal_m - self._position_m, pin.log3(self._goal_rotation @ self._rotation.T))
        )
        wanted = w * w * away - 2 * w * self._twist
        acceleration = np.clip(wanted, -MAX_ACCELERATION, MAX_ACCELERATION)
        self._twist = self._twist + acceleration * dt_s
        self._position_m = self._position_m + self._twist[:3] * dt_s
        self._rotation = pin.exp3(self._twist[3:] * dt_s) @ self._rotation
        return PoseReference(self._position_m, self._rotation, self._twist, acceleration)


class PandaRobot:
    """See the module."""

    def __init__(
        self, profile: Profile, domain: int, state_hz: float, qpos: SynchronizedArray[float]
    ) -> None:
        self.world = build_world(profile)
        self._qpos = qpos
        self._follower = Follower(*self.world.tcp())
        self._node = RosNode("panda", domain)
        self._joints = self._node.publisher(JOINT_STATES, JointState)
        self._pose = self._node.publisher(CURRENT_POSE, PoseStamped)
        self._goals: DataReader[CartesianImpedanceGoal] | None = None
        self.controlled = True
        self._gripper = MoveServer(self._node, MOVE, self.world)
        self._finger_joints = tuple(profile.robot.finger_joints)
        self._state_every = max(1, round(1e9 / PERIOD_NS / state_hz))
        self._ticks = 0
        self._show()

    def run(self, stop: threading.Event) -> None:
        """Simulate in real time until `stop` is set."""
        # A robot's control loop does not share its processor; without permission it has to.
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        next_ns = time.monotonic_ns()
        while not stop.is_set():
            next_ns += PERIOD_NS
            late_ns = time.monotonic_ns() - next_ns
            if late_ns < 0:
                time.sleep(-late_ns / 1e9)
            elif late_ns > CATCH_UP_NS:
                next_ns += late_ns
            self._tick()
        self._node.close()

    def _tick(self) -> None:
        if self.controlled is (self._goals is None):
            self._switch_controller()
        for goal in self._goals.take(10) if self._goals is not None else ():
            if goal.sample_info.valid_data:
                self._follower.lead(goal)
        self.world.tick(self._follower.tick(PERIOD_NS / 1e9), STEPS)
        self._ticks += 1
        self._gripper.tick()
        if self._ticks % self._state_every == 0:
            self._publish()
        if self._ticks % SHOW_EVERY == 0:
            self._show()

    def _switch_controller(self) -> None:
        if self._goals is None:
            self._goals = self._node.subscription(DESIRED_POSE, CartesianImpedanceGoal)
        else:
            self._node.leave(self._goals)
            self._goals = None

    def _publish(self) -> None:
        header = Header(Time.of(time.time_ns()), BASE)
        state = self.world.joint_state()
        finger_m = self.world.gripper_state().width_m / 2
        rest = [0.0] * len(self._finger_joints)
        assert state.velocity_rad_s is not None
        assert state.effort_nm is not None
        self._joints.write(
            JointState(
                header,
                [*state.names, *self._finger_joints],
                [*state.position_rad.tolist(), *(finger_m for _ in rest)],
                [*state.velocity_rad_s.tolist(), *rest],
                [*state.effort_nm.tolist(), *rest],
            )
        )
        position, rotation = self.world.tcp()
        quat = pin.Quaternion(rotation).coeffs().tolist()
        self._pose.write(PoseStamped(header, Pose(Point(*position.tolist()), Quaternion(*quat))))

    def _show(self) -> None:
        with self._qpos:
            self._qpos[:] = self.world.qpos().tolist()


def build_world(profile: Profile) -> World:
    """The world of a profile, whatever its driver."""
    return World(
        profile.sim.scene,
        [robot_model(profile)],
        home_rad=[profile.robot.home_rad],
        joint_friction_nm=profile.sim.joint_friction_nm,
        seed=profile.sim.seed,
    )


def robot_model(profile: Profile) -> RobotModel:
    return RobotModel(
        description=profile.robot.description,
        arm_joints=profile.robot.arm_joints,
        tcp_link=profile.robot.tcp_frame,
    )


def serve_cameras(
    domain: int,
    views: Sequence[str],
    width: int,
    height: int,
    rate_hz: float,
    qpos: SynchronizedArray[float],
) -> None:
    """The cameras' own node, in a process of its own as in a lab: draws what `qpos` says."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    node = RosNode("camera", domain)
    writers = {
        view: node.publisher(CAMERAS[view], Image, reliable=False, depth=1) for view in views
    }
    profile = load_profile("panda_sim")
    renderer = Renderer(profile.sim.scene, [robot_model(profile)])
    period_s = 1.0 / rate_hz
    next_s = time.monotonic()
    while True:
        next_s = max(next_s + period_s, time.monotonic() - period_s)
        time.sleep(max(0.0, next_s - time.monotonic()))
        with qpos:
            poses = np.array(qpos[:])
        stamp = Time.of(time.time_ns())
        renderer.set_qpos(poses)
        for view, writer in writers.items():
            rgb = renderer.render(view, width, height)
            header = Header(stamp, f"{view}_color_optical_frame")
            writer.write(Image(header, height, width, "rgb8", 0, 3 * width, rgb.tobytes()))


def main() -> None:
    """Be the robot until told to end."""
    parser = argparse.ArgumentParser(description="A simulated Franka Panda as a ROS 2 robot")
    parser.add_argument("--domain", type=int, default=0, help="ROS domain id")
    parser.add_argument("--state-hz", type=float, default=200.0, help="rate of /joint_states")
    parser.add_argument("--camera", choices=CAMERAS, action="append", help="which; default: all")
    parser.add_argument("--no-cameras", action="store_true", help="somebody else has them")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--camera-hz", type=float, default=30.0)
    chosen = parser.parse_args()
    if not math.isfinite(chosen.state_hz) or not 1 <= chosen.state_hz <= 1000:
        parser.error("--state-hz: 1 to 1000")

    stop = threading.Event()

    def end(number: int, frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGINT, end)
    signal.signal(signal.SIGTERM, end)

    def switch(number: int, frame: FrameType | None) -> None:
        robot.controlled = not robot.controlled

    profile = load_profile("panda_sim")
    context = multiprocessing.get_context("spawn")
    qpos = context.Array("d", len(build_world(profile).qpos()))
    robot = PandaRobot(profile, chosen.domain, chosen.state_hz, qpos)
    signal.signal(signal.SIGUSR1, switch)
    pictures = (chosen.camera or list(CAMERAS), chosen.width, chosen.height, chosen.camera_hz)
    # A daemon process is ended with this one.
    cameras = context.Process(
        target=serve_cameras, args=(chosen.domain, *pictures, qpos), daemon=True
    )
    if not chosen.no_cameras:
        cameras.start()
    print("ready", flush=True)
    robot.run(stop)
    if cameras.is_alive():
        cameras.terminate()
        cameras.join()


if __name__ == "__main__":
    main()
