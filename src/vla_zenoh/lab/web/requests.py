"""What a browser may ask: JSON to checked requests. Pure."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from vla_zenoh.errors import CodecError
from vla_zenoh.types import MAX_TEXT, shown

MAX_BYTES = 8192
"""Of one message; the longest is a prompt."""
MAX_STREAMS = 16
REPORT, FILM = "report", "film"
MAX_NUMBER = 1e9
AXES = 6


class PageRequest(NamedTuple):
    """A checked request. `do`: its name, of `FIELDS`."""

    do: str
    values: Mapping[str, Any]


def _text(value: Any) -> bool:
    if not isinstance(value, str) or len(value) > MAX_TEXT:
        return False
    return not any("\ud800" <= letter <= "\udfff" for letter in value)  # half a character


def _number(value: Any) -> bool:
    return type(value) in (int, float) and -MAX_NUMBER <= value <= MAX_NUMBER  # no NaN


def _share(value: Any) -> bool:
    return _number(value) and -1 <= value <= 1


def _twist(value: Any) -> bool:
    return isinstance(value, list) and len(value) == AXES and all(map(_share, value))


def _count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**53


def _flag(value: Any) -> bool:
    return isinstance(value, bool)


def _level(value: Any) -> bool:
    return type(value) is int and 0 <= value < 5


def _word(*allowed: str) -> Callable[[Any], bool]:
    return lambda value: value in allowed


def _streams(value: Any) -> bool:
    return isinstance(value, list) and len(value) <= MAX_STREAMS and all(map(_text, value))


FIELDS: Mapping[str, Mapping[str, Callable[[Any], bool]]] = {
    "enter": {"token": _text},
    "stop": {},
    "reset": {},
    "prompt": {"text": _text},
    "worker": {"name": _text},
    "rate": {"hz": _number},
    "speed": {"percent": _number},
    "held": {"part": _text, "text": _text},
    "activate": {},
    "deactivate": {},
    "hold": {"press": _count, "tick": _count},
    "primitive": {"press": _count, "tick": _count, "name": _word("home", "open", "closed")},
    "beat": {"press": _count, "tick": _count, "twist": _twist, "opening": _share},
    "release": {},
    "jog": {"on": _flag, "frame": _word("base", "tcp"), "level": _level, "part": _text},
    "record": {"on": _flag, "verdict": _word("success", "failure", "void", ""), "note": _text},
    "save": {"note": _text},
    "trial": {
        "name": _text,
        "workers": _text,
        "prompt": _text,
        "episodes": _count,
        "seconds": _number,
        "blind": _flag,
    },
    "answer": {"number": _count, "line": _text},
    "watched": {"tick": _count},
    "end_trial": {},
    "runs": {},
    "make": {"name": _text, "kind": _word(REPORT, FILM)},
    "look": {"streams": _streams, "hz": _number},
    "drawn": {"frame": _count},
}
"""PageRequest -> its fields with their checks; all are required, and no others are allowed."""


def parse(text: str) -> PageRequest:
    """Read a message of a browser. Raises CodecError: it is no request; says what is wrong."""
    if len(text) > MAX_BYTES:
        raise CodecError("oversize", f"{len(text)} characters, at most {MAX_BYTES} are accepted")
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise CodecError("malformed", "no JSON") from error
    do = found.pop("do", None) if isinstance(found, dict) else None
    if not isinstance(do, str) or do not in FIELDS:
        raise CodecError("malformed", f"unknown request {shown(do)}")
    fields = FIELDS[do]
    if found.keys() != fields.keys():
        wanted = ", ".join(fields) or "nothing else"
        raise CodecError("malformed", f"{do} wants {wanted}; given: {shown(list(found))}")
    for name, check in fields.items():
        if not check(found[name]):
            raise CodecError("malformed", f"{do}: {name} is {shown(found[name])}")
    return PageRequest(do, found)
