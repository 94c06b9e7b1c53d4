"""Receives camera images, prints rate and age, and saves the last one.

python examples/subscribe_to_camera.py [PROFILE] [CAMERA]
"""

import sys
import time
from pathlib import Path

import cv2

import vla_zenoh

IMAGES = 30


def main(profile: str = "panda_sim", camera: str = "front") -> None:
    """Print one line per image; write the last to ``CAMERA.png``."""
    with vla_zenoh.connect(profile) as robot:
        begun_s = time.monotonic()
        for count in range(1, IMAGES + 1):
            image = robot.image(camera)  # the next one, (height, width, 3) uint8 RGB
            age_ms = (time.time_ns() - image.header.stamp_wall_ns) / 1e6
            rate_hz = count / (time.monotonic() - begun_s)
            print(f"{image.record.rgb.shape}  {rate_hz:4.1f} Hz  {age_ms:5.1f} ms old")
        path = Path(f"{camera}.png")
        cv2.imwrite(str(path), cv2.cvtColor(image.record.rgb, cv2.COLOR_RGB2BGR))
        print(f"wrote {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
