"""Run on a host of the lab: all fixed motions, done and judged as `vla-zenoh demo --tour` does.

tour.py PROFILE
"""

from __future__ import annotations

import json
import sys
import threading

from chain import READY_PATIENCE_S

from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.lab.demo.runner import MotionRunner
from vla_zenoh.lab.demo.segments import tour
from vla_zenoh.profile import load_profile

RATE_HZ = 10.0


def main(name: str) -> None:
    profile = load_profile(name)
    with open_session(profile.session, wait_s=READY_PATIENCE_S) as session:
        client = Client(profile, session).subscribe()
        run = MotionRunner(client, threading.Event())
        run.begin(RATE_HZ)
        outcomes = [run.run_segment(segment, RATE_HZ) for segment in tour()]
        client.deactivate()
    print(json.dumps([outcome.to_dict() for outcome in outcomes]))


if __name__ == "__main__":
    main(sys.argv[1])
