"""Tells a webhook by JSON, without holding up the caller."""

from __future__ import annotations

import json
import queue
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from typing import Any

PATIENCE_S, ATTEMPTS, BACK_OFF_S = 5.0, 3, 1.0
MAX_WAITING = 50


class Webhook:
    """Posts messages on a thread of its own, in order; a full queue drops the newest.

    Args:
        url: where to; empty: nowhere.
        warn: called with what could not be sent.
    """

    def __init__(self, url: str, warn: Callable[[str], None]) -> None:
        self._url, self._warn = url, warn
        self._waiting: queue.Queue[dict[str, Any] | None] = queue.Queue(MAX_WAITING)
        self._thread = threading.Thread(target=self._send, name="webhook", daemon=True)
        if url:
            self._thread.start()

    def tell(self, what: str, fields: Mapping[str, Any]) -> None:
        """Post ``{"what": what, "time": Unix seconds, ...}``."""
        if not self._url:
            return
        try:
            self._waiting.put_nowait({"what": what, "time": round(time.time(), 3), **fields})
        except queue.Full:
            self._warn(f"webhook: too many messages wait, dropped {what!r}")

    def close(self, timeout_s: float = 2 * PATIENCE_S) -> None:
        """Send what waits, for `timeout_s` at most."""
        if self._url:
            try:
                self._waiting.put(None, timeout=timeout_s)
            except queue.Full:
                return
            self._thread.join(timeout_s)

    def _send(self) -> None:
        while (message := self._waiting.get()) is not None:
            body = json.dumps(message).encode()
            for attempt in range(ATTEMPTS):
                request = urllib.request.Request(
                    self._url, body, {"content-type": "application/json"}
                )
                try:
                    with urllib.request.urlopen(request, timeout=PATIENCE_S):
                        break
                except (OSError, ValueError) as error:
                    if isinstance(error, urllib.error.HTTPError):
                        error.close()
                    if attempt == ATTEMPTS - 1:
                        self._warn(f"webhook: {message['what']!r} was not delivered: {error}")
                    time.sleep(BACK_OFF_S)
