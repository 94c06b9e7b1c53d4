"""Frames between a ROS graph and this robot: /tf and /tf_static, read and published.

Published are the set-point, the links of the arms and the cameras that the profile mounts, each
unless somebody else publishes it. Read are the places of cameras and of the TCP, which are compared
with the profile's.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np
import pinocchio as pin

from vla_zenoh.bus.buffers import CallbackRing
from vla_zenoh.codec.cdr import MAX_MESSAGE_BYTES
from vla_zenoh.errors import CodecError
from vla_zenoh.kinematics.kinematics import Kinematics, make_kinematics
from vla_zenoh.kinematics.so3 import quat_from_rotation, rotation_from_rpy
from vla_zenoh.profile import Profile
from vla_zenoh.profile.schema import CameraMount
from vla_zenoh.sanitize import one_line
from vla_zenoh.types import Event, FloatArray
from vla_zenoh.types.records import JointReference, PoseReference
from vla_zenoh_ros2.arm import Ros2Arm
from vla_zenoh_ros2.camera import Camera
from vla_zenoh_ros2.keys import LATCHED, SENSOR, Qos
from vla_zenoh_ros2.messages import Messages
from vla_zenoh_ros2.ros_graph import RosGraph
from vla_zenoh_ros2.transforms import (
    TF,
    TF_MESSAGE,
    TF_STATIC,
    Edge,
    FrameTree,
    difference,
    placed,
    publishable,
    read_transforms,
    tf_message,
)

PERIOD_S, STATIC_PERIOD_S = 1 / 30, 1.0
LISTEN_S = 3.0
"""What others publish is listened to for so long before anything is published."""
SETPOINT_S = 0.5
"""An older set-point is not shown: the arm is not commanded."""
SAME_NS = 10_000_000
"""A TCP of ROS is compared with ours if their stamps differ by less."""
APART_M, APART_RAD = 0.005, 0.02
BUFFER = 64
SHOWN, MAX_WHY = 8, 300
"""At most this many names of others, and letters of a reason, are in the status."""


class ArmFrames:
    """Links of one arm by its joints; fingers and other joints that are not the arm's are left out.

    One object serves one thread.
    """

    def __init__(self, kinematics: Kinematics, base_frame: str) -> None:
        self.kinematics = kinematics
        joints = kinematics.described.joints.values()
        arm = {*kinematics.arm_joints, *kinematics.followers}
        links, grown = {base_frame}, True
        self._edges: dict[str, tuple[str, bool]] = {}
        while grown:
            found = [j for j in joints if j.parent in links and j.child not in links]
            found = [j for j in found if not j.moves or j.name in arm]
            links |= {j.child for j in found}
            self._edges |= {j.child: (j.parent, not j.moves) for j in found}
            grown = bool(found)
        self.links = frozenset(links)
        model = kinematics.model
        self._ids = {link: model.getFrameId(link, pin.FrameType.BODY) for link in links}

    def at(self, position_rad: FloatArray) -> list[Edge]:
        """Each link in its parent, with the joints there."""
        model, data = self.kinematics.model, self.kinematics.data
        pin.framesForwardKinematics(model, data, position_rad)
        return [
            Edge(parent, child, self._placement(parent, child), fixed)
            for child, (parent, fixed) in self._edges.items()
        ]

    def _placement(self, parent: str, child: str) -> FloatArray:
        placements = self.kinematics.data.oMf
        return placements[self._ids[parent]].actInv(placements[self._ids[child]]).homogeneous


def setpoint_pose(
    reference: PoseReference | JointReference, profile: Profile, kinematics: Kinematics
) -> FloatArray:
    """Pose (4, 4) of a set-point in the base frame."""
    if isinstance(reference, PoseReference):
        return placed(reference.position_m, reference.rotation)
    names = profile.robot.arm_joints
    return placed(*kinematics.forward(kinematics.ordered(names, reference.position_rad)))


def mount_pose(mount: CameraMount) -> FloatArray:
    """Pose (4, 4) of a camera in its link, by the profile."""
    return placed(mount.position_m, rotation_from_rpy(np.array(mount.rpy_rad)))


class FrameTopics:
    """Reads and publishes transforms; `run` is the body of a thread, the only user of `messages`.

    `emit` and `reject` may be called from any thread. `detail` is its part of the status.
    """

    def __init__(
        self,
        profile: Profile,
        graph: RosGraph,
        arms: Mapping[str, Ros2Arm],
        cameras: Collection[Camera],
        messages: Messages,
        emit: Callable[[Event], None],
        reject: Callable[[str, str, str], None],
    ) -> None:
        self._profile, self._graph, self._messages = profile, graph, messages
        self._arms, self._emit, self._reject = arms, emit, reject
        self._cameras = {camera.publisher.name: camera for camera in cameras}
        self._moving = CallbackRing(BUFFER, MAX_MESSAGE_BYTES)
        self._fixed = CallbackRing(BUFFER, MAX_MESSAGE_BYTES)
        graph.subscribe_to_others(TF, TF_MESSAGE, self._moving, SENSOR)
        graph.subscribe_to_others(TF_STATIC, TF_MESSAGE, self._fixed, LATCHED)
        self._tf = graph.publisher(TF, TF_MESSAGE, Qos(depth=100))
        self._tf_static = graph.publisher(TF_STATIC, TF_MESSAGE, Qos(1, transient_local=True))
        self._theirs = FrameTree()
        self._told: dict[str, str] = {}
        self._sent_ns = 0
        self._sent_static_s = 0.0
        self._published: tuple[str, ...] = ()
        self._refused: Mapping[str, str] = {}
        self._places: dict[str, Any] = {}

    @property
    def detail(self) -> dict[str, Any]:
        """For the status: frames published, refused, with several parents; where cameras are."""
        parents = list(self._theirs.parents.items())[:SHOWN]
        return {
            "tf": {
                "published": list(self._published),
                "refused": dict(self._refused),
                "several_parents": {_short(name): _names(known) for name, known in parents},
            },
            "tf_cameras": dict(self._places),
        }

    def run(self, stop: threading.Event) -> None:
        """Read and publish until `stop` is set."""
        own = {name: arm.profile for name, arm in self._arms.items()}
        links = {
            name: ArmFrames(make_kinematics(profile), profile.robot.base_frame)
            for name, profile in own.items()
        }
        heard_s: float | None = None
        while not stop.wait(PERIOD_S):
            self._read()
            now_s = time.monotonic()
            if not self._graph.others:
                heard_s = None
                continue
            heard_s = now_s if heard_s is None else heard_s
            if now_s - heard_s > LISTEN_S:
                self._publish(links, now_s)
                self._compare(links)

    # -- in -------------------------------------------------------------------------------------
    def _read(self) -> None:
        for topic, buffer in ((TF, self._moving), (TF_STATIC, self._fixed)):
            for arrival in buffer.drain():
                try:
                    payload = arrival.sample.payload.to_bytes()
                    message = self._messages.decode(TF_MESSAGE, payload)
                except CodecError as error:
                    self._reject(error.reason, f"{topic}: {error}", topic)
                    continue
                edges, faults = read_transforms(message, fixed=buffer is self._fixed)
                for edge in edges:
                    try:
                        self._theirs.add(edge)
                    except CodecError as error:
                        faults.append(error)
                for fault in faults:
                    self._reject(fault.reason, f"{topic}: {fault}", topic)
        for frame, parents in list(self._theirs.parents.items())[:SHOWN]:
            self._tell(frame, "frame_parents", f"{_short(frame)} has the parents {_names(parents)}")

    def _tell(self, about: str, what: str, why: str) -> None:
        """Emit an event, once until the reason is another one."""
        if self._told.get(about) != why:
            self._told[about] = why
            if why:
                self._emit(Event("warning", "notice", what, why[:1000]))

    def _compare(self, links: Mapping[str, ArmFrames]) -> None:
        """Where ROS sees cameras and TCPs, beside the profile."""
        every = frozenset().union(*(arm.links for arm in links.values()))
        robot = self._profile.robot
        for name, camera in self._cameras.items():
            mount = self._profile.cameras[name].mount
            frame = mount.frame if mount is not None else camera.frame
            if frame:
                self._places[name] = self._place(name, frame, mount, every, robot.base_frame)
        for name, arm in self._arms.items():
            tcp, posture = arm.profile.robot.tcp_frame, arm.posture
            seen = self._theirs.edges.get(tcp)
            if posture is None or seen is None or abs(seen.stamp_ns - posture.stamp_ns) > SAME_NS:
                continue
            try:
                theirs = self._theirs.pose(tcp, arm.profile.robot.base_frame)
            except CodecError:
                continue  # it has another base
            kinematics = links[name].kinematics
            apart = _apart(placed(*kinematics.forward(posture.position_rad)), theirs)
            why = f"{apart} lie between {tcp} in ROS and by robot.description" if apart else ""
            self._tell(f"{name} tcp", "tcp_differs", why)

    def _place(
        self, name: str, frame: str, mount: CameraMount | None, links: Collection[str], base: str
    ) -> dict[str, Any]:
        """Where ROS sees a camera, for the status."""
        frame = frame.lstrip("/")
        try:
            link, pose = self._theirs.mount(frame, links, base)
            if mount is not None:
                link, pose = mount.link, self._theirs.pose(frame, mount.link)
        except CodecError as error:
            return {"frame": _short(frame), "why": one_line(error, MAX_WHY)}
        apart = "" if mount is None else _apart(mount_pose(mount), pose)
        why = (
            f"{apart} lie between {_short(frame)} in ROS and by cameras.{name}.mount"
            if apart
            else ""
        )
        self._tell(f"camera {name}", "camera_moved", why)
        return {
            "frame": _short(frame),
            "link": link,
            "position_m": np.round(pose[:3, 3], 6).tolist(),
            "quat_xyzw": np.round(quat_from_rotation(pose[:3, :3]), 6).tolist(),
            "why": why,
        }

    # -- out ------------------------------------------------------------------------------------
    def _publish(self, links: Mapping[str, ArmFrames], now_s: float) -> None:
        ours, stamp_ns = self._mounts(), 0
        for name, arm in self._arms.items():
            posture = arm.posture
            if posture is not None:
                stamp_ns = max(stamp_ns, posture.stamp_ns)
                ours += links[name].at(posture.position_rad)
                ours += self._setpoint(name, arm, links[name].kinematics)
        allowed, self._refused = publishable(ours, self._theirs)
        self._published = tuple(edge.child for edge in allowed)
        why = "; ".join(f"{frame}: {why}" for frame, why in self._refused.items())
        self._tell("refused", "frames_refused", f"not published: {why}" if why else "")
        moving = [edge for edge in allowed if not edge.fixed]
        if moving and stamp_ns != self._sent_ns:
            self._sent_ns = stamp_ns
            self._tf.publish(self._messages.encode(tf_message(self._messages, moving, stamp_ns)))
        # Again and again: a bridge that was restarted has forgotten them.
        if now_s - self._sent_static_s > STATIC_PERIOD_S:
            self._sent_static_s = now_s
            fixed = [edge for edge in allowed if edge.fixed]
            message = tf_message(self._messages, fixed, stamp_ns)
            self._tf_static.publish(self._messages.encode(message))

    def _mounts(self) -> list[Edge]:
        """Cameras that are ours: those of ROS are placed there."""
        mounts = {
            name: camera.mount
            for name, camera in self._profile.cameras.items()
            if camera.mount is not None and name not in self._cameras
        }
        return [Edge(one.link, one.frame, mount_pose(one), True) for one in mounts.values()]

    def _setpoint(self, name: str, arm: Ros2Arm, kinematics: Kinematics) -> list[Edge]:
        found, robot = arm.setpoint, arm.profile.robot
        if found is None or time.monotonic_ns() - found[0] > SETPOINT_S * 1e9:
            return []
        child = "_".join(each for each in (robot.name, name, "setpoint") if each)
        pose = setpoint_pose(found[1], arm.profile, kinematics)
        return [Edge(robot.base_frame, child, pose, False)]


def _short(name: str) -> str:
    """A name of others, for status and events."""
    return one_line(name, 80)


def _names(names: Collection[str]) -> str:
    return " and ".join(map(_short, sorted(names)[:SHOWN]))


def _apart(a: FloatArray, b: FloatArray) -> str:
    """How far two poses are apart, where that is more than an error of calibration."""
    apart_m, apart_rad = difference(a, b)
    if apart_m < APART_M and apart_rad < APART_RAD:
        return ""
    return f"{apart_m * 1e3:.0f} mm and {apart_rad:.2f} rad"
