"""Order of emergency stops and requests: no request is carried out after a later stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import zenoh

from vla_zenoh.errors import SessionError


class EstopOrder:
    """Times of the last emergency stops, of this process and of others.

    A reset or an activation that waits, while another call is answered or this process does not
    run, must not undo a stop that came later and was sent at once.

    Args:
        session: to subscribe to the stops of others.
        key: of stops.
    """

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._lock = threading.Lock()
        self._ours_ns = self._others_ns = -1
        handler = zenoh.handlers.Callback(self._on_stop, indirect=False)
        self._subscriber = session.declare_subscriber(
            key, handler, allowed_origin=zenoh.Locality.REMOTE
        )

    def _on_stop(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._others_ns = time.monotonic_ns()

    def stop(self, publish: Callable[[], None]) -> None:
        """Stop by calling `publish`."""
        with self._lock:
            self._ours_ns = time.monotonic_ns()
            publish()

    def overtook(self, asked_ns: int) -> bool:
        """Whether a stop came after `asked_ns` on the monotonic clock."""
        return max(self._ours_ns, self._others_ns) > asked_ns

    def check(self, asked_ns: int) -> None:
        """Check that no stop came after `asked_ns`.

        Raises:
            SessionError: one came.
        """
        if self.overtook(asked_ns):
            raise SessionError("an emergency stop came after this request; send it again")

    def unless_stopped(self, asked_ns: int, publish: Callable[[], None]) -> None:
        """Call `publish`; no stop of this process comes between the check and it.

        Raises:
            SessionError: a stop came after `asked_ns`.
        """
        with self._lock:
            self.check(asked_ns)
            publish()
