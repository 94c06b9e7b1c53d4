"""Camera topics: a thread each, which decodes what is wanted and keeps the stamps."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from vla_zenoh.bus.buffers import LatestSample, ReceivedSample
from vla_zenoh.bus.node import Node
from vla_zenoh.errors import CodecError
from vla_zenoh.interop.joint_reading import StampFilter
from vla_zenoh.interop.ros2 import table
from vla_zenoh.interop.ros2.messages import MAX_PICTURE_BYTES, Messages
from vla_zenoh.interop.ros2.qos import SENSOR
from vla_zenoh.interop.ros2.samples import RosImage
from vla_zenoh.nodes.camera.camera_publisher import OK, CameraPublisher, resize
from vla_zenoh.nodes.camera.source import LOOK_S, STALL_S
from vla_zenoh.profile.ros2 import Ros2Camera
from vla_zenoh.robots.ros2.ros_graph import RosGraph
from vla_zenoh.types import Event

WAIT_S = 0.1
SAME_S = 2.0
"""A sensor has noise; drivers that skip a picture now and then are borne with."""

Tell = Callable[[Event], None]
Refuse = Callable[[str, str, str], None]


class Camera:
    """One camera: `run` is the body of its thread.

    Args:
        name: the camera's.
        topic: where its pictures come from.
        node: on whose behalf; only its streams and clock are used by the thread.
        link: to the ROS graph.
        messages: of the robot's distribution, for this thread alone.
        tell: writes an event; may be called from any thread.
        refuse: counts a refusal likewise.
    """

    def __init__(
        self,
        name: str,
        topic: Ros2Camera,
        node: Node,
        link: RosGraph,
        messages: Messages,
        tell: Tell,
        refuse: Refuse,
    ) -> None:
        self._topic, self._node, self._messages, self._refuse = topic, node, messages, refuse
        self.outlet = CameraPublisher(
            name, node.profile.cameras[name], topic.topic, node, tell, SAME_S
        )
        self.outlet.backend = topic.type
        self._newness = StampFilter()
        self._looked_s = -LOOK_S
        self._slot = link.read(topic.topic, topic.type, LatestSample(MAX_PICTURE_BYTES), SENSOR)

    def run(self, stop: threading.Event) -> None:
        """Serve until `stop` is set."""
        last_s = time.monotonic()
        while not stop.is_set():
            if self._slot.wait(WAIT_S):
                arrival = self._slot.pop()
                if arrival is not None and self._take(arrival):
                    last_s = time.monotonic()
            silent_s = time.monotonic() - last_s
            if silent_s > STALL_S:
                self.outlet.lose(f"no picture on {self._topic.topic} for {silent_s:.0f} s")

    def _take(self, arrival: ReceivedSample) -> bool:
        """Whether it was a picture."""
        outlet, now_s = self.outlet, time.monotonic()
        due = outlet.due(arrival.mono_ns)
        if not (due and outlet.has_subscribers) and now_s - self._looked_s < LOOK_S:
            if outlet.state == OK:
                outlet.captured(arrival.mono_ns)
            return outlet.state == OK
        self._looked_s = now_s
        try:
            picture = self._read(arrival)
            outlet.check(picture.rgb, arrival.mono_ns, picture.stamp_ns or None)
            if picture.stamp_ns:
                self._newness.check(picture.stamp_ns)
        except CodecError as error:
            self._refuse(error.reason, f"{self._topic.topic}: {error}", outlet.name)
            if error.reason in ("encoding", "frame"):  # they will all be like that
                outlet.lose(str(error))
            return False
        outlet.captured(arrival.mono_ns)
        outlet.set_state(OK)
        if due and outlet.has_subscribers:
            settings = outlet.profile
            rgb = resize(picture.rgb, settings.width, settings.height)
            stamp_ns = picture.stamp_ns or self._node.clock.wall_at(arrival.mono_ns)
            outlet.publish_rgb(rgb, arrival.mono_ns, stamp_ns)
        return True

    def _read(self, arrival: ReceivedSample) -> RosImage:
        payload = arrival.sample.payload.to_bytes()
        picture: RosImage = table.read(self._messages, self._topic.type, payload)
        if self._topic.frame is not None and picture.frame != self._topic.frame:
            raise CodecError(
                "frame", f"in frame {picture.frame[:60]!r}, wanted {self._topic.frame!r}"
            )
        return picture
