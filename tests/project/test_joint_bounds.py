"""Joints turn or slide: no number in radians is a bound of both."""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

from vla_zenoh.types import JointBound

ROOT = Path(__file__).parents[2]
FOLDERS = [ROOT / "src", *sorted(ROOT.glob("plugins/*/src"))]
SOURCES = [
    (folder, file)
    for folder in FOLDERS
    for file in sorted(folder.rglob("*.py"))
    if re.search(r"np\.abs|JointBound\(", file.read_text())
]
LEAST_M, MOST_M = 0.15, 0.55
"""For each rad: between the bounds of a pose that there are."""
RADIANS = re.compile(r"(^|_)RAD(_S)?$|_rad$")
TURNING = {
    "impedance.py: SAME_RAD": "an inertia is the same nearer than this, m or rad",
    "joint_follower.py: ROUNDING_RAD_S": "rounding, of either",
    "answer.py: ARRIVED_RAD": "R2C has no joints that slide",
    "served_policy.py: TURN_RAD": "of joints that turn without an end",
    "bounds.py: NEAR_RAD": "all joints of this maker turn",
}
"""What is compared with joints that turn, or whose unit does not matter."""


def test_a_slide_has_the_metres_that_a_pose_has_beside_its_radians() -> None:
    bounds = [
        (f"{file.name}: {name}", value)
        for folder, file in SOURCES
        if "JointBound(" in file.read_text() and file.name != "joint_bound.py"
        for name, value in vars(
            importlib.import_module(".".join(file.relative_to(folder).with_suffix("").parts))
        ).items()
        if isinstance(value, JointBound)
    ]
    assert len(bounds) > 10
    wrong = [where for where, each in bounds if not LEAST_M <= each.slides / each.turns <= MOST_M]
    assert wrong == []


def parts(function: ast.AST, side: ast.expr) -> Iterator[ast.AST]:
    """The nodes of an expression, and of what its names were assigned in the function."""
    known: dict[str, list[ast.expr]] = {}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            known.setdefault(node.targets[0].id, []).append(node.value)
    waiting, seen = [side], set[str]()
    while waiting:
        for node in ast.walk(waiting.pop()):
            yield node
            if isinstance(node, ast.Name) and node.id not in seen:
                seen.add(node.id)
                waiting += known.get(node.id, [])


def radians(nodes: list[ast.AST]) -> set[str]:
    """Constants and limits in radians, unless they are one of two."""
    if any(isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "of" for node in nodes):
        return set()
    names = {node.id for node in nodes if isinstance(node, ast.Name) and node.id.isupper()}
    names |= {
        node.attr
        for node in nodes
        if isinstance(node, ast.Attribute) and "limits" in ast.unparse(node.value)
    }
    return {name for name in names if RADIANS.search(name)}


def sizes(nodes: list[ast.AST]) -> bool:
    """Whether absolute values of an array are among them."""
    return any(isinstance(node, ast.Call) and ast.unparse(node.func) == "np.abs" for node in nodes)


def in_radians(file: Path) -> set[str]:
    """Numbers in radians that a file compares with absolute values of an array."""
    found = set[str]()
    for function in ast.walk(ast.parse(file.read_text())):
        for node in ast.walk(function) if isinstance(function, ast.FunctionDef) else ():
            if isinstance(node, ast.Compare) and len(node.comparators) == 1:
                sides = [list(parts(function, side)) for side in (node.left, *node.comparators)]
                one, other = sides if sizes(sides[0]) else sides[::-1]
                if sizes(one) and not sizes(other):
                    found |= radians(other)
    return {f"{file.name}: {name}" for name in found}


def test_no_number_in_radians_is_a_bound_of_joints_of_which_some_may_slide() -> None:
    assert set().union(*(in_radians(file) for _, file in SOURCES)) == TURNING.keys()
