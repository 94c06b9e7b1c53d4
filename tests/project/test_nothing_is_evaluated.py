"""Nothing from outside is unpickled, evaluated, or copied unmeasured: read off the code."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = tuple(ROOT / name for name in ("src", "models", "plugins", "scripts", "sim"))
SOURCES = sorted(path for folder in FOLDERS for path in folder.rglob("*.py"))
MODULES = frozenset(
    {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "jsonpickle"}
)
CALLS = frozenset({"eval", "exec", "compile", "__import__", "execfile"})
"""As plain names: ``net.eval()`` and ``re.compile`` are something else."""
SAFE_LOADERS = frozenset({"SafeLoader", "CSafeLoader", "_Reader"})
YAML_LOADS = frozenset({"load", "load_all", "unsafe_load", "full_load", "unsafe_load_all"})
FAULTS = re.compile(
    rf"\b(?<!\.)(?:{'|'.join(MODULES | CALLS)})\b"
    r"|allow_pickle|torch\.load|yaml\.\w*load|os\.(system|popen)|shell="
)
"""Words without which a file has none of the faults."""


def called(node: ast.Call) -> str:
    """``yaml.load`` for ``yaml.load(...)``, ``eval`` for ``eval(...)``."""
    if isinstance(node.func, ast.Attribute):
        owner = node.func.value
        return f"{owner.id if isinstance(owner, ast.Name) else '?'}.{node.func.attr}"
    return node.func.id if isinstance(node.func, ast.Name) else ""


def keyword(node: ast.Call, name: str) -> object:
    """The constant a keyword is given; None without it."""
    for given in node.keywords:
        if given.arg == name and isinstance(given.value, ast.Constant):
            return given.value.value
    return None


def fault(node: ast.AST) -> str:
    """What is wrong with a node; empty: nothing."""
    if isinstance(node, ast.Import):
        named = {alias.name.split(".")[0] for alias in node.names} & MODULES
        return f"imports {', '.join(sorted(named))}" if named else ""
    if isinstance(node, ast.ImportFrom):
        return f"imports {node.module}" if (node.module or "").split(".")[0] in MODULES else ""
    if not isinstance(node, ast.Call):
        return ""
    name = called(node)
    owner, _, function = name.rpartition(".")
    if name in CALLS:
        return f"calls {name}"
    if owner in ("np", "numpy") and function in ("load", "save", "savez"):
        # numpy's own default is the safe one; saying it keeps it so.
        allowed = keyword(node, "allow_pickle")
        return f"calls {name} with allow_pickle" if allowed not in (None, False) else ""
    if name == "torch.load" and keyword(node, "weights_only") is not True:
        return "calls torch.load without weights_only=True"
    if owner == "yaml" and function in YAML_LOADS:
        loader = ast.unparse(node).partition("Loader=")[2].strip(")").split(".")[-1]
        return "" if loader in SAFE_LOADERS else f"calls {name} with the loader {loader!r}"
    if name in ("os.system", "os.popen") or keyword(node, "shell") is True:
        return f"gives words to a shell ({name})"
    return ""


def nodes(text: str, words: re.Pattern[str]) -> Iterator[ast.AST]:
    """Every node of a file that has one of the words: to parse all of them takes seconds."""
    if words.search(text):
        yield from ast.walk(ast.parse(text))


def found(check: Callable[[ast.AST], object], words: re.Pattern[str]) -> list[str]:
    """``file:line: what`` of every node in the sources that `check` says something of."""
    return [
        f"{path}:{getattr(node, 'lineno', 0)}: {said}"
        for path in SOURCES
        for node in nodes(path.read_text("utf-8"), words)
        if (said := check(node))
    ]


def test_nothing_is_unpickled_evaluated_or_given_to_a_shell() -> None:
    assert len(SOURCES) > 100
    assert found(fault, FAULTS) == []


TAKING = frozenset({"to_bytes", "to_string"})
TAKEN = re.compile("|".join(TAKING))


def taken(node: ast.AST) -> bool:
    """Whether bytes are taken out of Zenoh's hands. Those of an arrival came through a slot, which
    has looked at their number."""
    if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
        return False
    owner = ast.unparse(node.func.value)
    of_zenoh = owner.endswith((".payload", "attachment"))
    return node.func.attr in TAKING and of_zenoh and "arrival.sample" not in owner


def test_bytes_are_taken_only_where_their_number_is_looked_at() -> None:
    assert found(taken, TAKEN) == []  # they are taken by `bytes_of` of buffers.py


@pytest.mark.parametrize("text", ["sample.payload.to_bytes()", "attachment.to_bytes()"])
def test_the_check_sees_what_is_taken(text: str) -> None:
    assert any(map(taken, nodes(text, TAKEN)))


@pytest.mark.parametrize(
    "text",
    [
        "import pickle",
        "from pickle import loads",
        "import joblib.memory",
        "eval(words)",
        "exec(words)",
        "__import__(name)",
        "np.load(path, allow_pickle=True)",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "yaml.load(text, Loader=yaml.Loader)",
        "yaml.unsafe_load(text)",
        "os.system(words)",
        "subprocess.run(words, shell=True)",
    ],
)
def test_the_check_sees(text: str) -> None:
    assert any(map(fault, nodes(text, FAULTS)))


@pytest.mark.parametrize(
    "text",
    [
        "Network(weights).eval()",
        "re.compile(words)",
        "np.load(path)",
        "torch.load(path, weights_only=True)",
        "yaml.compose(text, Loader=_Reader)",
        "yaml.load(text, Loader=yaml.SafeLoader)",
        "yaml.safe_load(text)",
    ],
)
def test_the_check_lets_pass(text: str) -> None:
    assert not any(fault(node) for node in ast.walk(ast.parse(text)))
