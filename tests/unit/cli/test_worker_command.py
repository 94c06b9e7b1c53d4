"""vla-zenoh worker, check, serve: which model is made, and with which options."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner
from vla_zenoh_serve.cli import serve

from vla_zenoh.cli.nodes import worker
from vla_zenoh.lab.cli.check import check
from vla_zenoh.profile import load_profile
from vla_zenoh.runtime.launch import node_commands
from vla_zenoh.security.roles import identities

APP = typer.Typer()
APP.command()(worker)

MODEL = """
class Model:
    def __init__(self, a="", b=""):
        raise ValueError(f"made with a={a} b={b}")

    def infer(self, observation): ...
"""


def said(command: Any, *words: str, **environment: str) -> str:
    """What a command says of the model that it makes."""
    app = typer.Typer()
    app.command()(command)
    done = CliRunner().invoke(app, [*words], env=environment)
    return f"{done.output} {done.exception}"


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


@pytest.fixture
def lab(tmp_path: Path) -> str:
    """A profile whose worker `low` runs a file beside it."""
    (tmp_path / "mine.py").write_text(MODEL)
    path = tmp_path / "lab.yaml"
    path.write_text(
        "extends: panda_sim\nworkers: [scripted, low]\nmodels: {low: mine.py}\n"
        "options: {low: {a: lab}}\n"
    )
    return str(path)


def test_a_worker_of_the_profile_runs_its_model_with_its_options(lab: str) -> None:
    assert "made with a=lab b=" in said(worker, "low", "--profile", lab)
    assert "made with a= b=here" in said(
        worker, "low", "--name", "other", "--set", "b=here", "--profile", lab
    )


def test_check_knows_it_too_and_takes_the_profile_of_the_environment(
    lab: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended: list[int] = []
    monkeypatch.setattr(os, "_exit", ended.append)
    assert "made with a=lab b=" in said(check, "low", "--profile", lab)
    assert "made with a=lab b=" in said(check, "low", VLA_ZENOH_PROFILE=lab)
    assert ended == [1, 1]
    assert "no model called 'low'" in said(check, "low")


def test_serve_knows_it_too(lab: str) -> None:
    assert "made with a=lab b=here" in said(
        serve, "--worker", "low", "--set", "b=here", "--profile", lab
    )


def test_a_worker_of_the_profile_has_its_command_line_and_certificate_by_its_name(
    lab: str,
) -> None:
    profile = load_profile(lab)
    commands = node_commands(profile, "here", Path(lab))
    assert ("worker", "low", "--profile", lab, "--host", "here") in [
        each.arguments for each in commands
    ]
    names = {each.common_name: each.worker for each in identities(profile)}
    assert names["worker-low@here"] == "low"
