"""What ``scripts/house.py`` measures."""

from __future__ import annotations

import importlib.util
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SPEC = importlib.util.spec_from_file_location("house", ROOT / "scripts" / "house.py")
assert SPEC is not None
assert SPEC.loader is not None
house = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(house)

SOURCE = '''"""Of the module."""

LIMIT = 3
"""Of the constant."""


def twice(value):  # a comment
    """Of the function."""
    return 2 * value
'''


def test_tokens_are_those_of_code_without_docstrings_comments_and_line_ends(tmp_path: Path) -> None:
    path = tmp_path / "module.py"
    path.write_text(SOURCE, "utf-8")
    # LIMIT = 3; def twice ( value ) : ; return 2 * value
    assert house.tokens_in(path) == 3 + 6 + 4


def test_constants_are_names_in_capitals_and_conditions_on_the_space_are_counted(
    tmp_path: Path,
) -> None:
    path = tmp_path / "module.py"
    code = "SLOW, FAST = 1, 2\nBOTH: int = 3\nother = 4\n"
    code += "if action.space == 'joint':\n    pass\nwhile other:\n    pass\n"
    path.write_text(code, "utf-8")
    assert house.constants_in(path) == ["SLOW", "FAST", "BOTH"]
    assert house.branches_on_space(path) == 1


def test_modules_that_cannot_be_imported_are_left_out_and_it_says_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "needs.py").write_text("import a_library_that_is_not_there\n", "utf-8")
    assert house.loaded_by(tmp_path, ["needs"], {}) is None
    told = capsys.readouterr().err
    assert "a_library_that_is_not_there" in told
    assert "`make setup`" in told


def test_a_constant_of_the_control_or_the_guard_means_the_same_in_all_their_files() -> None:
    folders = [ROOT / "src/vla_zenoh" / name for name in ("control", "guard")]
    paths = [path for folder in folders for path in folder.glob("*.py")]
    names = Counter(name for path in paths for name in house.constants_in(path))
    assert [name for name, files in names.items() if files > 1] == []


def test_no_two_public_classes_have_one_name() -> None:
    assert house.class_names_twice(house.modules_in(ROOT / "src")) == {}
