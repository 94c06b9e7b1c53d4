"""A Franka Panda in ROS 2: an rclpy node with an arm of its own, kinematics alone, for the tests.

    arm.py '{"namespace": "/robot1", "state_hz": 200}'

    joint_states     sensor_msgs/JointState      out, 200 Hz
    desired_pose     geometry_msgs/PoseStamped   in
    joint_command    std_msgs/Float64MultiArray  in, rad: the arm is there at its next tick
    joint_trajectory trajectory_msgs/JointTrajectory  in, with "trajectory": the same, of its end
    robot_description  std_msgs/String           out, once and latched, with "description": a file
    gripper_width    std_msgs/Float64            in, m between the fingers
    gripper/move, gripper/grasp                  franka_msgs actions, served
    /tf, /tf_static                              tf2_msgs/TFMessage, out
    /clock           rosgraph_msgs/Clock         out, with "sim_time"

Names without a slash begin with the namespace. The arm goes to the newest desired pose like a
critically damped spring, and stays there. Everything that it does and hears goes to the test: the
joints of every tick, the poses it is told.
"""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import panda_dh
import rclpy
from builtin_interfaces.msg import Time
from franka_msgs.action import Grasp, Move
from geometry_msgs.msg import PoseStamped, TransformStamped
from qos import publishes, qos, subscribes
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, String
from tf2_msgs.msg import TFMessage
from told import obey, tell
from trajectory_msgs.msg import JointTrajectory

SETTINGS = {
    "namespace": "",
    "prefix": "",  # of its joints and frames
    "state_hz": 200.0,
    "actions": False,
    "sim_time": 0.0,  # how fast simulated time goes; 0: none
    "goals": {},  # QoS of the topic of poses
    "states": {},  # QoS of the joint states
    "trajectory": "",  # topic of joint trajectories; empty: none
    "description": "",  # file of its description; empty: not published
    "serialized": False,  # joint states as bytes, as `ros2 bag play` publishes them
}
FOLLOW_1_S = 30.0
OPEN_M, FINGER_M_S = 0.08, 0.1
SIM_BEGAN_S = 100.0
TF_EVERY = 4
BASE, TCP = "panda_link0", "panda_hand_tcp"


class Follower:
    """The reference of a controller: position and rotation drawn to the newest goal."""

    def __init__(self, tcp: Any) -> None:
        self.position_m, self.rotation = tcp[:3, 3].copy(), tcp[:3, :3].copy()
        self.goal_m, self.goal_rotation = self.position_m, self.rotation
        self._twist = np.zeros(6)

    def tick(self, dt_s: float) -> None:
        """One step on."""
        turn = panda_dh.turn_between(self.goal_rotation, self.rotation)
        away = np.concatenate((self.goal_m - self.position_m, turn))
        # Implicit: stable at any rate.
        w = FOLLOW_1_S
        gain = 1 + 2 * w * dt_s + (w * dt_s) ** 2
        self._twist = (self._twist + w * w * dt_s * away) / gain
        self.position_m = self.position_m + self._twist[:3] * dt_s
        self.rotation = panda_dh.turned(self.rotation, self._twist[3:] * dt_s)


