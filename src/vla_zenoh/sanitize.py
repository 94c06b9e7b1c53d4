"""Makes text from untrusted sources safe for a terminal."""

from __future__ import annotations

import unicodedata

_NOT_PRINTED = {"Cc", "Cf", "Cs", "Zl", "Zp"}


def printable(text: str) -> str:
    """`text` with its control characters escaped, safe for a terminal."""
    if text.isprintable():
        return text
    return "".join(
        c
        if c in "\n\t" or unicodedata.category(c) not in _NOT_PRINTED
        else c.encode("unicode_escape", "backslashreplace").decode("ascii")
        for c in text
    )


def one_line(value: object, most: int = 200) -> str:
    """The text of a value as one safe line of at most `most` characters."""
    text = str(value)
    cut = text if len(text) <= most else f"{text[:most]}..."
    return printable(cut.replace("\n", " ").replace("\t", " "))
