"""Run on a host of the lab: drive the arm as an operator does, and say how far it went.

drive.py PROFILE DIRECTION COUNT
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
from camera_rig import until
from chain import READY_PATIENCE_S, FloatArray, Recorder

from vla_zenoh.bus.session import open_session
from vla_zenoh.client.client import Client
from vla_zenoh.errors import SessionError
from vla_zenoh.profile import load_profile

STILL_M_S = 0.005
ATTEMPTS = 2
STALLS = ("the command loop stood still", "robot state lost", "robot state comes late")
"""Why an arm brakes on a computer that gives its processes no time: right, and no fault of the lab.
Whatever else ends a motion is one."""
EARLY = "refused.activate_refused"
"""While nodes are still starting."""


def main(name: str, direction: str, count: int) -> None:
    profile = load_profile(name)
    with open_session(profile.session, wait_s=READY_PATIENCE_S) as session:
        client = Client(profile, session).subscribe()
        recorder = Recorder(session, profile.keys)
        reasons = [""]

        def activated() -> bool:
            try:
                return client.activate().active
            except SessionError as error:
                reasons.append(str(error))
                return False

        # Not by a status: `up` publishes one in the name of a node that is still starting.
        client.wait_for(lambda: "command" in client.alive and client.task, READY_PATIENCE_S)

        def begin() -> FloatArray:
            client.set_prompt("hold")
            client.set_rate(profile.task.rate_hz)
            try:
                until("an active arm", activated, READY_PATIENCE_S)
            except AssertionError as error:
                raise AssertionError(f"{error}: {reasons[-1]}") from error
            state = until("a pose", recorder.newest_state)
            assert state.reference_position_m is not None
            client.set_prompt(f"HARD: go {direction} x{count}")
            return np.array(state.reference_position_m)

        def done() -> bool:
            command, now = client.status("command"), recorder.newest_state()
            assert now is not None
            if command is not None and command.state == "inactive":
                why = str(command.detail.get("why"))
                anew.append(why)
                assert why.startswith(STALLS), f"the motion was ended: {why}"
                assert len(anew) < ATTEMPTS, f"ended again and again: {anew}"
                starts_m.append(begin())
                return False
            still = float(np.abs(now.twist[:3]).max()) < STILL_M_S
            return bool(command and command.detail.get("policy_done") and still)

        starts_m, anew = [begin()], list[str]()
        try:
            until("the motion", done, ATTEMPTS * (10.0 + count))
        except AssertionError as error:
            news = [f"{node} {event.what}: {event.why}" for node, _, event in client.events]
            raise AssertionError("\n".join([str(error), str(client.task), *news[-20:]])) from error
        time.sleep(0.5)
        end = until("a pose", recorder.newest_state)
        client.deactivate()
        camera = client.status("camera")
        refused = {
            node: {
                k: v for k, v in status.counters.items() if k.startswith("refused.") and k != EARLY
            }
            for node, (status, _, _) in client.snapshot().items()
        }
        print(
            json.dumps(
                {
                    "way_m": (np.array(end.reference_position_m) - starts_m[-1]).tolist(),
                    "jpeg": camera.counters.get("front.jpeg", 0) if camera else 0,
                    "raw": camera.counters.get("front.raw", 0) if camera else 0,
                    "begun_anew": anew,
                    "refused": {node: found for node, found in refused.items() if found},
                }
            )
        )


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
