"""A camera of a ROS 2 robot, with its depth."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from vla_zenoh.bus.buffers import CallbackRing, LatestSample, ReceivedSample
from vla_zenoh.bus.node import Node
from vla_zenoh.errors import CodecError
from vla_zenoh.nodes.camera.camera_publisher import OK, CameraPublisher
from vla_zenoh.nodes.camera.geometry import Pixels, resize
from vla_zenoh.nodes.camera.source import LOOK_S, STALL_S
from vla_zenoh.profile.robot import Ros2Camera
from vla_zenoh.robots.joint_reading import SimulatedClock, StampFilter, wall_stamp_ns
from vla_zenoh.types import Event
from vla_zenoh_ros2.keys import SENSOR
from vla_zenoh_ros2.messages import MAX_PICTURE_BYTES, Messages
from vla_zenoh_ros2.readers import RosDepth, RosImage, read, read_depth
from vla_zenoh_ros2.ros_graph import RosGraph

CAMERA_WAIT_S, CAMERA_SAME_S = 0.1, 2.0
"""A sensor has noise; a driver that repeats an image for less than the second is tolerated."""
DEPTHS_KEPT = 4
SAME_VIEW_PERIODS = 1.5
"""Depth may be this many image periods older than its colours: drivers publish it after them."""


class Camera:
    """One camera topic: `run` is the body of its thread, the only user of `messages`.

    It uses publishers and clock of the `node`; `emit` and `reject` may be called from any thread.
    `frame` is that of its newest image, empty before.
    """

    def __init__(
        self,
        name: str,
        topic: Ros2Camera,
        node: Node,
        graph: RosGraph,
        messages: Messages,
        emit: Callable[[Event], None],
        reject: Callable[[str, str, str], None],
        simulated: SimulatedClock | None,
    ) -> None:
        self.topic = topic.topic
        self.silent, self.frame = False, ""
        self._topic, self._node, self._messages, self._reject = topic, node, messages, reject
        self._simulated = simulated
        self.publisher = CameraPublisher(
            name, node.profile.cameras[name], topic.topic, node, emit, CAMERA_SAME_S
        )
        self.publisher.backend = topic.type
        self._stamps = StampFilter()
        self._decoded_s = -LOOK_S
        self._image = graph.subscribe(
            topic.topic, topic.type, LatestSample(MAX_PICTURE_BYTES), SENSOR
        )
        self._depth = None
        if topic.depth is not None:
            ring = CallbackRing(DEPTHS_KEPT, MAX_PICTURE_BYTES)
            self._depth = graph.subscribe(topic.depth.topic, topic.depth.type, ring, SENSOR)
        self._depths: deque[RosDepth] = deque(maxlen=DEPTHS_KEPT)

    def run(self, stop: threading.Event) -> None:
        """Publish images until `stop` is set."""
        last_s = time.monotonic()
        while not stop.is_set():
            if self._image.wait(CAMERA_WAIT_S):
                arrival = self._image.pop()
                if arrival is not None and self._handle(arrival):
                    last_s = time.monotonic()
            silent_s = time.monotonic() - last_s
            self.silent = silent_s > STALL_S
            if self.silent:
                self.publisher.lose(f"no image on {self.topic} for {silent_s:.0f} s")

    def _handle(self, arrival: ReceivedSample) -> bool:
        """Publish an image, or check it now and then; whether it is a valid one."""
        publisher, now_s = self.publisher, time.monotonic()
        wanted = publisher.due(arrival.mono_ns) and publisher.has_subscribers
        if not wanted and now_s - self._decoded_s < LOOK_S:
            if publisher.state == OK:
                publisher.captured(arrival.mono_ns)
            return publisher.state == OK
        self._decoded_s = now_s
        payload, frame = arrival.sample.payload.to_bytes(), self._topic.frame
        try:
            image: RosImage = read(self._messages, self._topic.type, payload)
            if frame is not None and image.frame != frame:
                raise CodecError("frame", f"in frame {image.frame[:60]!r}, wanted {frame!r}")
            publisher.check(image.rgb, arrival.mono_ns, image.stamp_ns or None)
            if image.stamp_ns:
                self._stamps.check(image.stamp_ns)
        except CodecError as error:
            self._reject(error.reason, f"{self.topic}: {error}", publisher.name)
            if error.reason in ("encoding", "frame"):  # true for all further images
                publisher.lose(str(error))
            return False
        self.frame = image.frame
        publisher.captured(arrival.mono_ns)
        publisher.set_state(OK)
        if wanted:
            settings = publisher.profile
            rgb = resize(image.rgb, settings.width, settings.height)
            arrived_ns = self._node.clock.wall_at(arrival.mono_ns)
            stamp_ns = wall_stamp_ns(image.stamp_ns, arrived_ns, self._simulated)
            publisher.publish_rgb(rgb, arrival.mono_ns, stamp_ns, self._depth_at(image.stamp_ns))
        return True

    def _depth_at(self, stamp_ns: int) -> Pixels | None:
        """(H, W) metres that were measured when the image was taken; None if there are none."""
        topic, settings = self._topic.depth, self.publisher.profile
        if self._depth is None or topic is None:
            return None
        for arrival in self._depth.drain():
            if not self.publisher.wants_depth:
                continue
            try:
                payload = arrival.sample.payload.to_bytes()
                self._depths.append(read_depth(self._messages, topic.type, payload))
            except CodecError as error:
                self._reject(error.reason, f"{topic.topic}: {error}", self.publisher.name)
        if not self._depths:
            return None
        near = min(self._depths, key=lambda depth: abs(depth.stamp_ns - stamp_ns))
        if abs(near.stamp_ns - stamp_ns) * settings.rate_hz > SAME_VIEW_PERIODS * 1e9:
            return None
        return resize(near.depth_m, settings.width, settings.height, depth=True)
