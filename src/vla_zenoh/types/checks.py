"""Checks of record fields: each returns the value in its final form, or raises a `RecordError`.

Those of arrays are in ``arrays.py``, so that a command that only drives does not load numpy.
"""

from __future__ import annotations

import math
import reprlib
import sys
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Any

from vla_zenoh.errors import RecordError

MAX_TEXT = 4096
MAX_SHOWN = 300
MAX_NAMES = 1024
MAX_ENTRIES = 1024
MAX_DETAIL_TEXT = 65_536
MAX_DETAIL_DEPTH = 3


def shown(value: Any) -> str:
    """`value` in short, for an error message: it may be huge, nested, or refuse to be printed."""
    if isinstance(value, (str, bytes)):
        value = value[:80]
    return reprlib.repr(value)[:MAX_SHOWN]


def is_bool(value: Any) -> bool:
    """Whether `value` is a bool, of numpy too, which is not imported for it."""
    numpy = sys.modules.get("numpy")
    return isinstance(value, bool) or (numpy is not None and isinstance(value, numpy.bool_))


def number(name: str, value: Any, minimum: float = -math.inf, maximum: float = math.inf) -> float:
    """A finite float within ``[minimum, maximum]``."""
    if type(value) is float and minimum <= value <= maximum and math.isfinite(value):
        return value
    if isinstance(value, bool) or not isinstance(value, Real):
        raise RecordError(f"{name} is not a number: {shown(value)}")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result) or not minimum <= result <= maximum:
        raise RecordError(
            f"{name} is {shown(value)}, wanted a number in [{minimum:g}, {maximum:g}]"
        )
    return result


def integer(name: str, value: Any, minimum: int = 0, maximum: int = 2**63 - 1) -> int:
    """An int within ``[minimum, maximum]``."""
    if type(value) is int and minimum <= value <= maximum:
        return value
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise RecordError(f"{name} is not a whole number: {shown(value)}")
    result = int(value)
    if not minimum <= result <= maximum:
        raise RecordError(
            f"{name} is {shown(value)}, wanted a whole number in [{minimum}, {maximum}]"
        )
    return result


def text(name: str, value: Any, limit: int = MAX_TEXT) -> str:
    """A str of at most `limit` characters, all of which UTF-8 can carry."""
    if not isinstance(value, str):
        raise RecordError(f"{name} is not text: {type(value).__name__}")
    if len(value) > limit:
        raise RecordError(f"{name} has {len(value)} characters, at most {limit} are allowed")
    if not value.isascii():
        try:
            value.encode("utf-8")
        except UnicodeEncodeError as error:
            raise RecordError(f"{name} holds half a character (a surrogate)") from error
    return value


def texts(name: str, value: Any, limit: int) -> tuple[str, ...]:
    """A tuple of texts, of a list or tuple; a single str is not a list of its letters."""
    if not isinstance(value, (list, tuple)):
        raise RecordError(f"{name} is not a list of texts: {shown(value)}")
    if len(value) > MAX_NAMES:
        raise RecordError(f"{name} has {len(value)} entries, at most {MAX_NAMES} are allowed")
    return tuple(text(name, item, limit) for item in value)


def joint_names(name: str, value: Any) -> tuple[str, ...]:
    """Names of joints: at least one, none of them twice."""
    names = texts(name, value, 128)
    if not names or len(set(names)) != len(names):
        raise RecordError(f"joint names must be present and differ: {shown(names)}")
    return names


def boolean(name: str, value: Any) -> bool:
    """A bool; 0 and 1 are rejected."""
    if not is_bool(value):
        raise RecordError(f"{name} is not true or false: {shown(value)}")
    return bool(value)


def entries(name: str, value: Any, of: Callable[..., Any], **bounds: Any) -> dict[str, Any]:
    """A copy of a map from short names to what the check `of` returns."""
    if not isinstance(value, Mapping):
        raise RecordError(f"{name} is not a map: {shown(value)}")
    if len(value) > MAX_ENTRIES:
        raise RecordError(f"{name} has {len(value)} entries, at most {MAX_ENTRIES} are allowed")
    return {
        text(f"a name in {name}", key, 256): of(f"{name}.{key}", item, **bounds)
        for key, item in value.items()
    }


def details(name: str, value: Any, depth: int = MAX_DETAIL_DEPTH) -> Any:
    """Text, finite numbers, bools and None, in lists and maps that are not nested deep."""
    if value is None:
        return None
    if is_bool(value):
        return bool(value)
    if isinstance(value, str):
        return text(name, value, MAX_DETAIL_TEXT)
    if isinstance(value, Integral):
        return integer(name, value, -(2**63))
    if isinstance(value, Real):
        return number(name, value)
    if depth == 0:
        raise RecordError(f"{name} is nested too deep")
    if isinstance(value, Mapping):
        return entries(name, value, details, depth=depth - 1)
    if isinstance(value, (list, tuple)) and len(value) <= MAX_ENTRIES:
        return [details(name, item, depth - 1) for item in value]
    raise RecordError(f"{name} is not text, a number, a bool, a list or a map: {shown(value)}")


set_field = object.__setattr__
"""Puts the final form of a field into a frozen record."""


def keep(record: Any, check: Callable[..., Any], *names: str, **bounds: Any) -> None:
    """Put fields of a frozen record into the final form that `check` returns."""
    for name in names:
        set_field(record, name, check(name, getattr(record, name), **bounds))


def keep_given(record: Any, check: Callable[..., Any], *names: str, **bounds: Any) -> None:
    """`keep` for fields that may be None."""
    keep(record, check, *(name for name in names if getattr(record, name) is not None), **bounds)
