"""Run on the robot's host: let each worker move the arm; how far it went, or why it did not.

try_workers.py PROFILE COUNT
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

from camera_rig import until
from chain import READY_PATIENCE_S, PatientClient, Recorder

from vla_zenoh.bus.session import open_session
from vla_zenoh.errors import SessionError
from vla_zenoh.profile import load_profile

STILL_M_S = 0.005
TRIED_S, ALIVE_S = 6.0, 20.0


def main(name: str, count: int) -> None:
    profile = load_profile(name)
    with open_session(profile.session, wait_s=READY_PATIENCE_S) as session:
        client = PatientClient(profile, session).subscribe()
        recorder = Recorder(session, profile.keys)
        client.wait_for(lambda: client.task, READY_PATIENCE_S)
        found = {worker: _try(client, recorder, worker, count) for worker in profile.workers}
        command = client.status("command")
        assert command is not None
        print(json.dumps({"workers": found, "counters": dict(command.counters)}))


def _try(client: PatientClient, recorder: Recorder, worker: str, count: int) -> dict[str, Any]:
    client.set_worker(worker)
    client.set_prompt("hold")
    why = ""
    until_s = time.monotonic() + ALIVE_S
    while time.monotonic() < until_s:
        try:
            client.activate()
            why = ""
            break
        except SessionError as error:
            why = str(error)
            # A worker of another build is there, and says so; another is still starting.
            if "schema" in why or "version" in why:
                break
            time.sleep(0.3)
    events = sorted({f"{node}: {event.what}: {event.why}" for node, _, event in client.events})
    client.events.clear()
    if why:
        return {"way_m": 0.0, "why": why, "events": events}
    state = until("a pose", recorder.newest_state)
    prompt = f"HARD: go up x{count}"
    client.set_prompt(prompt)

    def done() -> bool:
        command, now = client.status("command"), recorder.newest_state()
        assert command is not None
        assert now is not None
        still = abs(float(now.twist[2])) < STILL_M_S
        said = command.detail
        return bool(said.get("prompt") == prompt and said.get("policy_done") and still)

    ended = client.wait_for(done, TRIED_S + count)
    time.sleep(0.5)
    now = until("a pose", recorder.newest_state)
    client.deactivate()
    way_m = float(now.reference_position_m[2] - state.reference_position_m[2])
    return {"way_m": way_m, "why": "" if ended else "it did not end", "events": events}


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
