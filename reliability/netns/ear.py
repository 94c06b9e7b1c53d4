"""Run on a host of the lab: say one key again and again, and note when each key was heard.

    ear.py CONFIG.json KEY,KEY... [KEY=TEXT]     Zenoh's configuration, keys to hear, one to say

A line on standard input is answered by a line of JSON: key -> monotonic time it was last heard.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path

import zenoh

PERIOD_S = 0.02


def main(config: str, keys: str, saying: str = "") -> None:
    heard: dict[str, float] = {}
    stop = threading.Event()

    def take(sample: zenoh.Sample) -> None:
        heard[str(sample.key_expr)] = time.monotonic()

    with zenoh.open(zenoh.Config.from_json5(Path(config).read_text())) as session:
        handler = zenoh.handlers.Callback(take, indirect=False)
        listening = [session.declare_subscriber(key, handler) for key in keys.split(",")]
        key, _, text = saying.partition("=")

        def speak() -> None:
            while key and not stop.wait(PERIOD_S):
                session.put(key, text, allowed_destination=zenoh.Locality.REMOTE)

        thread = threading.Thread(target=speak)
        thread.start()
        print(json.dumps({"opened": True}), flush=True)
        for _ in sys.stdin:
            print(json.dumps(heard), flush=True)
        stop.set()
        thread.join()
        for one in listening:
            one.undeclare()


if __name__ == "__main__":
    main(*sys.argv[1:])
