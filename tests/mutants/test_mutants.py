"""The tool that puts faults into the code, on a made package with made tests."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from mutants import ROOT, reviewed
from mutations import Mutant, draw, mutants_of

LIMIT_S = 120
GRACE_S = 6  # of a mutant that hangs; a busy computer takes seconds to begin the others

MADE = '''
"""Tells whether something is > 1."""

import time

LIMIT = 3


def is_over(value: "1 + 1", message: str = f"{2 - 1}") -> bool:
    return value > LIMIT


def count_down(number):
    while number != 0:
        time.sleep(0.001)
        number -= 1
    return number


def unused(left, right):
    if left and right:
        raise ValueError("2 + 2" + "5")
'''
MADE_TESTS = """
from made.amounts import count_down, is_over


def test_four_is_over():
    assert is_over(4)


def test_two_is_not_over():
    assert not is_over(2)


def test_it_ends():
    assert count_down(5) == 0
"""
STRICT = "src/made/amounts.py is_over: value > LIMIT -> value >= LIMIT"


def make(folder: Path) -> Path:
    package = folder / "src" / "made"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "amounts.py").write_text(MADE)
    (folder / "tests").mkdir()
    (folder / "tests" / "test_amounts.py").write_text(MADE_TESTS)
    (folder / "equivalent.txt").write_text("")
    return folder


@pytest.fixture
def made(tmp_path: Path) -> Path:
    return make(tmp_path)


class Tried(NamedTuple):
    """A package all of whose mutants were tried: its folder, the status, and who caught which."""

    root: Path
    status: int
    by: dict[str, str | None]


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> Tried:
    root = make(tmp_path_factory.mktemp("tried"))
    run = mutants(root, "--json", "--grace-s", str(GRACE_S))
    by = {each["mutant"].split(" ", 1)[1]: each["by"] for each in json.loads(run.stdout)}
    return Tried(root, run.returncode, by)


def mutants(root: Path, *options: str) -> subprocess.CompletedProcess[str]:
    program = [sys.executable, str(ROOT / "tests" / "mutants" / "mutants.py"), "--root", str(root)]
    program += ["--of", "src/made", "--tests", "tests", "--equivalent", f"{root}/equivalent.txt"]
    return subprocess.run([*program, *options], capture_output=True, text=True, timeout=LIMIT_S)


def test_what_a_test_notices_is_caught_and_what_none_notices_survives(tried: Tried) -> None:
    assert tried.by["is_over: value > LIMIT -> value >= LIMIT"] is None
    caught = tried.by["is_over: value > LIMIT -> value <= LIMIT"]
    assert caught is not None
    assert caught.startswith("tests/test_amounts.py::test_")
    assert tried.status == 1, "one survived"
    assert (tried.root / "src" / "made" / "amounts.py").read_text() == MADE


def test_a_mutant_that_hangs_is_caught_by_its_time_limit(tried: Tried) -> None:
    told = mutants(tried.root, "--match", "number -= 1 -> pass")
    assert "number -= 1 -> pass  by time limit" in told.stdout
    assert told.returncode == 0


def test_a_constant_of_a_module_is_tried_with_the_tests_of_the_lines_that_name_it(
    tried: Tried,
) -> None:
    assert str(tried.by["module: 3 -> 4"]).startswith("tests/test_")


def test_a_survivor_that_was_reviewed_is_no_fault_and_nothing_is_tried_twice(tried: Tried) -> None:
    (tried.root / "tests" / "test_amounts.py").unlink()
    again = mutants(tried.root, "--match", STRICT)
    assert again.returncode == 1
    assert "1 tried, 0 caught, 0 equivalent, 1 missed" in again.stdout
    (tried.root / "equivalent.txt").write_text(f"# Why\n{STRICT}  # whole numbers\n")
    again = mutants(tried.root, "--match", STRICT)
    assert again.returncode == 0
    assert "1 tried, 0 caught, 1 equivalent, 0 missed" in again.stdout
    assert "equivalent: whole numbers" in again.stdout


def test_a_test_that_fails_without_a_mutant_is_told(made: Path) -> None:
    (made / "tests" / "test_broken.py").write_text("def test_it(): assert 1 == 2\n")
    run = mutants(made)
    assert run.returncode == 1
    assert "test_broken.py fails without a mutant" in run.stderr


def test_texts_types_and_messages_are_left_alone(made: Path) -> None:
    changes = {each.change for each in mutants_of(made, Path("src/made/amounts.py"))}
    assert changes == {
        "3 -> 4",
        "value > LIMIT -> value >= LIMIT",
        "value > LIMIT -> value <= LIMIT",
        "number != 0 -> number == 0",
        "0 -> 1",
        "time.sleep(0.001) -> pass",
        "0.001 -> 0.002",
        "number -= 1 -> number += 1",
        "number -= 1 -> pass",
        "1 -> 2",
        "left and right -> left or right",
        "left and right -> not (left and right)",
        "raise ValueError('2 + 2' + '5') -> pass",
    }


@pytest.mark.parametrize(
    ("line", "changes"),
    [
        ("x = a @ b", {"b @ a"}),
        ("x = a / 2.0", {"a * 2.0", "4.0"}),
        ("x = np.maximum(a, b)", {"np.minimum(a, b)"}),
        ("x = -a", {"a"}),
        ("x = a is None", {"a is not None"}),
        ("self.x = a", {"pass"}),
        ("x = [a for a in b if a]", {"not a"}),
        ("x = 0.0", {"1.0"}),
    ],
)
def test_each_kind_of_change(tmp_path: Path, line: str, changes: set[str]) -> None:
    (tmp_path / "code.py").write_text(line)
    found = list(mutants_of(tmp_path, Path("code.py")))
    assert {each.change.split(" -> ")[1] for each in found} == changes
    for each in found:
        ast.parse(each.of(line.encode()))


def test_a_draw_is_that_of_its_seed_and_outlasts_an_edit_elsewhere(made: Path) -> None:
    def labels(seed: int) -> list[str]:
        return [each.label for each in draw(made, ["src"], seed, 5)]

    before = labels(1)
    assert before != labels(2)
    file = made / "src" / "made" / "amounts.py"
    file.write_text("\n\n# A comment.\n" + file.read_text())
    assert labels(1) == before


def test_every_reviewed_mutant_can_still_be_drawn() -> None:
    def all_of(file: str) -> list[Mutant]:
        return list(mutants_of(ROOT, Path(file)))

    listed = reviewed(ROOT / "tests" / "mutants" / "equivalent.txt")
    known = {each.label for file in {label.split()[0] for label in listed} for each in all_of(file)}
    assert not listed.keys() - known
