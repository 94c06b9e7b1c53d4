"""What ``import vla_zenoh`` gives, and the examples that use it."""

from __future__ import annotations

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from chain import command_line

import vla_zenoh
from vla_zenoh.policy.loader import find_model, make_policy

ROOT = Path(__file__).parents[2]
HOME_M, STEP_M = 0.16, 0.01
"""Height of the TCP at home, and a step of the example's model."""
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.mark.parametrize("name", vla_zenoh.__all__)
def test_a_public_name_is_there_and_says_what_it_is(name: str) -> None:
    found = getattr(vla_zenoh, name)
    assert found.__doc__
    assert name in dir(vla_zenoh)


def test_a_name_that_is_not_public_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'conect'"):
        _ = vla_zenoh.conect


def test_types_and_modules_export_the_same_names() -> None:
    """What a type checker sees is what Python finds."""
    tree = ast.parse(Path(vla_zenoh.__file__).read_text("utf-8"))
    (checked,) = [node for node in tree.body if isinstance(node, ast.If)]
    names = {
        alias.name: node.module
        for node in checked.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    found = {name: getattr(vla_zenoh, name) for name in names}
    assert found == {name: getattr(import_module(str(m)), name) for name, m in names.items()}
    assert sorted(names) == sorted(vla_zenoh.__all__)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_an_example_is_in_the_table_of_the_docs(path: Path) -> None:
    text = (ROOT / "docs" / "how-to" / "python.md").read_text("utf-8")
    assert f"`examples/{path.name}`" in text


def test_the_loop_in_one_process_is_short_and_lifts_the_arm_by_a_centimetre_a_step() -> None:
    path = ROOT / "examples" / "in_one_process.py"
    assert len(path.read_text("utf-8").splitlines()) <= 80
    done = subprocess.run(
        [sys.executable, path], capture_output=True, text=True, check=True, timeout=120
    )
    *heights_m, unit = done.stdout.split()
    assert unit == "m"
    rises_m = np.diff([float(height_m) for height_m in heights_m])
    assert float(heights_m[0]) == pytest.approx(HOME_M, abs=0.001)
    assert rises_m[0] == pytest.approx(0.0, abs=0.001)  # it is not activated before the first chunk
    assert rises_m[2:] == pytest.approx(STEP_M, abs=0.002)


def test_the_model_of_the_loop_is_found_as_a_file() -> None:
    policy = make_policy(find_model(str(ROOT / "examples" / "ten_line_model.py")))
    assert policy.spec.name == "lift"


def test_the_python_robot_moves() -> None:
    profile = str(ROOT / "examples" / "python_robot.yaml")
    done = command_line("check", "scripted", "--profile", profile)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_reference_pages_are_those_of_the_code() -> None:
    done = subprocess.run(
        [sys.executable, ROOT / "scripts" / "reference.py", "--check"],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
