"""Plain text that people and foreign clients put on the setting keys, to values and back.

No envelope, no header: ``true`` on ``active`` is all it takes from any language.
"""

from __future__ import annotations

import math

from vla_zenoh.errors import CodecError
from vla_zenoh.types import MAX_TEXT

MAX_SETTING_BYTES = 4 * MAX_TEXT
TRUE_WORDS = frozenset({"true", "1", "on", "yes"})
FALSE_WORDS = frozenset({"false", "0", "off", "no"})
MIN_RATE_HZ, MAX_RATE_HZ = 0.05, 100.0


def decode_text(payload: bytes) -> str:
    """UTF-8 text without control characters, white space trimmed.

    Raises:
        CodecError: ``oversize``, ``malformed`` (not UTF-8) or ``invalid`` (control characters).
    """
    if len(payload) > MAX_SETTING_BYTES:
        raise CodecError("oversize", f"{len(payload)} bytes, at most {MAX_SETTING_BYTES} are read")
    try:
        value = payload.decode("utf-8").strip()
    except UnicodeDecodeError as error:
        raise CodecError("malformed", f"not UTF-8 text: {error.reason}") from error
    if len(value) > MAX_TEXT:
        raise CodecError("oversize", f"{len(value)} characters, at most {MAX_TEXT} are read")
    if any(ord(c) < 32 and c not in "\t\n\r" for c in value) or "\x7f" in value:
        raise CodecError("invalid", "text holds control characters")
    return value


def decode_bool(payload: bytes) -> bool:
    """true/false, 1/0, on/off, yes/no in any case; JSON booleans are among them."""
    word = decode_text(payload).strip('"').lower()
    if word in TRUE_WORDS:
        return True
    if word in FALSE_WORDS:
        return False
    raise CodecError("invalid", f"{word[:40]!r} is neither true nor false (also 1/0, on/off)")


def decode_rate(payload: bytes) -> float:
    """Chunks per second within `MIN_RATE_HZ` and `MAX_RATE_HZ`."""
    word = decode_text(payload)
    try:
        rate_hz = float(word)
    except ValueError as error:
        raise CodecError("invalid", f"{word[:40]!r} is not a number of Hz") from error
    if not math.isfinite(rate_hz) or not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise CodecError(
            "invalid", f"rate {word[:40]!r} Hz is outside [{MIN_RATE_HZ:g}, {MAX_RATE_HZ:g}]"
        )
    return rate_hz


def decode_name(payload: bytes) -> str:
    """A worker's name: one word that can stand in a key."""
    word = decode_text(payload)
    if not word or len(word) > 128 or not all(c.isascii() and (c.isalnum() or c in "_.-") for c in word):
        raise CodecError("invalid", f"{word[:40]!r} is not a worker's name")
    return word


def decode_seed(payload: bytes) -> int | None:
    """Empty, or a whole number: the seed of the simulator's next placement."""
    word = decode_text(payload)
    if not word:
        return None
    if not word.isascii() or not word.isdigit() or len(word) > 10:
        raise CodecError("invalid", f"{word[:40]!r} is not a seed: give nothing or a whole number")
    return int(word)


def encode_bool(value: bool) -> bytes:
    """What our own clients put."""
    return b"true" if value else b"false"
