"""A camera in plain Python: a device of OpenCV's, or noise where none is given.

    python examples/wire/camera.py [ENDPOINT] [ROBOT] [CAMERA] [RATE_HZ] [DEVICE]

Needs opencv-python-headless, too. Images have the size that the device gives: the profile's
`width` and `height` are to be the same.
"""

import sys
import time

import cv2
import numpy as np
import zenoh
from plain_node import IMAGES, Node, open_session

SIZE = (480, 640)


def images(device: str):
    """Images of the device in RGB, or noise."""
    if not device:
        while True:
            yield np.random.randint(0, 256, (*SIZE, 3), np.uint8)
    capture = cv2.VideoCapture(int(device) if device.isdecimal() else device)
    while True:
        got, bgr = capture.read()
        if not got:
            sys.exit(f"camera {device} gives no image")
        yield cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def main(
    endpoint: str = "tcp/127.0.0.1:7447",
    robot: str = "vla/panda",
    camera: str = "front",
    rate_hz: str = "30",
    device: str = "",
) -> None:
    """Run until it is ended."""
    with open_session(endpoint) as session:
        node = Node(session, robot, "camera")
        next_s = time.monotonic()
        for rgb in images(device):
            stamp_ns = time.time_ns()
            height, width, _ = rgb.shape
            raw = zenoh.Encoding(f"zenoh/bytes;rgb8;{height}x{width}")
            _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
            node.put(f"camera/{camera}/raw", rgb.tobytes(), raw, IMAGES, stamp_ns)
            jpeg_kind = zenoh.Encoding("image/jpeg")
            node.put(f"camera/{camera}/jpeg", jpeg.tobytes(), jpeg_kind, IMAGES, stamp_ns)
            age_s = (time.time_ns() - stamp_ns) / 1e9
            node.publish_status("running", {"cameras": {camera: {"age_s": age_s}}})
            next_s = max(next_s + 1 / float(rate_hz), time.monotonic())
            time.sleep(max(next_s - time.monotonic(), 0.0))


if __name__ == "__main__":
    main(*sys.argv[1:])
