"""A stranger's program: so many puts a second on one key, until it is ended.

``python flood.py CONNECT KEY HZ FILE``: the payload is what is in FILE, its attachment in FILE.head
where that exists. How many it made, and in how long, is printed at the end.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from pathlib import Path

import zenoh

NAP_S = 0.001


def main() -> None:
    """Flood."""
    connect, key, hz, file = sys.argv[1:]
    payload, head = Path(file).read_bytes(), Path(f"{file}.head")
    attachment = head.read_bytes() if head.exists() else None
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    settings = {
        "mode": "client",
        "connect": {"endpoints": [connect]},
        "scouting": {"multicast": {"enabled": False}},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(settings))) as session:
        publisher = session.declare_publisher(key)
        began, sent = time.monotonic(), 0
        while not stop.is_set():
            due = int((time.monotonic() - began) * float(hz))
            for _ in range(due - sent):
                publisher.put(payload, attachment=attachment)
            sent = max(sent, due)
            time.sleep(NAP_S)
        print(sent, time.monotonic() - began)


if __name__ == "__main__":
    main()
