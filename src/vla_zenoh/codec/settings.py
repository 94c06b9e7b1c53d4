"""Converts plain text that people and other clients put on the setting keys to values and back.

No envelope, no header: ``true`` on ``active`` is all it takes from any language. Decoders raise a
`CodecError` that says what is allowed: ``oversize``, ``malformed`` (not UTF-8) or ``invalid``.
"""

from __future__ import annotations

import re
import unicodedata

from vla_zenoh import keys
from vla_zenoh.errors import CodecError, ProfileError
from vla_zenoh.types import MAX_TEXT, HeldBox

MAX_SETTING_BYTES = 4 * MAX_TEXT
TRUE_WORDS = frozenset({"true", "1", "on", "yes"})
FALSE_WORDS = frozenset({"false", "0", "off", "no"})
WHILE = "while"
MIN_RATE_HZ, MAX_RATE_HZ = 0.05, 100.0
MIN_HELD_M, MAX_HELD_M = 0.001, 1.0
"""Of an edge of what a gripper holds, and of the distance of its centre."""

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?")
MAX_SEED_DIGITS = 10


def encode_text(text: str) -> bytes:
    """UTF-8; half a character (a surrogate) stays, and the decoders reject it."""
    return text.encode("utf-8", "surrogatepass")


def decode_text(payload: bytes) -> str:
    """UTF-8 text without control characters, white space trimmed."""
    if len(payload) > MAX_SETTING_BYTES:
        raise CodecError("oversize", f"{len(payload)} bytes, at most {MAX_SETTING_BYTES} are read")
    try:
        value = payload.decode("utf-8").strip()
    except UnicodeDecodeError as error:
        raise CodecError("malformed", f"not UTF-8 text: {error.reason}") from error
    if len(value) > MAX_TEXT:
        raise CodecError("oversize", f"{len(value)} characters, at most {MAX_TEXT} are read")
    # The C1 ones are among them: 0x9b alone steers a terminal.
    if any(unicodedata.category(c) == "Cc" and c not in "\t\n\r" for c in value):
        raise CodecError("invalid", "text holds control characters")
    return value


def decode_bool(payload: bytes) -> bool:
    """true/false, 1/0, on/off, yes/no in any case; JSON booleans are among them."""
    word = decode_text(payload).lower()
    if word in TRUE_WORDS:
        return True
    if word in FALSE_WORDS:
        return False
    raise CodecError("invalid", f"{word[:40]!r} is neither true nor false (also 1/0, on/off)")


def decode_activation(payload: bytes) -> bool | str:
    """A bool as `decode_bool`, or the deadman's name of ``true while NAME``."""
    words = decode_text(payload).split()
    if len(words) != 3 or words[0].lower() not in TRUE_WORDS or words[1].lower() != WHILE:
        return decode_bool(payload)
    return _key_part(words[2], "holder")


def decode_rate(payload: bytes) -> float:
    """Chunks per second within `MIN_RATE_HZ` and `MAX_RATE_HZ`."""
    word, wanted = decode_text(payload), f"{MIN_RATE_HZ:g} to {MAX_RATE_HZ:g} chunks per second"
    if not _NUMBER.fullmatch(word):
        raise CodecError("invalid", f"rate {word[:40]!r} is not a number: give {wanted}")
    rate_hz = float(word)
    if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise CodecError("invalid", f"rate {word[:40]!r} Hz is out of range: give {wanted}")
    return rate_hz


def decode_percent(payload: bytes) -> float:
    """A share of the speed, 0 to 100 percent: a plain number, ``%`` may stand behind it."""
    word = decode_text(payload)
    number = word.removesuffix("%").rstrip()
    if not _NUMBER.fullmatch(number):
        raise CodecError(
            "invalid",
            f"{word[:40]!r} is not a percentage: give a number from 0 to 100, such as '30'",
        )
    percent = float(number)
    if not 0.0 <= percent <= 100.0:
        raise CodecError(
            "invalid", f"speed {word[:40]!r} percent is out of range: give 0 to 100 percent"
        )
    return abs(percent)  # of "-0"


def decode_held(payload: bytes) -> HeldBox | str:
    """What the gripper holds: ``X Y Z [at X Y Z]`` in m, with spaces or commas; empty: nothing."""
    text = decode_text(payload)
    if not text:
        return text
    size, at, centre = (part.replace(",", " ").split() for part in text.partition("at"))
    numbers = [*size, *(centre if at else ("0", "0", "0"))]
    if len(size) != 3 or len(numbers) != 6 or not all(map(_NUMBER.fullmatch, numbers)):
        raise CodecError(
            "invalid",
            f"held {text[:60]!r} is no box: give its size in m along the axes of the TCP, such as "
            "'0.04 0.04 0.12', and where its centre is, such as '... at 0 0 0.02'",
        )
    x_m, y_m, z_m, *at_m = map(float, numbers)
    if not all(MIN_HELD_M <= edge <= MAX_HELD_M for edge in (x_m, y_m, z_m)) or not all(
        abs(offset) <= MAX_HELD_M for offset in at_m
    ):
        raise CodecError(
            "invalid",
            f"held {text[:60]!r} is out of range: edges {MIN_HELD_M:g} to {MAX_HELD_M:g} m, a "
            f"centre within {MAX_HELD_M:g} m of the TCP",
        )
    return HeldBox((x_m, y_m, z_m), (at_m[0], at_m[1], at_m[2]))


def decode_name(payload: bytes) -> str:
    """A worker's name: one word that can stand in a key."""
    return _key_part(decode_text(payload), "worker name")


def _key_part(word: str, what: str) -> str:
    try:
        return keys.key_chunk(word, what)
    except ProfileError as error:
        raise CodecError("invalid", str(error)) from error


def decode_seed(payload: bytes) -> int | None:
    """Empty, or a whole number: the seed of the simulator's next placement."""
    word = decode_text(payload)
    if not word:
        return None
    if not (word.isascii() and word.isdigit() and len(word) <= MAX_SEED_DIGITS):
        raise CodecError("invalid", f"{word[:40]!r} is not a seed: give nothing or a whole number")
    return int(word)
