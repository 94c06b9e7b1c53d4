"""The environment of a model follows its options: LeRobot's extra of a policy's type."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from vla_zenoh.errors import WorkerError
from vla_zenoh.policy.loader import find_model

EXTRAS = {
    **dict.fromkeys(("act", "tdmpc", "vqbet"), ""),
    **dict.fromkeys(("pi0", "pi05", "pi0_fast"), "[pi]"),
    "diffusion": "[diffusion]",
    "smolvla": "[smolvla]",
    "multi_task_dit": "[multi-task-dit]",
    "wall_x": "[wallx]",
    "xvla": "[xvla]",
    "groot": "[groot]",
    "a_plug_in": "",
}


@pytest.mark.parametrize("kind", EXTRAS)
def test_a_policy_brings_what_its_type_needs(kind: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"type": kind}))
    model = find_model("lerobot").for_options({"checkpoint": str(tmp_path)})
    assert model.dependencies[-1] == f"lerobot{EXTRAS[kind]}==0.6.1"


@pytest.mark.parametrize("text", [None, "{", "{}", "[]", '{"type": 1}'])
def test_what_is_no_policy_is_left_to_the_model_to_report(text: str | None, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / "config.json").write_text(text)
    model = find_model("lerobot")
    assert model.for_options({"checkpoint": str(tmp_path)}) == model
    assert model.for_options({}) == model


def test_other_models_have_what_their_header_says() -> None:
    for name in ("scripted", "openvla"):
        assert find_model(name).for_options({"a": "b"}) == find_model(name)


def test_an_environment_file_that_fails_is_named(tmp_path: Path) -> None:
    (tmp_path / "model.py").write_text("")
    (tmp_path / "environment.py").write_text("def dependencies(options): return options['a']")
    with pytest.raises(WorkerError, match=r"environment\.py: dependencies failed"):
        find_model(str(tmp_path)).for_options({})
