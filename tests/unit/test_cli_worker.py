"""vla-zenoh worker: which options a model is made with."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from vla_zenoh.cli.worker import worker

APP = typer.Typer()
APP.command()(worker)

MODEL = """
class Model:
    def __init__(self, a="", b=""):
        raise ValueError(f"made with a={a} b={b}")

    def infer(self, observation): ...
"""


@pytest.mark.parametrize(
    ("given", "made"), [((), "a=lab b=lab"), (("--set", "b=here"), "a=lab b=here")]
)
def test_a_model_gets_the_options_of_its_profile_and_the_command_line_goes_before_them(
    tmp_path: Path, given: tuple[str, ...], made: str
) -> None:
    (tmp_path / "mine.py").write_text(MODEL)
    (tmp_path / "lab.yaml").write_text(
        "extends: panda_sim\nworkers: [scripted, mine]\noptions: {mine: {a: lab, b: lab}}\n"
    )
    words = [str(tmp_path / "mine.py"), "--profile", str(tmp_path / "lab.yaml"), *given]
    assert f"made with {made}" in str(CliRunner().invoke(APP, words).exception)