class Arm:
    """See the module."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self._settings = settings
        self._node = node = rclpy.create_node("panda", namespace=settings["namespace"])
        self._lock = threading.Lock()
        self._joint_goal_rad: Any = None
        self._q_rad = np.array(panda_dh.HOME_RAD)
        self._follower = Follower(panda_dh.forward(self._q_rad))
        self._width_m = self._goal_width_m = OPEN_M
        self._finger_m_s = FINGER_M_S
        self._began_ns = time.monotonic_ns()
        self.stop = threading.Event()
        self._joints = node.create_publisher(
            JointState,
            "joint_states",
            qos(**settings["states"]),
            event_callbacks=publishes("joint_states"),
        )
        node.create_subscription(
            PoseStamped,
            "desired_pose",
            self._on_goal,
            qos(**settings["goals"]),
            event_callbacks=subscribes("desired_pose"),
        )
        node.create_subscription(Float64, "gripper_width", self._on_width, 10)
        node.create_subscription(Float64MultiArray, "joint_command", self._on_joints, 1)
        if settings["trajectory"]:
            topic = settings["trajectory"]
            node.create_subscription(JointTrajectory, topic, self._on_trajectory, 1)
        if settings["description"]:
            latched = qos(transient_local=True, depth=1)
            text = Path(settings["description"]).read_text("utf-8")
            node.create_publisher(String, "robot_description", latched).publish(String(data=text))
        self._tf = node.create_publisher(TFMessage, "/tf", 100)
        fixed = node.create_publisher(TFMessage, "/tf_static", qos(transient_local=True, depth=1))
        mount = self._transform("front_color_optical_frame", np.eye(4))
        fixed.publish(TFMessage(transforms=[mount]))
        self._clock = node.create_publisher(Clock, "/clock", 10) if settings["sim_time"] else None
        if settings["actions"]:
            self._serve(Move, "gripper/move")
            self._serve(Grasp, "gripper/grasp")

    # -- in ---------------------------------------------------------------------------------------
    def _on_goal(self, message: PoseStamped) -> None:
        wall_ns = time.time_ns()
        p, q = message.pose.position, message.pose.orientation
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        goal_m, quat = [p.x, p.y, p.z], [q.x, q.y, q.z, q.w]
        with self._lock:
            self._follower.goal_m = np.array(goal_m)
            self._follower.goal_rotation = panda_dh.rotation_of(quat)
        tell(goal=goal_m, quat=quat, stamp_ns=stamp_ns, wall_ns=wall_ns)

    def _on_joints(self, message: Float64MultiArray) -> None:
        with self._lock:
            self._joint_goal_rad = np.array(message.data)
        tell(joint_goal=list(message.data))

    def _on_trajectory(self, message: JointTrajectory) -> None:
        goal = dict(zip(message.joint_names, message.points[-1].positions, strict=True))
        prefix = self._settings["prefix"]
        with self._lock:
            self._joint_goal_rad = np.array([goal[prefix + name] for name in panda_dh.JOINTS])
        tell(joint_goal=list(message.points[-1].positions))

    def _on_width(self, message: Float64) -> None:
        tell(width=message.data)
        with self._lock:
            self._goal_width_m, self._finger_m_s = message.data, FINGER_M_S

    def _serve(self, kind: Any, name: str) -> None:
        def execute(handle: Any) -> Any:
            asked = handle.request
            tell(action=name, width=asked.width, speed=asked.speed)
            with self._lock:
                self._goal_width_m, self._finger_m_s = asked.width, asked.speed
            while abs(self._width_m - asked.width) > 1e-4 and rclpy.ok():
                if handle.is_cancel_requested:
                    handle.canceled()
                    return kind.Result(success=False, error="canceled")
                handle.publish_feedback(kind.Feedback(current_width=self._width_m))
                time.sleep(0.02)
            handle.succeed()
            tell(action_done=name)
            return kind.Result(success=True)

        ActionServer(
            self._node,
            kind,
            name,
            execute,
            callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    # -- out --------------------------------------------------------------------------------------
    def run(self) -> None:
        """The control loop, until `stop`."""
        period_s, ticks = 1 / self._settings["state_hz"], 0
        next_s, before_ns = time.monotonic(), time.monotonic_ns()
        while not self.stop.is_set():
            # None is made up for: the arm moves as time passes, also where a tick is late.
            next_s = max(next_s + period_s, time.monotonic())
            time.sleep(max(0.0, next_s - time.monotonic()))
            now_ns = time.monotonic_ns()
            dt_s, before_ns = (now_ns - before_ns) / 1e9, now_ns
            with self._lock:
                before_rad = self._q_rad
                self._follower.tick(dt_s)
                self._q_rad = panda_dh.inverse(
                    self._follower.position_m, self._follower.rotation, before_rad
                )
                if self._joint_goal_rad is not None:
                    self._q_rad = self._joint_goal_rad
                most_m = self._finger_m_s * dt_s
                self._width_m += np.clip(self._goal_width_m - self._width_m, -most_m, most_m)
            self._publish(now_ns, (self._q_rad - before_rad) / dt_s, ticks)
            ticks += 1

    def _publish(self, now_ns: int, velocity: Any, ticks: int) -> None:
        fingers = [self._width_m / 2] * 2
        message = JointState()
        message.header.stamp, message.header.frame_id = self._stamp(), BASE
        names = (*panda_dh.JOINTS, *panda_dh.FINGERS)
        message.name = [self._settings["prefix"] + name for name in names]
        message.position = [*self._q_rad.tolist(), *fingers]
        message.velocity = [*velocity.tolist(), 0.0, 0.0]
        message.effort = [0.0] * 9
        if self._clock is not None and ticks % 2 == 0:
            self._clock.publish(Clock(clock=message.header.stamp))
        serialized = self._settings["serialized"]
        self._joints.publish(serialize_message(message) if serialized else message)
        tell(t=now_ns, q=self._q_rad.tolist(), width_m=self._width_m)
        if ticks % TF_EVERY == 0:
            tcp = panda_dh.forward(self._q_rad)
            self._tf.publish(TFMessage(transforms=[self._transform(TCP, tcp)]))

    def _stamp(self) -> Time:
        speed = self._settings["sim_time"]
        now_ns = time.time_ns()
        if speed:
            passed_s = (time.monotonic_ns() - self._began_ns) / 1e9
            now_ns = int((SIM_BEGAN_S + speed * passed_s) * 1e9)
        return Time(sec=now_ns // 10**9, nanosec=now_ns % 10**9)

    def _transform(self, child: str, pose: Any) -> TransformStamped:
        prefix = self._settings["prefix"]
        out = TransformStamped(child_frame_id=prefix + child)
        out.header.stamp, out.header.frame_id = self._stamp(), prefix + BASE
        out.transform.translation.x, out.transform.translation.y, out.transform.translation.z = (
            pose[:3, 3].tolist()
        )
        rotation = out.transform.rotation
        rotation.x, rotation.y, rotation.z, rotation.w = panda_dh.quat_of(pose[:3, :3]).tolist()
        return out

    def spin(self) -> None:
        """Serve until ROS ends."""
        executor = MultiThreadedExecutor(4)
        executor.add_node(self._node)
        with contextlib.suppress(ExternalShutdownException):
            executor.spin()


def main() -> None:
    """Be the robot until stdin ends."""
    settings = SETTINGS | json.loads(sys.argv[1])
    rclpy.init()
    arm = Arm(settings)
    threads = [threading.Thread(target=body) for body in (arm.run, arm.spin)]
    for thread in threads:
        thread.start()
    tell(ready=rclpy.get_rmw_implementation_identifier())
    obey({})
    arm.stop.set()
    threads[0].join()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
