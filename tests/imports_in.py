"""The imports of a file, found without parsing the rest of it, which takes far longer."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

NAME = r"\w+(?:\.\w+)*(?: as \w+)?"
STATEMENT = re.compile(
    rf"^[ \t]*(?:import {NAME}(?:, {NAME})*[ \t]*(?:[#;].*)?$"
    r"|from [\w.]+ import (?:\([^)]*\)|[\w*].*))",
    re.MULTILINE,
)


def imports_in(source: str) -> Iterator[ast.Import | ast.ImportFrom]:
    """At the beginning of lines, where the formatter puts every one; those in strings, too."""
    for found in STATEMENT.finditer(source):
        for node in ast.parse(found.group().strip()).body:
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                yield ast.increment_lineno(node, source.count("\n", 0, found.start()))
