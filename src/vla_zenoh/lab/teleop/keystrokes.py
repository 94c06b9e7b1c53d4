"""Bytes from a terminal to key strokes.

Most terminals only say that a key was typed, again and again while it is held. Those with the
keyboard protocol of kitty (https://sw.kovidgoyal.net/kitty/keyboard-protocol/) also say when it is
let go; `BEGIN` asks for it, and others ignore what they do not know.
"""

from __future__ import annotations

import re
from enum import Enum
from typing import NamedTuple

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


class How(Enum):
    """What happened to a key."""

    TYPED = "typed"  # pressed or still held: this terminal does not tell
    PRESSED = "pressed"
    HELD = "held"
    RELEASED = "released"


class Stroke(NamedTuple):
    """One event of one key: its name (`w`, `space`, `enter`, `ctrl+c`) and what happened.

    Besides keys there are `releases`: this terminal tells them; and `unfocused`: it hears no more.
    """

    key: str
    how: How


class KeystrokeParser:
    """Takes bytes as they come, cut anywhere."""

    def __init__(self) -> None:
        self._rest = b""

    def read(self, data: bytes) -> list[Stroke]:
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


def _plain(byte: bytes) -> list[Stroke]:
    character = byte.decode("ascii", "replace").lower()
    name = _NAMES.get(character, character)
    return [Stroke(name, How.TYPED)] if name.isprintable() and name.isascii() else []


def _sequence(parameters: str, final: str) -> list[Stroke]:
    if final == "O" and not parameters:
        return [Stroke("unfocused", How.TYPED)]
    if final != "u":
        return []
    if parameters.startswith("?"):
        return [Stroke("releases", How.TYPED)]
    fields = [field.split(":") for field in parameters.split(";")]
    try:
        code = int(fields[0][0])
        modifiers = int(fields[1][0] or 1) - 1 if len(fields) > 1 else 0
        event = int(fields[1][1]) if len(fields) > 1 and len(fields[1]) > 1 else 1
    except ValueError:
        return []
    how = {1: How.PRESSED, 2: How.HELD, 3: How.RELEASED}.get(event)
    name = _CODES.get(code) or (chr(code).lower() if 0x20 < code < 0x7F else "")
    if how is None or not name:
        return []
    return [Stroke(f"ctrl+{name}" if modifiers & CTRL else name, how)]
