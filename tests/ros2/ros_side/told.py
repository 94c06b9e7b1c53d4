"""How these programs talk with a test: JSON objects, one a line, on stdin and stdout."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

_LOCK = threading.Lock()


def tell(**what: Any) -> None:
    """One line to the test; `t` is the monotonic clock of this computer, ns."""
    line = json.dumps({"t": time.monotonic_ns(), **what})
    with _LOCK:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()


def obey(commands: dict[str, Callable[..., None]]) -> None:
    """Execute the lines of the test, each with its name in `do`, until there are no more."""
    for line in sys.stdin:
        given = json.loads(line)
        try:
            commands[given.pop("do")](**given)
        except Exception as error:  # the test decides what it means
            tell(failed=f"{type(error).__name__}: {error}")
