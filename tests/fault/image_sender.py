"""A camera node of our own kind that can be killed: ``python image_sender.py CONNECT``.

It publishes an image of `IMAGE_BYTES` on the JPEG key of camera ``front``, and its status.
"""

from __future__ import annotations

import os
import sys
import time

import zenoh

from vla_zenoh.bus import shared_memory
from vla_zenoh.bus.node import Node
from vla_zenoh.bus.session import open_session
from vla_zenoh.keys import Kind
from vla_zenoh.profile import load_profile, override

IMAGE_BYTES, RATE_HZ = 300_000, 15.0


def main() -> None:
    """Publish until killed; a second argument is the host's bound in bytes."""
    connect = [sys.argv[1]]
    if len(sys.argv) > 2:
        shared_memory.HOST_BYTES = int(sys.argv[2])
    profile = override(load_profile("panda_sim"), {"session": {"connect": connect}})
    with open_session(profile.session, wait_s=30.0) as session:
        node = Node("camera", profile, session)
        images = node.declare_publisher(node.keys.camera_jpeg("front"), Kind.FRAME)
        payload = os.urandom(IMAGE_BYTES)  # recordings are compressed
        next_s = time.monotonic()
        while True:
            next_s += 1 / RATE_HZ
            time.sleep(max(0.0, next_s - time.monotonic()))
            images.publish(payload, encoding=zenoh.Encoding.IMAGE_JPEG)
            node.publish_status("running")


if __name__ == "__main__":
    main()
