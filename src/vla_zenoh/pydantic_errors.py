"""What pydantic found wrong, in words for whoever wrote the value."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from typing import Any

_WORDS = {
    "missing": "is missing",
    "extra_forbidden": "is not known here",
    "float_type": "wants a number",
    "int_type": "wants a whole number",
    "int_from_float": "wants a whole number",
    "bool_type": "wants true or false",
    "string_type": "wants text",
    "string_unicode": "holds half a character (a surrogate)",
    "tuple_type": "wants a list",
    "dict_type": "wants a map",
    "model_type": "wants a map",
    "finite_number": "wants a finite number",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "too_long": "has {actual_length} entries, at most {max_length} fit",
    "too_short": "has {actual_length} entries, wants at least {min_length}",
    "string_too_long": "is longer than {max_length} characters",
    "string_too_short": "must not be empty",
}
_QUOTED = re.compile(r"'([^']*)'")


def describe_fault(fault: Any) -> str:
    """One entry of ``ValidationError.errors()``, as what is to be said after a field's name."""
    context = fault.get("ctx", {})
    if fault["type"] == "literal_error":
        near = nearest(str(fault.get("input")), _QUOTED.findall(context["expected"]))
        return f"wants {context['expected']}{near}"
    words = _WORDS.get(fault["type"])
    if words is not None:
        return words.format(**context)
    return fault["msg"].removeprefix("Value error, ")


def nearest(word: str, known: Iterable[str]) -> str:
    """``; did you mean 'x'?`` where one of `known` is like `word`, else nothing."""
    close = difflib.get_close_matches(word, list(known), 1)
    return f"; did you mean {close[0]!r}?" if close else ""
