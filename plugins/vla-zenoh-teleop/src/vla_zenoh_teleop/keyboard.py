"""Keyboard of teleoperation: terminal bytes to keystrokes, held keys to operator input. Pure.

Most terminals repeat a held key and do not report its release. Terminals with kitty's keyboard
protocol (https://sw.kovidgoyal.net/kitty/keyboard-protocol/) do report it; `BEGIN` requests it, and
other terminals ignore the request.
"""

from __future__ import annotations

import re
from enum import Enum
from typing import NamedTuple

from vla_zenoh_teleop.policy import AXES, OperatorInput, clipped_twist

BEGIN = b"\x1b[>11u\x1b[?u\x1b[?1004h"
"""Report releases (1 + 2 + 8), confirm that, and report when the window loses the focus."""
END = b"\x1b[?1004l\x1b[<u"
"""Undo `BEGIN`."""
MAX_SEQUENCE = 32
CTRL = 4
HOLD_S = 0.15
"""Without reports of releases a key counts as held for this long; repeats come at 20 to 30 Hz."""
SILENT_S = 1.0
"""With them, keys without any keystroke for this long are let go: the release may be stuck in a
stalled network, and a held key repeats, after 0.7 s at most by default. Only the last of several
held keys does."""

PAIRS = ("ws", "ad", "rf", "lj", "ik", "uo")
"""Keys of each axis of the twist, forward and back."""
MOVES = {
    key: (axis, sign)
    for axis, pair in enumerate(PAIRS)
    for key, sign in zip(pair, (1.0, -1.0), strict=True)
}
"""Key -> axis of the twist and direction."""
OPENINGS = {".": 1.0, ",": -1.0}
TOGGLE, NEXT_PART = "space", "p"
LEVELS = "12345"
QUIT, STOP, ACTIVATE, TAKE_OVER = "quit", "stop", "activate", "take_over"
KEY_COMMANDS = {"q": QUIT, "ctrl+c": QUIT, "x": STOP, "enter": ACTIVATE, "tab": TAKE_OVER}
LEGEND = """\
  w/s  x forward, back     l/j  rotate about x   space  gripper         enter  (de)activate
  a/d  y left, right       i/k  rotate about y   . ,    open, close     tab    take over, return
  r/f  z up, down          u/o  rotate about z   1-5    speed           x STOP      q quit"""
PARTS_LEGEND = "  p  move the next of: {}"

_ESCAPE = 0x1B
_CSI = re.compile(rb"\x1b\[([0-?]*)[ -/]*([@-~])")
_NAMES = {"\r": "enter", "\n": "enter", "\t": "tab", " ": "space", "\x03": "ctrl+c"}
_CODES = {13: "enter", 9: "tab", 32: "space", 27: "escape"}


class KeyEvent(Enum):
    """What happened to a key."""

    TYPED = "typed"  # pressed or repeated: this terminal does not distinguish
    PRESSED = "pressed"
    HELD = "held"
    RELEASED = "released"


class Keystroke(NamedTuple):
    """One event of one key.

    Args:
        key: its name (`w`, `space`, `enter`, `ctrl+c`); or `releases`: this terminal reports them;
            or `unfocused`: the window has lost the focus.
    """

    key: str
    event: KeyEvent


class KeystrokeParser:
    """Parses terminal bytes, split anywhere."""

    def __init__(self) -> None:
        self._rest = b""

    def read(self, data: bytes) -> list[Keystroke]:
        """Keystrokes complete by now; unknown sequences are dropped."""
        rest, out = self._rest + data, []
        while rest:
            if rest[0] != _ESCAPE:
                out += _plain(rest[:1])
                rest = rest[1:]
                continue
            found = _CSI.match(rest)
            if found:
                out += _sequence(found[1].decode(), found[2].decode())
                rest = rest[found.end() :]
            elif rest in (b"\x1b", b"\x1b[") or (rest[1:2] == b"[" and len(rest) < MAX_SEQUENCE):
                break
            else:
                rest = rest[1:]  # the Escape key itself, or nonsense
        self._rest = rest
        return out


