"""Run on the robot's host: what of a stranger came through, and whether the arm moved.

watch.py PROFILE SECONDS MARK
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter

import numpy as np
import zenoh
from camera_rig import until
from chain import READY_PATIENCE_S, Recorder

from vla_zenoh.nodes.client import Client
from vla_zenoh.nodes.session import open_session
from vla_zenoh.profile import load_profile


def main(name: str, seconds: float, mark: str) -> None:
    profile = load_profile(name)
    marked: Counter[str] = Counter()

    def take(sample: zenoh.Sample) -> None:
        attachment = sample.attachment
        said = sample.payload.to_bytes() + (attachment.to_bytes() if attachment else b"")
        if mark.encode() in said:
            marked[profile.keys.short(str(sample.key_expr))] += 1

    with open_session(profile.session, wait_s=READY_PATIENCE_S) as session:
        client = Client(profile, session).follow()
        recorder = Recorder(session, profile.keys)
        handler = zenoh.handlers.Callback(take, indirect=False)
        listening = session.declare_subscriber(profile.keys.everything, handler)
        until("a pose", recorder.newest_state)
        until("a task", lambda: client.task)
        print("watching", flush=True)
        time.sleep(seconds)
        track = recorder.track()
        listening.undeclare()
        assert client.task is not None
        print(
            json.dumps(
                {
                    "marked": marked,
                    "moved_m": float(np.ptp(track.position_m, axis=0).max()),
                    "prompt": client.task.prompt,
                    "active": client.task.active,
                    "worker": client.task.worker,
                    "alive": sorted(client.alive),
                }
            )
        )


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), sys.argv[3])
