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
    unknown = {"robot": None, "heard_by": [], "speed_rad_s": None, "speed_m_s": None}
    line = json.dumps({"ok": False, "outcome": "not_confirmed", **unknown, "message": UNHEARD})
    print(line if "--json" in sys.argv else UNHEARD, flush=True)


class Silence:
    """Runs during the slow imports of `vla-zenoh stop`; its first line cancels it."""

    def __init__(self) -> None:
        self._timer: threading.Timer | None = None

    def start(self) -> None:
        """Say that nobody answered in `SILENCE_S`, unless it is cancelled before."""
        self._timer = threading.Timer(SILENCE_S, _say_unheard)
        self._timer.daemon = True
        self._timer.start()

    def cancel(self) -> None:
        """Say nothing; also where it was not started."""
        if self._timer is not None:
            self._timer.cancel()


silence = Silence()