def _plain(byte: bytes) -> list[Keystroke]:
    character = byte.decode("ascii", "replace").lower()
    name = _NAMES.get(character, character)
    return [Keystroke(name, KeyEvent.TYPED)] if name.isprintable() and name.isascii() else []


def _sequence(parameters: str, final: str) -> list[Keystroke]:
    if final == "O" and not parameters:
        return [Keystroke("unfocused", KeyEvent.TYPED)]
    if final != "u":
        return []
    if parameters.startswith("?"):
        return [Keystroke("releases", KeyEvent.TYPED)]
    fields = [field.split(":") for field in parameters.split(";")]
    try:
        code = int(fields[0][0])
        modifiers = int(fields[1][0] or 1) - 1 if len(fields) > 1 else 0
        number = int(fields[1][1]) if len(fields) > 1 and len(fields[1]) > 1 else 1
    except ValueError:
        return []
    event = {1: KeyEvent.PRESSED, 2: KeyEvent.HELD, 3: KeyEvent.RELEASED}.get(number)
    name = _CODES.get(code) or (chr(code).lower() if 0x20 < code < 0x7F else "")
    if event is None or not name:
        return []
    return [Keystroke(f"ctrl+{name}" if modifiers & CTRL else name, event)]


class Keyboard:
    """Held keys of a terminal. Times are the caller's, in s, of a monotonic clock.

    Attributes:
        level: selected speed, from 0.
        reports_releases: this terminal reports when a key is released.
    """

    def __init__(self, level: int = 2) -> None:
        self.level = level
        self.reports_releases = False
        self._until_s: dict[str, float] = {}
        self._stroke_s = 0.0
        self._new: set[str] = set()
        self._toggles = self._part = 0

    def update(self, stroke: Keystroke, now_s: float) -> str | None:
        """Process one keystroke; the command it gives, one of `KEY_COMMANDS`, if any."""
        key, event = stroke
        self._stroke_s = now_s
        if key == "releases":
            self.reports_releases = True
        elif key == "unfocused":  # no releases will be reported
            self.release_all()
        elif key in MOVES or key in OPENINGS:
            self._hold(key, event, now_s)
        elif event in (KeyEvent.TYPED, KeyEvent.PRESSED):
            if key == TOGGLE:
                self._toggles += 1
            elif key == NEXT_PART:
                self._part += 1
            elif key in LEVELS:
                self.level = LEVELS.index(key)
            return KEY_COMMANDS.get(key)
        return None

    def _hold(self, key: str, event: KeyEvent, now_s: float) -> None:
        if event is KeyEvent.RELEASED:
            self._until_s.pop(key, None)
            return
        if key not in self._until_s and event is not KeyEvent.HELD:
            self._new.add(key)
        # A repetition that a slow network kept back may be of a key that is up by now.
        held = event is KeyEvent.PRESSED or self._until_s.get(key) == float("inf")
        self._until_s[key] = float("inf") if held else now_s + HOLD_S

    def release_all(self) -> None:
        self._until_s.clear()
        self._new.clear()

    def read(self, now_s: float) -> OperatorInput:
        """Input since the last call: a key that was only tapped counts once."""
        if now_s - self._stroke_s > SILENT_S:
            self._until_s.clear()
        self._until_s = {key: until for key, until in self._until_s.items() if until > now_s}
        down = self._new | set(self._until_s)
        self._new = set()
        twist = [0.0] * AXES
        for key in down & MOVES.keys():
            axis, sign = MOVES[key]
            twist[axis] += sign
        opening = sum(OPENINGS[key] for key in down & OPENINGS.keys())
        return OperatorInput(clipped_twist(twist), opening, self._toggles, part=self._part)
