"""Run on the robot's host: what of a stranger came through, and whether the arm moved.

    watch.py PROFILE MARK      says ``watching``; a line on standard input ends it

Tokens of whoever holds the arm are for the command node alone, whose certificate lies here.
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

from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.codec import records
from vla_zenoh.keys import last_chunk, worker_node
from vla_zenoh.profile import load_profile
from vla_zenoh.types import Task

SETTLE_S = 1.0
"""Status comes twice a second."""
RESETS = "sim.resets"


def main(name: str, mark: str) -> None:
    profile = load_profile(name)
    keys = profile.keys
    marked: Counter[str] = Counter()
    tasks: dict[tuple[str, str, float, bool], None] = {}
    alive, held = set[str](), set[str]()

    def take(sample: zenoh.Sample) -> None:
        attachment, payload = sample.attachment, sample.payload.to_bytes()
        if mark.encode() in payload + (attachment.to_bytes() if attachment else b""):
            marked[keys.short(str(sample.key_expr))] += 1
        if str(sample.key_expr) == keys.task:
            task = records.decode(Task, payload)
            tasks[task.prompt, task.worker, task.rate_hz, task.active] = None

    def note(into: set[str]) -> zenoh.handlers.Callback[zenoh.Sample]:
        return zenoh.handlers.Callback(
            lambda s: into.add(last_chunk(str(s.key_expr))), indirect=False
        )

    with (
        open_session(profile.session, wait_s=READY_PATIENCE_S) as session,
        open_session(profile.session, identity="command") as commands,
    ):
        client = Client(profile, session).subscribe()
        recorder = Recorder(session, keys)
        until("a pose", recorder.newest_state)
        until("a task", lambda: client.task)
        first = client.task
        assert first is not None
        until("its worker", lambda: worker_node(first.worker) in client.alive, READY_PATIENCE_S)
        until("the simulator", lambda: client.status("sim"))
        client.pop_events()
        before = client.snapshot()["sim"][0].counters.get(RESETS, 0)
        taking = zenoh.handlers.Callback(take, indirect=False)
        listening = [
            session.declare_subscriber(keys.all_keys, taking),
            session.liveliness().declare_subscriber(keys.all_alive, note(alive), history=True),
            commands.liveliness().declare_subscriber(keys.all_holding, note(held), history=True),
        ]
        until("the task of now", lambda: tasks)
        began_ns = time.time_ns()
        print("watching", flush=True)
        sys.stdin.readline()
        time.sleep(SETTLE_S)
        track = recorder.track().between(began_ns)
        for one in listening:
            one.undeclare()
        news = [[node, event.what] for node, _, event in client.pop_events()]
        print(
            json.dumps(
                {
                    "marked": marked,
                    "moved_m": float(np.ptp(track.position_m, axis=0).max()),
                    "tasks": list(tasks),
                    "transitions": [what for _, what in news if "->" in what],
                    "resets": client.snapshot()["sim"][0].counters.get(RESETS, 0) - before,
                    "alive": sorted(alive),
                    "held": sorted(held),
                }
            )
        )


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
