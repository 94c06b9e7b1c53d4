"""Small faults in source text: what can be changed, and a draw of it that a seed decides.

A mutant is known by its file, function and change, not by its line: a seed draws the same ones
after an edit elsewhere.
"""

from __future__ import annotations

import ast
import copy
import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

TURNED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
}
"""Comparison -> with or without its boundary, and its opposite."""
SWAPPED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.BitAnd: ast.BitOr,
}
PAIRS = [("min", "max"), ("minimum", "maximum"), ("any", "all"), ("floor", "ceil"), ("sin", "cos")]
EXCHANGED = dict(PAIRS) | {second: first for first, second in PAIRS}
NUMBERS = {"float", "int", "FloatArray"}
"""Annotations of what can be returned with its sign turned."""
NOT_CODE = (ast.JoinedStr, ast.Import, ast.ImportFrom)
LEFT_OUT = {"annotation", "returns", "decorator_list", "exc", "cause", "msg"}
"""Fields of nodes: types, and messages of errors."""
FOR_READERS = {"__repr__", "__str__"}


@dataclass(frozen=True)
class Place:
    function: str = "module"
    returns: str = ""
    lines: range = range(0)
    """Of the statement, without those of its body."""
    assigned: str = ""
    """What gets its value there."""


@dataclass(frozen=True)
class Mutant:
    file: Path
    """Relative to the root of the tree."""
    place: Place
    change: str
    """Before -> after, and which one where a function has several alike."""
    replaced: slice
    """Of the bytes of the file."""
    text: str

    @property
    def label(self) -> str:
        return f"{self.file.as_posix()} {self.place.function}: {self.change}"

    def rank(self, seed: int) -> str:
        return hashlib.sha256(f"{seed} {self.label}".encode()).hexdigest()

    def of(self, source: bytes) -> bytes:
        """The text of the file with this fault."""
        return source[: self.replaced.start] + self.text.encode() + source[self.replaced.stop :]


def draw(root: Path, folders: Iterable[str], seed: int, number: int) -> list[Mutant]:
    """`number` mutants of the Python files in `folders`, in the order of the draw."""
    files = sorted(file for folder in folders for file in (root / folder).rglob("*.py"))
    found = [mutant for file in files for mutant in mutants_of(root, file.relative_to(root))]
    return sorted(found, key=lambda mutant: mutant.rank(seed))[:number]


def mutants_of(root: Path, file: Path) -> Iterator[Mutant]:
    source = (root / file).read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    seen: Counter[tuple[str, str]] = Counter()
    for node, place, is_test in _nodes(ast.parse(source), Place()):
        for new in _changes(node, place, is_test):
            change = f"{ast.unparse(node)} -> {ast.unparse(new)}"
            seen[place.function, change] += 1
            which = seen[place.function, change]
            text = ast.unparse(new)
            yield Mutant(
                file,
                place,
                change if which == 1 else f"{change} ({which})",
                slice(
                    starts[node.lineno - 1] + node.col_offset,
                    starts[node.end_lineno - 1] + node.end_col_offset,
                ),
                text if isinstance(new, ast.stmt) else f"({text})",
            )


def _nodes(node: ast.AST, place: Place) -> Iterator[tuple[Any, Place, bool]]:
    """All that may be changed, where it stands, and whether it decides a branch."""
    for field, value in ast.iter_fields(node):
        if field in LEFT_OUT or (isinstance(node, ast.ClassDef) and field != "body"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, NOT_CODE):
                continue
            if getattr(child, "name", None) in FOR_READERS:
                continue
            inner = _place(child, place) if isinstance(child, ast.stmt) else place
            if hasattr(child, "lineno"):
                yield child, inner, field in ("test", "ifs")
            yield from _nodes(child, inner)


def _place(node: Any, outer: Place) -> Place:
    inside = [
        child for child in ast.walk(node) if isinstance(child, ast.stmt) and child is not node
    ]
    last = min((child.lineno - 1 for child in inside), default=node.end_lineno)
    place = replace(outer, lines=range(node.lineno, max(last, node.lineno) + 1), assigned="")
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        name = node.name if outer.function == "module" else f"{outer.function}.{node.name}"
        returns = getattr(node, "returns", None)
        return replace(place, function=name, returns=ast.unparse(returns) if returns else "")
    target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
    return replace(place, assigned=target.id) if isinstance(target, ast.Name) else place


def _changes(node: Any, place: Place, is_test: bool) -> Iterator[ast.AST]:
    match node:
        case ast.Compare(ops=[op]):
            for new in TURNED[type(op)]:
                yield _with(node, ops=[new()])
        case ast.BinOp(op=ast.MatMult()):
            yield _with(node, left=node.right, right=node.left)
        case ast.BinOp(op=op) if type(op) in SWAPPED and not _joins_text(node):
            yield _with(node, op=SWAPPED[type(op)]())
        case ast.BoolOp(op=op):
            yield _with(node, op=ast.Or() if isinstance(op, ast.And) else ast.And())
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            yield node.operand
        case ast.Constant(value=bool(value)):
            yield ast.Constant(not value)
        case ast.Constant(value=int(value)):
            yield ast.Constant(value + 1)
        case ast.Constant(value=float(value)):
            yield ast.Constant(2 * value or 1.0)
        case ast.Call(func=ast.Name(id=name)) if name in EXCHANGED:
            yield _with(node, func=_with(node.func, id=EXCHANGED[name]))
        case ast.Call(func=ast.Attribute(attr=name)) if name in EXCHANGED:
            yield _with(node, func=_with(node.func, attr=EXCHANGED[name]))
        case ast.AugAssign(op=op):
            if type(op) in SWAPPED:
                yield _with(node, op=SWAPPED[type(op)]())
            yield ast.Pass()
        case ast.Return(value=ast.expr() as value) if not isinstance(value, ast.Constant):
            if place.returns == "bool" and not _is_turned(value):
                yield _with(node, value=ast.UnaryOp(ast.Not(), value))
            if place.returns in NUMBERS:
                yield _with(node, value=ast.UnaryOp(ast.USub(), value))
        case (
            ast.Expr(value=ast.Call())
            | ast.Assign(targets=[ast.Attribute() | ast.Subscript()])
            | ast.Raise()
            | ast.Continue()
            | ast.Break()
            | ast.Return(value=None)
        ):
            yield ast.Pass()
    if is_test and not _is_turned(node) and not isinstance(node, ast.Constant):
        yield ast.UnaryOp(ast.Not(), node)


def _is_turned(test: ast.expr) -> bool:
    """Whether this test is changed to its opposite already."""
    return isinstance(test, ast.UnaryOp) or (isinstance(test, ast.Compare) and len(test.ops) == 1)


def _joins_text(node: ast.BinOp) -> bool:
    parts = [node.left, node.right]
    return any(isinstance(getattr(part, "value", None), str) for part in parts) or any(
        isinstance(part, ast.JoinedStr) for part in parts
    )


def _with(node: Any, **fields: Any) -> Any:
    new = copy.copy(node)
    for field, value in fields.items():
        setattr(new, field, value)
    return new
