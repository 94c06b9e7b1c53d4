"""Cameras in ROS 2: an rclpy node that publishes pictures which the test knows as well.

    camera.py '{"rate_hz": 30, "topics": [{"topic": "/f", "encoding": "rgb8", "reliable": false}]}'

`encoding` is that of a sensor_msgs/Image, or ``jpeg`` for a CompressedImage, or another name with
the ``format`` of one. Pictures come in turn from the files `folder`/0.ENCODING and so on, which
hold the bytes of `data`.
"""

from __future__ import annotations

import array
import contextlib
import json
import sys
import threading
import time
from pathlib import Path
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from qos import publishes, qos
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import CompressedImage, Image
from told import obey, tell

SETTINGS = {"rate_hz": 30.0, "width": 640, "height": 480, "frame": "front_color_optical_frame"}


def message_of(settings: dict[str, Any], encoding: str, form: str, data: bytes) -> Any:
    """A picture as a ROS message, compressed in this form if there is one."""
    if form:
        out = CompressedImage(format=form)
    else:
        width, height = settings["width"], settings["height"]
        out = Image(encoding=encoding, width=width, height=height, step=len(data) // height)
    out.data = array.array("B", data)
    out.header.frame_id = settings["frame"]
    return out


def publish(settings: dict[str, Any], node: Any, stop: threading.Event) -> None:
    """Publish until `stop`."""
    outs = []
    for one in settings["topics"]:
        encoding = one["encoding"]
        form = one.get("format", "jpeg" if encoding == "jpeg" else "")
        kind = CompressedImage if form else Image
        how = qos(reliable=one.get("reliable", False), depth=one.get("depth", 5))
        publisher = node.create_publisher(
            kind, one["topic"], how, event_callbacks=publishes(one["topic"])
        )
        files = sorted(Path(settings["folder"]).glob(f"*.{encoding}"))
        made = [message_of(settings, encoding, form, file.read_bytes()) for file in files]
        outs.append((publisher, made))
    tell(ready=rclpy.get_rmw_implementation_identifier())
    next_s, count = time.monotonic(), 0
    while not stop.is_set():
        next_s = max(next_s + 1 / settings["rate_hz"], time.monotonic() - 0.1)
        time.sleep(max(0.0, next_s - time.monotonic()))
        for publisher, messages in outs:
            message = messages[count % len(messages)]
            now_ns = time.time_ns()
            message.header.stamp = Time(sec=now_ns // 10**9, nanosec=now_ns % 10**9)
            publisher.publish(message)
        count += 1


def spin(node: Any) -> None:
    """Serve until ROS ends: events come by it."""
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


def main() -> None:
    """Be the cameras until stdin ends."""
    settings = SETTINGS | json.loads(sys.argv[1])
    rclpy.init()
    node = rclpy.create_node("cameras")
    stop = threading.Event()
    publisher = threading.Thread(target=publish, args=(settings, node, stop))
    publisher.start()
    spinner = threading.Thread(target=spin, args=(node,))
    spinner.start()
    obey({})
    stop.set()
    publisher.join()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
