"""The page about activation has every reason that the code can give, and what to do about it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "vla_zenoh"
PAGE = ROOT / "docs" / "how-to" / "not-activated.md"
REASONS = {
    "control/preflight.py": {
        *("reasons_by_joints", "reasons_of_worker", "joint_state_faults", "_elbow_is_not_held"),
        *(
            "_robot",
            "_guesses",
            "reasons_of_part",
            "_too_old",
            "_worker",
            "_chunk",
            "_cameras",
            "_clocks",
        ),
        *("unsettled", "why_not_ready", "state_lost"),
    },
    "control/commanded_part.py": {"reasons_by_worker"},
    "control/watchdog.py": {"reasons_against"},
    "control/contact.py": {"missing"},
    "control/commander.py": {"_activate", "_preflight", "_ended_before"},
}
"""File -> functions that give reasons against an activation, beside ``reasons`` of a monitor."""
LEAST_WORDS, LEAST_PREFIX = 4, 20
GAP = "..."


def sentences(file: str, functions: set[str]) -> Iterator[str]:
    """What these functions can say, with ``...`` for what is filled in."""
    for function in ast.walk(ast.parse((SOURCE / file).read_text())):
        if not isinstance(function, ast.FunctionDef) or function.name not in functions:
            continue
        inner: set[int] = set()
        for node in ast.walk(function):
            if id(node) in inner:
                continue
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                inner.add(id(node.value))  # a docstring
            if isinstance(node, ast.JoinedStr):
                inner |= {id(part) for part in ast.walk(node)} - {id(node)}
                parts = [
                    part.value if isinstance(part, ast.Constant) else GAP for part in node.values
                ]
                yield "".join(map(str, parts))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.value


def monitor_files() -> list[str]:
    """Files of control/ with a monitor, whose ``reasons`` count wherever it is."""
    return [
        str(path.relative_to(SOURCE))
        for path in sorted((SOURCE / "control").glob("*.py"))
        if re.search(r"^class \w+\(Monitor\):", path.read_text(), re.M)
    ]


@cache
def all_sentences() -> set[str]:
    given = {text for file, names in REASONS.items() for text in sentences(file, names)}
    return given | {text for file in monitor_files() for text in sentences(file, {"reasons"})}


def test_the_reasons_of_every_monitor_are_among_them() -> None:
    assert {"control/state_monitor.py", "control/contact.py"} <= {*monitor_files()}


def reasons() -> list[str]:
    """Those that are reasons by themselves: neither names nor the rest of another sentence."""
    return sorted(
        text
        for text in all_sentences()
        if len(text.replace(GAP, " ").split()) >= LEAST_WORDS and not text.startswith(",")
    )


def entries() -> list[str]:
    """The sentences in the first column of the page's tables."""
    return re.findall(r"^\| `(.+?)` \|", PAGE.read_text(), re.M)


def stands_for(entry: str, reason: str) -> bool:
    return entry == reason or (len(entry) >= LEAST_PREFIX and reason.startswith(entry))


def test_every_reason_has_an_entry() -> None:
    lacking = [
        reason for reason in reasons() if not any(stands_for(entry, reason) for entry in entries())
    ]
    assert lacking == []


def test_every_entry_is_a_reason_that_the_code_gives() -> None:
    said = all_sentences() | findings()
    unsaid = [entry for entry in entries() if not any(stands_for(entry, each) for each in said)]
    assert unsaid == []


@cache
def findings() -> set[str]:
    """Names of the errors that a spec or a chunk can have."""
    tree = ast.parse((SOURCE / "control" / "policy_check.py").read_text())
    return {
        str(node.args[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in ("error", "level")
        and isinstance(node.args[0], ast.Constant)
    }


def test_every_error_of_spec_or_chunk_has_an_entry() -> None:
    assert findings() - {*entries()} == set()


@pytest.mark.parametrize("file", REASONS)
def test_the_functions_that_give_reasons_exist(file: str) -> None:
    tree = ast.parse((SOURCE / file).read_text())
    names = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    assert REASONS[file] <= names
