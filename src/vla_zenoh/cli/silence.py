"""The first word of ``vla-zenoh stop`` where its imports, or the router, take long."""

from __future__ import annotations

import json
import sys
import threading
import time

BEGAN_S = time.monotonic()
"""When this program began, before its slow imports."""
SILENCE_S = 0.9
"""A stop that has said nothing for so long says that it is not confirmed, whatever it waits for."""
UNHEARD = (
    "NOT CONFIRMED: no answer yet. The stop may still arrive. USE THE ROBOT'S OWN EMERGENCY STOP"
)


def _say_unheard() -> None:
    unknown = {"robot": None, "heard_by": [], "speed_rad_s": None, "message": UNHEARD}
    line = json.dumps({"ok": False, "outcome": "not_confirmed", **unknown})
    print(line if "--json" in sys.argv else UNHEARD, flush=True)


silence = threading.Timer(SILENCE_S, _say_unheard)
"""Runs during the slow imports of `vla-zenoh stop`; its first line cancels it."""
silence.daemon = True
