"""Run on a host of the lab: all fixed motions, done and judged as `vla-zenoh demo --prompt` does.

tour.py PROFILE
"""

from __future__ import annotations

import json
import sys
import threading

from chain import READY_PATIENCE_S

from benchmarks.motion.runner import MotionRunner
from benchmarks.motion.segments import make_segment
from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.profile import load_profile

RATE_HZ = 10.0
TOUR: tuple[tuple[str, int], ...] = (
    ("HARD: go up", 15),
    ("HARD: roll right", 6),
    ("HARD: roll left", 6),
    ("HARD: pitch down", 6),
    ("HARD: pitch up", 6),
    ("HARD: yaw left", 10),
    ("HARD: yaw right", 10),
    ("HARD: close gripper", 2),
    ("HARD: open gripper", 2),
    ("HARD: go down", 15),
)
"""Prompt and steps: every axis there and back, and the gripper, within reach of the home pose."""


def main(name: str) -> None:
    profile = load_profile(name)
    with open_session(profile.session, wait_s=READY_PATIENCE_S) as session:
        client = Client(profile, session).subscribe()
        run = MotionRunner(client, threading.Event())
        run.begin(RATE_HZ)
        segments = [make_segment(prompt, steps) for prompt, steps in TOUR]
        outcomes = [run.run_segment(segment, RATE_HZ) for segment in segments]
        client.deactivate()
    print(json.dumps([outcome.to_dict() for outcome in outcomes]))


if __name__ == "__main__":
    main(sys.argv[1])
