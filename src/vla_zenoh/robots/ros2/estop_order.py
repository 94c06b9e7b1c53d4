"""Emergency stops, whoever puts them: what was asked before one is not done after it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import zenoh

from vla_zenoh.errors import SessionError


class EstopOrder:
    """See the module.

    What waits its turn, while somebody else's call is answered or this process does not run, is
    older than a stop that waits for nothing, and would take it back: a reset, or ``true``.

    Args:
        session: on which those of others are heard.
        key: of stops.
    """

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._lock = threading.Lock()
        self._ours_ns = self._others_ns = -1
        handler = zenoh.handlers.Callback(self._heard, indirect=False)
        self._subscriber = session.declare_subscriber(
            key, handler, allowed_origin=zenoh.Locality.REMOTE
        )

    def _heard(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._others_ns = time.monotonic_ns()

    def stop(self, put: Callable[[], None]) -> None:
        """Stop by calling `put`."""
        with self._lock:
            self._ours_ns = time.monotonic_ns()
            put()

    def overtook(self, asked_ns: int) -> bool:
        """Whether a stop came after that, on the monotonic clock."""
        return max(self._ours_ns, self._others_ns) > asked_ns

    def check(self, asked_ns: int) -> None:
        """That none did.

        Raises:
            SessionError: one did.
        """
        if self.overtook(asked_ns):
            raise SessionError("an emergency stop came after this was asked; ask again")

    def unless_stopped(self, asked_ns: int, put: Callable[[], None]) -> None:
        """Call `put`; no stop of ours comes between the check and it.

        Raises:
            SessionError: a stop came after `asked_ns`.
        """
        with self._lock:
            self.check(asked_ns)
            put()
