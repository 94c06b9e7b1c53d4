"""Bytes from a terminal to key strokes.

Most terminals only say that a key was typed, again and again while it is held. Those with the
keyboard protocol of kitty (https://sw.kovidgoyal.net/kitty/keyboard-protocol/) also say when it is
let go; `BEGIN` asks for it, and others ignore what they do not know.
"""

from __future__ import annotations

import re
from enum import Enum
from typing import NamedTuple

from vla_zenoh.lab.teleop.policy import AXES, OperatorInput, clipped_twist

BEGIN = b"\x1b[>11u\x1b[?u\x1b[?1004h"
"""Tell releases (1 + 2 + 8), say whether you do, and tell when the window loses the focus."""
END = b"\x1b[?1004l\x1b[<u"
"""Everything as it was."""

MAX_SEQUENCE = 32
CTRL = 4
_ESCAPE = 0x1B
_CSI = re.compile(rb"\x1b\[([0-?]*)[ -/]*([@-~])")
_NAMES = {"\r": "enter", "\n": "enter", "\t": "tab", " ": "space", "\x03": "ctrl+c"}
_CODES = {13: "enter", 9: "tab", 32: "space", 27: "escape"}


class KeyEvent(Enum):
    """What happened to a key."""

    TYPED = "typed"  # pressed or still held: this terminal does not tell
    PRESSED = "pressed"
    HELD = "held"
    RELEASED = "released"


class Keystroke(NamedTuple):
    """One event of one key: its name (`w`, `space`, `enter`, `ctrl+c`) and what happened.

    Besides keys there are `releases`: this terminal tells them; and `unfocused`: it hears no more.
    """

    key: str
    how: KeyEvent


class KeystrokeParser:
    """Takes bytes as they come, cut anywhere."""

    def __init__(self) -> None:
        self._rest = b""

    def read(self, data: bytes) -> list[Keystroke]:
        """Strokes that are complete now; what is not known is left out."""
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
        event = int(fields[1][1]) if len(fields) > 1 and len(fields[1]) > 1 else 1
    except ValueError:
        return []
    how = {1: KeyEvent.PRESSED, 2: KeyEvent.HELD, 3: KeyEvent.RELEASED}.get(event)
    name = _CODES.get(code) or (chr(code).lower() if 0x20 < code < 0x7F else "")
    if how is None or not name:
        return []
    return [Keystroke(f"ctrl+{name}" if modifiers & CTRL else name, how)]


HOLD_S = 0.15
"""Where releases are not told, a key counts as held for so long after it was typed: repeats come
at 20 to 30 Hz."""

MOVES: dict[str, tuple[int, float]] = {
    "w": (0, 1.0),
    "s": (0, -1.0),
    "a": (1, 1.0),
    "d": (1, -1.0),
    "r": (2, 1.0),
    "f": (2, -1.0),
    "l": (3, 1.0),
    "j": (3, -1.0),
    "i": (4, 1.0),
    "k": (4, -1.0),
    "u": (5, 1.0),
    "o": (5, -1.0),
}
"""Key -> axis of the twist and direction."""
OPENINGS = {".": 1.0, ",": -1.0}
TOGGLE = "space"
LEVELS = "12345"
QUIT, STOP, ACTIVATE, TAKE_OVER = "quit", "stop", "switch", "give"
KEY_COMMANDS = {"q": QUIT, "ctrl+c": QUIT, "x": STOP, "enter": ACTIVATE, "tab": TAKE_OVER}
"""Keys that are said once: end, emergency stop, activate or deactivate, take or give the arm."""

LEGEND = """\
  w/s  x forward, back     l/j  turn about x     space  gripper         enter  (de)activate
  a/d  y left, right       i/k  turn about y     . ,    wider, less     tab    take or give
  r/f  z up, down          u/o  turn about z     1-5    speed           x STOP      q end"""


class Keyboard:
    """Held keys of a terminal. Time is the caller's, in s, of any steady clock.

    Attributes:
        level: chosen speed, from 0.
        tells_releases: this terminal says when a key is let go.
    """

    def __init__(self, level: int = 2) -> None:
        self.level = level
        self.tells_releases = False
        self._until_s: dict[str, float] = {}
        self._new: set[str] = set()
        self._toggles = 0

    def take(self, stroke: Keystroke, now_s: float) -> str | None:
        """One stroke; the order it gives, if it gives one."""
        key, how = stroke
        if key == "releases":
            self.tells_releases = True
        elif key == "unfocused":  # its releases will not be told
            self.release_all()
        elif key in MOVES or key in OPENINGS:
            self._hold(key, how, now_s)
        elif how in (KeyEvent.TYPED, KeyEvent.PRESSED):
            if key == TOGGLE:
                self._toggles += 1
            elif key in LEVELS:
                self.level = LEVELS.index(key)
            return KEY_COMMANDS.get(key)
        return None

    def _hold(self, key: str, how: KeyEvent, now_s: float) -> None:
        if how is KeyEvent.RELEASED:
            self._until_s.pop(key, None)
            return
        if key not in self._until_s:
            self._new.add(key)
        self._until_s[key] = now_s + HOLD_S if how is KeyEvent.TYPED else float("inf")

    def release_all(self) -> None:
        """No key is held any more."""
        self._until_s.clear()
        self._new.clear()

    def read(self, now_s: float) -> OperatorInput:
        """What is wanted since the last look: a key that was only tapped counts once."""
        self._until_s = {key: until for key, until in self._until_s.items() if until > now_s}
        down = self._new | set(self._until_s)
        self._new = set()
        twist = [0.0] * AXES
        for key in down & MOVES.keys():
            axis, sign = MOVES[key]
            twist[axis] += sign
        opening = sum(OPENINGS[key] for key in down & OPENINGS.keys())
        return OperatorInput(clipped_twist(twist), opening, self._toggles)
