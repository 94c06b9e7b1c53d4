"""Kinds of bad messages, searched for in all of the code."""

from __future__ import annotations

import ast
import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel, ValidationError
from pydantic_core import PydanticKnownError
from pydantic_core.core_schema import ErrorType

from vla_zenoh import errors
from vla_zenoh.errors import describe_fault, in_words, nearest
from vla_zenoh.policy import ActionSpec, ModelSpec, ObservationSpec
from vla_zenoh.profile import Profile

ROOT = Path(__file__).parents[2]
SOURCES = [
    path for folder in ("src", "models", "plugins") for path in (ROOT / folder).rglob("*.py")
]
TRAINING = {"training", "measure.py"}
RAW = re.compile(r"https?://|errors\.pydantic|Input should|unable to parse|type=")


def nodes_with(word: str) -> Iterator[tuple[Path, ast.AST]]:
    """Every node of the files that have the word."""
    for path in SOURCES:
        if word in (text := path.read_text()):
            yield from ((path, node) for node in ast.walk(ast.parse(text)))


def broad_handlers() -> Iterator[tuple[str, ast.ExceptHandler]]:
    """``except Exception as error`` and broader, with their file and line."""
    for path, node in nodes_with("Exception"):
        if TRAINING & set(path.parts):
            continue
        if not isinstance(node, ast.ExceptHandler) or node.name is None:
            continue
        caught = ast.unparse(node.type) if node.type else ""
        if re.search(r"\b(Base)?Exception\b", caught):
            yield f"{path.relative_to(ROOT)}:{node.lineno}", node


def test_faults_of_pydantic_are_put_into_words_in_one_place() -> None:
    own = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path, node in nodes_with("msg")
        if path != Path(errors.__file__)
        if isinstance(node, ast.FormattedValue)
        and isinstance(node.value, ast.Subscript)
        and ast.unparse(node.value.slice) == "'msg'"
    ]
    assert not own, f"use describe_faults(error, ...) in: {own}"


def test_what_another_library_raises_is_put_into_words_before_it_is_shown() -> None:
    raw = [
        where
        for where, handler in broad_handlers()
        for node in ast.walk(handler)
        if isinstance(node, ast.FormattedValue)
        and isinstance(node.value, ast.Name)
        and node.value.id == handler.name
    ]
    assert not raw, f"write in_words({{error}}) in: {raw}"


def faults_without_context() -> list[dict[str, Any]]:
    """One fault of every type that Pydantic can find in plain numbers, texts and lists."""
    found: list[dict[str, Any]] = []
    for kind in get_args(ErrorType):
        with contextlib.suppress(TypeError):  # it wants a context
            said = PydanticKnownError(kind).message()
            found.append({"type": kind, "msg": said, "input": "abc"})
    return [fault for fault in found if not fault["type"].startswith("complex")]


def test_no_fault_is_told_in_the_words_of_pydantic() -> None:
    said = {fault["type"]: describe_fault(fault) for fault in faults_without_context()}
    assert {kind: text for kind, text in said.items() if RAW.search(text)} == {}


def sections(model: type[BaseModel], seen: set[type[BaseModel]]) -> set[type[BaseModel]]:
    if model not in seen:
        seen.add(model)
        for field in model.model_fields.values():
            for each in _classes(field.annotation):
                sections(each, seen)
    return seen


def _classes(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _classes(argument)


MODELS = sorted(
    {model for root in (Profile, ModelSpec) for model in sections(root, set())},
    key=lambda model: model.__name__,
)


@pytest.mark.parametrize("given", [object(), "x", -1e9, None, True, [1], {"nosuch": 1}])
def test_every_field_says_what_it_wants_in_plain_words(given: object) -> None:
    for model in MODELS:
        with pytest.raises(ValidationError) as caught:
            model.model_validate(dict.fromkeys([*model.model_fields, "nosuch"], given))
        said = in_words(caught.value)
        assert said.startswith(f"{model.__name__} is wrong: ")
        assert not RAW.search(said)


def test_a_value_that_is_wrong_is_shown() -> None:
    with pytest.raises(ValidationError) as caught:
        ActionSpec(horizon="8", dt_s=0.1)  # pyright: ignore[reportArgumentType]
    assert in_words(caught.value) == (
        "ActionSpec is wrong: horizon: wants a whole number (given: '8')"
    )


def test_joints_as_an_action_are_answered_by_what_to_do() -> None:
    with pytest.raises(ValidationError) as caught:
        ActionSpec(horizon=1, dt_s=0.1, kind="joint_position")  # pyright: ignore
    assert "declared as space='joint' with joints=" in in_words(caught.value)
    with pytest.raises(ValidationError) as caught:
        ObservationSpec(state=("joints",))  # pyright: ignore[reportArgumentType]
    assert "did you mean 'joint'?" in in_words(caught.value)


def test_advice_to_run_what_a_file_of_weights_contains_is_not_repeated() -> None:
    torch = RuntimeError(
        "Weights only load failed. Re-running `torch.load` with `weights_only` set to `False` will "
        "likely succeed, but it can result in arbitrary code execution"
    )
    said = in_words(torch)
    assert "False" not in said
    assert "loading those runs code from the file. Convert it to safetensors" in said


def test_an_error_of_a_library_keeps_its_name_and_its_file() -> None:
    assert in_words(KeyError("spec")) == "KeyError: there is no 'spec'"
    assert in_words(ValueError("x" * 5000)).endswith("xxx ...")
    assert in_words(FileNotFoundError(2, "No such file or directory", "w.pt")) == (
        "w.pt: No such file or directory"
    )
    assert in_words(errors.SpecError("ours, as it is")) == "ours, as it is"


def test_a_near_name_or_a_full_stop_stands_before_the_list_of_what_is_known() -> None:
    assert nearest("frnt", ["front"]) == "; did you mean 'front'?"
    assert nearest("x", ["front"]) == "."
    for path in SOURCES:
        for found in re.finditer(r"[^.?:}\s\"'] Known(?: here)?: ", path.read_text()):
            pytest.fail(f"{path}: no full stop before {found.group()!r}")


COUNTED = re.compile(r"\{(?:len\([a-z_.]+\)|errors|warnings|episodes|faults)\} [a-z]+s\b(?! of)")


def test_one_of_a_thing_is_not_told_in_the_plural() -> None:
    shown = [
        *(ROOT / "src/vla_zenoh/cli").glob("*.py"),
        *(ROOT / "src/vla_zenoh/lab/cli").glob("*.py"),
    ]
    found = [
        f"{path.name}: {match.group()}"
        for path in shown
        for match in COUNTED.finditer(path.read_text())
        if "bytes" not in match.group()
    ]
    assert not found, f"use counted(): {found}"
