"""Hold-to-run: when the button of a page counts as held. Pure.

The server sends a tick, its monotonic time in ms, several times a second; while the button is held
the browser sends back the newest tick it got. A tick that is older than `HOLD_S` is no proof, so
messages that a network kept back and delivers late do not keep an arm in motion. A hold that ended
does not come back: the button has to be pressed again.
"""

from __future__ import annotations

from typing import NamedTuple

HOLD_S = 0.6
"""From a tick until its echo is too old. A tick goes out each 50 ms and an echo each 100 ms, so a
network may be late by 0.4 s."""


class Held(NamedTuple):
    """The hold in force.

    Args:
        page: that holds; number of its connection.
        until_s: when it ends without a newer echo.
    """

    page: int
    press: int
    until_s: float


class Hold:
    """At most one page at a time holds."""

    def __init__(self) -> None:
        self.held: Held | None = None
        self._last_press: dict[int, int] = {}

    def press(self, page: int, press: int, tick_ms: int, now_s: float) -> str:
        """Begin a hold; returns why not, empty if it began."""
        self.expire(now_s)
        if self.held is not None and self.held.page != page:
            return "another page holds the arm"
        if press <= self._last_press.get(page, -1):
            return "this press has ended"
        until_s = _until_s(tick_ms, now_s)
        if until_s <= now_s:
            return "the connection is too slow: let go, and press again"
        self._last_press[page] = press
        self.held = Held(page, press, until_s)
        return ""

    def beat(self, page: int, press: int, tick_ms: int, now_s: float) -> bool:
        """Extend a hold; False if it is not in force any more."""
        self.expire(now_s)
        held = self.held
        if held is None or (held.page, held.press) != (page, press):
            return False
        self.held = held._replace(until_s=max(held.until_s, _until_s(tick_ms, now_s)))
        return True

    def holds(self, page: int, press: int | None = None) -> bool:
        """Whether the hold in force is of this page, and of this press of it."""
        held = self.held
        return held is not None and held.page == page and press in (None, held.press)

    def release(self, page: int, press: int | None = None) -> None:
        """End the hold of a page, if it has it; of a press: no newer one."""
        if self.holds(page, press):
            self.held = None

    def forget(self, page: int) -> None:
        self.release(page)
        self._last_press.pop(page, None)

    def expire(self, now_s: float) -> None:
        """End a hold whose echoes are too old."""
        if self.held is not None and now_s >= self.held.until_s:
            self.held = None


def _until_s(tick_ms: int, now_s: float) -> float:
    sent_s = tick_ms / 1e3
    return sent_s + HOLD_S if sent_s <= now_s else now_s
